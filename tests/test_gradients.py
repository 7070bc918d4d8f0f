"""Derivatives of exact coverage: forward = reverse, both = central differences of the oracle."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
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
    scene = pj.Scene(mesh=mesh)

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
    np.testing.assert_allclose(
        found, expected, atol=1e-6 * max(np.abs(expected).max(), 1e-3 * scale)
    )
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
        np.testing.assert_allclose(found[vertex], expected, atol=1e-6 * np.abs(found).max())


def test_gradient_by_all_vertices_is_minus_the_camera_s(gradients):
    along = np.asarray(gradients[1].mesh.vertices).sum(axis=0)
    camera = np.asarray(gradients[0].e) + np.asarray(gradients[0].p)
    np.testing.assert_allclose(along, -camera, rtol=1e-10)


@pytest.mark.full
def test_image_jacobian_equals_per_pixel_differences(mesh):
    scene = pj.Scene(mesh=mesh)
    image = lambda e: pj.silhouette(with_value(CAMERA, "e", e), scene)
    jacobian = jax.jit(jax.jacfwd(image))(CAMERA.e)
    oracle = lambda e: mesh_coverage(with_value(CAMERA, "e", e), mesh.vertices, mesh.faces)
    expected = central_difference(oracle, CAMERA.e, 1e-6)
    # Where the contour passes a pixel's corner within the step the difference is of first order.
    error = np.abs(np.asarray(jacobian) - expected).max(axis=2)
    assert np.quantile(error, 0.99) < 1e-6
    assert error.max() < 1e-3


@pytest.mark.long
def test_forward_and_reverse_agree(mesh):
    spheres = pj.Spheres([[1.2, 0.9, 0]], [0.3])
    scene = pj.Scene(mesh=mesh, spheres=spheres)
    moving, still = eqx.partition((CAMERA, scene), eqx.is_inexact_array)
    random = np.random.default_rng(1)
    direction = jax.tree.map(lambda x: jnp.asarray(random.normal(size=x.shape)), moving)

    def loss(moving):
        # Where nothing overlaps; test_overlaps does it with unions.
        image = pj.silhouette(*eqx.combine(moving, still), overlaps=False)
        return jnp.sum(jnp.asarray(WEIGHT) * image)

    _, forward = jax.jit(lambda m, d: jax.jvp(loss, (m,), (d,)))(moving, direction)
    reverse = jax.grad(loss)(moving)
    products = jax.tree.map(lambda a, b: jnp.sum(a * b), reverse, direction)
    total = sum(float(x) for x in jax.tree.leaves(products))
    np.testing.assert_allclose(forward, total, rtol=1e-10)
    assert abs(total) > 1


@pytest.mark.long
def test_sphere_gradients_equal_central_differences():
    # Three spheres apart; differences of the image itself, which test_silhouette proves.
    centers = np.array([[-0.9, 0.3, 0], [0.5, -0.7, 1], [0.6, 0.6, -1]])
    radii = np.array([0.4, 0.15, 0.35])

    def loss(e, phi, centers, radii):
        camera = eqx.tree_at(lambda c: (c.e, c.phi), CAMERA, (e, phi))
        return jnp.sum(
            jnp.asarray(WEIGHT)
            * pj.silhouette(camera, pj.Scene(spheres=pj.Spheres(centers, radii)), overlaps=False)
        )

    compiled = jax.jit(loss)
    values = [np.asarray(CAMERA.e), np.asarray(CAMERA.phi), centers, radii]
    found = jax.jit(jax.grad(loss, argnums=(0, 1, 2, 3)))(*values)
    for k, slope in enumerate(found):

        def at(x, k=k):
            return compiled(*(jnp.asarray(x if n == k else v) for n, v in enumerate(values)))

        expected = central_difference(at, values[k], 1e-6)
        np.testing.assert_allclose(slope, expected, atol=2e-5 * np.abs(expected).max())


def test_frozen_leaves_cost_no_derivative(mesh):
    """What does not move has no entries in the library's push: its derivative is not computed."""
    if not is_available():
        pytest.skip("there is no compiled library")
    scene = pj.Scene(mesh=mesh)

    def moving_arrays(function, x):
        jaxpr = jax.make_jaxpr(lambda x: jax.jvp(function, (x,), (x,)))(x)
        equations = [*jaxpr.jaxpr.eqns]
        for equation in equations:
            if equation.params.get("target_name") == "pinhole_image_push":
                return [x.aval.shape for x in equation.invars[-4:] if x.aval.size]
            for value in equation.params.values():
                for part in jax.tree.leaves(value, is_leaf=lambda v: hasattr(v, "jaxpr")):
                    inner = getattr(part, "jaxpr", part)
                    equations += getattr(inner, "eqns", [])
        raise AssertionError("no push")

    phi = lambda x: pj.silhouette(with_value(CAMERA, "phi", x), scene)
    assert moving_arrays(phi, CAMERA.phi) == [(18,)]
    turn = lambda x: pj.silhouette(with_value(CAMERA, "e", x), scene)
    assert moving_arrays(turn, CAMERA.e) == [(18,)]
    everything = lambda c: pj.silhouette(c, scene)
    assert moving_arrays(everything, CAMERA) == [(18,)]
    moving = lambda x: pj.silhouette(x[0], pj.Scene(mesh=pj.Mesh(x[1], mesh.faces)))
    assert moving_arrays(moving, (CAMERA, mesh.vertices)) == [(18,), mesh.vertices.shape]


@pytest.mark.long
def test_second_derivatives_are_refused(mesh):
    scene = pj.Scene(mesh=mesh)
    loss = lambda phi: jnp.sum(pj.silhouette(with_value(CAMERA, "phi", phi), scene) ** 2)
    with pytest.raises(NotImplementedError, match="differentiated once"):
        jax.hessian(loss)(CAMERA.phi)
