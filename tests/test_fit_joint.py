"""Many masks, one problem: a robot's postures, a hand's camera, a rig, an object, robots' files."""

import json
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from oracles import drawn
from PIL import Image
from scipy.spatial.transform import Rotation
from scipy.stats import t

import pinhole_jax as pj
from pinhole_jax import __main__ as command, shapes
from pinhole_jax._camera.poses import adjoint, at_pose, exponential, inverse, pose_of, skew
from pinhole_jax._command.proposals import _information as tells, worths
from pinhole_jax._fit.observability import information
from pinhole_jax._joint.door import MANY_VIEWS, joint_problem
from pinhole_jax._joint.levels import descended, to_the_end
from pinhole_jax._solver import levenberg_marquardt
from pinhole_jax._solver.least_squares import Rows, held_to_the_end, solve
from pinhole_jax._solver.moves import reported

SIZE = 96
TRUTH = pj.Camera([0.4, -0.9, 6], [0, 0, 0.2], [0, 1, 0], 0.6, 1.0, SIZE, SIZE)
#: Some 10 degrees and a fifth of a unit off.
OFF = exponential(np.array([0.1, -0.12, 0.08, 0.1, 0.05, -0.2]))
START = at_pose(TRUTH, pose_of(TRUTH) @ OFF)
RIG = {"left": np.eye(4), "right": exponential(np.array([0, -0.1, 0, 0.6, 0, 0]))}
RIGHT = at_pose(TRUTH, pose_of(TRUTH) @ RIG["right"])
BOTH_EYES = {"left": TRUTH, "right": RIGHT}


def posture(k):
    """Where an arm and its second link are."""
    random = np.random.default_rng(100 + k)
    turn, aside = random.uniform(-1, 1, 3), 1.2 * random.uniform(-1, 1, 2)
    return [np.eye(4), exponential(np.array([*turn, *aside, 0.9]))]


@pytest.fixture(scope="module")
def arm():
    bar = trimesh.creation.box((0.6, 0.9, 2.2))
    return pj.Assembly([shapes.bumpy(2), pj.Mesh(np.asarray(bar.vertices), bar.faces)])


@pytest.fixture(scope="module")
def scenes(arm):
    return [arm.at(posture(k)) for k in range(4)]


@pytest.fixture(scope="module")
def views(scenes):
    return [pj.JointView(scene, drawn(TRUTH, scene)) for scene in scenes]


def apart(a, b):
    """Degrees and world units between two cameras."""
    angle, shift = pj.pose_error(a, b)
    return float(np.rad2deg(angle)), float(shift)


def test_camera_is_found_from_several_postures(views):
    fit = pj.fit_joint(views, START, ("pose", "phi"))
    assert (fit.status, fit.weak, fit.modes) == ("converged", (), ())
    assert max(apart(fit.camera, TRUTH)) < 1e-9
    assert abs(float(fit.camera.phi) - 0.6) < 1e-10
    assert fit.cameras["camera"].names[-1] == "phi"
    assert all(view.iou > 1 - 1e-9 for view in fit.views)


def test_camera_is_found_with_no_start(views):
    fit = pj.fit_joint(views, START, search=True)
    assert (fit.status, fit.modes) == ("converged", ())
    assert max(apart(fit.camera, TRUTH)) < 1e-8


@pytest.mark.long
def test_derivative_by_the_mask_of_a_rough_mesh():
    """In whose pixels lie more pieces than a look sweeps: these count as all others do."""
    smooth = pj.shapes.bumpy(4)
    size = 1 + 0.05 * np.random.default_rng(0).standard_normal((len(smooth.vertices), 1))
    scene = pj.Scene(mesh=pj.Mesh(np.asarray(smooth.vertices) * size, smooth.faces))
    here = pj.Camera([0.3, 0.2, 5.0], [0.1, 0, 0], [0, 1, 0], 0.7, 1.0, 24, 20)
    way = jnp.eye(3)[0]
    aside = lambda s: here.replace(e=here.e + s * way, p=here.p + s * way)
    mask, change = jax.jvp(lambda s: pj.silhouette(aside(s), scene), (0.0,), (1.0,))
    eye = lambda target: pj.fit_joint([pj.JointView(scene, target)], here).camera.e
    np.testing.assert_allclose(jax.jvp(eye, (mask,), (change,))[1], way, atol=1e-6)


@pytest.mark.long
def test_misleading_start_triggers_a_search(views):
    far = at_pose(TRUTH, pose_of(START) @ exponential(np.array([0.1, 0.2, 2.5, 0.5, 0.3, 0.5])))
    fit = pj.fit_joint(views, far)
    assert fit.status == "converged"
    assert max(apart(fit.camera, TRUTH)) < 1e-8


@pytest.fixture(scope="module")
def far_off(arm):
    """Hard masks of two postures, and a start from which descents lead elsewhere."""
    random = np.random.default_rng(134)
    scenes = []
    for _ in range(3):
        turn, aside = random.uniform(-1, 1, 3), 1.2 * random.uniform(-1, 1, 2)
        scenes.append(arm.at([np.eye(4), exponential(np.array([*turn, *aside, 0.9]))]))
    off = exponential(0.35 * random.standard_normal(6))
    views = [pj.JointView(scene, drawn(TRUTH, scene) > 0.5) for scene in scenes[:2]]
    return views, at_pose(TRUTH, pose_of(TRUTH) @ off)


@pytest.mark.long
def test_local_minimum_that_covers_most_of_hard_masks_is_rejected(far_off):
    """From 35 degrees off the descent comes to 0.86 of two masks, 31 degrees from the camera."""
    fit = pj.fit_joint(*far_off, ("pose", "phi"))
    assert fit.status == "converged"
    assert apart(fit.camera, TRUTH)[0] < 0.2


@pytest.mark.long
def test_outline_beside_most_masks_is_no_fit_without_a_search(far_off):
    """A sixth of the outline is beside masks that were cut off. A camera by itself, whose views are
    all compared, is believed; one beside an object that is sought as well is not."""
    views = []
    for view in far_off[0]:
        mask = np.array(view.target)
        mask[: np.flatnonzero(mask.any(axis=1))[0] + 8] = False
        views.append(view._replace(target=mask))
    alone = pj.fit_joint(views, START, ("pose", "phi"))
    assert all(0.1 < view.astray < 0.25 for view in alone.views)
    assert alone.status == "converged"
    assert apart(alone.camera, TRUTH)[0] < 0.2
    beside = [views[0], views[1]._replace(object="part")]
    fit = pj.fit_joint(beside, START, objects={"part": OFF})
    assert fit.status == "misfit"
    words = r"1\d% of the outline is far from the edges of most masks"
    assert re.match(words, fit.cameras["camera"].weak[0])


def test_hand_eye_camera_is_found(scenes):
    held = exponential(np.array([0.2, 0.1, -0.1, 0.1, 0.2, 0.3]))
    views = []
    for k in range(4):
        random = np.random.default_rng(k)
        off = exponential(np.append(random.uniform(-0.2, 0.2, 3), random.uniform(-0.4, 0.4, 3)))
        mount = off @ pose_of(TRUTH) @ inverse(held)
        seen = drawn(at_pose(TRUTH, mount @ held), scenes[0])
        views.append(pj.JointView(scenes[0], seen, mount=mount))
    fit = pj.fit_joint(views, at_pose(TRUTH, held @ OFF))
    assert fit.status == "converged"
    assert max(apart(fit.camera, at_pose(TRUTH, held))) < 1e-9


@pytest.fixture(scope="module")
def stereo(scenes):
    return [
        pj.JointView(scene, drawn(camera, scene), camera=name)
        for scene in scenes[:2]
        for name, camera in (("left", TRUTH), ("right", RIGHT))
    ]


