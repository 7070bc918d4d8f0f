"""Joint fits of objects: their poses and sizes, before known cameras; and what views show before
there is a mask.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from arm import (
    BAR,
    BOTH_EYES,
    OFF,
    RIG,
    SIZE,
    START,
    TRUTH,
    check_slope,
    grown,
    information_of,
    posture,
)
from numpy.testing import assert_allclose
from oracles import body, camera_anywhere, drawn
from refusals import refusal
from results import NAMES, fit_at

import pinhole_jax as pj
from pinhole_jax._camera.poses import at_pose, exponential, inverse, pose_of
from pinhole_jax._command.hand_eye import worths

#: Where an object is, somewhere before the cameras.
PLACE = exponential(np.array([0.3, 0.2, -0.4, 0.2, 0.1, 0.3]))


@pytest.fixture(scope="module")
def larger(arm, scenes):
    """Views of a part that is 1.1 times as large as its mesh, somewhere before known cameras."""
    moved = arm.scene_at([PLACE @ grown(1.1) @ pose for pose in posture(0)])
    views = [
        pj.JointView(scenes[0], drawn(camera, moved), camera=name, object="part", scale="part")
        for name, camera in BOTH_EYES.items()
    ]
    return views, {"part": PLACE}


def test_object_size_is_found_with_its_pose(arm, scenes, larger):
    """The same for both views of it; the object of a third view has its own."""
    views, place = larger
    shrunk = drawn(TRUTH, arm.scene_at([grown(0.93) @ pose for pose in posture(1)]))
    other = pj.JointView(scenes[1], shrunk, camera="left", scale="other")
    start = {"part": place["part"] @ OFF}
    fit = pj.fit_joint([*views, other], BOTH_EYES, (), objects=start)
    assert (fit.status, fit.weak) == ("converged", ())
    assert abs(fit.scales["part"].value - 1.1) < 1e-9
    assert abs(fit.scales["other"].value - 0.93) < 1e-9
    assert np.max(np.abs(fit.objects["part"].pose - place["part"])) < 1e-9
    assert all(0 < scale.std < 1e-6 for scale in fit.scales.values())
    # What is larger is farther away, and the other way round.
    away = place["part"][:3, 3] - np.asarray(TRUTH.e)
    correlation = fit.scales["part"].across["part"] / fit.objects["part"].std
    assert correlation[3:] @ away / np.linalg.norm(away) > 0.9 * fit.scales["part"].std
    # (Each view's camera is in its scene's frame, as the scene is given.)
    shown = fit.views[2]
    assert np.max(np.abs(drawn(shown.camera, shown.scene) - shrunk)) < 1e-6


def test_size_that_no_camera_shows_leaves_the_rest_known(scenes):
    """Four cameras see a part of unknown size, and share a lens with a fifth, which sees another.
    (What eliminating the four leaves of the size is rounding: their errors were NaN.)"""
    truth = {name: camera_anywhere(k, SIZE, SIZE) for k, name in enumerate("abcde")}
    views = [
        pj.JointView(
            scenes[0], drawn(camera, scenes[0]), name, scale="size" * (name != "e") or None
        )
        for name, camera in truth.items()
    ]
    fit = pj.fit_joint(views, truth, shared="phi")
    assert fit.status == "rank_deficient"
    assert fit.weak[0].startswith("the scale of 'size' and its distance cannot be told apart")
    *four, other = fit.cameras.values()
    assert all(found.status == "rank_deficient" for found in four)
    assert all(np.all(np.isfinite(found.std[[0, 1, 2, 6]])) for found in four)
    assert (other.status, np.all(np.isfinite(other.std))) == ("converged", True)


def test_size_and_distance_are_one_to_a_single_camera(larger):
    views, place = larger
    start = {"part": place["part"] @ OFF}
    one = {"left": TRUTH}
    fit = pj.fit_joint(views[:1], one, (), objects=start)
    assert fit.status == "rank_deficient"
    assert fit.weak[0].startswith("the scale of 'part' and its distance cannot be told apart")
    assert np.isinf(fit.scales["part"].std)
    assert np.any(np.isinf(fit.objects["part"].std[3:]))
    assert np.all(fit.objects["part"].std[:3] < 1e-6)
    # What is known of it makes it as surely known, and the distance with it.
    known = {"part": {"scale": (1.1, 0.02)}}
    fit = pj.fit_joint(views[:1], one, (), objects=start, prior=known)
    found = fit.scales["part"]
    assert (fit.status, fit.weak) == ("converged", ())
    assert abs(found.value - 1.1) < 0.2 * 0.02
    assert abs(found.std / 0.02 - 1) < 1e-3
    away = place["part"][:3, 3] - np.asarray(TRUTH.e)
    assert np.allclose(found.across["part"][3:], 0.02**2 * away / 1.1, rtol=2e-2)
    assert abs(fit.objects["part"].std[5] / (0.02 * abs(away[2]) / 1.1) - 1) < 2e-2


@pytest.mark.full
@pytest.mark.parametrize("noise, by_mesh", [(0.03, False), (0.0, True)])
def test_derivative_of_a_part_equals_refits(larger, noise, by_mesh):
    """Of its pose and size, by a mask, a camera's carrier and what the other camera sees, all at
    once; by the mesh, forward and reverse, where masks are explained."""
    (one, other), place = larger
    random, faces = np.random.default_rng(0), np.asarray(one.scene.mesh.faces)
    shown = lambda view: view.target + noise * random.normal(size=(SIZE, SIZE))
    one, other = one._replace(target=shown(one)), other._replace(target=shown(other))

    def answer(vertices, target, mount, placed):
        scene = body(vertices, faces)
        views = [
            one._replace(scene=scene, target=target, mount=mount),
            other._replace(scene=scene, placed=placed),
        ]
        fit = pj.fit_joint(views, BOTH_EYES, (), objects=place, outlier_px=None)
        return jnp.append(jnp.ravel(fit.objects["part"].pose[:3]), fit.scales["part"].value)

    vertices = jnp.asarray(one.scene.mesh.vertices)
    change, twists = random.normal(size=(SIZE, SIZE)), random.normal(size=(2, 6))
    if by_mesh:
        by_vertices = lambda v: answer(v, one.target, None, None)
        wrong = 0.01 * jnp.asarray(random.normal(size=vertices.shape))
        check_slope(by_vertices, [vertices], [wrong], 1e-3, 1e-3)
        return
    by_rest = lambda *given: answer(vertices, *given)
    turning = [(exponential(1e-5 * x) - exponential(-1e-5 * x)) / 2e-6 for x in twists]
    inputs, velocity = [one.target, np.eye(4), np.eye(4)], [change, *turning]
    check_slope(by_rest, [*map(jnp.asarray, inputs)], [*map(jnp.asarray, velocity)], 1e-5, 1e-3)


def test_observability_of_several_views_equals_polygon_differences(arm, larger):
    """The error bars are those of the polygons' differences; there is no mask yet."""
    views, place = larger
    views = [v._replace(target=None) for v in views]
    told = pj.joint_observability(views, BOTH_EYES, (), objects=place, noise=0.1)
    assert told.names[:3] == ("part rotation_x", "part rotation_y", "part rotation_z")
    assert told.names[3:] == ("part x", "part y", "part z", "part scale")
    assert (told.rank, told.of) == (7, 7)

    def shown(camera, x):
        moved = place["part"] @ exponential(np.append(x[:3], place["part"][:3, :3].T @ x[3:6]))
        return drawn(camera, arm.scene_at([moved @ grown(1 + x[6]) @ pose for pose in posture(0)]))

    both = lambda x: np.stack([shown(camera, x) for camera in BOTH_EYES.values()])
    information = information_of(both, 7)
    assert_allclose(told.std, np.sqrt(np.diag(np.linalg.inv(information))), rtol=1e-4)
    # What is known beforehand adds to it.
    known = {"part": {"scale": (1.0, 1e-3), "y": (0.0, 2e-3)}}
    both = pj.joint_observability(views, BOTH_EYES, (), objects=place, prior=known)
    information[6, 6] += 1e-3**-2
    information[4, 4] += 2e-3**-2
    assert_allclose(both.covariance, np.linalg.inv(information), rtol=1e-3, atol=1e-9)
    # One eye does not tell a size from a distance.
    one = pj.joint_observability(views[:1], {"left": TRUTH}, (), objects=place)
    assert (one.rank, one.of, len(one.values)) == (6, 7, 7)
    assert np.isinf(one.std[-1])
    assert one.weak[0] == "the position of part against the scale of part is not visible"
    assert "6 of 7 directions are visible" in str(one)


