"""Derivatives of exact coverage: forward = reverse, both = central differences of the oracle."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import central_difference, mesh_coverage

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._native.library import is_available

W, H = 24, 20
CAMERA = pj.Camera([0.3, 1.0, 5.0], [0.1, 0, 0], [0.2, 1, 0.1], 0.6, 1.3, W, H)
WEIGHT = np.random.default_rng(0).normal(size=(H, W))


@pytest.fixture(scope="module")
def mesh():
    return shapes.bumpy(2, bumps=0.02)


@pytest.fixture(scope="module")
def gradients(mesh):
    scene = pj.Scene(mesh)

    def loss(moving):
        return jnp.sum(jnp.asarray(WEIGHT) * pj.silhouette(*moving))

    return eqx.filter_jit(eqx.filter_grad(loss))((CAMERA, scene))


def with_value(camera, name, value):
    return eqx.tree_at(lambda c: getattr(c, name), camera, jnp.asarray(value))


@pytest.mark.parametrize("name", ["e", "p", "u", "phi", "d"])
def test_camera_gradient_equals_central_differences_of_the_polygon_union(mesh, gradients, name):
    def oracle(value):
        return np.sum(
            WEIGHT * mesh_coverage(with_value(CAMERA, name, value), mesh.vertices, mesh.faces)
        )

    found = np.asarray(getattr(gradients[0], name))
    expected = central_difference(oracle, np.asarray(getattr(CAMERA, name)))
    scale = np.abs(np.asarray(gradients[0].phi))
    assert np.all(np.isfinite(found))
    # 1e-6 relative, of each parameter's own gradient; d moves nothing.
    assert_allclose(found, expected, atol=1e-6 * max(np.abs(expected).max(), 1e-3 * scale))
    if name == "d":
        assert float(found) == 0


def test_vertex_gradient_equals_central_differences_of_the_polygon_union(mesh, gradients):
    found = np.asarray(gradients[1].mesh.vertices)
    order = np.argsort(-np.abs(found).max(axis=1))
    vertices = np.asarray(mesh.vertices)
    for vertex in (*order[:4], order[40]):

        def oracle(value, vertex=vertex):
            moved = vertices.copy()
            moved[vertex] = value
            return np.sum(WEIGHT * mesh_coverage(CAMERA, moved, mesh.faces))

        expected = central_difference(oracle, vertices[vertex])
        assert_allclose(found[vertex], expected, atol=1e-6 * np.abs(found).max())


def test_frozen_leaves_cost_no_derivative(mesh):
    """Nothing that does not move enters the library's push."""
    if not is_available():
        pytest.skip("there is no compiled library")

    def pushed(function, x):
        """The sizes of the moving arrays: film, lens, vertices and spheres."""
        text = jax.jit(lambda x: jax.jvp(function, (x,), (x,))).lower(x).as_text()
        (taken,) = re.findall(r"@pinhole_image_push.* : \((.*)\) ->", text)
        return [x for x in re.findall(r"tensor<([\dx]*)xf64>", taken)[-4:] if x[0] != "0"]

    phi = lambda x: pj.silhouette(with_value(CAMERA, "phi", x), pj.Scene(mesh))
    assert pushed(phi, CAMERA.phi) == ["18"]
    moving = lambda x: pj.silhouette(x[0], pj.Scene(pj.Mesh(x[1], mesh.faces)))
    assert pushed(moving, (CAMERA, mesh.vertices)) == ["18", "162x3"]
