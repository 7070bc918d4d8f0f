"""Any number of points: a few programs serve all, and what was filled up is not there."""

import jax
import jax.numpy as jnp
import numpy as np
from chosen import on_cpu
from oracles import lump

import pinhole_jax as pj
from pinhole_jax import plot
from pinhole_jax._camera.camera import bent

LENS = pj.Lens([23.0, 21.0], 1.0, pj.BrownConrady(0.1, 0.02, 1e-3, -2e-3, 0.0))
PLAIN = pj.Camera([0.3, 0.2, 4.0], [0.1, 0, 0], [0, 1, 0], 0.7, 1.0, 48, 40)
BENT = PLAIN.replace(lens=LENS)
RANDOM = np.random.default_rng(7)


def test_no_points_are_projected_to_none():
    assert pj.project(PLAIN, np.zeros((0, 3))).shape == (0, 2)
    assert pj.project(PLAIN, np.zeros((4, 0, 3))).shape == (4, 0, 2)


@on_cpu
def test_points_stay_on_their_device():
    asked = jax.device_put(jnp.ones((5, 3)), jax.devices()[0])
    assert pj.project(PLAIN, asked).committed
    assert not pj.project(PLAIN, np.ones((5, 3))).committed


@on_cpu
def test_further_numbers_of_points_and_pixels_compile_nothing(compiled):
    scene = lump(1)

    def all_of_it(n):
        points = RANDOM.standard_normal((n, 3))
        pj.fit_points(points, pj.project(PLAIN, points), PLAIN, free=("pose", "phi"))
        pj.project(PLAIN.replace(W=n, H=2 * n), points)
        pj.project(BENT, points.reshape(1, n, 3))
        bent(BENT, points[:, :2])
        pj.rays_through(BENT, points[:, :2])
        rays = pj.Rays(np.asarray(PLAIN.e), points)
        pj.trace(scene, rays)
        pj.occluded(scene, rays)

    all_of_it(11)
    first = len(compiled)
    for n in (3, 12, 40, 64):
        all_of_it(n)
    assert len(compiled) == first
    all_of_it(300)  # (it would be seen)
    assert len(compiled) > first


@on_cpu
def test_drawing_a_new_view_compiles_nothing(compiled):
    """Its outline has another number of parts."""
    scene, image = lump(1), np.zeros((40, 48), np.uint8)
    drawn, programs = [], []
    for x in (0.0, 0.4, 1.0):
        camera = BENT.replace(e=jnp.asarray([x, 0.2, 4.0]))
        plot.overlay(image, camera, scene)
        drawn.append(len(plot.outline(camera, scene)))
        plot.contour_points(camera, scene)
        programs.append(len(compiled))
    assert len(set(drawn)) > 1
    assert programs[0] == programs[2]
