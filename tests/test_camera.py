import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pinhole_jax as pj
from pinhole_jax._camera.camera import basis, camera_basis, film_size, focal_px, to_camera
from pinhole_jax._camera.lens import check_lens

E, P, U = [0.0, 0.0, 5.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]


def arrays(*values):
    return [jnp.array(v, float) for v in values]


def test_basis_by_hand():
    # v = (p-e)/|p-e|, b1 = (v x u)/|v x u|, b2 = b1 x v
    b1, b2, v = basis(*arrays([0, 0, 5], [0, 0, 0], [0, 1, 0]))
    np.testing.assert_allclose(v, [0, 0, -1])
    np.testing.assert_allclose(b1, [1, 0, 0])
    np.testing.assert_allclose(b2, [0, 1, 0])


def test_basis_by_hand_with_u_neither_unit_nor_orthogonal():
    # v = (3,4,0)/5; v x (0,0,7) = (28,-21,0)/5 -> b1 = (4,-3,0)/5; b2 = b1 x v = (0,0,1)
    b1, b2, v = basis(*arrays([1, 1, 1], [4, 5, 1], [3, 4, 7]))
    np.testing.assert_allclose(v, [0.6, 0.8, 0], atol=1e-15)
    np.testing.assert_allclose(b1, [0.8, -0.6, 0], atol=1e-15)
    np.testing.assert_allclose(b2, [0, 0, 1], atol=1e-15)


def test_film_size_by_hand():
    # h = 2 d tan(phi/2) = 2 * 3 * tan(45 deg) = 6, w = h W/H = 6 * 4/2 = 12
    w, h = film_size(*arrays(np.pi / 2, 3.0), 4, 2)
    np.testing.assert_allclose([w, h], [12, 6])


def test_focal_length_in_pixels():
    # H / (2 tan(phi/2)) = 100 / 2
    camera = pj.Camera(E, P, U, np.pi / 2, W=200, H=100)
    np.testing.assert_allclose(focal_px(camera), [50, 50])
    wide = pj.Camera(E, P, U, np.pi / 2, W=200, H=100, lens=pj.Lens([90.0, 40.0], 1.5))
    np.testing.assert_allclose(focal_px(wide), [75, 50])


def test_camera_coordinates_are_right_up_forward():
    camera = pj.Camera(E, P, U, 0.5, W=4, H=4)
    np.testing.assert_allclose(to_camera(camera, jnp.array([1.0, 2.0, 2.0])), [1, 2, 3])


def test_gauge_changes_no_view():
    camera = pj.Camera([1, 2, 5], [0, 0.5, 0], [0.1, 1, 0.3], 0.5, W=4, H=4)
    other = pj.Camera(
        camera.e,
        camera.e + 7 * (camera.p - camera.e),
        3 * camera.u + camera.p - camera.e,
        0.5,
        9.0,
        4,
        4,
    )
    np.testing.assert_allclose(camera_basis(camera), camera_basis(other), atol=1e-15)
    points = jnp.array([[0.3, 0.2, 0.1]])
    np.testing.assert_allclose(pj.project(camera, points), pj.project(other, points), atol=1e-13)


def test_positional_order_is_that_of_the_note_and_keywords_work():
    camera = pj.Camera(E, P, U, 0.5, 2.0, 8, 6)
    assert (float(camera.phi), float(camera.d), camera.W, camera.H) == (0.5, 2.0, 8, 6)
    same = pj.Camera(e=E, p=P, u=U, phi=0.5, d=2.0, W=8, H=6)
    assert jax.tree.structure(camera) == jax.tree.structure(same)


def test_resolution_is_static_and_the_rest_are_leaves():
    camera = pj.Camera(E, P, U, 0.5, W=8, H=6)
    leaves, tree = jax.tree.flatten(camera)
    assert [leaf.shape for leaf in leaves] == [(3,), (3,), (3,), (), ()]
    assert tree.unflatten(leaves).W == 8


def test_float_type_follows_the_arguments():
    assert pj.Camera(E, P, U, 0.5, W=2, H=2).e.dtype == jnp.float64
    single = pj.Camera(np.array(E, np.float32), np.array(P), U, 0.5, W=2, H=2)
    assert single.e.dtype == jnp.float64  # p is float64
    half = pj.Camera(jnp.array(E, jnp.bfloat16), P, U, 0.5, W=2, H=2)
    assert half.e.dtype == jnp.float32
    single = pj.Camera(np.array(E, np.float32), P, U, 0.5, W=2, H=2, lens=pj.Lens([1.0, 1.0]))
    assert {x.dtype for x in jax.tree.leaves(single)} == {np.dtype(np.float32)}


