import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import central_difference

import pinhole_jax as pj

# Looking down -z with y up, 90 degrees: at d = 1 the film is 2 high and, with W/H = 2, 4 wide.
E, P, U = jnp.array([0.0, 0, 5]), jnp.array([0.0, 0, 0]), jnp.array([0.0, 1, 0])
PHI, D = jnp.array(np.pi / 2), jnp.array(1.0)


def unit(*q):
    return np.array(q) / np.linalg.norm(q)


def test_pixel_centres_and_row_order_by_hand():
    rays = pj.generate_rays(E, P, U, PHI, D, 4, 2)
    assert rays.origin.shape == (3,)
    assert rays.direction.shape == (2, 4, 3)
    # Pixel (0, 0) is bottom left: centre (1/2, 1/2) px, that is x = -2 + 1/2, y = -1 + 1/2.
    np.testing.assert_allclose(rays.direction[1, 0], unit(-1.5, -0.5, -1), rtol=1e-14)
    # image[H-1-j, i]: the top row holds the largest y, the last column the largest x.
    np.testing.assert_allclose(rays.direction[0, 3], unit(1.5, 0.5, -1), rtol=1e-14)
    np.testing.assert_allclose(rays.direction[0, 1], unit(-0.5, 0.5, -1), rtol=1e-14)


def test_directions_are_q_over_its_length():
    # q = b1 x + b2 y + v d with d = 3: the film is 6 x 6; centre pixel of 3 x 3 looks ahead.
    rays = pj.generate_rays(E, P, U, PHI, jnp.array(3.0), 3, 3)
    np.testing.assert_allclose(rays.direction[1, 1], [0, 0, -1], atol=1e-15)
    np.testing.assert_allclose(rays.direction[0, 2], unit(2, 2, -3), rtol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(rays.direction, axis=-1), 1, rtol=1e-14)


def test_film_is_centred_on_the_axis_and_not_on_p():
    near, far = (pj.generate_rays(E, E + k * (P - E), U, PHI, D, 4, 2) for k in (0.01, 7.0))
    np.testing.assert_allclose(near.direction, far.direction, atol=1e-15)


def test_d_changes_no_direction():
    one, two = (pj.generate_rays(E, P, U, PHI, jnp.array(d), 4, 2) for d in (0.1, 40.0))
    np.testing.assert_allclose(one.direction, two.direction, rtol=1e-14, atol=1e-15)
    single = [np.asarray(x, np.float32) for x in (E, P, U, PHI)]
    for d in (1e-30, 1e30):  # squares of d would not be float32 numbers
        rays = pj.generate_rays(*single, np.float32(d), 4, 2)
        np.testing.assert_allclose(rays.direction, one.direction, atol=1e-6)


def test_samples_are_cell_centres_by_hand():
    rays = pj.generate_rays(E, P, U, PHI, D, 4, 2, samples=2)
    assert rays.direction.shape == (2, 4, 4, 3)
    # Pixel (0, 0), its lower left cell: (1/4, 1/4) px; then (3/4, 1/4), (1/4, 3/4), (3/4, 3/4).
    np.testing.assert_allclose(rays.direction[1, 0, 0], unit(-1.75, -0.75, -1), rtol=1e-14)
    np.testing.assert_allclose(rays.direction[1, 0, 1], unit(-1.25, -0.75, -1), rtol=1e-14)
    np.testing.assert_allclose(rays.direction[1, 0, 2], unit(-1.75, -0.25, -1), rtol=1e-14)


