"""Something stands before the object, and nobody said so."""

import numpy as np
import pytest
import trimesh
from oracles import drawn, turned
from scipy.spatial.transform import Rotation

import pinhole_jax as pj
from pinhole_jax import plot, report, shapes
from pinhole_jax._fit.mask import Mask
from pinhole_jax._fit.occluders import edge_of

pytestmark = pytest.mark.optimised

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


def test_an_edge_has_points_on_it_and_normals_outwards():
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


def check(fit, truth, wall):
    # (With a weight image that tells the wall: 1.18 degrees from the start, sigma 0.8.)
    assert degrees(fit, truth) < 1.5
    assert fit.iou > 0.97
    assert "of the mask's edge" in " ".join(fit.weak)
    # What was not believed is the wall's edge.
    off = np.abs(fit.unbelieved[:, 0] - wall)
    assert np.mean(off < 1) > 0.9
    assert np.max(off) < 6


def test_from_a_start_the_rest_of_the_edge_is_enough(scene):
    truth = anywhere(0)
    seen, wall = behind_a_wall(truth, scene, 0.3)
    start = turned(truth, [1, 2, 3], 10)
    fit = pj.fit_camera(scene, seen, start)
    check(fit, truth, wall)
    assert fit.status == "converged"
    plain = pj.fit_camera(scene, seen, start, outlier_px=None)
    assert degrees(plain, truth) > 20
    assert plain.unbelieved is None
    red = np.all(plot.overlay(seen * np.uint8(255), fit.camera, scene) == plot.RED, axis=-1)
    assert not red.any()
    shown = plot.overlay(seen * np.uint8(255), fit.camera, scene, dots=fit.unbelieved)
    at = np.argwhere(np.all(shown == plot.RED, axis=-1))
    assert abs(np.median(at[:, 1]) / (shown.shape[1] / 96) - wall) < 1
    assert "Red: the mask's edge that was not believed" in report.page(fit, scene, seen)


@pytest.mark.long
def test_with_no_start_the_rest_of_the_edge_is_enough(scene):
    truth = anywhere(1)
    seen, wall = behind_a_wall(truth, scene, 0.25)
    check(pj.fit_camera(scene, seen, None, phi=0.6), truth, wall)


@pytest.mark.long
@pytest.mark.parametrize("sign", [-1, 1])
def test_an_occluder_that_leaves_what_another_view_shows_is_not_told_as_certain(sign):
    """A box of 1 x 2 x 3, of which a wall leaves 1 x 2: another side of it."""
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


@pytest.mark.long
@pytest.mark.parametrize("seed", [2, 4])
def test_another_shape_is_no_covered_one(seed):
    """Its outline lies within the object's here and there, as if something stood before it."""
    scene, other = (pj.Scene(mesh=shapes.bumpy(3, k)) for k in (0, seed))
    camera = pj.Camera([0.3, 1.0, 5.0], [0.1, 0, 0], [0.2, 1, 0.1], 0.6, 1.0, 192, 160)
    fit = pj.fit_camera(scene, drawn(camera, other) > 0.5, turned(camera, [1, 2, 3], 10))
    assert fit.status != "converged"
