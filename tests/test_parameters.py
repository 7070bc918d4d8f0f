"""What may move: rows of the table, the moves' sizes, and what is reported of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose
from oracles import central_difference, skew_camera, usual_camera
from scipy.spatial.transform import Rotation

import pinhole_jax as pj
from pinhole_jax._camera.camera import camera_basis
from pinhole_jax._camera.distortion import COEFFICIENTS
from pinhole_jax._solver.moves import (
    Bounds,
    Move,
    canonical,
    displaced,
    moved,
    on_film,
    reported,
    rotation,
    scales,
)
from pinhole_jax._solver.parameters import NAMES, check_free, components, in_one, labels_of

CAMERA = skew_camera(30, 20, d=2.0)
PIVOT = jnp.array([0.2, -0.1, 0.3])


@pytest.mark.parametrize("size", [0, 1e-9, 1e-2, 0.0099, 3.0])
def test_rotation_is_that_of_scipy(size):
    vector = size * np.array([1.0, 2, 3])
    wanted = Rotation.from_rotvec(vector).as_matrix()
    assert_allclose(rotation(jnp.asarray(vector)), wanted, atol=1e-14)


def test_focal_length_by_phi_and_by_d():
    # d means something only while the film's height h is held: phi = 2 atan(h / (2 d)).
    h = 2 * 2.0 * np.tan(0.35)
    by_d, by_phi = (
        moved(Move(CAMERA, PIVOT, jnp.ones(1)), jnp.log(jnp.array([1.5])), (name,))
        for name in ("d", "phi")
    )
    assert_allclose([by_d.d, by_phi.d], [3.0, 2.0])
    assert_allclose([by_d.phi, by_phi.phi], 2 * np.arctan(h / 6.0))


def test_position_keeps_the_orientation_and_orientation_the_eye():
    step = Move(CAMERA, PIVOT, jnp.ones(3)), jnp.array([0.1, 0.2, 0.3])
    there, turned = (moved(*step, (name,)) for name in ("position", "orientation"))
    assert_allclose(camera_basis(there), camera_basis(CAMERA), atol=1e-14)
    assert_allclose(turned.e, CAMERA.e, atol=1e-14)


EVERYTHING = ("pose", "phi", "principal_point", "aspect", *COEFFICIENTS)
FREE = [EVERYTHING, ("position", "orientation", "d")]
BOUNDS = Bounds(("phi", "k1"), jnp.array([0.4, 0.0]), jnp.array([0.9, 0.4]))


@pytest.mark.parametrize("free, bounds", [*zip(FREE, [BOUNDS, None], strict=True)])
def test_moves_agree_with_central_differences_of_the_film(free, bounds):
    """Of points on it: by the moves themselves, and by what is reported of them."""
    lens = pj.Lens([14, 11], 1.1, pj.Rational(0.3, -0.1, 1e-3, -2e-3, 0.02, 0.6, 0.02, 0.05))
    camera, labels = CAMERA.replace(phi=0.5, lens=lens), labels_of(free)
    move = Move(camera, PIVOT, jnp.ones(len(components(free))), bounds)
    points = np.random.default_rng(0).uniform(-1, 1, (9, 3))
    film = lambda camera: pj.project(camera, points)
    at = jax.jit(lambda y: moved(move, y, free))
    still = jnp.zeros(len(move.scale))
    slopes = jax.jit(jax.jacfwd(lambda y: film(at(y))))(still)
    assert_allclose(slopes, central_difference(lambda y: film(at(y)), still), atol=1e-7)
    by_label = central_difference(lambda x: film(displaced(camera, labels, x)), 0 * still)
    by_move = jax.jit(jax.jacfwd(lambda y: reported(camera, at(y), free)))(still)
    assert_allclose(slopes, by_label @ by_move, atol=1e-7)


#: Eye, field of view, size of an ellipsoid about the origin.
SIGHTS = [
    ([0.3, 1, 5], 0.6, [1.0, 1, 1]),
    ([1.5, 5, 25], 0.12, [0.4, 0.7, 1.5]),
    ([0.2, 0.4, 2], 1.5, [0.8, 0.8, 0.6]),
]


@pytest.mark.parametrize("free", FREE)
def test_sizes_of_moves_are_about_a_pixel(free):
    """Where the body moves most, or in a corner of the film by the lens (0.33 to 2.1 px)."""
    names, lens = components(free), pj.Lens([48, 40], 1, pj.Rational())

    @jax.jit
    def shifts(camera, points, radius):
        start, middle = canonical(camera), jnp.zeros(3)
        move = Move(start, middle, scales(start, middle, radius, np.array(80.0), free))
        film = lambda y: pj.project(on_film(moved(move, y, free), camera), points)
        return jax.jacfwd(film)(jnp.zeros(len(names)))

    for e, phi, size in SIGHTS:
        camera = usual_camera().replace(e=e, phi=phi, lens=lens)
        (corner,) = pj.rays_through(camera, [[0.0, 0]]).direction
        points = np.append(
            trimesh.creation.icosphere(1).vertices * size, [np.add(e, corner)], axis=0
        )
        *body, corner = np.abs(shifts(camera, points, jnp.asarray(max(size)))).max(axis=1)
        for name, most, far in zip(names, np.max(body, axis=0), corner, strict=True):
            assert 0.3 < (far if name in COEFFICIENTS else most) < 2.2, name


def test_table_has_a_row_for_each_name():
    assert NAMES[-1] == "distortion"
    camera = CAMERA.replace(phi=0.5, lens=pj.Lens([14, 11], 1, pj.Rational()))
    everything = check_free(("pose", "phi", *NAMES[5:]), camera)
    assert {*everything} == {*NAMES} - {"position", "orientation", "d", "distortion"}


def test_names_may_be_in_any_order_and_position_with_orientation_is_the_pose():
    """A whole pose is searched and walked, under whatever names."""
    assert in_one(check_free(["phi", "orientation", "position"])) == ("pose", "phi")
    assert in_one(("position", "phi")) == ("position", "phi")


def test_camera_is_changed_by_its_arguments_and_its_pose():
    wide = CAMERA.replace(phi=1.0, W=60)
    assert (float(wide.phi), wide.W, wide.H, float(wide.d)) == (1.0, 60, 20, 2.0)
    axes = Rotation.random(random_state=0).as_matrix() * np.array([[1], [1], [-1]])  # b1, b2, v
    there = CAMERA.with_pose([3.0, 2.0, 1.0], axes)
    assert_allclose(there.e, [3, 2, 1])
    assert_allclose(np.stack(camera_basis(there)), axes, atol=1e-12)
    length = lambda c: np.linalg.norm(c.p - c.e)
    assert_allclose(length(there), length(CAMERA))