@pytest.mark.full
def test_rig_is_better_determined_than_its_eyes(stereo):
    right = at_pose(TRUTH, pose_of(RIGHT) @ OFF)
    together = pj.fit_joint(stereo, {"left": START, "right": right}, rig=RIG)
    alone = pj.fit_joint(stereo, {"left": START, "right": right})
    for fit in (together, alone):
        assert fit.status == "converged"
        assert max(apart(fit.cameras["left"].camera, TRUTH)) < 1e-8
        assert max(apart(fit.cameras["right"].camera, RIGHT)) < 1e-8
    least = lambda fit: fit.cameras["left"].independent_covariance
    assert np.all(
        np.linalg.eigvalsh(np.linalg.inv(least(together)) - np.linalg.inv(least(alone))) > 0
    )


def test_object_pose_before_known_cameras_is_found(arm, scenes):
    place = exponential(np.array([0.3, 0.2, -0.4, 0.2, 0.1, 0.3]))
    moved = arm.at([place @ pose for pose in posture(0)])
    cameras = {"left": TRUTH, "right": RIGHT}
    views = [
        pj.JointView(scenes[0], drawn(camera, moved), camera=name, object="part")
        for name, camera in cameras.items()
    ]
    fit = pj.fit_joint(views, cameras, (), objects={"part": place @ OFF})
    found = fit.objects["part"]
    assert fit.status == "converged"
    assert np.max(np.abs(found.pose - place)) < 1e-9
    assert np.all(found.std > 0)
    assert np.all(found.std < 1e-6)


# --- how large it is -----------------------------------------------------------------------------


def grown(times):
    return np.diag([times, times, times, 1.0])


@pytest.fixture(scope="module")
def larger(arm, scenes):
    """Views of a part that is 1.1 times as large as its mesh, somewhere before known cameras."""
    place = exponential(np.array([0.3, 0.2, -0.4, 0.2, 0.1, 0.3]))
    moved = arm.at([place @ grown(1.1) @ pose for pose in posture(0)])
    views = [
        pj.JointView(scenes[0], drawn(camera, moved), camera=name, object="part", scale="part")
        for name, camera in BOTH_EYES.items()
    ]
    return views, {"part": place}


def test_object_size_is_found_with_its_pose(arm, scenes, larger):
    """The same for both views of it; that of what a third view shows is another."""
    views, place = larger
    shrunk = drawn(TRUTH, arm.at([grown(0.93) @ pose for pose in posture(1)]))
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


def test_size_and_distance_are_one_to_a_single_camera(larger):
    views, place = larger
    start = {"part": place["part"] @ OFF}
    one = {"left": TRUTH}
    fit = pj.fit_joint(views[:1], one, (), objects=start)
    assert fit.status == "rank_deficient"
    assert fit.weak[0].startswith("the scale of 'part' and how far it is away are one")
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


def of_inputs(views, place, target, vertices, mount, placed):
    """Return the pose and size of a part, as they follow a mask, its mesh and known transforms."""
    scene = pj.Scene(mesh=pj.Mesh(vertices, np.asarray(views[0].scene.mesh.faces)))
    given = [
        views[0]._replace(scene=scene, target=target, mount=mount),
        views[1]._replace(scene=scene, placed=placed),
    ]
    fit = pj.fit_joint(given, BOTH_EYES, (), objects=place, outlier_px=None)
    pose, size = fit.objects["part"].pose, fit.scales["part"].value
    return jnp.append(jnp.ravel(pose[:3]), size)


@pytest.mark.full
def test_derivative_by_masks_and_transforms_equals_refits(larger):
    views, place = larger
    random = np.random.default_rng(0)
    noise = lambda: 0.03 * random.normal(size=(SIZE, SIZE))
    views = [v._replace(target=v.target + noise()) for v in views]
    vertices = np.asarray(views[0].scene.mesh.vertices)
    answer = lambda t, m, p: of_inputs(views, place, t, vertices, m, p)
    # A mask that changes, a camera's carrier and what the other sees move, all at once.
    change = random.normal(size=(SIZE, SIZE))
    twists = random.normal(size=(2, 6))

    def at(h):
        return views[0].target + h * change, *(exponential(10 * h * x) for x in twists)

    h = 1e-5
    velocity = [(a - b) / (2 * h) for a, b in zip(at(h), at(-h), strict=True)]
    value, slope = jax.jvp(
        answer, tuple(map(jnp.asarray, at(0.0))), tuple(map(jnp.asarray, velocity))
    )
    refits = (answer(*at(h)) - answer(*at(-h))) / (2 * h)
    np.testing.assert_allclose(value, answer(*at(0.0)), atol=1e-9)
    np.testing.assert_allclose(slope, refits, atol=1e-3 * np.abs(refits).max())


@pytest.mark.full
def test_derivative_by_the_mesh_equals_refits(larger):
    """Forward and reverse, where masks are explained."""
    views, place = larger
    vertices = jnp.asarray(views[0].scene.mesh.vertices)
    answer = lambda v: of_inputs(views, place, views[0].target, v, None, None)
    wrong = 0.01 * jnp.asarray(np.random.default_rng(1).normal(size=vertices.shape))
    slope, h = jax.jvp(answer, (vertices,), (wrong,))[1], 1e-3
    refits = (answer(vertices + h * wrong) - answer(vertices - h * wrong)) / (2 * h)
    np.testing.assert_allclose(slope, refits, atol=1e-3 * np.abs(refits).max())
    gradient = jax.grad(lambda v: answer(v)[-1])(vertices)
    np.testing.assert_allclose(jnp.sum(gradient * wrong), slope[-1], rtol=1e-6)


def test_priors_and_photos_are_not_differentiated(larger):
    views, place = larger
    known = {"part": {"scale": (1.1, 0.1)}}
    size = lambda target: (
        pj.fit_joint(
            [views[0]._replace(target=target)], {"left": TRUTH}, (), objects=place, prior=known
        )
        .scales["part"]
        .value
    )
    with pytest.raises(ValueError, match="`prior`: expected none where the fit is differentiated"):
        jax.grad(size)(jnp.asarray(views[0].target))


def differences(image, h=1e-5):
    """Return how an image follows seven numbers."""
    ends = [(image(h * x) - image(-h * x)) / (2 * h) for x in np.eye(7)]
    return np.stack([x.ravel() for x in ends], axis=1)


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
        return drawn(camera, arm.at([moved @ grown(1 + x[6]) @ pose for pose in posture(0)]))

    J = [differences(lambda x, c=camera: shown(c, x)) for camera in BOTH_EYES.values()]
    information = sum(j.T @ j for j in J) / 0.1**2
    np.testing.assert_allclose(told.std, np.sqrt(np.diag(np.linalg.inv(information))), rtol=1e-4)
    # What is known beforehand adds to it.
    known = {"part": {"scale": (1.0, 1e-3), "y": (0.0, 2e-3)}}
    both = pj.joint_observability(views, BOTH_EYES, (), objects=place, prior=known)
    information[6, 6] += 1e-3**-2
    information[4, 4] += 2e-3**-2
    np.testing.assert_allclose(both.covariance, np.linalg.inv(information), rtol=1e-3, atol=1e-9)
    # One eye does not tell a size from a distance.
    one = pj.joint_observability(views[:1], {"left": TRUTH}, (), objects=place)
    assert (one.rank, one.of, len(one.values)) == (6, 7, 7)
    assert np.isinf(one.std[-1])
    assert one.weak[0] == "the place of part against the scale of part is not visible"
    assert "6 of 7 directions are visible" in str(one)


def by_the_left_eye():
    """Return how what is reported of the right eye follows what is of the left one."""
    flip, step, turned = np.diag([1, -1, 1]), RIG["right"], pose_of(TRUTH)[:3, :3]
    follows = np.eye(6)
    follows[:3, :3] = flip @ step[:3, :3].T @ flip
    follows[3:, :3] = -skew(turned @ step[:3, 3]) @ turned @ flip
    return follows


