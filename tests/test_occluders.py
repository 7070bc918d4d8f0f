"""Something stands before the object, and nobody said so."""

import html
from typing import Any

import numpy as np
import pytest
import trimesh
from chosen import first, full
from oracles import drawn, turned
from scipy.spatial.transform import Rotation

import pinhole_jax as pj
from pinhole_jax import plot, report, shapes
from pinhole_jax._fit import occluders
from pinhole_jax._fit.occluders import edge_of
from pinhole_jax._mask.mask import Mask
from pinhole_jax._solver.moves import canonical
from pinhole_jax._solver.solver import Solver
from pinhole_jax._solver.stretches import coverage_of, outline_pixels, smoothed_about
from pinhole_jax.show.outline import RED

COLUMNS = np.arange(96) + 0.5


@pytest.fixture(scope="module")
def scene():
    return pj.Scene(mesh=shapes.bumpy(3))


def anywhere(seed: int) -> pj.Camera:
    axes = Rotation.random(random_state=seed).as_matrix()
    return pj.Camera(-5 * axes[2], np.zeros(3), axes[1], 0.6, 1.0, 96, 80)


def degrees(fit, truth):
    return np.rad2deg(float(pj.pose_error(fit.camera, truth)[0]))


def behind_a_wall(truth, scene, share: float) -> tuple[np.ndarray, float]:
    """Return the mask without what a wall on the left hides: a share of the object's width; and
    the wall's column."""
    inside = drawn(truth, scene) > 0.5
    there = np.flatnonzero(inside.any(axis=0))
    wall = int(there[0] + share * np.ptp(there))
    return inside & (wall < COLUMNS), float(wall)


def test_edge_has_points_on_it_and_outward_normals():
    """A disc with a soft edge: where it is one half is the circle."""
    row, column = np.mgrid[:80, :96] + 0.5
    away = np.hypot(80 - row - 33.3, column - 41.7)
    mask = Mask(np.clip(20 - away + 0.5, 0, 1), np.ones((80, 96)), anywhere(0))
    edge = edge_of(mask)
    from_middle = edge.at - [41.7, 33.3]
    np.testing.assert_allclose(np.linalg.norm(from_middle, axis=1), 20, atol=0.1)
    assert np.min(np.sum(edge.out * from_middle / 20, axis=1)) > 0.98
    np.testing.assert_allclose(edge.stretch.sum(axis=1), 1)
    half = Mask(mask.target, np.broadcast_to(COLUMNS > 41.7, (80, 96)) * 1.0, mask.camera)
    assert edge_of(half).at[:, 0].min() > 41
    assert len(edge_of(mask, 40).at) == 40


def test_blocks_of_a_large_photo_match_its_pixels(monkeypatch):
    """A square, one side of which is not trusted, rows and columns no multiples of a block's."""
    along = np.arange(10, 91) + 0.5
    sides = [(along, 10), (along, 91), (10, along), (91, along)]
    at = np.concatenate([np.stack(np.broadcast_arrays(x, y), axis=-1) for x, y in sides])
    edge = occluders.Edge(at.astype(float), np.zeros_like(at), None, 81.0)
    trusted, told = np.arange(len(at)) >= len(along), {}
    for blocks in (256, 20):  # pixels; 6 px
        monkeypatch.setattr(occluders, "BLOCKS", blocks)
        told[blocks] = occluders._nearness(edge, trusted, 2.3, np.array([0.5, 99.5]), (100, 110))
    pixel, block = told[256], told[20]
    row, column = np.indices((100, 110))
    x, y = column + 0.5, 99.5 - row
    below = np.hypot(np.clip(abs(x - 50.5) - 40, 0, None), y - 10)
    sure = abs(below - 5.6) > 0.1  # (Points lie 1 px apart.)
    np.testing.assert_array_equal(pixel[2][sure], (below < 5.6)[sure])
    assert np.any(pixel[1])
    assert np.any(pixel[0])
    for a, b in zip(pixel[1:], block[1:], strict=True):
        np.testing.assert_array_equal(a, b)
    differ = pixel[0] != block[0]
    assert np.mean(differ) < 0.03
    assert not np.any(differ & (pixel[1] | pixel[2]))


def test_means_about_an_outline_are_those_of_whole_images(scene):
    """... that SciPy's filter takes, at the film's border, too."""
    from scipy.ndimage import uniform_filter

    truth = anywhere(3)
    hard, ones = drawn(truth, scene) > 0.5, np.ones((80, 96))
    solver = Solver.of(scene, hard, ones, np.float64, ("pose",), 8)
    near = pj.Camera(0.5 * truth.e, truth.p, truth.u, truth.phi, 1.0, 96, 80)
    view = solver.look(canonical(near), solver.finest)
    place, rows, _ = outline_pixels(view)
    coverage = coverage_of(view)
    assert place[:, 0].min() < 2
    slopes = np.gradient(coverage)
    moves = np.zeros((*coverage.shape, rows.shape[1]))
    moves[tuple(place.T)] = rows
    found = smoothed_about(view, place, rows)
    wanted = np.dstack([np.hypot(*slopes), slopes[1], slopes[0], moves])
    mean = uniform_filter(wanted, (5, 5, 0), mode="constant")[tuple(place.T)]
    got = np.column_stack(found)
    np.testing.assert_allclose(got, mean, atol=1e-12 * np.abs(mean).max())


