"""The conventions by hand, what is refused, and what is shown."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import central_difference, skew_camera, turned
from refusals import refusal, refuses
from scipy.spatial.transform import Rotation

import pinhole_jax as pj
from pinhole_jax._camera.lens import check_lens

E, P, U = [0.0, 0.0, 5.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]
GOOD = {"e": E, "p": P, "u": U, "phi": 0.5, "d": 1.0, "W": 4, "H": 4}
PLAIN = pj.Camera(E, P, U, np.pi / 2, W=200, H=100)
SHIFTED = PLAIN.replace(lens=pj.Lens([90.0, 40.0], 1.5))
K = np.array([[70.0, 0, 30], [0, 65, 26], [0, 0, 1]])


@pytest.mark.parametrize(
    "e, p, u, basis",
    [
        (E, P, U, [[1, 0, 0], [0, 1, 0], [0, 0, -1]]),
        # v = (3,4,0)/5; v x (0,0,7) = (28,-21,0)/5 -> b1 = (4,-3,0)/5; b2 = b1 x v = (0,0,1)
        ([1, 1, 1], [4, 5, 1], [3, 4, 7], [[0.8, -0.6, 0], [0, 0, 1], [0.6, 0.8, 0]]),
    ],
)
def test_basis_by_hand(e, p, u, basis):
    # v = (p-e)/|p-e|, b1 = (v x u)/|v x u|, b2 = b1 x v; u is neither unit nor orthogonal
    camera = pj.Camera(e, p, u, 0.5, W=4, H=4)
    assert_allclose(pj.camera_basis(camera), basis, atol=1e-15)
    assert_allclose(np.asarray(camera.R) * [[1], [-1], [1]], basis, atol=1e-15)
    assert_allclose(np.asarray(camera.R) @ e + camera.t, 0, atol=1e-15)


def test_gauge_changes_no_view():
    camera = pj.Camera([1, 2, 5], [0, 0.5, 0], [0.1, 1, 0.3], 0.5, W=4, H=4)
    view = camera.p - camera.e
    other = camera.replace(p=camera.e + 7 * view, u=3 * camera.u + view, d=9.0)
    assert_allclose(pj.camera_basis(camera), pj.camera_basis(other), atol=1e-15)
    points = [[0.3, 0.2, 0.1]]
    assert_allclose(pj.project(camera, points), pj.project(other, points), atol=1e-13)
    other = other.replace(phi=0.3, W=8, H=8)
    assert_allclose(pj.pose_error(camera, other), 0, atol=1e-15)


def test_focal_length_is_seen_in_K_and_can_be_changed_alone():
    focal = lambda camera: [camera.K[0, 0], camera.K[1, 1]]
    assert_allclose(focal(PLAIN), [50, 50])  # H / (2 tan(phi/2)) = 100 / 2
    assert_allclose(focal(SHIFTED), [75, 50])
    assert_allclose(focal(SHIFTED.with_focal(80.0)), [120, 80])
    other = SHIFTED.with_focal([90.0, 80.0])
    assert_allclose([*focal(other), *other.lens.principal_point], [90, 80, 90, 40])
    assert PLAIN.with_focal(80.0).lens is None
    assert_allclose(PLAIN.with_focal([90.0, 80.0]).lens.principal_point, [100, 50])
    place = lambda f: pj.project(PLAIN.with_focal(f), jnp.array([1.0, 2.0, 1.0]))
    assert_allclose(jax.jit(jax.jacrev(place))(80.0), [1 / 4, 2 / 4], atol=1e-12)


def test_order_of_arguments_is_that_of_the_note_and_resolution_is_static():
    leaves, tree = jax.tree.flatten(pj.Camera(E, P, U, 0.5, 2.0, 8, 6))
    assert [*map(np.ndim, leaves)] == [1, 1, 1, 0, 0]
    assert leaves[3:] == [0.5, 2.0]
    assert tree == jax.tree.structure(pj.Camera(e=E, p=P, u=U, phi=0.5, d=2.0, W=8, H=6))


def test_camera_from_K_projects_as_by_hand_and_differentiates():
    """u, v, w = K (R X + t) by themselves, and how that changes with K, the rotation and t."""
    random, point = np.random.default_rng(0), np.array([0.3, -0.2, 0.4])
    R = Rotation.from_rotvec([2.9, 0.3, -0.2]).as_matrix()
    change = random.normal(size=(3, 3)) * (K != 0) * [[1], [1], [0]]  # the last row is none
    turn, shift = random.normal(size=(2, 3))
    turned = np.cross(turn, R, axisb=0).T  # how R changes

    def given(s):
        return K + s * change, R + s * turned, np.array([0.1, 0.2, 4]) + s * shift

    def by_hand(s):
        k, R, t = given(s)
        u, v, w = k @ (R @ point + t)
        return np.array([u / w, 48 - v / w])  # film coordinates: y up

    def by_camera(s):
        return pj.project(pj.Camera.from_K(*given(s), 64, 48, pixel_centres="half"), point)

    place, slope = jax.jit(lambda s: jax.jvp(by_camera, (s,), (1.0,)))(0.0)
    assert_allclose(place, by_hand(0.0), atol=1e-10)
    assert_allclose(slope, central_difference(by_hand, 0.0), rtol=1e-6)


@pytest.mark.parametrize(
    "e, p, dtype",
    [
        (E, P, "float64"),
        (np.array(E, np.float32), np.array(P), "float64"),
        (np.array(E, np.float32), P, "float32"),
        (jnp.array(E, jnp.bfloat16), P, "float32"),
    ],
)
def test_float_type_follows_the_arguments(e, p, dtype):
    camera = pj.Camera(e, p, U, 0.5, W=2, H=2, lens=pj.Lens([1.0, 1.0]))
    assert {x.dtype for x in jax.tree.leaves(camera)} == {np.dtype(dtype)}
    assert pj.project(camera, np.ones((2, 3), dtype)).dtype == dtype


test_bad_arguments_are_refused = refuses(
    pj.Camera,
    GOOD,
    {
        r"`e`: expected a real array of shape \(3,\), got shape \(2,\)": {"e": [0, 0]},
        r"`e`: expected .*, got \[\[1\]": {"e": [[1], [1, 2], 3]},
        r"`e`: expected finite values, got nan at index \(1,\)": {"e": [0, np.nan, 1]},
        r"`phi`: expected a real number, got shape \(1,\)": {"phi": [0.5]},
        r"`phi`: expected an angle in \(0, pi\) rad, got 0.0": {"phi": 0.0},
        r"`phi`: expected an angle in \(0, pi\) rad": {"phi": np.pi},
        "`d`: expected a positive distance, got 0.0": {"d": 0.0},
        "`p`: expected a view point other than the eye `e`": {"p": E},
        "`u`: expected a direction not parallel to the view": {"u": [0, 0, 3]},
        "`u`: expected an up direction, got the null vector": {"u": [0, 0, 0]},
        "`W`: expected an integer of at least 1, got 0": {"W": 0},
        "`W`: expected an integer of at least 1, got 2.5": {"W": 2.5},
        "`W`: expected": {"W": 2**31},
        "`W`, `H`: expected at most 1073741824 pixels": {"W": 2**16, "H": 2**16},
    },
)

test_bad_lenses_are_refused = refuses(
    pj.Lens,
    {"principal_point": [1.0, 2.0]},
    {
        r"`principal_point`: expected .* got shape \(1,\)": {"principal_point": [1.0]},
        "`principal_point`: expected finite values": {"principal_point": [1.0, np.nan]},
        "`aspect`: expected a positive ratio, got 0.0": {"aspect": 0.0},
    },
)

test_bad_poses_are_refused = refuses(
    PLAIN.with_pose,
    {"eye": [1.0, 2, 3], "axes": np.diag([1.0, 1, -1])},
    {
        r"`eye`: expected a real array of shape \(3,\), got shape \(2,\)": {"eye": [1.0, 2]},
        "`eye`: expected finite values, got inf": {"eye": [1.0, 2, np.inf]},
        r"`axes`: expected a real array of shape \(3, 3\)": {"axes": np.eye(2)},
        "`axes`: expected unit vectors right, up, forward": {"axes": np.eye(3)},
        "`axes`: expected finite values, got nan": {"axes": np.full((3, 3), np.nan)},
    },
)


@pytest.mark.parametrize("focal", [0.0, [80.0, -1.0], [1.0, 2, 3], np.nan, None])
def test_bad_focal_lengths_are_refused(focal):
    with refusal("`focal_px`: expected"):
        PLAIN.with_focal(focal)


def test_lens_that_is_none_is_refused():
    with refusal("`lens`: expected a Lens or None, got tuple"):
        check_lens((2.0, 1.0))


def test_camera_without_a_resolution_names_what_is_missing():
    for arguments in ((), (640, 480)):
        with pytest.raises(TypeError, match=r"missing W or H, .* \(d comes before them\)"):
            pj.Camera(E, P, U, 0.6, *arguments)


def test_traced_cameras_are_made_without_a_look_at_values():
    lens = pj.Lens([1, 1], distortion=pj.BrownConrady(0.05))
    known = pj.Camera(E, P, U, 0.5, 1.0, 2, 2, lens)
    # (phi and lens are not traced.)
    moves = jax.jit(jax.grad(lambda e: jnp.sum(known.replace(e=e).e ** 2)))
    assert moves(jnp.array(E)).tolist() == [0, 0, 10]


def test_camera_prints_as_a_table_and_its_gradient_as_one():
    lens = pj.Lens([320, 240], 1.01, pj.BrownConrady(-0.2, p1=1e-3))
    far = pj.Camera([1e5 + 2.125, 1, 5], [1e5, 0, 0], U, 0.6, 1.0, 640, 480, lens)
    text = str(far)
    for part in ("Camera of 640 x 480 px", "(100002.125, 1, 5)   eye", "0.6 rad", "34.3775 degrees",
                 "aspect 1.01", "BrownConrady: k1 = -0.2, k2 = 0, p1 = 0.001"):  # fmt: skip
        assert part in text
    assert "(nan, nan, nan)   eye" in str(jax.tree.map(lambda x: x * np.nan, far))
    jax.jit(lambda c: str(c) and c.e)(far)
    slope = jax.jit(jax.grad(lambda c: pj.project(c, jnp.ones(3))[0]))(PLAIN)
    assert str(slope).startswith("Gradient, or change, of a camera of 200 x 100 px\n")
    assert f"{float(slope.phi):.6g}" in str(slope)
    assert "degrees" not in str(slope)
    assert "eye" not in slope._repr_html_()


def test_column_is_a_translation_and_a_centred_camera_has_no_lens():
    middle = [[70.0, 0, 31.5], [0, 70, 23.5], [0, 0, 1]]
    column = [[0.0], [0], [4]]
    centred = pj.Camera.from_K(middle, np.eye(3), column, 64, 48, pixel_centres="integer")
    assert centred.lens is None
    assert_allclose(centred.e, [0, 0, -4])


# --- how far two cameras, or masks, are apart -----------------------------------------------------

SKEW = skew_camera(3, 2, d=2.0)


@pytest.mark.parametrize("degrees", [1e-9, 0.3, 90.0, 180.0])
def test_pose_error_is_the_angle_turned_and_the_way_moved(degrees):
    angle, shift = pj.pose_error(SKEW, turned(SKEW, degrees))
    assert_allclose(np.rad2deg(angle), degrees, rtol=1e-5)
    expected = np.linalg.norm(np.asarray(turned(SKEW, degrees).e - SKEW.e))
    assert_allclose(shift, expected)


def test_pose_error_has_a_finite_derivative_at_zero():
    slope = jax.jit(jax.grad(lambda c: pj.pose_error(c, SKEW)[0]))(SKEW)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(slope))


def test_iou_by_hand():
    a, b = jnp.array([[1.0, 0.5, 0]]), jnp.array([[0.5, 0.5, 0.5]])
    assert_allclose(pj.iou(a, b), 1.0 / 2.0)
    assert float(pj.iou(0 * a, 0 * a)) == 1