def test_stratified_samples_stay_in_their_cells():
    camera = pj.Camera(E, P, U, PHI, D, 4, 2)
    rays = pj.camera_rays(camera, 3, jax.random.key(0))
    film = np.asarray(pj.project(camera, camera.e[None] + 2.0 * rays.direction.reshape(-1, 3)))
    film = film.reshape(2, 4, 9, 2)
    column, row = np.arange(4)[None, :, None], np.arange(2)[::-1][:, None, None]
    cell = np.arange(9)[None, None]
    for k, (at, sub) in enumerate(((column, cell % 3), (row, cell // 3))):
        within = (film[..., k] - at) * 3 - sub
        assert np.all((within >= -1e-9) & (within <= 1 + 1e-9))
    assert np.ptp(film[..., 0] * 3 % 1) > 0.5


@pytest.mark.parametrize("lens", [None, pj.Lens([1.7, 0.4], 1.3)])
def test_project_undoes_rays(lens):
    camera = pj.Camera([1.0, 2, 5], [0.1, 0, 0], [0.1, 1, 0], 0.7, 2.0, 5, 3, lens)
    rays = pj.camera_rays(camera)
    film = pj.project(camera, camera.e[None] + 3.0 * rays.direction.reshape(-1, 3))
    expected = [(i + 0.5, j + 0.5) for j in (2, 1, 0) for i in range(5)]
    np.testing.assert_allclose(film, expected, atol=1e-13)


def test_project_by_hand():
    camera = pj.Camera(E, P, U, PHI, D, 4, 2)
    # One unit up at distance 5: y = 1/5 of the half film height (1 px) above the centre (2, 1).
    np.testing.assert_allclose(pj.project(camera, jnp.array([0.0, 1, 0])), [2, 1.2])
    np.testing.assert_allclose(pj.project(camera, jnp.array([[1.0, 0, 0]])), [[2.2, 1]])


def test_generate_rays_and_camera_rays_agree():
    camera = pj.Camera(E, P, U, PHI, D, 4, 2)
    one, two = pj.camera_rays(camera), pj.generate_rays(E, P, U, PHI, D, 4, 2)
    np.testing.assert_array_equal(one.direction, two.direction)


@pytest.mark.parametrize("name", ["e", "p", "u", "phi", "d"])
def test_forward_reverse_and_central_differences_agree(name):
    camera = pj.Camera([1.0, 2, 5], [0.1, 0, 0], [0.3, 1, 0.2], 0.7, 2.0, 3, 2)
    weight = jnp.asarray(np.random.default_rng(0).normal(size=(2, 3, 3)))

    def loss(value):
        moved = eqx.tree_at(lambda c: getattr(c, name), camera, jnp.asarray(value))
        rays = pj.generate_rays(moved.e, moved.p, moved.u, moved.phi, moved.d, 3, 2)
        return jnp.sum(weight * rays.direction) + jnp.sum(rays.origin**2)

    at = getattr(camera, name)
    forward, reverse = jax.jacfwd(loss)(at), jax.jacrev(loss)(at)
    assert np.all(np.isfinite(forward))
    np.testing.assert_allclose(forward, reverse, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(forward, central_difference(loss, at), rtol=1e-7, atol=1e-8)


def test_project_is_differentiable_at_the_eye_plane():
    camera = pj.Camera(E, P, U, PHI, D, 4, 2)
    jacobian = jax.jacfwd(lambda x: pj.project(camera, x))(E + jnp.array([1.0, 0, 0]))
    assert np.all(np.isfinite(jacobian))


@pytest.mark.parametrize(
    ("samples", "key", "message"),
    [(0, None, "`samples`: expected at least 1"), (None, 0, "`key`: expected `samples`")],
)
def test_bad_samples_are_refused(samples, key, message):
    key = None if key is None else jax.random.key(key)
    with pytest.raises(ValueError, match=message):
        pj.generate_rays(E, P, U, PHI, D, 4, 2, samples, key)


def test_rays_jit_and_vmap_in_float32():
    eyes = jnp.array([[0, 0, 5], [0, 1, 4]], jnp.float32)
    p, u = jnp.zeros(3, jnp.float32), jnp.array([0, 1, 0], jnp.float32)
    phi, d = jnp.float32(0.5), jnp.float32(1)
    rays = jax.jit(jax.vmap(lambda e: pj.generate_rays(e, p, u, phi, d, 4, 2)))(eyes)
    assert rays.direction.shape == (2, 2, 4, 3)
    assert rays.direction.dtype == jnp.float32


@pytest.mark.parametrize(
    "call",
    [
        lambda c, x: pj.generate_rays(c.e, c.p, c.u, c.phi, c.d, 4, 2, 2),
        lambda c, x: pj.camera_rays(c),
        lambda c, x: pj.project(c, x),
        lambda c, x: pj.pose_error(c, c),
        lambda c, x: pj.iou(x, x),
    ],
    ids=["generate_rays", "camera_rays", "project", "pose_error", "iou"],
)
def test_call_outside_jit_is_one_program(call):
    """Step by step each step would be compiled: 47 for the rays of a camera."""
    steps = jax.make_jaxpr(call)(pj.Camera(E, P, U, PHI, D, 4, 2), jnp.ones((5, 3))).eqns
    assert len(steps) == 1, steps


@pytest.mark.parametrize("lens", [None, pj.Lens([30.0, 35.0], 1.1, pj.BrownConrady(-0.2, 0.05))])
def test_rays_through_film_points_are_seen_there(lens):
    camera = pj.Camera([1.0, 2, 5], [0.1, 0, 0], [0, 1, 0], 0.6, 1.0, 64, 48, lens)
    points = np.random.default_rng(0).uniform(0, 48, (2, 3, 2))
    rays = pj.rays_through(camera, points)
    assert rays.direction.shape == (2, 3, 3)
    np.testing.assert_allclose(np.linalg.norm(rays.direction, axis=-1), 1, rtol=1e-12)
    np.testing.assert_allclose(
        pj.project(camera, np.array(rays.origin) + 7 * np.array(rays.direction)), points
    )
    single = pj.rays_through(camera, points[1, 2]).direction
    np.testing.assert_allclose(single, rays.direction[1, 2], rtol=1e-12)


def test_ray_through_a_film_point_is_the_notes():
    camera = pj.Camera([0.0, 0, 5], [0, 0, 0], [0, 1, 0], 0.6, W=96, H=80)
    rays = pj.rays_through(camera, [58.0, 20])
    direction = np.array([10.0, -20, -40 / np.tan(0.3)])
    np.testing.assert_allclose(rays.direction, direction / np.linalg.norm(direction))
    with pytest.raises(ValueError, match=r"`points`: expected shape \(..., 2\), got shape \(3,\)"):
        pj.rays_through(camera, [1.0, 2, 3])
