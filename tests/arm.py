"""An arm of two links, its postures, and a camera before it: what joint fits are tried on."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from numpy.random import default_rng
from oracles import central_difference, drawn

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._camera.poses import at_pose, exponential, pose_of

SIZE = 96
TRUTH = pj.Camera([0.4, -0.9, 6], [0, 0, 0.2], [0, 1, 0], 0.6, 1.0, SIZE, SIZE)
#: Some 10 degrees and a fifth of a unit off.
OFF = exponential(np.array([0.1, -0.12, 0.08, 0.1, 0.05, -0.2]))
START = at_pose(TRUTH, pose_of(TRUTH) @ OFF)
RIG = {"left": np.eye(4), "right": exponential(np.array([0, -0.1, 0, 0.6, 0, 0]))}
RIGHT = at_pose(TRUTH, pose_of(TRUTH) @ RIG["right"])
BOTH_EYES = {"left": TRUTH, "right": RIGHT}
BAR = trimesh.creation.box((0.6, 0.9, 2.2))


def posture(k, random=None):
    """Where an arm and its second link are, by a number or by chance."""
    random = random or default_rng(100 + k)
    turn, aside = random.uniform(-1, 1, 3), 1.2 * random.uniform(-1, 1, 2)
    return [np.eye(4), exponential(np.array([*turn, *aside, 0.9]))]


@cache
def arm():
    return pj.Assembly([shapes.bumpy(2), pj.Mesh(BAR)])


@cache
def scenes():
    return [arm().scene_at(posture(k)) for k in range(4)]


@cache
def views():
    return [pj.JointView(scene, drawn(TRUTH, scene)) for scene in scenes()]


def apart(a, b):
    """Degrees and world units between two cameras."""
    angle, shift = pj.pose_error(a, b)
    return float(np.rad2deg(angle)), float(shift)


def grown(times):
    return np.diag([times, times, times, 1.0])


@cache
def noisy():
    """Masks whose pixels err independently."""
    random = default_rng(0)
    noise = [0.05 * random.normal(size=(SIZE, SIZE)) for _ in views()]
    return [
        v._replace(target=np.clip(v.target + n, 0, 1)) for v, n in zip(views(), noise, strict=True)
    ]


def information_of(shown, size):
    """What images tell of some numbers near 0, by differences; a pixel errs by 0.1."""
    J = central_difference(shown, np.zeros(size)).reshape(-1, size)
    return J.T @ J / 0.1**2


def numbers_of(fits):
    """What is free of the fits' cameras, in one row."""
    return jnp.array([x for f in fits for x in (*f.camera.e, *f.camera.p, f.camera.phi)])


def check_slope(answer, inputs, velocity, h, tolerance):
    """Assert that the answer's derivative along a velocity is that of refits, and of its last
    number that by reverse, too; return this one's gradients."""
    slope = jax.jvp(answer, tuple(inputs), tuple(velocity))[1]
    moved = lambda step: answer(*(np.asarray(x + step * v) for x, v in pairs))
    pairs = [*zip(inputs, velocity, strict=True)]
    refits = (moved(h) - moved(-h)) / (2 * h)
    np.testing.assert_allclose(slope, refits, atol=tolerance * np.abs(refits).max())
    every = tuple(range(len(inputs)))
    gradients = jax.grad(lambda *given: answer(*given)[-1], every)(*inputs)
    by_reverse = sum(np.sum(g * v) for g, v in zip(gradients, velocity, strict=True))
    np.testing.assert_allclose(by_reverse, slope[-1], rtol=1e-6, atol=1e-12)
    return gradients