GOOD = {"e": E, "p": P, "u": U, "phi": 0.5, "d": 1.0, "W": 4, "H": 4}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"e": [0, 0]}, r"`e`: expected a real array of shape \(3,\), got shape \(2,\)"),
        ({"p": [[0, 0, 0]]}, r"`p`: expected .* got shape \(1, 3\)"),
        ({"e": ["a", "b", "c"]}, r"`e`: expected .* got dtype"),
        ({"e": [[1], [1, 2], 3]}, r"`e`: expected .*, got \[\[1\]"),
        ({"u": [0, 1j, 0]}, r"`u`: expected .* got dtype complex128"),
        ({"e": [0, np.nan, 1]}, r"`e`: expected finite values, got nan at index \(1,\)"),
        ({"phi": np.inf}, r"`phi`: expected finite values, got inf"),
        ({"phi": [0.5]}, r"`phi`: expected a real number, got shape \(1,\)"),
        ({"phi": 0.0}, r"`phi`: expected an angle in \(0, pi\) rad, got 0.0"),
        ({"phi": np.pi}, r"`phi`: expected an angle in \(0, pi\) rad"),
        ({"phi": -0.5}, r"`phi`: expected an angle in \(0, pi\) rad, got -0.5"),
        ({"d": 0.0}, r"`d`: expected a positive distance, got 0.0"),
        ({"p": E}, r"`p`: expected a view point other than the eye `e`"),
        ({"u": [0, 0, 3]}, r"`u`: expected a direction not parallel to the view"),
        ({"u": [0, 0, 0]}, r"`u`: expected an up direction, got the null vector"),
        ({"W": 0}, r"`W`: expected an integer of at least 1, got 0"),
        ({"H": -3}, r"`H`: expected an integer of at least 1, got -3"),
        ({"W": 2.5}, r"`W`: expected an integer of at least 1, got 2.5"),
        ({"H": None}, r"`H`: expected an integer of at least 1, got None"),
        ({"e": True}, r"`e`: expected .* got dtype bool"),
    ],
)
def test_bad_input_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        pj.Camera(**{**GOOD, **change})


@pytest.mark.parametrize(
    ("point", "aspect", "message"),
    [
        ([1.0], 1.0, r"`principal_point`: expected .* got shape \(1,\)"),
        ([1.0, np.nan], 1.0, r"`principal_point`: expected finite values"),
        ([1.0, 2.0], 0.0, r"`aspect`: expected a positive ratio, got 0.0"),
    ],
)
def test_bad_lens_is_refused(point, aspect, message):
    with pytest.raises(ValueError, match=message):
        pj.Lens(point, aspect)


def test_traced_cameras_are_made_without_a_look_at_values():
    make = jax.jit(lambda e, phi: pj.Camera(e, jnp.zeros(3), jnp.array([0.0, 1, 0]), phi, W=2, H=2))
    assert make(jnp.array([0.0, 0, 5]), 0.5).W == 2
    lens = pj.Lens([1, 1], distortion=pj.BrownConrady(0.05))
    known = pj.Camera([0.0, 0, 5], [0, 0, 0], [0, 1, 0], 0.5, 1.0, 2, 2, lens)
    moves = jax.grad(lambda e: jnp.sum(known.replace(e=e).e ** 2))  # (phi and lens are not traced)
    assert moves(jnp.array([0.0, 0, 5])).tolist() == [0, 0, 10]


def test_camera_without_a_resolution_names_what_is_missing():
    for arguments in ((), (640, 480)):
        with pytest.raises(TypeError, match=r"missing W or H, .* \(d comes before them\)"):
            pj.Camera([0, 0, 5], [0, 0, 0], [0, 1, 0], 0.6, *arguments)


def test_camera_prints_as_a_table():
    lens = pj.Lens([320, 240], 1.01, pj.BrownConrady(-0.2, p1=1e-3))
    text = str(pj.Camera([1, 2, 5], [0, 0, 0], [0, 1, 0], 0.6, 1.0, 640, 480, lens))
    for part in ("640 x 480 px", "(1, 2, 5)", "0.6 rad", "34.3775 degrees", "aspect 1.01"):
        assert part in text
    assert "BrownConrady: k1 = -0.2, k2 = 0, p1 = 0.001" in text
    far = pj.Camera([1e5 + 2.125, 1, 5], [1e5, 0, 0], [0, 1, 0], 0.6, 1.0, 640, 480)
    assert "(100002.125, 1, 5)   eye" in str(far)
    assert "(nan, nan, nan)   eye" in str(jax.tree.map(lambda x: x * np.nan, far))
    with pytest.raises(ValueError, match="`lens`: expected a Lens or None, got tuple"):
        check_lens((320.0, 240.0))
    jax.jit(lambda c: str(c) and c.e)(pj.Camera([1, 2, 5], [0, 0, 0], [0, 1, 0], 0.6, 1.0, 64, 48))


K = np.array([[70.0, 0, 30], [0, 65, 26], [0, 0, 1]])


