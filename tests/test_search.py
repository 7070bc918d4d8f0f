"""A camera with no start, or a bad one."""

import numpy as np
import pytest
import trimesh
from chosen import first
from oracles import drawn, turned
from scipy.spatial.transform import Rotation

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._mask import search
from pinhole_jax._mask.mask import Mask
from pinhole_jax._mask.search import VIEWS, sphere_points
from pinhole_jax._mask.signatures import ANGLES, distances, facing, signatures
from pinhole_jax._mask.thumbnails import SIZE, axes_inward, thumbnails
from pinhole_jax._scene import coarse
from pinhole_jax._scene.scene import ball_about, bounding_box, padded


@pytest.fixture(scope="module")
def scene():
    return pj.Scene(mesh=shapes.bumpy(3))


def anywhere(seed: int, W: int = 96, H: int = 80) -> pj.Camera:
    """A camera 5 units from the origin, turned at random, the object not in the middle."""
    random = np.random.default_rng(seed)
    axes = Rotation.random(random_state=seed).as_matrix()
    e = -5 * axes[2] + random.uniform(-0.4, 0.4, 2) @ axes[:2]
    return pj.Camera(e, e + 5 * axes[2], axes[1], 0.6, 1.0, W, H)


def degrees(fit, truth):
    return np.rad2deg(float(pj.pose_error(fit.camera, truth)[0]))


def mask_of(camera, scene):
    return drawn(camera, scene)


def test_roll_is_found_by_correlation():
    disc = np.hypot(*(np.mgrid[:80, :96] - np.array([[[30]], [[50]]]))) < 12
    disc[30:, 50:] = False  # three quarters of a disc
    film = (np.array([200.0, 200.0]), np.array([48.0, 40.0]))
    one = signatures(disc[None] * 1.0, np.ones((80, 96)), *film)
    rolled = one._replace(samples=np.roll(one.samples, 9, axis=-1))
    score = distances(one, rolled)
    assert np.argmin(score) == 72 - 9
    assert score.min() < 1e-12


def test_facing_turns_to_a_direction():
    directions = sphere_points(50)
    axes = facing(directions)
    squares = axes @ np.swapaxes(axes, 1, 2)
    np.testing.assert_allclose(squares, np.broadcast_to(np.eye(3), squares.shape), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(axes), 1, atol=1e-6)
    np.testing.assert_allclose(axes[:, 2], directions, atol=1e-12)


@pytest.mark.usefixtures("in_arrays")  # (the library never sums layers)
@pytest.mark.parametrize("what", first(1, ["closed", "open", "filled up", "spheres"]))
def test_thumbnails_are_silhouettes_whose_layers_are_clamped(what):
    random = np.random.default_rng(0)
    box = trimesh.creation.box((1, 2, 3)).apply_translation((7, 0, 0))
    scene = pj.Scene(mesh=pj.Mesh(box.vertices, box.faces[: -3 if what == "open" else None]))
    if what == "spheres":
        radii = random.uniform(0.02, 0.6, 20)
        scene = pj.Scene(spheres=pj.Spheres(random.normal(size=(20, 3)), radii))
    ball = ball_about(np.asarray(bounding_box(scene), float))
    directions, phi = sphere_points(5), 2 * np.arcsin(1 / 1.5)
    axes = axes_inward(directions)
    drawn = padded(scene) if what == "filled up" else scene
    images = thumbnails(drawn, ball, 1.5 * directions, axes, phi)
    for direction, (_, b2, v), image in zip(directions, axes, images, strict=True):
        eye = ball.centre + 1.5 * ball.radius * direction
        camera = pj.Camera(eye, eye + v, b2, phi, W=SIZE, H=SIZE)
        exact = np.asarray(pj.silhouette(camera, scene, overlaps=False))
        np.testing.assert_allclose(image, exact, atol=0.15)
        assert np.mean(np.abs(image - exact)) < 2e-3


@pytest.mark.parametrize("closed", [True, False])
def test_fine_mesh_is_coarsened_for_the_search(closed, monkeypatch):
    """A search of all views of 5M faces took 35 s: pictures of 48 px need some 60 000 of them."""
    fine = shapes.bumpy(5)
    fine = fine if closed else pj.Mesh(fine.vertices, fine.faces[:-3000])
    monkeypatch.setattr(coarse, "FINE", 1000)
    monkeypatch.setattr(coarse, "CELLS", 40)
    mesh = coarse.seen_from_afar(fine)
    assert len(mesh.faces) < 0.6 * len(fine.faces)
    assert np.all(mesh.edge_faces >= 0) == closed
    ball, directions = (
        ball_about(np.asarray(bounding_box(pj.Scene(mesh=fine)), float)),
        sphere_points(9),
    )
    drawn = [
        thumbnails(
            pj.Scene(mesh=m), ball, 4 * directions, axes_inward(directions), 2 * np.arcsin(1 / 4)
        )
        for m in (fine, mesh)
    ]
    assert np.sqrt(np.mean((drawn[0] - drawn[1]) ** 2)) < 0.02
    assert np.mean(drawn[0]) > 0.1


