"""Derivatives of exact coverage: forward = reverse, both = central differences of the oracle."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import body, central_difference, coverage, normal, usual_camera
from slopes import gradients

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._native.library import is_available

W, H = 24, 20
CAMERA = usual_camera(W, H).replace(d=1.3)
WEIGHT = normal((H, W))


MESH = shapes.bumpy(2, bumps=0.02)


@pytest.fixture(scope="module")
def found():
    return gradients(CAMERA, pj.Scene(MESH), jnp.asarray(WEIGHT))


def weighted(camera, mesh):
    return np.sum(WEIGHT * coverage(camera, pj.Scene(mesh)))


@pytest.mark.parametrize("name", ["e", "p", "u", "phi", "d"])
def test_camera_gradient_equals_central_differences_of_the_polygon_union(found, name):
    oracle = lambda value: weighted(CAMERA.replace(**{name: value}), MESH)
    expected = central_difference(oracle, getattr(CAMERA, name))
    # 1e-6 relative, of each parameter's own gradient; d moves nothing.
    close = 0 if name == "d" else 1e-6 * np.abs(expected).max()
    assert_allclose(getattr(found[0], name), expected, atol=close)


def test_vertex_gradient_equals_central_differences_of_the_polygon_union(found):
    slopes = np.asarray(found[1].mesh.vertices)
    order = np.argsort(-np.abs(slopes).max(axis=1))
    for vertex in (*order[:4], order[40]):
        moved = lambda x, k=vertex: pj.Mesh(MESH.vertices.at[k].set(x), MESH.faces)
        oracle = lambda x, moved=moved: weighted(CAMERA, moved(x))
        expected = central_difference(oracle, MESH.vertices[vertex])
        assert_allclose(slopes[vertex], expected, atol=1e-6 * np.abs(slopes).max())


def test_frozen_leaves_cost_no_derivative():
    """Nothing that does not move enters the library's push."""
    if not is_available():
        pytest.skip("there is no compiled library")

    def pushed(function, x):
        """The sizes of the moving arrays: film, lens, vertices and spheres."""
        text = jax.jit(lambda x: jax.jvp(function, (x,), (x,))).lower(x).as_text()
        (taken,) = re.findall(r"@pinhole_image_push.* : \((.*)\) ->", text)
        return [x for x in re.findall(r"tensor<([\dx]*)xf64>", taken)[-4:] if x[0] != "0"]

    phi = lambda x: pj.silhouette(CAMERA.replace(phi=x), pj.Scene(MESH))
    assert pushed(phi, CAMERA.phi) == ["18"]
    moving = lambda x: pj.silhouette(x[0], body(x[1], MESH.faces))
    assert pushed(moving, (CAMERA, MESH.vertices)) == ["18", "162x3"]
