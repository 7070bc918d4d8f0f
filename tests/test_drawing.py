"""A large film, drawn band by band, is what it is drawn at once."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._camera.camera import film_map
from pinhole_jax._silhouette import drawing
from pinhole_jax._silhouette.curve_sets import find
from pinhole_jax._silhouette.drawing import Asked, drawn
from pinhole_jax._silhouette.silhouette import _Moving, _parts, _Still
from pinhole_jax._silhouette.surrounding import rows_seen, surrounding

#: Columns and rows: fewer and more than bands have, with and without whole words.
SIZES = [(1, 1), (1, 90), (200, 1), (64, 64), (99, 70), (131, 37)]
#: Eye, view point and field of view.
VIEWS = {
    "whole": ([0.4, 1.1, 4.8], [0, 0, 0], 0.6),
    "small, in a corner": ([1, 4, 28], [2.5, 1.6, 0], 0.5),
    "across the film": ([0.4, 1.1, 4.8], [0.7, 0, 0], 0.1),
    "past its left side": ([0.4, 1.1, 4.8], [1.4, 0, 0], 0.5),
    "past its right side": ([0.4, 1.1, 4.8], [-1.4, 0, 0], 0.5),
    "around the eye": ([0.1, 0.2, 0.3], [0, 0, 0], 0.8),
    "behind the eye's plane too": ([0, 0.3, 1.15], [1, 0, 1], 0.9),
    "nothing": ([0.4, 1.1, 4.8], [9, 9, 9], 0.4),
}


def camera_of(view: str, W: int, H: int) -> pj.Camera:
    e, p, phi = VIEWS[view]
    return pj.Camera(np.array(e, float), np.array(p, float), [0.1, 1, 0.05], phi, 1.0, W, H)


def crumpled(open_mesh: bool) -> pj.Mesh:
    mesh = shapes.bumpy(2)
    moved = mesh.vertices + 0.05 * np.random.default_rng(0).normal(size=mesh.vertices.shape)
    return pj.Mesh(moved, mesh.faces[: -40 if open_mesh else None])


@pytest.fixture
def banded(monkeypatch):
    """Every film is large, and few pieces can be listed."""

    def at_most(listed: int) -> None:
        monkeypatch.setattr(drawing, "LARGE", 0)
        monkeypatch.setattr(drawing, "BAND", 1024)
        monkeypatch.setattr(drawing, "BLOCK", 32)
        monkeypatch.setattr(drawing, "LISTED", listed)
        jax.clear_caches()

    yield at_most
    jax.clear_caches()


def both(camera, scene):
    """Return the film at once and in bands."""
    film = film_map(camera)
    rows = rows_seen(film, scene)
    still = _Still(find(film, scene), surrounding(film, scene), rows, None, (), None)
    parts = _parts(_Moving(film, scene.mesh.vertices, scene.spheres), still)
    asked = Asked(film, parts, still.base, True, True, 1.5)
    return drawn(asked, None), drawn(asked, rows)


def same(whole, bands):
    np.testing.assert_allclose(bands.image, whole.image, atol=1e-12)
    for name in ("overlapping", "layers"):
        np.testing.assert_array_equal(getattr(bands, name), getattr(whole, name))
    crossed = (whole.image > 0) & (whole.image < 1)
    np.testing.assert_array_equal(bands.alone[crossed], whole.alone[crossed])


@pytest.mark.parametrize(("W", "H"), SIZES)
def test_bands_are_the_film_drawn_at_once(W, H, banded):
    """All views by one program, one after the other; in the last size there is little room."""
    banded(40 if SIZES[-1] == (W, H) else 1 << 12)
    scene = pj.Scene(mesh=crumpled(open_mesh=W % 2 == 0))
    draw = jax.jit(both)
    seen = []
    for view in VIEWS:
        whole, bands = draw(camera_of(view, W, H), scene)
        same(whole, bands)
        np.testing.assert_allclose(bands.winding, whole.winding, atol=1e-9)
        seen.append(float(jnp.sum(whole.image)))
    assert max(seen) > 0.5 * W * H
    assert min(seen) == 0


@pytest.mark.long
def test_views_side_by_side_are_drawn_in_bands_as_each_alone(banded):
    banded(300)
    scene = pj.Scene(mesh=crumpled(False), spheres=pj.Spheres([[0.5, 0.9, 0.2]], [0.4]))
    cameras = [camera_of(view, 99, 70) for view in VIEWS]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *cameras)
    whole, bands = jax.jit(jax.vmap(both, (0, None)))(stacked, scene)
    same(whole, bands)


@pytest.mark.long
@pytest.mark.parametrize("balls", [0, pytest.param(1, marks=pytest.mark.full)])
def test_masks_and_derivatives_of_large_films(banded, balls):
    """(With arcs there is twice as much to compile; they are drawn in bands above.)"""
    ball = pj.Spheres([[0.5, 0.9, 0.2]], [0.4]) if balls else None
    scene = pj.Scene(mesh=crumpled(False), spheres=ball)
    camera = camera_of("whole", 99, 70)
    weight = jnp.asarray(np.random.default_rng(1).normal(size=(70, 99)))

    def value_and_slope(camera):
        loss = lambda c: (lambda x: (jnp.sum(weight * x), x))(pj.silhouette(c, scene))
        return eqx.filter_value_and_grad(loss, has_aux=True)(camera)

    (_, image), slope = value_and_slope(camera)
    banded(1 << 12)
    (_, again), slope_again = value_and_slope(camera)
    np.testing.assert_allclose(again, image, atol=1e-12)
    for one, other in zip(jax.tree.leaves(slope), jax.tree.leaves(slope_again), strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-10)
