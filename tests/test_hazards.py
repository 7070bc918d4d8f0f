"""What one bad number may touch: nothing but its own element; and no masked branch makes NaN.

NaN is looked for in every operation, not only in what a compiled program returns: the library runs
without `jit`, and each result is checked (`jax_debug_nans`). Infinities are meant: a ray that
misses has t = inf. Searches for a camera are left out: a fit rejects a step by its NaN.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stress
from chosen import first, full
from numpy.testing import assert_allclose, assert_array_equal

import pinhole_jax as pj
from pinhole_jax import shapes

# Of numbers whose differences are exact: the view direction, too.
CAMERA = pj.Camera([0.25, 1.0, 5.0], [0.125, 0, 0], [0.2, 1, 0.1], 0.6, 1.0, 6, 5)
BALLS = pj.Spheres([[0.4, 0.2, 1.0], [-0.5, 0.1, 0]], [0.4, 0.6])
SCENE = pj.Scene(shapes.bumpy(0), spheres=BALLS)


# --- batches -------------------------------------------------------------------------------------


CORNERS = jnp.asarray(np.random.default_rng(1).uniform(-1, 1, (8, 3)))


def seen(camera, scene, overlaps=False):
    """Return all that can be seen of a scene."""
    rays = pj.camera_rays(camera)
    hit = pj.trace(scene, rays)
    points = pj.project(camera, CORNERS)
    return pj.silhouette(camera, scene, overlaps), rays, hit, points


def summary(camera, scene, overlaps):
    """Return a number that depends on everything that can be differentiated."""
    image, rays, hit, points = seen(camera, scene, overlaps)
    near = jnp.where(jnp.isfinite(hit.t), hit.t, 0)
    parts = (image**2, rays.direction**3, near, hit.normal, hit.barycentric**2, points)
    return sum(map(jnp.sum, parts))


@eqx.filter_jit
@eqx.filter_vmap
def batch(camera, scene):
    """Return the views of a batch's elements."""
    return seen(camera, scene)


@pytest.mark.parametrize("bad", [np.nan, full(np.inf)])
def test_poisoned_element_leaves_the_rest_of_a_batch_alone(bad):
    many = lambda x: jnp.stack([x, x, x]) if eqx.is_array(x) else x
    cameras, scenes = jax.tree.map(many, (CAMERA, SCENE))
    cameras = eqx.tree_at(lambda c: c.e, cameras, cameras.e + jnp.eye(3) / 10)
    arrays, rest = eqx.partition((cameras, scenes), eqx.is_inexact_array)
    leaves, tree = jax.tree.flatten(arrays)
    whole = jax.tree.leaves(batch(cameras, scenes))
    assert not any(np.any(np.isnan(leaf)) for leaf in whole)
    for k, leaf in enumerate(leaves):
        bad_leaf = leaf.at[(1, *[0] * (leaf.ndim - 1))].set(bad)
        spoilt = jax.tree.unflatten(tree, [*leaves[:k], bad_leaf, *leaves[k + 1 :]])
        for x, y in zip(jax.tree.leaves(batch(*eqx.combine(spoilt, rest))), whole, strict=True):
            assert_array_equal(x[::2], y[::2])


SOLID = pj.Mesh(*stress.SHAPES[2])
FLAT = pj.Mesh([[0, 0, 0], [1, 0, 0], [2, 0, 0.0]], [[0, 1, 2], [0, 0, 1]])


# --- masked branches -----------------------------------------------------------------------------

BALL = pj.Spheres([[0.0, 0, 0]], [1.0])


BODIES = {"solid": (SOLID, None), "ball": (None, BALL), "both": (SOLID, BALL), "flat": (FLAT, None)}
#: Eye, view point, up, field of view; a mesh, spheres.
VIEWS = """
    0.3 1 5    0.1 0 0  0 1 0  0.9  both   # ordinary
    0.3 1 5    0.1 0 9  0 1 0  0.9  both   # nothing in sight
    1 1 1      0.1 0 0  0 1 0  0.9  solid  # the eye on a vertex
    3 -1 -1    0 0 0    0 1 0  0.9  solid  # the eye in a face's plane
    0 0 0.1    1 0 0    0 1 0  0.9  both   # the eye within
    0 0 1      0 1 1    0 0 1  0.9  ball   # the eye on a sphere
    0 1 2      0 1 0    0 1 0  3.0  ball   # a sphere as a parabola
    0 0 4      0 0 0    0 1 0  0.9  ball   # a sphere on the axis
    0 0 4      0 0 0    0 1 0  0.9  flat   # no area
"""


@pytest.mark.full
@pytest.mark.parametrize("row", VIEWS.strip().splitlines())
def test_no_operation_makes_nan(row):
    """Every operation on its own: minutes."""
    *numbers, kind = row.partition("#")[0].split()
    e, p, u = np.array(numbers[:9], float).reshape(3, 3)
    moving = pj.Camera(e, p, u, float(numbers[9]), W=3, H=3), pj.Scene(*BODIES[kind])
    with jax.disable_jit(), jax.debug_nans(True):
        value, slopes = eqx.filter_value_and_grad(lambda x: summary(*x, True))(moving)
    for leaf in jax.tree.leaves((value, slopes)):
        assert np.all(np.isfinite(leaf))


# --- kinks ---------------------------------------------------------------------------------------


@jax.jit
@partial(jax.jacrev, has_aux=True)
def looking(camera):
    """Return derivatives of sums by the camera, and what it sees."""
    image, rays, _, points = seen(camera, SCENE)
    sums = jnp.sum(image), jnp.sum(points)
    return sums, (image, rays.direction, points, pj.depth(camera, SCENE))


@pytest.mark.parametrize("part", first(0, ["u", "p"], of=2))
def test_traced_camera_that_is_none_sees_nothing(part):
    """Its up direction is the view direction, or its view point the eye."""
    value = CAMERA.p - CAMERA.e if part == "u" else CAMERA.e
    camera = eqx.tree_at(lambda c: getattr(c, part), CAMERA, value)
    slopes, (image, direction, points, depth) = looking(camera)
    assert_allclose(image, 0, atol=1e-15)
    assert_allclose(points, np.tile([3, 2.5], (len(points), 1)))  # the principal point
    assert np.all(np.linalg.norm(direction, axis=-1) <= 1)  # beside the axis they are shorter
    assert np.all(np.isposinf(depth))
    assert all(np.all(np.isfinite(slope)) for slope in jax.tree.leaves(slopes))


def test_rays_that_miss_or_touch_have_the_stated_derivative():
    down = jnp.array([0.0, 0, -1])
    t = lambda origin: pj.trace(pj.Scene(spheres=BALL), pj.Rays(origin, down)).t
    both = jax.jit(jax.value_and_grad(t))
    for x, value, slope in (
        (0.6, 3.2, [0.75, 0, 1]),
        (1.0, 4.0, [0, 0, 1]),
        (1.1, np.inf, [0] * 3),
    ):
        found, derivative = both(jnp.array([x, 0.0, 4]))
        assert_allclose(found, value, rtol=1e-12)
        assert_allclose(derivative, slope, atol=1e-12)