@pytest.mark.long
def test_box_before_two_cameras_is_ambiguous_by_half_turns():
    box = pj.Assembly([pj.Mesh(BAR)])
    views = [
        pj.JointView(box.scene_at([np.eye(4)]), drawn(c, box.scene_at([PLACE])), n, object="box")
        for n, c in BOTH_EYES.items()
    ]
    fit = pj.fit_joint(views, BOTH_EYES, (), objects={"box": PLACE @ OFF})
    assert fit.status == "ambiguous"
    assert len(fit.modes) == 3
    turns = [PLACE[:3, :3].T @ m.objects["box"].pose[:3, :3] for m in (fit, *fit.modes)]
    assert max(np.max(np.abs(np.abs(turn) - np.eye(3))) for turn in turns) < 1e-6


# --- before there is a mask ----------------------------------------------------------------------


def test_observability_of_a_rig_on_a_mount_equals_polygon_differences(scenes):
    """The right eye follows the left one, and both have one lens."""
    mount, placed = exponential(np.full(6, 0.1)), exponential(np.full(6, 0.2))
    left = fit_at(at_pose(TRUTH, inverse(mount) @ placed @ pose_of(TRUTH)), np.eye(7))
    place = {"mount": mount, "placed": placed}
    views = [pj.JointView(scenes[0], None, camera=name, **place) for name in RIG]
    cameras = {name: at_pose(left.camera, pose_of(left.camera) @ RIG[name]) for name in RIG}
    known = {"left": {"phi": (0.6, 0.01)}}
    told = pj.joint_observability(
        views, cameras, ("pose", "phi"), rig=RIG, shared="phi", prior=known, noise=0.1
    )

    def shown(x):
        moved = left.displaced(x)
        poses = (inverse(placed) @ mount @ pose_of(moved) @ RIG[name] for name in RIG)
        return np.stack([drawn(at_pose(moved, pose), scenes[0]) for pose in poses])

    information = information_of(shown, 7)
    information[6, 6] += 0.01**-2
    assert (told.names[:7], told.rank) == (tuple(f"left {name}" for name in NAMES), 7)
    expected = np.diag(np.linalg.inv(information))
    assert_allclose(told.std[:7] ** 2, expected, rtol=2e-4)


