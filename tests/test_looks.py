"""A fit's look against the image itself: the same squares, Jacobian and overlap, by the compiled
library and by the whole window."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chosen import full
from oracles import drawn
from views import FREE, taken

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._mask.pyramid import pyramid
from pinhole_jax._numerics.thin_qr import triangle_of
from pinhole_jax._outline.stretches import Coverage, coverage_of
from pinhole_jax._solver.moves import canonical, moved, on_film

LENS = pj.BrownConrady(-0.3, 0.1, 2e-3, 1e-3, 0.02)


def setting(look_at=(0.0, 0, 0), W=30, H=24, spheres=False, phi=0.6, seed=0):
    random = np.random.default_rng(seed)
    look_at = np.array(look_at)
    camera = pj.Camera(np.add(look_at, [0.3, 1, 5]), look_at, [0.1, 1, 0], phi, 1.0, W, H)
    balls = pj.Spheres([[1.2, 0.9, 0], [-1.3, -0.8, 0.5]], [0.3, 0.2]) if spheres else None
    scene = pj.Scene(mesh=shapes.bumpy(2, bumps=0.006), spheres=balls)
    target = np.clip(random.random((H, W)) * 1.4 - 0.2, 0, 1)
    weight = random.random((H, W)) * (random.random((H, W)) > 0.2)
    return camera, scene, target, weight


def image_jacobian(view, camera, scene):
    """The image, and its derivatives by the moves of a view."""
    move = view.origin.problem.move(view.camera, view.level, FREE)

    def image(y):
        image = pj.silhouette(on_film(moved(move, y, FREE), camera), scene)
        return image, image

    columns, value = eqx.filter_jit(jax.jacfwd(image, has_aux=True))(jnp.zeros(7))
    return np.asarray(value), np.asarray(columns).reshape(-1, 7)


@pytest.mark.parametrize("whole_window", [False, pytest.param(True, marks=pytest.mark.long)])
@pytest.mark.parametrize(
    ("look_at", "spheres", "W", "phi", "model"),
    [
        ((-1.2, 0, 0), False, 30, 0.6, LENS),
        ((0, 0, 0), True, 30, 0.6, None),
        full((0, 0, 0), False, 150, 0.6, None),
        full((-8, 0, 0), False, 150, 0.6, None),  # more film heights away than a 1 x 1 film has
        full((1.7, 0, 0), False, 30, 0.6, None),
        full((-1.7, 0, 0), True, 30, 0.6, None),
        full((0, -1.3, 0), False, 30, 0.6, None),
        full((-1, 0, 0), True, 30, 0.05, None),  # the object goes on far right of the film
        full((1, 0, 0), True, 30, 0.05, None),
        full((-1.2, 0, 0), True, 30, 0.6, LENS),
    ],
)
def test_squares_sums_and_jacobian_are_those_of_the_image(
    look_at, spheres, W, phi, model, whole_window
):
    camera, scene, target, weight = setting(look_at, W=W, spheres=spheres, phi=phi)
    if model is not None:
        lens = pj.Lens([14.0, 13.0], 1.02, model)
        camera = pj.Camera(camera.e, camera.p, camera.u, camera.phi, camera.d, W, camera.H, lens)
    data, levels = pyramid(target, weight, float)
    size = (W + 3, camera.H + 5) if whole_window else None
    view = taken(canonical(camera), scene, data, levels[-1], size)
    covered, dense = image_jacobian(view, camera, scene)
    difference = np.sqrt(weight) * (covered - target)
    dense = np.sqrt(weight).reshape(-1, 1) * dense
    close = {"rtol": 1e-9, "atol": 1e-9}
    if model is not None:  # curves that bend are cut into parts, which stray by 2e-4 px
        close = {"rtol": 1e-5, "atol": 1.0 if whole_window else 1e-3}
    np.testing.assert_allclose(view.sums.squares, np.sum(difference**2), **close)
    least, most = (weight * f(covered, target) for f in (np.minimum, np.maximum))
    np.testing.assert_allclose(view.sums.overlap, np.sum(least), **close)
    np.testing.assert_allclose(view.sums.union, np.sum(most), **close)
    np.testing.assert_allclose(view.sums.weight, np.sum(weight), rtol=1e-12)
    J, R, r = view.jacobian, view.triangle, view.pixels.residual
    np.testing.assert_allclose(R.T @ R, dense.T @ dense, **close)
    np.testing.assert_allclose(J.T @ J, dense.T @ dense, **close)
    np.testing.assert_allclose(J.T @ r, dense.T @ difference.ravel(), **close)
    np.testing.assert_allclose(R.T @ view.along, dense.T @ difference.ravel(), **close)
    np.testing.assert_allclose(coverage_of(view)[::-1], covered, **close)


@pytest.mark.long
def test_whole_windows_touch_what_the_library_does():
    camera, scene, target, weight = setting((0.4, 0.3, 0), spheres=True)
    data, levels = pyramid(target, weight, float)
    for level in (levels[0], levels[-1]):
        own, whole = (
            taken(canonical(camera), scene, data, level, size) for size in (None, (33, 29))
        )
        for a, b in zip(own.sums, whole.sums, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9)
        np.testing.assert_allclose(abs(own.triangle), abs(whole.triangle), atol=1e-9)
        row, column = np.indices((int(level.H), int(level.W))).reshape(2, -1)
        covered = [Coverage.from_view(view).lookup(row, column) for view in (own, whole)]
        np.testing.assert_allclose(*covered, atol=1e-12)


def test_rough_mesh_is_seen_as_in_the_image():
    """Most pixels with several pieces are covered."""
    mesh, (camera, _, target, weight) = shapes.bumpy(3), setting(W=60, H=50)
    off = np.random.default_rng(1).normal(0, 0.02, mesh.vertices.shape)
    scene = pj.Scene(mesh=pj.Mesh(np.asarray(mesh.vertices) + off, mesh.faces))
    data, levels = pyramid(target, weight, float)
    view = taken(canonical(camera), scene, data, levels[-1])
    image, columns = image_jacobian(view, camera, scene)
    np.testing.assert_allclose(coverage_of(view)[::-1], image, atol=1e-12)
    counted = np.sqrt(weight).reshape(-1, 1) * columns
    np.testing.assert_allclose(view.jacobian.T @ view.jacobian, counted.T @ counted, rtol=1e-9)
    assert np.sum(view.pixels.weight > 0) > 100


def test_coarse_levels_are_means_of_blocks():
    camera, scene, _, _ = setting(W=33, H=50)
    target = drawn(camera, scene)
    data, levels = pyramid(target, np.ones_like(target), float, coarsest_px=8)
    assert [(int(v.W), int(v.H)) for v in levels] == [(9, 13), (17, 25), (33, 50)]
    for level in levels:  # the target is the scene's own image: nothing is left at any level
        view = taken(canonical(camera), scene, data, level)
        np.testing.assert_allclose(view.squares, 0, atol=1e-12)
        assert float(view.sums.overlap) > 0


def test_exact_runs_cost_exactly_nothing_in_float32():
    camera, scene, _, _ = setting()
    target = drawn(camera, scene)
    data, levels = pyramid(target > 0.5, np.ones_like(target), np.float32)
    camera = jax.tree.map(lambda x: x.astype(jnp.float32), camera)
    view = taken(canonical(camera), scene, data, levels[-1])
    of_pixels = np.sum(view.pixels.residual**2)
    np.testing.assert_allclose(view.squares, of_pixels, rtol=1e-6)


def test_lens_that_folds_within_the_window_is_nan():
    camera, scene, target, weight = setting()
    camera = camera.replace(lens=pj.Lens([15.0, 12.0], 1.0, pj.BrownConrady(-0.1)))
    bent = eqx.tree_at(lambda c: c.lens.distortion.k1, canonical(camera), jnp.array(-9.0))
    data, levels = pyramid(target, weight, float)
    view = taken(bent, scene, data, levels[-1])
    assert np.all(np.isnan(view.triangle[np.triu_indices(7)]))
    assert np.isnan(view.squares)


@pytest.mark.parametrize("rows", [8, 700])
def test_triangle_is_that_of_the_table(rows):
    table = np.random.default_rng(rows).normal(size=(rows, 4))
    table[rows // 2 :, 1] = 0
    found = np.asarray(jax.jit(triangle_of)(table))
    assert np.all(np.tril(found, -1) == 0)
    assert np.allclose(found.T @ found, table.T @ table, rtol=1e-12, atol=1e-9)
    table[2, 1] = np.nan
    assert np.isnan(np.asarray(jax.jit(triangle_of)(table))).any()