def with_matrices(k, rotated, t):
    """Return a camera of OpenCV's matrices: its rotation follows a vector by Rodrigues."""
    angle = jnp.linalg.norm(rotated)
    x, y, z = rotated / angle
    by = jnp.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    R = jnp.eye(3) + jnp.sin(angle) * by + (1 - jnp.cos(angle)) * by @ by
    return pj.Camera.from_K(k, R, t, 64, 48, pixel_centres="half")


def test_camera_from_K_projects_and_differentiates_as_by_hand():
    """u, v, w = K (R X + t) by themselves, and their derivative."""
    point, rotated, t = arrays([0.3, -0.2, 0.4], [2.9, 0.3, -0.2], [0.1, 0.2, 4.0])

    def by_hand(k, rotated, t):
        angle = jnp.linalg.norm(rotated)
        axis = rotated / angle
        seen = point * jnp.cos(angle) + jnp.cross(axis, point) * jnp.sin(angle)
        u, v, w = k @ (seen + axis * jnp.dot(axis, point) * (1 - jnp.cos(angle)) + t)
        return jnp.stack([u / w, 48 - v / w])  # film coordinates: y up

    by_camera = lambda *given: pj.project(with_matrices(*given), point)
    given = jnp.asarray(K), rotated, t
    np.testing.assert_allclose(by_camera(*given), by_hand(*given), atol=1e-10)
    ours, theirs = (jax.jacrev(f, argnums=(0, 1, 2))(*given) for f in (by_camera, by_hand))
    free = np.diag([0, 0, 1]) != K  # (the last row is no parameter, and there is no skew)
    free[0, 1] = free[2] = False
    np.testing.assert_allclose(ours[0][:, free], theirs[0][:, free], atol=1e-9)
    for mine, hand in zip(ours[1:], theirs[1:], strict=True):
        np.testing.assert_allclose(mine, hand, atol=1e-8)
    # A column is a translation, too, and a centred camera has no lens.
    middle = [[70.0, 0, 31.5], [0, 70, 23.5], [0, 0, 1]]
    column = [[0.0], [0], [4]]
    centred = pj.Camera.from_K(middle, np.eye(3), column, 64, 48, pixel_centres="integer")
    assert centred.lens is None


def test_focal_length_changes_nothing_else():
    camera = pj.Camera(E, P, U, 0.5, W=200, H=100, lens=pj.Lens([90.0, 40.0], 1.5))
    np.testing.assert_allclose(focal_px(camera.with_focal(80.0)), [120, 80])
    other = camera.with_focal([90.0, 80.0])
    np.testing.assert_allclose(focal_px(other), [90, 80])
    np.testing.assert_allclose(other.lens.principal_point, [90, 40])
    plain = pj.Camera(E, P, U, 0.5, W=200, H=100)
    assert plain.with_focal(80.0).lens is None
    np.testing.assert_allclose(plain.with_focal([90.0, 80.0]).lens.principal_point, [100, 50])
    of_focal = lambda f: pj.project(plain.with_focal(f), jnp.array([1.0, 2.0, 1.0]))
    np.testing.assert_allclose(jax.jacrev(of_focal)(80.0), [1 / 4, 2 / 4], atol=1e-12)


@pytest.mark.parametrize("focal", [0.0, [80.0, -1.0], [1.0, 2, 3], np.nan, None])
def test_bad_focal_length_is_refused(focal):
    with pytest.raises(ValueError, match="`focal_px`: expected"):
        pj.Camera(E, P, U, 0.5, W=200, H=100).with_focal(focal)


@pytest.mark.parametrize(
    ("eye", "axes", "words"),
    [
        ([1.0, 2], np.diag([1.0, 1, -1]), "`eye`: expected finite numbers of shape"),
        ([1.0, 2, np.inf], np.diag([1.0, 1, -1]), "`eye`: expected finite numbers of shape"),
        ([1.0, 2, 3], np.eye(2), r"`axes`: expected shape \(3, 3\)"),
        ([1.0, 2, 3], np.eye(3), "`axes`: expected unit vectors right, up, forward"),
        ([1.0, 2, 3], 2 * np.diag([1.0, 1, -1]), "`axes`: expected unit vectors"),
        ([1.0, 2, 3], np.full((3, 3), np.nan), "`axes`: expected unit vectors"),
    ],
)
def test_bad_pose_is_refused(eye, axes, words):
    with pytest.raises(ValueError, match=words):
        pj.Camera(E, P, U, 0.5, W=4, H=4).with_pose(eye, axes)


def test_gradient_of_a_camera_is_shown_as_one():
    camera = pj.Camera([0.3, 1, 5], [0.1, 0, 0], [0.2, 1, 0.1], 0.6, W=24, H=20)
    slope = jax.grad(lambda c: pj.project(c, jnp.ones(3))[0])(camera)
    shown = str(slope)
    assert shown.startswith("Gradient, or change, of a camera of 24 x 20 px\n")
    assert f"{float(slope.phi):.6g}" in shown
    assert "degrees" not in shown
    assert str(camera).startswith("Camera of 24 x 20 px\n")
    assert "eye" not in slope._repr_html_()