def test_coarse_mesh_is_searched_as_it_is(scene):
    assert coarse.seen_from_afar(scene.mesh) is scene.mesh


def test_camera_is_found_with_no_start(scene):
    for seed in range(3):
        truth = anywhere(seed)
        fit = pj.fit_camera(scene, mask_of(truth, scene), None, phi=0.6)
        assert fit.status == "converged"
        assert fit.modes == ()
        assert degrees(fit, truth) < 1e-6
        assert float(fit.camera.phi) == 0.6


def test_round_mask_is_tried_from_all_views(scene, monkeypatch):
    """No roll of a disc fits better than the next: there was no guess, and the fit of a ball to one
    ended in an error."""
    row, column = np.mgrid[:80, :96] + 0.5
    mask = Mask(1.0 * (np.hypot(row - 40, column - 48) < 30), np.ones((80, 96)), anywhere(0))
    monkeypatch.setattr(search, "distances", lambda mask, views: np.ones((VIEWS, ANGLES)))
    ball = ball_about(np.asarray(bounding_box(scene), float))
    assert len(list(search.guesses(mask, scene, ball))) == VIEWS


@pytest.mark.long
def test_focal_length_can_be_a_guess(scene):
    truth = anywhere(3)
    fit = pj.fit_camera(scene, mask_of(truth, scene), None, ("pose", "phi"))
    assert fit.status == "converged"
    assert degrees(fit, truth) < 1e-6
    assert abs(float(fit.camera.phi) - 0.6) < 1e-6


@pytest.mark.parametrize("where", ["beside", "behind", "inside", "far", "upside down"])
def test_start_that_misses_the_mask_is_pulled_in(scene, where):
    truth = anywhere(0)
    e, p, u = (np.asarray(x) for x in (truth.e, truth.p, truth.u))
    arrays = {
        "beside": (e, p + np.array([3, 3, 0]), u),
        "behind": (e, 2 * e - p, u),
        "inside": (0 * e, p - e, u),
        "far": (100 * e, p, u),
        "upside down": (e, p, -u),
    }[where]
    start = pj.Camera(*arrays, 0.6, 1.0, 96, 80)
    fit = pj.fit_camera(scene, mask_of(truth, scene), start)
    assert fit.status == "converged"
    assert degrees(fit, truth) < 1e-6


@pytest.mark.long
def test_box_has_four_views():
    """Half turns about its three axes change nothing: four cameras, all of them are given."""
    box = trimesh.creation.box((1.2, 0.8, 2)).subdivide()
    scene = pj.Scene(mesh=pj.Mesh(box.vertices, box.faces))
    truth = anywhere(1)
    fit = pj.fit_camera(scene, mask_of(truth, scene), None, phi=0.6)
    assert fit.status == "ambiguous"
    assert len(fit.modes) == 3
    views = [fit, *fit.modes]
    assert min(degrees(f, truth) for f in views) < 1e-4
    for f in views:
        assert f.rms < 1e-6
        np.testing.assert_allclose(mask_of(f.camera, scene), mask_of(truth, scene), atol=1e-4)
    near = turned(truth, [1, 2, 3], 20)
    assert degrees(pj.fit_camera(scene, mask_of(truth, scene), near), truth) < 1e-4


@pytest.mark.long
def test_occluder_is_masked_by_a_weight_or_reported(scene):
    truth = anywhere(0)
    mask, start = mask_of(truth, scene), turned(truth, [1, 2, 3], 5)
    hidden = np.broadcast_to(np.arange(96) < 48, mask.shape)
    covered = np.where(hidden, 0, mask)
    told = pj.fit_camera(scene, covered, start, weight=~hidden * 1.0)
    assert degrees(told, truth) < 1e-6
    assert not any("far from the mask's edge" in words for words in told.weak)
    row, column = np.argwhere((mask > 0.2) & (mask < 0.8))[0]
    y, x = np.mgrid[:80, :96]
    bite = np.where(np.hypot(y - row, x - column) < 11, 0, mask)
    plain = pj.fit_camera(scene, bite, start, outlier_px=None)
    robust = pj.fit_camera(scene, bite, start)
    assert degrees(robust, truth) < 0.5 * degrees(plain, truth)
    assert "of the mask's edge" in robust.weak[-1]
    assert "was ignored" in robust.weak[-1]
    assert np.all(np.hypot(*(robust.unbelieved - [column + 0.5, 79.5 - row]).T) < 16)


@pytest.mark.long
def test_continuous_symmetry_is_no_list_of_modes():
    cylinder = trimesh.creation.cylinder(0.5, 2.0, sections=256)
    cylinder.vertices[cylinder.vertices[:, 2] > 0, :2] *= 0.6  # a cone's stump: no second axis
    scene = pj.Scene(mesh=pj.Mesh(cylinder.vertices, cylinder.faces))
    fit = pj.fit_camera(scene, mask_of(anywhere(2), scene), None, phi=0.6)
    assert fit.iou > 0.999
    assert fit.modes == ()
    assert "the turn about the axis" in fit.weak[0]