def by_eyes(stereo, run, sides=tuple(BOTH_EYES)):
    """Return what a rig leads to, and its left and right eye by themselves."""
    own = {side: [v for v in stereo if v.camera == side] for side in sides}
    alone = [run(own[side], {side: BOTH_EYES[side]}, {}) for side in sides]
    return run(stereo, BOTH_EYES, {"rig": RIG}), *alone


def test_information_of_both_eyes_of_a_rig_adds_up(stereo):
    """What a rig's masks tell of its pose is what its left eye's and its right eye's do."""
    told = lambda views, cameras, rig: pj.joint_observability(views, cameras, **rig)
    both, left, right = by_eyes(stereo, told)
    assert both.names[:6] == left.names
    assert both.of == 6
    follows = by_the_left_eye()
    information = np.linalg.inv(left.covariance)
    information = information + follows.T @ np.linalg.inv(right.covariance) @ follows
    expected = np.sqrt(np.diag(np.linalg.inv(information)))
    np.testing.assert_allclose(both.std[:6], expected, rtol=1e-6)


@pytest.mark.long
def test_rig_pose_is_as_much_better_as_theory_says(stereo):
    """Masks whose pixels err by 5 %: how far poses are off, beside what the limit is."""
    told = lambda views, cameras, rig: pj.joint_observability(views, cameras, noise=0.05, **rig)
    limits = [found.std[:6] for found in by_eyes(stereo, told, ["left"])]
    off = []
    for seed in range(10):
        random = np.random.default_rng(seed)
        noise = lambda r=random: 0.05 * r.normal(size=(SIZE, SIZE))
        noisy = [v._replace(target=v.target + noise()) for v in stereo]
        fitted = lambda views, cameras, rig: pj.fit_joint(views, cameras, **rig)
        cameras = [f.cameras["left"].camera for f in by_eyes(noisy, fitted, ["left"])]
        turns = [np.array(reported(c, TRUTH, ("pose",)))[:3] for c in cameras]
        off.append([np.append(t, TRUTH.e - c.e) for t, c in zip(turns, cameras, strict=True)])
    rms = np.sqrt(np.mean(np.square(off), axis=0))
    np.testing.assert_allclose(np.sqrt(np.mean((rms / limits) ** 2, axis=1)), 1, atol=0.25)
    better, expected = (np.exp(np.mean(np.log(x[0] / x[1]))) for x in (rms, limits))
    assert expected < 0.75
    assert abs(better / expected - 1) < 0.3


def test_observability_predicts_the_error_bars_of_a_fit(noisy):
    asked = START, ("pose", "phi")
    fit = pj.fit_joint(noisy[:1], *asked).cameras["camera"]
    told = pj.joint_observability(noisy[:1], fit.camera, ("pose", "phi"), noise=0.05)
    assert told.names == tuple(f"camera {name}" for name in fit.names)
    np.testing.assert_allclose(told.std, np.sqrt(np.diag(fit.independent_covariance)), rtol=0.15)
    alone = pj.observability(fit.camera, noisy[0].scene, ("pose", "phi"), noise=0.05)
    np.testing.assert_allclose(told.covariance, alone.covariance, rtol=1e-6)
    with pytest.raises(ValueError, match="`noise`: expected a positive standard deviation"):
        pj.joint_observability(noisy[:1], *asked, noise=0.0)


@pytest.mark.long
def test_error_bars_of_a_size_hold(larger):
    views, place = larger
    off = []
    for seed in range(12):
        random = np.random.default_rng(seed)
        noisy = [
            v._replace(target=v.target + 0.05 * random.normal(size=(SIZE, SIZE))) for v in views
        ]
        fit = pj.fit_joint(noisy, BOTH_EYES, (), objects=place)
        off.append((fit.scales["part"].value - 1.1) / fit.scales["part"].std)
    assert np.mean(np.abs(off) < 1.96) >= 10 / 12
    assert np.max(np.abs(off)) > 0.3


@pytest.mark.full
def test_size_of_one_body_among_several_is_found(arm):
    """A rig before two bodies, the second of which is 5 % larger than its mesh."""

    def shown(k):
        return lambda x: [posture(k)[0], posture(k)[1] @ grown(1 + x[0])]

    postures = [pj.Posture(arm, shown(k), {"bar": "scale"}) for k in range(2)]
    views = [
        pj.JointView(p.scene(), drawn(camera, p.scene([0.05])), name, posture=p)
        for p in postures
        for name, camera in (("left", TRUTH), ("right", RIGHT))
    ]
    right = at_pose(TRUTH, pose_of(START) @ RIG["right"])
    fit = pj.fit_joint(views, {"left": START, "right": right}, rig=RIG, joint_zeros={"bar": 0.1})
    assert fit.status == "converged"
    assert abs(fit.joint_zeros.values[0] - 0.05) < 1e-5
    assert fit.joint_zeros.units == ("scale",)
    assert max(apart(fit.cameras["left"].camera, TRUTH)) < 1e-4


@pytest.fixture(scope="module")
def noisy(views):
    """Masks whose pixels err independently."""
    random = np.random.default_rng(0)
    noise = [0.05 * random.normal(size=(SIZE, SIZE)) for _ in views]
    return [
        v._replace(target=np.clip(v.target + n, 0, 1)) for v, n in zip(views, noise, strict=True)
    ]


@pytest.mark.long
def test_prior_on_a_camera_counts_as_in_fit_camera(noisy):
    known = {"phi": (0.604, 0.004), "e_x": (0.42, 0.02)}
    asked = START, ("pose", "phi")
    one = pj.fit_camera(noisy[0].scene, noisy[0].target, *asked, prior=known)
    joint = pj.fit_joint(noisy[:1], *asked, prior=known).cameras["camera"]
    assert np.allclose(joint.std, one.std, rtol=2e-3)
    assert max(apart(joint.camera, one.camera)) < 0.02 * np.min(one.std)
    assert abs(float(joint.camera.phi - one.camera.phi)) < 0.01 * one.std[-1]
    told = np.diag(joint.independent_covariance) / np.diag(one.independent_covariance)
    assert np.allclose(told, 1, rtol=4e-3)


def test_prior_on_an_object_counts(arm, scenes):
    """What is known better than the mask tells is found there, as surely as it is known."""
    place = exponential(np.array([0.3, 0.2, -0.4, 0.2, 0.1, 0.3]))
    seen = drawn(TRUTH, arm.at([place @ pose for pose in posture(0)]))
    seen = np.clip(seen + 0.05 * np.random.default_rng(1).normal(size=seen.shape), 0, 1)
    view = pj.JointView(scenes[0], seen, object="part")
    known = {"part": {"x": (0.2, 1e-5), "z": (0.3, 10.0)}}
    fit = pj.fit_joint([view], TRUTH, (), objects={"part": place @ OFF}, prior=known)
    found = fit.objects["part"]
    assert fit.status == "converged"
    assert abs(found.pose[0, 3] - 0.2) < 4e-5
    assert abs(found.std[3] / 1e-5 - 1) < 0.01
    assert np.all(np.abs(found.pose[1:3, 3] - place[1:3, 3]) < 4 * found.std[4:])
    assert np.all(found.std[4:] > 1e-4)


@pytest.mark.full
def test_bounds_hold_what_the_masks_would_have_elsewhere(noisy):
    fit = pj.fit_joint(noisy[:2], START, ("pose", "phi"), bounds={"phi": (0.61, 0.7)})
    found = fit.cameras["camera"]
    assert fit.status == "rank_deficient"
    assert abs(float(fit.camera.phi) - 0.61) < 1e-5
    assert np.isinf(found.std[-1])
    assert found.weak[-1] == "phi is held at an end of its bounds"
    within = pj.fit_joint(noisy[:2], START, ("pose", "phi"), bounds={"camera": {"phi": (0.5, 0.7)}})
    free = pj.fit_joint(noisy[:2], START, ("pose", "phi"))
    assert within.status == "converged"
    assert abs(float(within.camera.phi - free.camera.phi)) < 1e-6


