"""From film to rays and back, by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from oracles import skew_camera
from refusals import refusal

import pinhole_jax as pj

# Looking down -z with y up, 90 degrees: at d = 1 the film is 2 high and, with W/H = 2, 4 wide.
E, P, U = jnp.array([0.0, 0, 5]), jnp.array([0.0, 0, 0]), jnp.array([0.0, 1, 0])
PHI, D, SIZE = jnp.array(np.pi / 2), jnp.array(1.0), (4, 2)
CAMERA = pj.Camera(E, P, U, PHI, D, *SIZE)
SKEW = skew_camera(*SIZE, d=2.0)
LENSES = [None, pj.Lens([1.7, 0.4], 1.3), pj.Lens([2.2, 1.1], 1.1, pj.BrownConrady(-0.2, 0.05))]


def unit(*q):
    return np.array(q) / np.linalg.norm(q)


def test_pixel_centres_and_row_order_by_hand():
    rays = pj.generate_rays(E, P, U, PHI, D, *SIZE)
    assert rays.origin.shape == (3,)
    assert rays.direction.shape == (2, 4, 3)
    # Pixel (0, 0) is bottom left: centre (1/2, 1/2) px, that is x = -2 + 1/2, y = -1 + 1/2.
    assert_allclose(rays.direction[1, 0], unit(-1.5, -0.5, -1), rtol=1e-14)
    # image[H-1-j, i]: the top row holds the largest y, the last column the largest x.
    assert_allclose(rays.direction[0, 3], unit(1.5, 0.5, -1), rtol=1e-14)
    assert_allclose(rays.direction[0, 1], unit(-0.5, 0.5, -1), rtol=1e-14)
    assert_allclose(np.linalg.norm(rays.direction, axis=-1), 1, rtol=1e-14)
    assert_array_equal(rays.direction, pj.camera_rays(CAMERA).direction)


def test_samples_are_cell_centres_by_hand():
    rays = pj.generate_rays(E, P, U, PHI, D, *SIZE, samples=2)
    assert rays.direction.shape == (2, 4, 4, 3)
    # Pixel (0, 0), its lower left cell: (1/4, 1/4) px; then (3/4, 1/4), (1/4, 3/4), (3/4, 3/4).
    assert_allclose(rays.direction[1, 0, 0], unit(-1.75, -0.75, -1), rtol=1e-14)
    assert_allclose(rays.direction[1, 0, 1], unit(-1.25, -0.75, -1), rtol=1e-14)
    assert_allclose(rays.direction[1, 0, 2], unit(-1.75, -0.25, -1), rtol=1e-14)


def test_stratified_samples_stay_in_their_cells():
    rays = pj.camera_rays(CAMERA, 3, jax.random.key(0))
    film = np.asarray(pj.project(CAMERA, np.asarray(E) + 2 * np.asarray(rays.direction)))
    row, column, cell = np.indices((2, 4, 9))
    corner = np.stack([column + cell % 3 / 3, 1 - row + cell // 3 / 3], axis=-1)
    within = 3 * (film - corner)
    assert np.all((within >= -1e-9) & (within <= 1 + 1e-9))
    assert np.ptp(within) > 0.5


@pytest.mark.parametrize("lens", LENSES, ids=["plain", "shifted", "distorted"])
def test_project_undoes_rays(lens):
    camera = SKEW.replace(lens=lens)
    centres = np.stack(np.meshgrid(np.arange(4) + 0.5, np.arange(2)[::-1] + 0.5), axis=-1)
    through = pj.rays_through(camera, centres)
    assert_allclose(np.linalg.norm(through.direction, axis=-1), 1, rtol=1e-14)
    for direction in (pj.camera_rays(camera).direction, through.direction):
        film = pj.project(camera, np.asarray(camera.e) + 3 * np.asarray(direction))
        assert_allclose(film, centres, atol=1e-13)


def test_project_by_hand():
    # One unit up at distance 5: y = 1/5 of the half film height (1 px) above the centre (2, 1).
    assert_allclose(pj.project(CAMERA, [0.0, 1, 0]), [2, 1.2])
    assert_allclose(pj.project(CAMERA, [[1.0, 0, 0]]), [[2.2, 1]])


def test_project_is_differentiable_at_the_eye_plane():
    jacobian = jax.jit(jax.jacfwd(lambda x: pj.project(CAMERA, x)))(E + jnp.array([1.0, 0, 0]))
    assert np.all(np.isfinite(jacobian))


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: pj.camera_rays(CAMERA, 0), "`samples`: expected an integer of at least 1"),
        (lambda: pj.camera_rays(CAMERA, key=jax.random.key(0)), "`key`: expected `samples`"),
        (lambda: pj.rays_through(CAMERA, [1.0, 2, 3]), r"`points`: expected shape \(..., 2\), got"),
        (lambda: pj.project(CAMERA, [1.0, 2]), r"`points`: expected shape \(..., 3\), got"),
        *(
            (lambda points=points: pj.project(CAMERA, points), "`points`: expected real numbers")
            for points in (["a", "b", "c"], [1j, 2, 3], np.zeros((2, 3), bool))
        ),
    ],
)
def test_bad_input_is_refused(call, message):
    with refusal(message):
        call()


@pytest.mark.parametrize(
    "call",
    [
        lambda c, x: pj.generate_rays(c.e, c.p, c.u, c.phi, c.d, *SIZE, 2),
        lambda c, x: pj.camera_rays(c),
        lambda c, x: pj.project(c, x),
        lambda c, x: pj.pose_error(c, c),
        lambda c, x: pj.iou(x, x),
    ],
    ids=["generate_rays", "camera_rays", "project", "pose_error", "iou"],
)
def test_call_outside_jit_is_one_program(call):
    """Step by step each step would be compiled: 47 for the rays of a camera."""
    steps = jax.make_jaxpr(call)(CAMERA, jnp.ones((5, 3))).eqns
    assert len(steps) == 1, steps
