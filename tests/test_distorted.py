"""Silhouettes under lens distortion against polygons whose sides have many corners."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chosen import first
from folders import in_trimesh
from jax.flatten_util import ravel_pytree
from numpy.testing import assert_allclose
from oracles import body, coverage, lump, off
from slopes import both_ways

import pinhole_jax as pj

W, H = 24, 18
BROWN = pj.BrownConrady(-0.2, 0.05, 4e-3, -3e-3, 0.004)
FISHEYE = pj.Fisheye(-0.02, 0.006, -0.002, 0.0003)
CUSHION = pj.BrownConrady(0.25, 0.1, -3e-3, 2e-3)


def camera(model, phi, distance=3.0):
    lens = pj.Lens([W * 0.53, H * 0.46], 1.04, model)
    return pj.Camera([0.4, 0.3, distance], [0.1, 0.05, 0], [0.1, 1, 0], phi, 1.0, W, H, lens)


def sheet(size=1.0):
    """Return two long triangles, whose edges bend, and one before them."""
    vertices = [
        [-2, -1, 0], [2.2, -1.1, 0.2], [2, 1.2, 0], [-2, 1, -0.3], [0, -3, 0.6], [0.5, 2.5, 1]
    ]  # fmt: skip
    return pj.Mesh(size * np.array(vertices), [[0, 1, 2], [0, 2, 3], [4, 5, 0]])


CASES = {
    "brown": (BROWN, 1.1),
    "cushion": (CUSHION, 0.9),
    "fisheye": (FISHEYE, 1.25),
    "strong": (pj.BrownConrady(-0.32), 0.7),
}
silhouette = jax.jit(pj.silhouette)


@pytest.mark.parametrize("case", first(1, CASES, of=2))
def test_coverage_is_that_of_the_bent_triangles(case):
    view, mesh = camera(*CASES[case]), sheet()
    image = silhouette(view, pj.Scene(mesh))
    expected = coverage(view, pj.Scene(mesh))
    assert np.sum((expected > 0) & (expected < 1)) > 20
    assert_allclose(image, expected, atol=1.5e-3)
    assert np.sqrt(np.mean((image - expected) ** 2)) < 3e-4


def test_scene_through_the_eye_plane_is_clipped():
    """The far ends lie behind: what is seen is cut off where the lens sees no more."""
    view, mesh = camera(*CASES["brown"], distance=0.7), sheet(3.0)
    image = silhouette(view, pj.Scene(mesh))
    v = np.asarray(pj.camera_basis(view).v)
    whole = in_trimesh(mesh)
    ahead = whole.slice_plane(np.asarray(view.e) + 0.02 * v, v)
    assert_allclose(image, coverage(view, body(ahead)), atol=5e-3)


BALLS = pj.Spheres([[0.3, 0.2, 0.1], [-0.5, -0.3, 0.5], [1.2, -0.6, 0.2]], [0.5, 0.3, 0.4])


@pytest.mark.full
@pytest.mark.parametrize("case", ["brown", "fisheye"])
def test_spheres_are_the_bent_images_of_their_rims(case):
    view, scene = camera(*CASES[case]), pj.Scene(spheres=BALLS)
    assert_allclose(silhouette(view, scene), coverage(view, scene), atol=1.5e-3)


@pytest.mark.full
def test_derivatives_are_differences_of_the_oracle():
    """In all of the camera, its lens too, the vertices and the spheres."""
    rng = np.random.default_rng(3)
    up = rng.normal(size=(H, W))
    corners = jnp.array([[-2.0, -1, 0], [2.2, -1.1, 0.2], [0.2, 1.2, 0]])
    start = camera(*CASES["brown"]), corners, pj.Spheres([[0.1, 0.9, 0.3]], [0.5])
    flat, unravel = ravel_pytree(start)

    def loss(x, image):
        view, vertices, spheres = unravel(jnp.asarray(x))
        return jnp.sum(up * image(view, pj.Scene(pj.Mesh(vertices, [[0, 1, 2]]), spheres)))

    ours = partial(both_ways, partial(loss, image=pj.silhouette))
    _, forward, gradient = jax.jit(ours)(flat, jnp.ones_like(flat), 1.0)
    assert np.all(np.isfinite(gradient))
    assert_allclose(forward, np.sum(gradient), rtol=1e-9)
    # The lens's coefficients one by one (all else costs the oracle minutes), then all at once.
    ways = np.concatenate([np.eye(len(flat))[14:19], rng.normal(size=(3, len(flat)))])
    along = lambda t: [loss(flat + t * way, coverage) for way in ways]
    expected = (np.array(along(1e-4)) - along(-1e-4)) / 2e-4
    assert_allclose(ways @ gradient, expected, rtol=5e-3, atol=5e-3 * np.abs(expected).max())


@pytest.fixture(scope="module")
def fitted():
    """Return scene, truth, mask, start, and the fit of pose and k1 to the exact mask."""
    scene = lump(2)
    start = pj.Camera([0.5, 0.2, 3.3], [0.05, 0, 0], [0, 1, 0.1], 0.7, W=96, H=72)
    lens = pj.Lens([48, 36], 1.0, pj.BrownConrady(-0.25))
    truth = start.replace(e=[0.3, 0.4, 3.2], p=[0, 0, 0], lens=lens)
    mask = pj.silhouette(truth, scene)
    return scene, truth, mask, start, pj.fit_camera(scene, mask, start, free=("pose", "k1"))


@pytest.mark.long
def test_fit_finds_the_lens(fitted):
    _, truth, _, _, fit = fitted
    assert (fit.status, fit.names[-1]) == ("converged", "k1")
    assert off(fit.camera, truth) < 1e-4
    assert abs(float(fit.camera.lens.distortion.k1) + 0.25) < 1e-3


@pytest.mark.long
def test_prior_holds_phi_that_a_hard_mask_barely_shows(fitted):
    scene, _, mask, start, _ = fitted
    hard = np.asarray(mask) > 0.5
    plain, sure = (
        pj.fit_camera(scene, hard, start, ("pose", "phi", "k1"), prior=prior)
        for prior in (None, {"phi": (0.7, 1e-4), "k1": (-0.25, 1e-3)})
    )
    at = plain.names.index("phi")
    assert abs(float(sure.camera.phi) - 0.7) < 3e-4
    assert 0.9e-4 < sure.std[at] < 1.1e-4 < plain.std[at]


@pytest.mark.long
def test_bounds_are_kept(fitted):
    scene, _, mask, start, _ = fitted
    held, inside = (
        pj.fit_camera(scene, mask, start, ("pose", "k1"), bounds={"k1": (low, 0.1)})
        for low in (-0.1, -0.4)
    )
    assert -0.1 <= float(held.camera.lens.distortion.k1) < -0.09
    assert held.status == "misfit"  # (An exact mask shows that the bounds are wrong.)
    assert "k1 is held at an end of its bounds" in held.weak
    assert inside.status == "converged"
    assert abs(float(inside.camera.lens.distortion.k1) + 0.25) < 1e-3