@pytest.mark.long
def test_box_before_two_cameras_is_ambiguous_by_half_turns():
    bar = trimesh.creation.box((0.6, 0.9, 2.2))
    box = pj.Assembly([pj.Mesh(np.asarray(bar.vertices), bar.faces)])
    place = exponential(np.array([0.3, 0.2, -0.4, 0.2, 0.1, 0.3]))
    cameras = {"left": TRUTH, "right": RIGHT}
    views = [
        pj.JointView(box.at([np.eye(4)]), drawn(c, box.at([place])), n, object="box")
        for n, c in cameras.items()
    ]
    fit = pj.fit_joint(views, cameras, (), objects={"box": place @ OFF})
    assert fit.status == "ambiguous"
    assert len(fit.modes) == 3
    turns = [place[:3, :3].T @ m.objects["box"].pose[:3, :3] for m in (fit, *fit.modes)]
    assert max(np.max(np.abs(np.abs(turn) - np.eye(3))) for turn in turns) < 1e-6


@pytest.mark.full
def test_ball_shows_no_rotation():
    scene = pj.Scene(spheres=pj.Spheres([[0.2, 0, 0.1]], [0.8]))
    views = [
        pj.JointView(scene, np.asarray(pj.silhouette(c, scene)), camera=n)
        for n, c in (("left", TRUTH), ("right", RIGHT))
    ]
    fit = pj.fit_joint(views, {"left": TRUTH, "right": RIGHT}, rig=RIG)
    assert fit.status == "rank_deficient"
    assert np.any(np.isinf(fit.cameras["left"].std))


@pytest.mark.long
def test_wrong_posture_is_named_and_ignored(arm, views):
    wrong = posture(2)[1] @ exponential(np.array([0.1, 0, 0, 0, 0, 0.05]))
    bad = [*views[:2], pj.JointView(arm.at([np.eye(4), wrong]), views[2].target), views[3]]
    fit = pj.fit_joint(bad, START)
    assert fit.views[2].weight < 1e-3
    assert any(words.startswith("view 2:") for words in fit.weak)
    assert max(apart(fit.camera, TRUTH)) < 1e-4


@pytest.mark.long
def test_intervals_hold_the_camera_of_masks_that_err_by_stretches(scenes, exhaustive):
    """Outlines that waver by half a pixel, each mask another way: fits of six numbers each."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    inside, stated = [], []
    for seed in range(24 if exhaustive else 8):
        random = np.random.default_rng(seed)
        views = []
        for scene in scenes[:3]:
            wave = [gaussian_filter(random.normal(size=(SIZE, SIZE)), 6) for _ in range(2)]
            wave = [0.5 * w / np.std(w) for w in wave]
            at = np.indices((SIZE, SIZE)) + np.array(wave)
            image = map_coordinates(drawn(TRUTH, scene), at, order=1)
            views.append(pj.JointView(scene, image > 0.5))
        fit = pj.fit_joint(views, TRUTH).cameras["camera"]
        turn = np.array(reported(fit.camera, TRUTH, ("pose",)))
        off = np.append(turn[:3], np.asarray(TRUTH.e - fit.camera.e))
        inside.append(np.abs(off) < 1.96 * fit.std)
        stated.append(np.abs(off) / fit.std)
    assert np.mean(inside) > 0.88
    assert np.median(stated) > 0.08  # (a mask may err all outwards, which these do not)


def test_moves_are_those_of_differences(stereo):
    """What a view sees of a step is what its own camera's moves say."""
    cameras, place = {"left": START, "right": RIGHT}, exponential(np.full(6, 0.1))
    view = stereo[1]._replace(object="part", placed=exponential(np.full(6, 0.2)), mount=place)
    problem = joint_problem(
        [view._replace(scale="size"), stereo[0]._replace(object="part")],
        cameras,
        ("pose", "phi"),
        objects={"part": exponential(np.full(6, -0.1))},
        rig=RIG,
        prior={"size": {"scale": (1.2, 0.1)}},
    )
    state, eye = problem.start, problem.eyes[0]
    seen = problem.look(state)[0]
    before, n = eye.canonical(state), len(problem.columns(0))
    numeric = np.zeros((n, n))
    to_reported = np.asarray(seen.view.to_reported)
    for k, column in enumerate(problem.columns(0)):
        x = np.zeros(problem.size)
        sides = []
        for sign in (1, -1):
            x[column] = sign * 1e-6
            there = eye.canonical(problem.stepped(state, x))
            sides.append(np.asarray(reported(before, there, eye.solver.freed)))
        numeric[: len(to_reported), k] = (sides[0] - sides[1]) / 2e-6
    stated = to_reported @ seen.moves
    assert np.max(np.abs(stated - numeric[: len(stated)])) < 1e-7


def test_elimination_equals_the_dense_solution():
    """Two views have a camera in common, all have the last numbers; of one, something is known."""
    random = np.random.default_rng(0)
    size, parts, dense, right = 9, [], [], []
    for own, number in (([0, 1], 7), ([0, 1], 4), ([2, 3], 7), ([4, 5], 7), ([2], 1)):
        columns = np.array([6, *own, 7, 8] if number > 1 else own)
        rows, left = random.normal(size=(number, len(columns))), random.normal(size=number)
        parts.append(Rows(rows, left, columns, np.isin(columns, own)))
        whole = np.zeros((number, size))
        whole[:, columns] = rows
        dense.append(whole)
        right.append(left)
    matrix, left = np.concatenate(dense), np.concatenate(right)
    found = solve(parts, size, np.zeros(size))
    assert found.shared.tolist() == [6, 7, 8]
    assert len(found.own) == 3
    assert np.allclose(found.x, -np.linalg.lstsq(matrix, left, rcond=None)[0], atol=1e-12)
    everything = np.arange(size)
    inverse_normal = np.linalg.inv(matrix.T @ matrix)
    assert np.allclose(found.inverse(everything, everything), inverse_normal, atol=1e-12)
    damping = np.linspace(0.1, 2, size)
    damped = solve(parts, size, damping).x
    more = np.concatenate([matrix, np.diag(damping)])
    expected = -np.linalg.lstsq(more, np.append(left, np.zeros(size)), rcond=None)[0]
    assert np.allclose(damped, expected, atol=1e-12)


def test_elimination_order_makes_the_least_work():
    """Cameras that share a lens; pictures of one part each, by both eyes of a head."""
    cameras = [[k, 50] for k in range(50)]
    held = held_to_the_end(cameras, [6] * 50 + [1])
    assert np.flatnonzero(held).tolist() == [50]
    frames = [[eye, 2 + k] for k in range(50) for eye in (0, 1)]
    assert np.flatnonzero(held_to_the_end(frames, [6] * 52)).tolist() == [0, 1]
    assert np.all(held_to_the_end([[0, 1], [0, 1]], [6, 1]))


def test_many_views_hold_little_memory(scenes):
    """Views of one scene share its arrays, and each has room for its own mask alone."""
    mask, cameras = drawn(TRUTH, scenes[0]), {f"{k}": TRUTH for k in range(MANY_VIEWS)}
    views = [pj.JointView(scenes[0], mask, camera=name) for name in cameras]
    few, many = (
        joint_problem(views[:k], dict([*cameras.items()][:k]), "pose") for k in (2, MANY_VIEWS)
    )
    size = lambda problem: [e.solver.problem.pyramid.cells.size for e in problem.eyes]
    assert min(size(few)) > 10 * max(size(many))
    scene = [eye.solver.problem.scene.mesh for eye in many.eyes]
    assert all(mesh.vertices is scene[0].vertices for mesh in scene)


# --- what cameras share --------------------------------------------------------------------------