def test_edge_lies_within_a_third_of_a_pixel_of_its_own_outline(scene):
    """Half a pixel along it, to the next point that is known, says nothing."""
    truth = anywhere(0)
    seen, _ = behind_a_wall(truth, scene, 0.3)
    mask = Mask(seen * 1.0, np.ones((80, 96)), truth)
    solver = Solver.of(scene, mask.target, mask.weight, np.float64, ("pose",), 8)
    right, near = (
        occluders.covered_at(solver, mask, edge_of(mask), canonical(camera), 0.0)
        for camera in (truth, turned(truth, [1, 2, 3], 3))
    )
    assert right is not None
    assert near is not None
    assert 0.15 < right.off < occluders.SURE_PX
    assert near.off > occluders.SURE_PX
    assert occluders.is_sure(right)
    assert not occluders.is_sure(near)


def check(fit, truth, wall):
    # (With a weight image that tells the wall: 1.18 degrees from the start, sigma 0.8.)
    assert degrees(fit, truth) < 1.5
    assert fit.iou > 0.97
    assert "of the mask's edge" in " ".join(fit.weak)
    # What was not believed is the wall's edge.
    off = np.abs(fit.unbelieved[:, 0] - wall)
    assert np.mean(off < 1) > 0.9
    assert np.max(off) < 6


def test_visible_edge_is_enough_from_a_start(scene):
    truth = anywhere(0)
    seen, wall = behind_a_wall(truth, scene, 0.3)
    start = turned(truth, [1, 2, 3], 10)
    fit = pj.fit_camera(scene, seen, start)
    check(fit, truth, wall)
    assert fit.status == "converged"
    plain = pj.fit_camera(scene, seen, start, outlier_px=None)
    assert degrees(plain, truth) > 20
    assert plain.unbelieved is None
    red = np.all(plot.overlay(seen * np.uint8(255), fit.camera, scene) == RED, axis=-1)
    assert not red.any()
    shown = plot.overlay(seen * np.uint8(255), fit.camera, scene, dots=fit.unbelieved)
    at = np.argwhere(np.all(shown == RED, axis=-1))
    assert abs(np.median(at[:, 1]) / (shown.shape[1] / 96) - wall) < 1
    assert "Red: edges of the mask that were ignored" in html.unescape(
        report.page(fit, scene, seen)
    )


@pytest.mark.full
def test_visible_edge_is_enough_with_no_start(scene):
    truth = anywhere(1)
    seen, wall = behind_a_wall(truth, scene, 0.25)
    check(pj.fit_camera(scene, seen, None, phi=0.6), truth, wall)


@pytest.mark.long
@pytest.mark.parametrize("sign", [-1, full(1)])
def test_occluder_that_mimics_another_view_is_not_called_certain(sign):
    """A box of 1 x 2 x 3; a wall leaves 1 x 2 of it: another side."""
    box = trimesh.creation.box([1.0, 2.0, 3.0])
    scene = pj.Scene(mesh=pj.Mesh(box.vertices, box.faces))
    truth = pj.Camera([7.0, 0.2, 0.1], [0, 0, 0], [0, 1, 0], 0.6, 1.0, 96, 80)
    inside = drawn(truth, scene) > 0.5
    left, right = np.flatnonzero(inside.any(axis=0))[[0, -1]] + 0.5
    third = left + (right - left) / 3
    seen = inside & (third > COLUMNS if sign < 0 else left + right - third < COLUMNS)
    fit = pj.fit_camera(scene, seen, turned(truth, [1, 2, 3], 10))
    assert fit.status != "converged" or degrees(fit, truth) < 5
    assert pj.fit_camera(scene, seen, None, phi=0.6).status != "converged"


@pytest.mark.full
def test_view_closest_to_the_edge_wins():
    """Three plates that meet at a corner, 40 % of the outline behind a half-plane, no start: a view
    turned by 179 degrees explains nearly as much of the edge, 0.5 px off."""
    parts = [([1.6, 1.2, 0.15], [0, 0, 0]), ([0.15, 1.2, 0.9], [-0.72, 0, 0.5])]
    parts += [([0.9, 0.15, 0.5], [-0.3, 0.52, 0.3])]
    plates = [trimesh.creation.box(size) for size, _ in parts]
    for plate, (_, place) in zip(plates, parts, strict=True):
        plate.apply_translation(place)
    bracket: Any = trimesh.util.concatenate(plates)
    scene = pj.Scene(mesh=pj.Mesh(np.asarray(bracket.vertices, np.float32), bracket.faces))
    pose = [-0.3207, 4.8651, 5.4846], [0.0262, -0.0893, 0.0836], [0.5031, 0.6527, -0.5664]
    e, p, u = (np.array(x, np.float32) for x in pose)
    truth = pj.Camera(e, p, u, np.float32(0.6), 1.0, 256, 256)
    row, column = np.mgrid[:256, :256]
    hidden = np.cos(3.0755) * row + np.sin(3.0755) * column < -136.52
    fit = pj.fit_camera(scene, (drawn(truth, scene) > 0.5) & ~hidden, None, phi=0.6)
    assert degrees(fit, truth) < 1
    # (How the compiler rounds decides whether what is left is as much as a hard mask may leave.)
    assert fit.status in ("converged", "misfit")


@pytest.mark.parametrize("seed", first(0, [2, 4], of=2))
def test_different_shape_is_not_taken_for_an_occluded_one(seed):
    """Its outline lies within the object's here and there, as if something stood before it."""
    scene, other = (pj.Scene(mesh=shapes.bumpy(3, k)) for k in (0, seed))
    camera = pj.Camera([0.3, 1.0, 5.0], [0.1, 0, 0], [0.2, 1, 0.1], 0.6, 1.0, 192, 160)
    fit = pj.fit_camera(scene, drawn(camera, other) > 0.5, turned(camera, [1, 2, 3], 10))
    assert fit.status != "converged"
