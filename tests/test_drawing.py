"""A film drawn piece by piece, at once and in bands, is what it is drawn of vectors of pieces."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chosen import first, full

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._camera.camera import film_map
from pinhole_jax._silhouette import drawing, parts, piece_by_piece
from pinhole_jax._silhouette.asked import Asked
from pinhole_jax._silhouette.drawing import drawn_in_vectors
from pinhole_jax._silhouette.piece_by_piece import drawn_piece_by_piece
from pinhole_jax._silhouette.silhouette import _Given, _Moving, _parts, _Still, _View
from pinhole_jax._silhouette.surrounding import rows_seen

#: Columns and rows: fewer and more than bands have, with and without whole words.
SIZES = [(64, 64), (99, 70), (1, 90), (200, 1), (131, 37), (1, 1)]
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
    """Bands have few words, and few curves can be listed; every film is large."""
    monkeypatch.setattr(drawing, "LARGE", 0)
    monkeypatch.setattr(piece_by_piece, "BAND", 32)
    monkeypatch.setattr(parts, "LISTED", 600)
    jax.clear_caches()
    yield
    jax.clear_caches()


def asked_of(film, scene):
    """Return what is asked of a film."""
    vertices = None if scene.mesh is None else scene.mesh.vertices
    still = _Still.of(_Given(scene, (), None), _View.of(film, scene))
    parts = _parts(_Moving(film, vertices, scene.spheres), still)
    return Asked(film, parts, still.view.base, True, True, 1.5)


def each_way(camera, scene):
    """Return the film of vectors, and piece by piece: all rows, and those where the scene is."""
    film = film_map(camera)
    asked = asked_of(film, scene)
    pieces = [drawn_piece_by_piece(asked, rows)[0] for rows in (None, rows_seen(film, scene))]
    return drawn_in_vectors(asked), *pieces


def same(vectors, *others, atol=1e-13):
    """Which pixels hold what is the same to the last bit: the pieces are the same ones."""
    for pieces in others:
        np.testing.assert_allclose(pieces.image, vectors.image, atol=atol)
        for name in ("overlapping", "layers"):
            np.testing.assert_array_equal(getattr(pieces, name), getattr(vectors, name))
        crossed = (vectors.image > 0) & (vectors.image < 1)
        np.testing.assert_array_equal(pieces.alone[crossed], vectors.alone[crossed])
        np.testing.assert_allclose(pieces.winding, vectors.winding, rtol=1e4 * atol, atol=1e-9)
    np.testing.assert_array_equal(others[0].alone, vectors.alone)


@pytest.mark.parametrize(("W", "H"), first(1, SIZES, of=4))
def test_piecewise_areas_equal_vectorised_ones(W, H, banded):
    """All views by one program, one after the other."""
    scene = pj.Scene(mesh=crumpled(open_mesh=W % 2 == 0))
    draw = jax.jit(each_way)
    seen = []
    for view in VIEWS:
        vectors, *pieces = draw(camera_of(view, W, H), scene)
        same(vectors, *pieces)
        seen.append(float(jnp.sum(vectors.image)))
    assert max(seen) > 0.5 * W * H
    assert min(seen) == 0


SPHERES = pj.Spheres([[0.5, 0.9, 0.2], [0.3, 0.2, 1.1]], [0.4, 0.5])


@pytest.mark.parametrize("what", first(0, ["spheres", "on the grid", "float32", "lens"], of=4))
def test_piecewise_areas_equal_vectorised_ones_for_any_curves(what):
    """Arcs; vertices where pixels meet; parts of bent curves; the other float type."""
    camera, scene, atol = camera_of("whole", 40, 40), pj.Scene(crumpled(False), SPHERES), 1e-13
    if what == "spheres":
        scene = pj.Scene(spheres=SPHERES)
    elif what == "on the grid":  # 10 pixels to a unit of length
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1.5, 0]])
        scene = pj.Scene(mesh=pj.Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]])))
        camera = pj.Camera([0.0, 0, 2], [0.0, 0, 0], [0.0, 1, 0], np.pi / 2, 1.0, 40, 40)
    elif what == "lens":
        lens = pj.Lens((20.0, 20.0), distortion=pj.BrownConrady(k1=0.1))
        camera = eqx.tree_at(lambda c: c.lens, camera, lens, is_leaf=lambda x: x is None)
    else:
        short = lambda x: x.astype(np.float32) if eqx.is_inexact_array(x) else x
        (camera, scene), atol = jax.tree.map(short, (camera, scene)), 1e-5
    vectors, *pieces = jax.jit(each_way)(camera, scene)
    assert 0 < float(jnp.sum(vectors.image)) < 1600
    same(vectors, *pieces, atol=atol)


@pytest.mark.full
def test_views_side_by_side_are_drawn_as_each_alone(banded):
    scene = pj.Scene(mesh=crumpled(False), spheres=SPHERES)
    cameras = [camera_of(view, 99, 70) for view in VIEWS]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *cameras)
    same(*jax.jit(jax.vmap(each_way, (0, None)))(stacked, scene))


@pytest.mark.long
@pytest.mark.parametrize("balls", [0, full(1)])
def test_masks_and_derivatives_of_large_films(request, balls):
    """(With arcs there is twice as much to compile; they are drawn in bands above.)"""
    ball = pj.Spheres([[0.5, 0.9, 0.2]], [0.4]) if balls else None
    scene = pj.Scene(mesh=crumpled(False), spheres=ball)
    camera = camera_of("whole", 99, 70)
    weight = jnp.asarray(np.random.default_rng(1).normal(size=(70, 99)))

    def value_and_slope(camera):
        loss = lambda c: (lambda x: (jnp.sum(weight * x), x))(pj.silhouette(c, scene))
        return eqx.filter_value_and_grad(loss, has_aux=True)(camera)

    (_, image), slope = value_and_slope(camera)
    request.getfixturevalue("banded")
    (_, again), slope_again = value_and_slope(camera)
    np.testing.assert_allclose(again, image, atol=1e-12)
    for one, other in zip(jax.tree.leaves(slope), jax.tree.leaves(slope_again), strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-10)