NAMES = ("one", "two", "three")


def lone(seed, phi):
    """Return a camera somewhere about the object, and one some degrees off it."""
    axes = Rotation.random(random_state=seed).as_matrix()
    camera = pj.Camera(-5 * axes[2], [0, 0, 0], axes[1], phi, 1.0, SIZE, SIZE)
    return camera, at_pose(camera, pose_of(camera) @ (OFF if seed else inverse(OFF)))


@pytest.fixture(scope="module")
def three(scenes):
    """Noisy masks by three cameras of one kind of lens, and starts."""
    random = np.random.default_rng(5)
    truths, starts = zip(*(lone(k, 0.6) for k in range(3)), strict=True)
    noise = lambda: 0.03 * random.normal(size=(SIZE, SIZE))
    views = [
        pj.JointView(scenes[0], drawn(camera, scenes[0]) + noise(), camera=name)
        for name, camera in zip(NAMES, truths, strict=True)
    ]
    off = [s.replace(phi=phi) for s, phi in zip(starts, (0.6, 0.62, 0.64), strict=True)]
    return views, dict(zip(NAMES, truths, strict=True)), dict(zip(NAMES, off, strict=True))


def test_cameras_that_share_phi_are_those_of_fit_cameras(three):
    views, truths, starts = three
    scene, masks = views[0].scene, [view.target for view in views]
    pj.fit_camera(scene, masks[0], starts["one"], ("pose", "phi"))
    programs = levenberg_marquardt.descended._cached._cache_size()
    fit = pj.fit_joint(views, starts, shared="phi")
    others = pj.fit_cameras(scene, masks, [*starts.values()])
    assert programs == levenberg_marquardt.descended._cached._cache_size()
    assert fit.status == "converged"
    assert len({float(f.camera.phi) for f in fit.cameras.values()}) == 1
    for (name, one), other in zip(fit.cameras.items(), others, strict=True):
        assert one.names == other.names
        assert max(apart(one.camera, other.camera)) < 1e-4 * min(other.std[:3])
        assert np.allclose(
            one.independent_covariance, other.independent_covariance, rtol=1e-3, atol=1e-12
        )
        # (How far views differ says the joint fit from two numbers alone.)
        wider = fit.excess * t.ppf(0.975, 2) / 1.96 if fit.excess > 1 else 1.0
        assert np.allclose(one.std, wider * other.std, rtol=0.1)
        assert max(apart(one.camera, truths[name])) < 1
        assert (len(one.history), one.history[0].steps) == (len(one.steps) + 1, 0)
        assert max(apart(one.history[0].camera, starts[name])) < 1e-9
        assert max(apart(one.history[-1].camera, one.camera)) < 1e-9
    assert abs(float(fit.cameras["one"].camera.phi) - 0.6) < 4 * fit.cameras["one"].std[-1]


def test_covariance_equals_that_of_one_dense_matrix(three):
    """All residuals' derivatives by all unknowns side by side; what is known of some among them."""
    views, _, starts = three
    known = {"phi": (0.61, 0.002), "e_x": (0.0, 3.0)}
    problem = joint_problem(views, starts, "pose", outlier_px=2.0, prior=known, shared="phi")
    layout = problem
    assert (layout.size, len(layout.priors)) == (19, 4)
    path = descended(problem, problem.start, lambda words: None, range(problem.levels, 0, -1))
    found = to_the_end(problem, path, lambda words: None).found
    layout = found.problem
    seen, rows = found.descent.seen, []
    for k, one in enumerate(seen):
        rows.append(np.zeros((len(one.view.triangle), layout.size)))
        rows[-1][:, layout.columns(k)] = np.asarray(one.view.triangle) @ one.moves
    noise, state = layout.noise(seen), found.descent.state
    beliefs = np.zeros((4, layout.size))
    beliefs[0, layout.place("one", "phi")] = noise / 0.002
    for k, name in enumerate(NAMES):
        x = layout.place(name, "pose")[3:]
        beliefs[1 + k, x] = noise / 3 * state.poses[name][0, :3]
    whole = np.concatenate([*rows, beliefs])
    # (What phi follows of its own unknown, a logarithm of the focal length, a difference says.)
    step = np.zeros(layout.size)
    step[layout.place("one", "phi")] = h = 1e-6
    phi = lambda sign: float(layout.stepped(state, sign * step).lenses["three"].phi)
    slope = (phi(1) - phi(-1)) / (2 * h)
    whole[-4] *= slope
    inverse_normal = np.linalg.inv(whole.T @ whole)
    middle = noise**2 * whole[-4:].T @ whole[-4:]
    for k, (one, gradient) in enumerate(zip(seen, found.gradients, strict=True)):
        by = np.zeros((layout.size, len(gradient)))
        by[layout.columns(k)] = layout.weights[k] * one.moves.T
        middle += found.wider * by @ gradient @ by.T
    expected = inverse_normal @ middle @ inverse_normal
    size = np.sqrt(np.diag(expected))
    everything = np.arange(layout.size)
    assert np.allclose(
        found.covariance(everything) / np.outer(size, size),
        expected / np.outer(size, size),
        atol=1e-6,
    )
    for name in NAMES:
        place = np.append(layout.place(name, "pose"), layout.place("one", "phi"))
        scale = np.outer(size[place], size[place])
        assert np.allclose(found.covariance(place) / scale, expected[np.ix_(place, place)] / scale)
    sums = [x.view.sums for x in seen]
    count = sum(float(x.touched) for x in sums) - layout.size
    variance = sum(float(x.touched_squares) for x in sums) / count
    one = found.independent(everything)
    told = variance * inverse_normal
    told += (noise**2 - variance) * inverse_normal @ whole[-4:].T @ whole[-4:] @ inverse_normal
    assert np.allclose(one / np.outer(size, size), told / np.outer(size, size), atol=1e-6)


@pytest.mark.long
def test_groups_of_cameras_have_a_lens_each(scenes):
    truths = {f"{k}": lone(k, 0.6 if k < 2 else 0.7)[0] for k in range(4)}
    views = [pj.JointView(scenes[0], drawn(c, scenes[0]), camera=n) for n, c in truths.items()]
    starts = {n: lone(int(n), 0.65)[1] for n in truths}
    fit = pj.fit_joint(views, starts, shared={"phi": [("0", "1"), ("3", "2")]})
    assert fit.status == "converged"
    phi = {n: float(f.camera.phi) for n, f in fit.cameras.items()}
    assert phi["0"] == phi["1"] != phi["2"] == phi["3"]
    assert abs(phi["0"] - 0.6) < 1e-9
    assert abs(phi["2"] - 0.7) < 1e-9
    assert all(max(apart(f.camera, truths[n])) < 1e-7 for n, f in fit.cameras.items())


def test_twists_and_adjoints():
    random = np.random.default_rng(1)
    pose, twist = exponential(random.normal(size=6)), 1e-5 * random.normal(size=6)
    seen = pose @ exponential(twist) @ inverse(pose)
    assert np.allclose(seen, exponential(adjoint(pose) @ twist), atol=1e-9)
    assert np.allclose(pose_of(at_pose(TRUTH, pose)), pose, atol=1e-12)
    assert np.allclose(exponential(np.zeros(6)), np.eye(4))


def test_assembly_is_the_union_of_its_parts(arm):
    scene = arm.at(posture(1))
    box = trimesh.creation.box((0.6, 0.9, 2.2)).vertices
    moved = box @ posture(1)[1][:3, :3].T + posture(1)[1][:3, 3]
    assert np.allclose(np.asarray(scene.mesh.vertices)[-8:], moved)
    assert scene.mesh.closed
    assert scene.mesh.faces is arm.at(posture(2)).mesh.faces
    with pytest.raises(ValueError, match=r"`poses`: expected finite numbers \(2, 4, 4\)"):
        arm.at(np.eye(4))


