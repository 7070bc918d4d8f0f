"""Silhouettes under lens distortion against polygons of points that OpenCV projects densely."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from chosen import first
from jax.flatten_util import ravel_pytree
from numpy.testing import assert_allclose
from oracles import clipped, rims, union_per_pixel
from slopes import both_ways
from test_distortion import by_opencv

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


def bent_polygon(view, corners, number):
    """Return a polygon in space, each side in many pieces, projected by OpenCV."""
    steps = np.linspace(corners, np.roll(corners, -1, axis=0), number, endpoint=False, axis=1)
    return shapely.Polygon(by_opencv(view, steps.reshape(-1, 3)))


def triangles(mesh):
    return np.asarray(mesh.vertices, float)[np.asarray(mesh.faces)]


def union_of(view, polygons, number=1000):
    return union_per_pixel([bent_polygon(view, x, number) for x in polygons], view.W, view.H)


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
    expected = union_of(view, triangles(mesh))
    assert np.sum((expected > 0) & (expected < 1)) > 20
    assert_allclose(image, expected, atol=1.5e-3)
    assert np.sqrt(np.mean((image - expected) ** 2)) < 3e-4


def test_scene_through_the_eye_plane_is_clipped():
    """The far ends lie behind: what is seen is cut off where the lens sees no more."""
    view, mesh = camera(*CASES["brown"], distance=0.7), sheet(3.0)
    image = silhouette(view, pj.Scene(mesh))
    v = np.asarray(pj.camera_basis(view).v)
    plane = np.append(v, -np.asarray(view.e) @ v - 0.02)
    corners = [np.pad(x, ((0, 0), (0, 1)), constant_values=1) for x in triangles(mesh)]
    ahead = [clipped(x, [plane]) for x in corners]
    expected = union_of(view, [x[:, :3] for x in ahead], 3000)
    assert_allclose(image, expected, atol=5e-3)


BALLS = pj.Spheres([[0.3, 0.2, 0.1], [-0.5, -0.3, 0.5], [1.2, -0.6, 0.2]], [0.5, 0.3, 0.4])


def bent_rims(view, spheres, number=4000):
    """Return the spheres' outlines, projected by OpenCV."""
    found = rims(view, spheres.centers, spheres.radii, number)
    return [shapely.Polygon(by_opencv(view, rim)) for rim in found]


@pytest.mark.full
@pytest.mark.parametrize("case", ["brown", "fisheye"])
def test_spheres_are_the_bent_images_of_their_rims(case):
    view = camera(*CASES[case])
    image = silhouette(view, pj.Scene(spheres=BALLS))
    assert_allclose(image, union_per_pixel(bent_rims(view, BALLS), W, H), atol=1.5e-3)


@pytest.mark.full
def test_derivatives_are_differences_of_the_oracle():
    """In all of the camera, its lens too, the vertices and the spheres."""
    rng = np.random.default_rng(3)
    up = rng.normal(size=(H, W))
    corners = jnp.array([[-2.0, -1, 0], [2.2, -1.1, 0.2], [0.2, 1.2, 0]])
    start = camera(*CASES["brown"]), corners, pj.Spheres([[0.1, 0.9, 0.3]], [0.5])
    flat, unravel = ravel_pytree(start)

    def ours(x):
        view, vertices, spheres = unravel(x)
        moved = pj.Scene(pj.Mesh(vertices, [[0, 1, 2]]), spheres)
        return jnp.sum(up * pj.silhouette(view, moved))

    def oracle(x):
        view, vertices, spheres = unravel(jnp.asarray(x))
        shapes = [bent_polygon(view, np.asarray(vertices), 400), *bent_rims(view, spheres, 800)]
        return np.sum(up * union_per_pixel(shapes, W, H))

    _, forward, gradient = jax.jit(partial(both_ways, ours))(flat, jnp.ones_like(flat), 1.0)
    assert np.all(np.isfinite(gradient))
    assert_allclose(forward, np.sum(gradient), rtol=1e-9)
    # The lens's coefficients one by one (all else costs the oracle minutes), then all at once.
    ways = np.concatenate([np.eye(len(flat))[14:19], rng.normal(size=(3, len(flat)))])
    along = lambda t: [oracle(flat + t * way) for way in ways]
    expected = (np.array(along(1e-4)) - along(-1e-4)) / 2e-4
    assert_allclose(ways @ gradient, expected, rtol=5e-3, atol=5e-3 * np.abs(expected).max())


FIT_W, FIT_H = 96, 72


def fit_camera(eye, k1):
    lens = pj.Lens([FIT_W / 2, FIT_H / 2], 1.0, pj.BrownConrady(k1))
    return pj.Camera(eye, [0, 0, 0], [0, 1, 0.1], 0.7, W=FIT_W, H=FIT_H, lens=lens)


@pytest.fixture(scope="module")
def fitted():
    """Return scene, truth, mask, start, and the fit of pose and k1 to the exact mask."""
    scene = pj.Scene(pj.shapes.bumpy(2))
    truth = fit_camera([0.3, 0.4, 3.2], -0.25)
    mask = pj.silhouette(truth, scene)
    start = pj.Camera([0.5, 0.2, 3.3], [0.05, 0, 0], [0, 1, 0.1], 0.7, W=FIT_W, H=FIT_H)
    return scene, truth, mask, start, pj.fit_camera(scene, mask, start, free=("pose", "k1"))


@pytest.mark.long
def test_fit_finds_the_lens(fitted):
    _, truth, _, _, fit = fitted
    assert (fit.status, fit.names[-1]) == ("converged", "k1")
    assert max(float(x) for x in pj.pose_error(fit.camera, truth)) < 1e-4
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
