"""A fit's look against the image itself: the same squares, Jacobian and overlap, by the compiled
library and by the whole window."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chosen import full, long
from numpy.testing import assert_allclose
from oracles import drawn
from views import FREE, taken

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._mask.pyramid import pyramid
from pinhole_jax._outline.stretches import OutlineMeans, coverage_of
from pinhole_jax._solver.looks import Origin
from pinhole_jax._solver.moves import canonical, moved, on_film

LENS = pj.Lens([14.0, 13.0], 1.02, pj.BrownConrady(-0.3, 0.1, 2e-3, 1e-3, 0.02))


def setting(look_at=(0.0, 0, 0), W=30, H=24, spheres=False, phi=0.6, lens=None, rough=0.0):
    random, look_at = np.random.default_rng(0), np.array(look_at)
    camera = pj.Camera(np.add(look_at, [0.3, 1, 5]), look_at, [0.1, 1, 0], phi, 1.0, W, H, lens)
    balls = pj.Spheres([[1.2, 0.9, 0], [-1.3, -0.8, 0.5]], [0.3, 0.2]) if spheres else None
    mesh = shapes.bumpy(3 if rough else 2, bumps=0.006)
    vertices = mesh.vertices + random.normal(0, rough, mesh.vertices.shape)
    target = np.clip(random.random((H, W)) * 1.4 - 0.2, 0, 1)
    weight = random.random((H, W)) * (random.random((H, W)) > 0.2)
    return camera, pj.Scene(pj.Mesh(vertices, mesh.faces), spheres=balls), target, weight


def image_jacobian(view, camera, scene):
    """The image, and its derivatives by the moves of a view."""
    move = view.origin.problem.move(view.camera, view.level, FREE)

    def image(y):
        image = pj.silhouette(on_film(moved(move, y, FREE), camera), scene)
        return image, image

    columns, value = eqx.filter_jit(jax.jacfwd(image, has_aux=True))(jnp.zeros(7))
    return np.asarray(value), np.asarray(columns).reshape(-1, 7)


@pytest.mark.parametrize("whole_window", [False, long(True)])
@pytest.mark.parametrize(
    "given",
    [
        {"look_at": (-1.2, 0, 0), "lens": LENS},
        {
            "W": 60,
            "H": 50,
            "rough": 0.02,
            "spheres": True,
        },  # most pixels of many pieces are covered
        full({"spheres": True}),
        full({"W": 60, "H": 50, "rough": 0.02}),
        full({"W": 150}),
        full({"W": 150, "look_at": (-8, 0, 0)}),  # more film heights away than a 1 x 1 film has
        full({"look_at": (1.7, 0, 0)}),
        full({"look_at": (-1.7, 0, 0), "spheres": True}),
        full({"look_at": (0, -1.3, 0)}),
        full({"look_at": (-1, 0, 0), "spheres": True, "phi": 0.05}),  # it goes on far to the right
        full({"look_at": (1, 0, 0), "spheres": True, "phi": 0.05}),
        full({"look_at": (-1.2, 0, 0), "spheres": True, "lens": LENS}),
    ],
)
def test_squares_sums_and_jacobian_are_those_of_the_image(given, whole_window):
    camera, scene, target, weight = setting(**given)
    data, levels = pyramid(target, weight, float)
    size = (camera.W + 3, camera.H + 5) if whole_window else None
    view = taken(canonical(camera), scene, data, levels[-1], size)
    covered, dense = image_jacobian(view, camera, scene)
    difference = np.sqrt(weight) * (covered - target)
    dense = np.sqrt(weight).reshape(-1, 1) * dense
    close = {"rtol": 1e-9, "atol": 1e-9}
    if camera.lens:  # curves that bend are cut into parts, which stray by 2e-4 px
        close = {"rtol": 1e-5, "atol": 1.0 if whole_window else 1e-3}
    least, most = (np.sum(weight * f(covered, target)) for f in (np.minimum, np.maximum))
    sums = [view.sums.squares, view.sums.overlap, view.sums.union]
    assert_allclose(sums, [np.sum(difference**2), least, most], **close)
    assert_allclose(view.sums.weight, np.sum(weight), rtol=1e-12)
    J, R, r = view.jacobian, view.triangle, view.pixels.residual
    for table, along in ((J, J.T @ r), (R, R.T @ view.along)):
        assert_allclose(table.T @ table, dense.T @ dense, **close)
        assert_allclose(along, dense.T @ difference.ravel(), **close)
    assert_allclose(coverage_of(view)[::-1], covered, **close)


class PixelsAlone(Origin):
    """Where arrays make the outline, of the library's pixels."""

    outline = None


def test_outline_by_the_library_is_that_by_arrays():
    camera, scene, target, weight = setting(W=60, H=50, rough=0.02, spheres=True)
    data, levels = pyramid(target, weight, float)
    origin = taken(canonical(camera), scene, data, levels[-1]).origin
    given = (origin.camera, origin.problem, origin.level, origin.freed, origin.size)
    both = map(OutlineMeans.from_origin, (origin, PixelsAlone(*given)))
    for ours, theirs in zip(*both, strict=True):
        assert len(ours) > 50
        assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)


def test_coarse_levels_are_means_of_blocks():
    camera, scene, _, _ = setting(W=33, H=50)
    target = drawn(camera, scene)
    data, levels = pyramid(target, np.ones_like(target), float, coarsest_px=8)
    assert [(int(v.W), int(v.H)) for v in levels] == [(8, 12), (16, 25), (33, 50)]
    for level in levels:  # the target is the scene's own image: nothing is left at any level
        view = taken(canonical(camera), scene, data, level)
        assert_allclose(view.squares, 0, atol=1e-12)
        assert float(view.sums.overlap) > 0


def test_thin_picture_has_pixels_on_each_level():
    target = np.zeros((200, 3))
    target[20:180, 1] = 1
    _, levels = pyramid(target, np.ones_like(target), float)
    assert [(int(v.W), int(v.H)) for v in levels] == [(1, 100), (3, 200)]


def test_lens_that_folds_within_the_window_is_nan():
    camera, scene, target, weight = setting()
    camera = camera.replace(lens=pj.Lens([15.0, 12.0], 1.0, pj.BrownConrady(-0.1)))
    bent = eqx.tree_at(lambda c: c.lens.distortion.k1, canonical(camera), jnp.array(-9.0))
    data, levels = pyramid(target, weight, float)
    view = taken(bent, scene, data, levels[-1])
    assert np.all(np.isnan(view.triangle[np.triu_indices(7)]))
    assert np.isnan(view.squares)