def hinged():
    """Return the posture of one body that turns about z."""
    turned_by = lambda x: [exponential(np.array([0, 0, x[0], 0, 0, 0]))]
    return pj.Posture(pj.Assembly([shapes.bumpy(1)]), turned_by, {"hinge": "rad"})


def one(views, **change):
    """One view, something of it changed."""
    return {"views": [views[0]._replace(**change)]}


BOTH = {"camera": TRUTH, "other": TRUTH}


@pytest.mark.parametrize(
    ("words", "change"),
    [
        (r"`views`: expected at least one JointView", lambda v: {"views": []}),
        (
            r"`cameras`: expected left among them, got camera",
            lambda v: one(v, camera="left"),
        ),
        (
            r"`cameras`: expected what a view names, got other",
            lambda v: {"cameras": {"camera": TRUTH, "other": TRUTH}},
        ),
        (
            r"`objects`: expected part among them, got none",
            lambda v: one(v, object="part"),
        ),
        (
            r"`views\[0\].mount`: expected shape \(4, 4\)",
            lambda v: one(v, mount=np.eye(3)),
        ),
        (
            r"`views\[0\].placed`: expected a rotation and a",
            lambda v: one(v, placed=2 * np.eye(4)),
        ),
        (r"`rig\['left'\]`: expected a matrix", lambda v: {"rig": {"left": "here"}}),
        (
            r"`views\[0\]`: `target`: expected the camera's shape",
            lambda v: one(v, target=np.ones((2, 3))),
        ),
        (r"`free`: expected something to fit, got none", lambda v: {"free": ()}),
        (r"`search`: expected one unknown pose", lambda v: {"free": "phi", "search": True}),
        (
            r"`views\[1\]`: expected a view of something unknown",
            lambda v: {
                "views": [v[0]._replace(object="part"), v[1]],
                "free": (),
                "objects": {"part": np.eye(4)},
            },
        ),
        (
            r"`cameras`: expected names other than 'rig'",
            lambda v: {
                "views": [v[0]._replace(camera="rig"), v[1]._replace(camera="left")],
                "cameras": {"rig": TRUTH, "left": TRUTH},
                "rig": {"left": np.eye(4)},
            },
        ),
        (
            r"`views\[0\].scale`: expected a name that no camera has, got 'camera'",
            lambda v: one(v, scale="camera"),
        ),
        (
            r"`prior`: expected a positive scale of 'size', got -1.0",
            lambda v: {**one(v, scale="size"), "prior": {"size": {"scale": (-1, 0.1)}}},
        ),
        (
            r"`prior`: expected free parameters among scale, got 'x'",
            lambda v: {**one(v, scale="size"), "prior": {"size": {"x": (0, 0.1)}}},
        ),
        (r"`outlier_px`: expected a positive", lambda v: {"outlier_px": -1.0}),
        (r"`shared`: expected names among phi, .* got pose", lambda v: {"shared": "pose"}),
        (
            r"`shared`: expected groups of cameras among camera, got 'left'",
            lambda v: {"shared": {"phi": [("camera", "left")]}},
        ),
        (
            r"`shared`: expected each camera in one group of phi, got more",
            lambda v: {"shared": {"phi": [("camera",), ("camera",)]}},
        ),
        (
            r"`bounds`: expected the same of phi for camera and other, which share it",
            lambda v: {
                "views": [v[0], v[1]._replace(camera="other")],
                "cameras": BOTH,
                "shared": "phi",
                "bounds": {"other": {"phi": (0.5, 0.7)}},
            },
        ),
        (r"`max_steps`: expected an integer", lambda v: {"max_steps": 0}),
        (
            r"`prior`: expected free parameters among e_x, e_y, e_z, got 'phi'",
            lambda v: {"prior": {"phi": (0.6, 0.1)}},
        ),
        (
            r"`prior`: expected names among camera, got 'left'",
            lambda v: {"prior": {"left": {"e_x": (0, 1)}}},
        ),
        (
            r"`prior`: expected a positive deviation of 'x', got 0.0",
            lambda v: {
                **one(v, object="part"),
                "objects": {"part": np.eye(4)},
                "free": (),
                "prior": {"part": {"x": (0, 0)}},
            },
        ),
        (
            r"`joint_zeros`: expected views with a `posture`, got none",
            lambda v: {"joint_zeros": 0.01},
        ),
        (
            r"`joint_zeros`: expected no `mount` beside a `posture`.*views\[0\]",
            lambda v: {
                **one(v, posture=hinged(), mount=np.eye(4)),
                "joint_zeros": 0.01,
            },
        ),
        (
            r"`views\[0\].posture`: expected a Posture or None, got list",
            lambda v: one(v, posture=[0.1]),
        ),
        (
            r"`bounds`: expected low < high of 'phi'",
            lambda v: {"free": ("pose", "phi"), "bounds": {"phi": (1, 0.5)}},
        ),
    ],
)
def test_wrong_arguments_are_named(views, words, change):
    arguments = {"views": views[:1], "cameras": TRUTH, **change(views)}
    with pytest.raises(ValueError, match=words):
        pj.fit_joint(**arguments)


URDF = """<robot name="two">
  <link name="base"><visual><geometry><box size="0.5 0.5 0.2"/></geometry></visual></link>
  <link name="arm"><visual><origin xyz="0 0 0.5"/><geometry><mesh filename="arm.stl" scale="2 2 2"/>
  </geometry></visual></link>
  <link name="tip"/>
  <joint name="turn" type="revolute"><parent link="base"/><child link="arm"/>
  <origin xyz="0 0 0.1"/><axis xyz="0 1 0"/>
  <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="held" type="fixed"><parent link="arm"/><child link="tip"/>
  <origin xyz="0 0 1"/></joint>
</robot>"""


def test_urdf_becomes_a_scene(tmp_path):
    pytest.importorskip("yourdfpy", reason="no yourdfpy here: URDFs are not tried")
    trimesh.creation.box((0.1, 0.1, 0.5)).export(tmp_path / "arm.stl")
    (tmp_path / "two.urdf").write_text(URDF)
    robot = pj.robots.load_urdf(tmp_path / "two.urdf")
    assert (robot.joints, robot.links) == (("turn",), ("base", "arm"))
    tip = robot.poses([np.pi / 2])["tip"]
    assert np.allclose(tip[:3, 3], [1, 0, 0.1])
    low, high = (
        f(np.asarray(robot.scene({"turn": np.pi / 2}).mesh.vertices), axis=0)
        for f in (np.min, np.max)
    )
    assert np.allclose(low, [-0.25, -0.25, -0.1], atol=1e-6)
    assert np.allclose(high, [1, 0.25, 0.2], atol=1e-6)
    alone = pj.robots.load_urdf(tmp_path / "two.urdf", leave_out=["base"])
    assert len(alone.scene([0.0]).mesh.vertices) == 8
    with pytest.raises(ValueError, match="`angles`: expected one of each joint, got none of turn"):
        robot.poses({})
    with pytest.raises(ValueError, match="`angles`: expected joints among turn, got 'bend'"):
        robot.poses({"turn": 0, "bend": 1})
    with pytest.raises(ValueError, match=r"`angles`: expected 1 numbers \(turn\), got shape"):
        robot.scene([0, 1])
    with pytest.raises(ValueError, match="`leave_out`: expected links among base"):
        pj.robots.load_urdf(tmp_path / "two.urdf", leave_out=["hand"])
    with pytest.raises(ValueError, match="`poses`: expected one of each link, got none of arm"):
        robot.at({"base": np.eye(4)})
    (tmp_path / "no.urdf").write_text("<robot")
    with pytest.raises(ValueError, match="`path`: expected a URDF file, got"):
        pj.robots.load_urdf(tmp_path / "no.urdf")