def test_observability_predicts_the_error_bars_of_a_fit(noisy):
    asked = START, ("pose", "phi")
    fit = pj.fit_joint(noisy[:1], *asked).cameras["camera"]
    told = pj.joint_observability(noisy[:1], fit.camera, ("pose", "phi"), noise=0.05)
    assert told.names == tuple(f"camera {name}" for name in fit.names)
    assert_allclose(told.std, np.sqrt(np.diag(fit.independent_covariance)), rtol=0.15)
    alone = pj.observability(fit.camera, noisy[0].scene, ("pose", "phi"), noise=0.05)
    assert_allclose(told.covariance, alone.covariance, rtol=1e-6)
    with refusal("`noise`: expected a positive standard deviation"):
        pj.joint_observability(noisy[:1], *asked, noise=0.0)


def test_proposed_mask_adds_its_information(scenes):
    """Of two masks that are alike a third one is worth its share; one that shows nothing, none."""
    seen = pj.JointView(scenes[0], None)
    mesh = scenes[0].mesh
    aside = seen._replace(scene=body(mesh.vertices + 90.0, mesh.faces))
    found = worths([seen, seen], TRUTH, "pose,phi", [seen, aside])
    assert_allclose(found, [1.5**0.5, 1], rtol=1e-6)
    assert worths([aside], TRUTH, "pose,phi", [seen, aside]) == [np.inf, 1]