#: A lump and three links, their joints' axes this way and that.
THREE = """<robot name="three">
  <link name="base"><visual><geometry><mesh filename="body.stl"/></geometry></visual></link>
  <link name="upper"><visual><origin xyz="0 0 0.6"/><geometry><box size="0.3 0.4 1.2"/></geometry>
  </visual></link>
  <link name="fore"><visual><origin xyz="0.1 0 0.5"/><geometry><box size="0.35 0.2 1.0"/></geometry>
  </visual></link>
  <link name="hand"><visual><origin xyz="0.15 0 0.2"/><geometry><box size="0.5 0.2 0.3"/></geometry>
  </visual></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
  <origin xyz="0 0 0.2"/><axis xyz="0 1 0"/>
  <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/>
  <origin xyz="0 0 1.2"/><axis xyz="0 1 0.3"/>
  <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="wrist" type="revolute"><parent link="fore"/><child link="hand"/>
  <origin xyz="0.1 0 1.0"/><axis xyz="1 0 0"/>
  <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
</robot>"""
#: What its joints' readings lack (rad), the camera before it, and where a fit starts.
LACK = np.deg2rad([0.7, -1.3, 2.0])
BEFORE = pj.Camera([3, -5.5, 3], [0, 0, 0.8], [0, 0, 1], 0.6, 1.0, SIZE, SIZE)
NEAR = at_pose(
    BEFORE, pose_of(BEFORE) @ exponential(np.array([0.05, -0.06, 0.04, 0.1, 0.05, -0.2]))
)


@pytest.fixture(scope="module")
def misread(tmp_path_factory):
    """Views of five postures of a robot whose joints' zeros are off."""
    pytest.importorskip("yourdfpy", reason="no yourdfpy here: URDFs are not tried")
    folder, body = tmp_path_factory.mktemp("three"), shapes.bumpy(2)
    half = trimesh.Trimesh(0.5 * np.asarray(body.vertices), body.faces, process=False)
    half.export(folder / "body.stl")
    (folder / "three.urdf").write_text(THREE)
    robot = pj.robots.load_urdf(folder / "three.urdf")
    postures = np.random.default_rng(3).uniform(-1, 1, (3, 3))
    return [
        pj.JointView(
            robot.scene(read),
            drawn(BEFORE, robot.scene(read + LACK)),
            posture=robot.posture(read),
        )
        for read in postures
    ]


def test_joint_zeros_are_found_with_the_camera(misread):
    fit = pj.fit_joint(misread, NEAR, joint_zeros=np.deg2rad(1.5))
    assert fit.status == "converged"
    assert fit.joint_zeros.names == ("shoulder", "elbow", "wrist")
    assert np.rad2deg(np.max(np.abs(fit.joint_zeros.values - LACK))) < 1e-4  # (0.01 was asked)
    assert max(apart(fit.camera, BEFORE)) < 1e-5
    assert np.all(fit.joint_zeros.std < 1e-5)
    assert all(view.iou > 1 - 1e-6 for view in fit.views)


@pytest.mark.long
def test_zeros_that_are_not_sought_move_the_camera(misread):
    fit = pj.fit_joint(misread, NEAR)
    angle, _ = apart(fit.camera, BEFORE)
    assert fit.status == "misfit"
    assert angle > 0.1


@pytest.mark.long
def test_joint_that_masks_do_not_show_keeps_its_prior(misread):
    """Two sigma from its readings at most; what is not named stays."""
    known = {"wrist": 1e-5}
    fit = pj.fit_joint(misread[:2], NEAR, joint_zeros=known)
    assert fit.joint_zeros.names == ("wrist",)
    assert abs(fit.joint_zeros.std[0] / 1e-5 - 1) < 0.1


def test_jacobian_by_joint_zeros_equals_differences(misread):
    """But for pixels in which two links end: a small picture has some."""
    problem = joint_problem(misread[:1], BEFORE, "pose", joint_zeros=1).with_zeros()
    state, posture = problem.start, misread[0].posture
    seen = problem.look(state)[0]
    pixels, count = seen.view.pixels, len(seen.view.pixels.cell)
    stated = (np.asarray(seen.view.jacobian) @ seen.moves)[:count, -3:]
    used = np.asarray(pixels.weight) > 0
    row, column = np.divmod(np.asarray(pixels.cell)[used], int(seen.view.level.W) + 2)
    left, bottom = np.asarray(seen.view.level.origin, int)
    for k, step in enumerate(1e-5 * np.eye(3)):
        one, other = (drawn(BEFORE, posture.scene(sign * step)) for sign in (1, -1))
        change = (one - other) / 2e-5
        here = change[SIZE - 1 - row - bottom, column - 1 + left]
        assert np.isclose(np.linalg.norm(here), np.linalg.norm(change))
        off = np.abs(stated[used, k] - here) > 1e-3 * np.max(np.abs(here))
        assert np.mean(off) < 0.06
        assert np.linalg.norm(stated[used, k] - here) < 0.1 * np.linalg.norm(here)


def test_proposed_mask_adds_its_information(scenes):
    free, mesh = ("pose", "phi"), scenes[0].mesh
    ideal = information(TRUTH, scenes[0], free)
    expected = pj.observability(TRUTH, scenes[0], free, noise=1.0)
    np.testing.assert_allclose(np.linalg.inv(ideal), expected.covariance, rtol=1e-6)
    # A camera on a link sees what it sees where the scene is given in the link's frame.
    mount = exponential(np.array([0.4, -1.0, 0.3, 0.5, 2.0, -1.0]))
    held = at_pose(TRUTH, inverse(mount) @ pose_of(TRUTH))
    points = (np.asarray(mesh.vertices) - mount[:3, 3]) @ mount[:3, :3]
    before = pj.Scene(mesh=pj.Mesh(points, mesh.faces))
    told = tells(held, scenes[0], mount, free, expected.names)
    np.testing.assert_allclose(told, information(held, before, free), rtol=1e-6, atol=1e-3)
    # Of two masks that are alike a third one is worth its share; one that shows nothing, none.
    seen, lost = (scenes[0], None), 3 * np.linalg.inv(ideal)
    aside = pj.Scene(mesh=pj.Mesh(mesh.vertices + 90.0, mesh.faces)), None
    found = worths(TRUTH, lost, free, [seen, seen], [seen, aside])
    np.testing.assert_allclose(found, [1.5**0.5, 1], rtol=1e-6)
    assert worths(TRUTH, np.nan * lost, free, [seen], [seen]) == [np.inf]


@pytest.fixture
def robot_files(tmp_path, monkeypatch):
    """A robot of two links, angles and masks of three postures, a camera to start from."""
    pytest.importorskip("yourdfpy", reason="no yourdfpy here: URDFs are not tried")
    # What the command sets for its own process would change those of the other tests.
    monkeypatch.setattr(command, "_set_up_jax", lambda *_, **__: None)
    monkeypatch.chdir(tmp_path)
    body = shapes.bumpy(2)
    trimesh.Trimesh(body.vertices, body.faces, process=False).export("body.stl")
    trimesh.creation.box((0.6, 0.9, 2.2)).export("arm.stl")
    base = '<box size="0.5 0.5 0.2"/>', '<mesh filename="body.stl"/>'
    text = URDF.replace(*base).replace(' scale="2 2 2"', "").replace('xyz="0 0 0.1"', 'xyz="1 0 0"')
    Path("arm.urdf").write_text(text)
    Path("joints.csv").write_text("turn\n-0.6\n0.3\n1.1\n")
    robot = pj.robots.load_urdf("arm.urdf")
    for k, angle in enumerate((-0.6, 0.3, 1.1)):
        pj.io.save_image(f"mask_{k}.png", drawn(TRUTH, robot.scene([angle])))
    pj.io.save_camera("start.json", START)
    return ["hand-eye", "arm.urdf", "joints.csv", *(f"mask_{k}.png" for k in range(3))]


@pytest.mark.long
def test_command_finds_joint_zeros_and_writes_a_page(robot_files, capsys):
    Path("joints.csv").write_text("turn\n-0.61\n0.29\n1.09\n")
    Path("more.csv").write_text("turn\n0.31\n-1.9\n")
    words = [*robot_files, "--camera", "start.json", "--joint-zeros", "1", "-o", "found"]
    words += ["--propose", "more.csv", "--holdout", "--report", "page.html"]
    assert command.main(words) == 0
    out = capsys.readouterr().out
    assert max(apart(pj.io.load_fit("found/camera.json").camera, TRUTH)) < 0.02
    found = float(re.search(r"^turn +([-+0-9.]+) ", out, re.M)[1])
    assert abs(found - np.rad2deg(0.01)) < 0.05
    page = Path("page.html").read_text()
    for words in ("95 % interval", "sigma off", "mask only", "they agree", "mask_2.png", "turn"):
        assert words in page
    assert re.search(r"^recorded +without view [012] .* were 1\.\d\d times as large$", out, re.M)
    more = re.search(r"^proposed +(one more mask .*)$", out, re.M)[1]
    assert more in page
    assert {"1", "2"} == set(re.findall(r"row (\d) 1\.\d\d", more))
    assert page.count("<img") == 3
    assert page.count("<section") == page.count("</section>") == 7
    headings = re.findall("<h2>(.*?)</h2>", page)
    assert headings[0] == "Outlines"
    assert {"Halves of the postures", "Other postures"} < {*headings}


@pytest.mark.long
def test_command_finds_the_camera_of_a_robot(robot_files, capsys):
    words = [*robot_files, "--camera", "start.json", "--holdout", "-o", "found"]
    words += ["--images", *robot_files[3:], "--refine"]
    assert command.main(words) == 0
    out = capsys.readouterr().out
    assert len(re.findall(r"view \d: the camera is the mask's", out)) == 3
    found = pj.io.load_fit("found/camera.json")
    assert max(apart(found.camera, TRUTH)) < 2e-3
    assert re.search(r"^halves .* sigma: they agree$", out, re.M)
    written = re.search(r"^written +(.*)$", out, re.M)[1].split(", ")
    assert len(written) == 4
    assert all(Path(path).exists() for path in written)


def test_command_names_the_wrong_robot_argument(robot_files, capsys):
    start = ["--camera", "start.json"]
    Path("short.json").write_text('{"names": ["turn"], "postures": [[1, 2]]}')
    Path("other.csv").write_text("bend\n0\n0\n0\n")
    Path("far.csv").write_text("turn\n0.1\n-34\n0.2\n")
    for unit in ("deg", "gon"):
        text = f'{{"unit": "{unit}", "names": ["turn"], "postures": [[400]]}}'
        Path(f"{unit}.json").write_text(text)
    pj.io.save_image("small.png", np.zeros((30, 40, 3), np.uint8))
    robot, masks = robot_files[:2], robot_files[3:]
    for change, words in (
        ([*robot_files[:-1], *start], "`MASK`: expected one for each of 3 rows of 'joints.csv'"),
        ([*robot_files, *start, "--joint-zeros", "-1"], "`--joint-zeros`: expected a positive"),
        (
            [*robot_files, *start, "--joint-zeros", "1", "--in-hand", "arm"],
            "`--joint-zeros`: expected none beside `--in-hand`",
        ),
        (
            [*robot_files, *start, "--propose", "short.json"],
            "`--propose`: expected 1 angles in row 1",
        ),
        (
            [*robot_files, *start, "--free", "phi", "--propose", "joints.csv"],
            "`--propose`: expected `pose` in --free",
        ),
        ([*robot_files, *start, "--refine"], "`--refine`: expected photos, --images"),
        ([*robot_files, *start, "--images", masks[0]], "`--images`: expected one for each of 3"),
        (
            [*robot_files, *start, "--images", *masks[:2], "small.png"],
            "`--images`: expected the mask's size 96 x 96, got 40 x 30 (small.png)",
        ),
        ([*robot_files, *start, "--in-hand", "tool"], "`--in-hand`: expected a link among base"),
        ([*robot_files, *start, "--leave-out", "tool"], "`--leave-out`: expected links among base"),
        ([*robot, "far.csv", *masks, *start], "-34 in row 2 of 'far.csv': degrees?"),
        ([*robot, "deg.json", *masks, *start], "`JOINTS`: expected -3 to 3 rad of joint"),
        (
            [*robot, "gon.json", *masks, *start],
            '`JOINTS`: expected "unit": "rad" or "deg", got \'unit\': \'gon\'',
        ),
        ([*robot, "other.csv", *masks, *start], "`JOINTS`: expected one of each joint, got none"),
        ([*robot, "short.json", *masks[:1], *start], "`JOINTS`: expected 1 angles in row 1, got 2"),
    ):
        assert command.main(change) == 2
        assert words in capsys.readouterr().err


def test_mesh_with_unshared_vertices_warns():
    sphere = trimesh.creation.icosphere(2)
    loose = np.asarray(sphere.vertices)[sphere.faces].reshape(-1, 3)
    with pytest.warns(UserWarning, match="`vertices`: 960 stand at 162 places"):
        pj.Mesh(loose, np.arange(len(loose)).reshape(-1, 3))
    pj.Mesh(sphere.vertices, sphere.faces)  # (a warning here is an error)


@pytest.fixture
def med7(shared):
    pytest.importorskip("yourdfpy", reason="no yourdfpy here: robots are not tried")
    folder = shared / "robots" / "lbr_med7"
    joints = json.loads((folder / "joints.json").read_text())
    robot = pj.robots.load_urdf(folder / "lbr_med7.urdf")
    return folder, [robot.scene(angles) for angles in joints["postures"]]


#: The stereo camera's, both eyes', centres at integers.
FOCAL, CENTRE, BASELINE = 534.6265258789062, (478.0846252441406, 260.9943542480469), 0.12009


def med7_fit(med7, side, **near):
    folder, scenes = med7
    K = [[FOCAL, 0, CENTRE[0]], [0, FOCAL, CENTRE[1]], [0, 0, 1]]
    pose = np.eye(3), np.zeros(3)
    camera = pj.formats.from_opencv(K, *pose, 960, 540, pixel_centres="integer")
    views = []
    for k, scene in enumerate(scenes):
        mask = np.asarray(Image.open(folder / f"{side}_mask_{k}.png"))
        views.append(pj.JointView(scene, mask))
    # (With no start it takes three times as long.)
    start = camera.replace(**near)
    return pj.fit_joint(views, start, search=not near).cameras["camera"]


@pytest.mark.long
def test_stereo_camera_before_a_real_robot_is_recovered(med7, exhaustive):
    """The left from nearby (of all tests: with no start), the right from where the left is: that
    they are 120.09 mm apart and parallel no fit knew."""
    near = {"e": [0.8, -1, 1.1], "p": [0, -0.4, 0.7], "u": [-0.5, 0, 0.9]}
    left = med7_fit(med7, "left", **({} if exhaustive else near))
    right = med7_fit(med7, "right", **{name: getattr(left.camera, name) for name in near})
    assert (left.status, right.status) == ("converged", "converged")
    between = inverse(pose_of(left.camera)) @ pose_of(right.camera)
    assert abs(np.linalg.norm(between[:3, 3]) - BASELINE) < 1.5e-3
    turn = Rotation.from_matrix(between[:3, :3]).as_rotvec()
    assert np.rad2deg(np.linalg.norm(turn)) < 0.2  # (0.1 was asked)
    sigma = np.hypot(left.std, right.std)
    assert np.all(np.abs(turn) < 1.96 * sigma[:3])
    apart_by = pose_of(left.camera)[:3, :3] @ (between[:3, 3] - [BASELINE, 0, 0])
    assert np.all(np.abs(apart_by) < 1.96 * sigma[3:])
