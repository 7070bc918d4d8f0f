"""Which primitive each ray meets first: down the tree, ray after ray.

What a ray does next depends on what it met: vectors of many rays wait for the slowest, or look at
all that each may meet. A compiled loop over rays does neither, and XLA's CPU compiler makes one of
a call that it is told to make a single kernel of. In it a vector is the eight boxes of a node, or
the primitives of a leaf. On other machines rays go side by side (`_side_by_side`).
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._numerics.one_kernel import one_kernel
from .bvh import CHILDREN, Tree, levels, permuted
from .components import Parts, largest, parts
from .intersect import sphere_depth, triangle_depth

Vectors = Float[Array, "N 3"]
BESIDE = 1 << 15  # rays side by side: memory for what each has still to look at


def walk(
    tree: Tree, origin: Vectors, direction: Vectors, axis: Int[Array, "N"], order: Int[Array, "N"]
) -> Int[Array, "N"]:
    """Return the index of the primitive that each ray meets first, -1 for none; each ray's axis,
    along which it is tested, is given.

    `order` is that in which rays are taken; a ray that is not in it gets -1.
    """
    # Rays are turned first: what is read where it is would be waited for.
    ray = jnp.maximum(order, 0)
    rays = _turned(parts(origin[ray]), parts(direction[ray]), axis[ray])
    nothing = jnp.full(order.shape, -1, jnp.int32)
    return jax.lax.platform_dependent(
        tree, rays, order, nothing, cpu=one_kernel(_in_turn), default=_side_by_side
    )


def _in_turn(
    tree: Tree, rays: "_Ray", order: Int[Array, "N"], met: Int[Array, "N"]
) -> Int[Array, "N"]:
    def one(state):
        k, met = state
        first = _first_met(tree, jax.tree.map(lambda x: x[k], rays))
        return k + 1, jax.lax.dynamic_update_slice(met, first[None], (order[k],))

    N = order.shape[0]
    more = lambda state: (state[0] < N) & (order[jnp.minimum(state[0], N - 1)] >= 0)
    return jax.lax.while_loop(more, one, (jnp.int32(0), met))[1]


def _side_by_side(
    tree: Tree, rays: "_Ray", order: Int[Array, "N"], met: Int[Array, "N"]
) -> Int[Array, "N"]:
    N = order.shape[0]
    found = jax.lax.map(partial(_first_met, tree), rays, batch_size=min(BESIDE, N))
    return met.at[jnp.where(order < 0, N, order)].set(found, mode="drop")


class _Ray(NamedTuple):
    """A ray, or many, turned so that it runs along the third axis, upwards.

    - `axes`: which axes are its three.
    - `near`, `far`: which planes of a box it passes first and last, of those across each axis.
    - `scale`, `start`, `end`: planes, scaled and shifted, are the depths where the ray passes them:
      the near ones no sooner than by `start`, the far ones no later than by `end`.
    - `line`: origin and slopes, as primitives' tests take them.
    """

    axes: Parts
    near: Parts
    far: Parts
    scale: Parts
    start: Parts
    end: Parts
    line: Parts


def _turned(origin: Parts, direction: Parts, axis: Int[Array, "N"]) -> _Ray:
    """Return rays as they go down the tree.

    The slack is some times the rounding of the boxes' and the primitives' tests: what a primitive's
    test finds its boxes never hide. The tree's lengths are about 1.
    """
    dtype = direction[0].dtype
    along, o = permuted(direction, axis, 1), permuted(origin, axis, 1)
    sign = jnp.where(along[2] < 0, -1, 1).astype(dtype)
    slopes = [along[0] / (along[2] * sign), along[1] / (along[2] * sign), sign]
    eps, reach = jnp.finfo(dtype).eps, 4 + largest(origin)
    axes = [(axis + k) % 3 for k in (1, 2, 3)]
    upper = [jnp.where(slope < 0, 3, 0).astype(jnp.int32) for slope in slopes]
    near = [k + up for k, up in zip(axes, upper, strict=True)]
    far = [k + 3 - up for k, up in zip(axes, upper, strict=True)]
    scale, start, end = [], [], []
    for slope, x in zip(slopes, o, strict=True):
        size = jnp.maximum(jnp.abs(slope), eps)  # flatter ones go aside by less than the slack
        inverse = jnp.where(slope < 0, -1 / size, 1 / size)
        slack = 16 * eps * reach * (1 + size) / size
        scale.append(inverse)
        start.append(-x * inverse - slack)
        end.append(-x * inverse + slack)
    line = [o[0], o[1], o[2] * sign, slopes[0], slopes[1]]
    return _Ray(axes, near, far, scale, start, end, line)


class _Walk(NamedTuple):
    """Where a ray's walk is.

    A child that the ray may meet is one number: the bits of how deep that may be, at the least,
    whose last three say which child it is. (Depths of at least 0 compare as their bits do.)

    - `level`: how many nodes wait; -1 when the walk is over.
    - `now`, `base`: a node's children still to look at, and the number of its first.
    - `waiting`, `bases`: the same of the nodes that wait, by levels.
    - `best`, `met`: the depth and the index of the nearest primitive so far.
    """

    level: Int[Array, ""]
    now: Int[Array, "children"]
    base: Int[Array, ""]
    waiting: Int[Array, "levels children"]
    bases: Int[Array, "levels"]
    best: Float[Array, ""]
    met: Int[Array, ""]

    def over(self, number: Array) -> Array:
        """Whether a child is further away than what was met, or there is none."""
        return (number & -CHILDREN) > _bits(self.best)


def _bits(depth: Float[Array, "*any"]) -> Int[Array, "*any"]:
    """Return the bits of numbers."""
    return jax.lax.bitcast_convert_type(
        depth, jnp.int32 if depth.dtype.itemsize == 4 else jnp.int64
    )


def _first_met(tree: Tree, ray: _Ray) -> Int[Array, ""]:
    """Return the index of the primitive that a ray meets first, -1 for none."""
    finite = sum(x * 0 for x in (*ray.start, *ray.line)) == 0
    best = jnp.array(jnp.inf, ray.line[0].dtype)
    depth, nothing = levels(tree) + 1, _nothing(_bits(best))
    start = _Walk(
        level=jnp.where(finite, 0, -1).astype(jnp.int32),
        now=jnp.where(jnp.arange(CHILDREN) == 0, 0, nothing),  # the root, as if it were a child
        base=jnp.int32(0),
        waiting=jnp.full((depth, CHILDREN), nothing),
        bases=jnp.zeros(depth, jnp.int32),
        best=best,
        met=jnp.int32(-1),
    )
    return jax.lax.while_loop(lambda s: s.level >= 0, partial(_step, tree, ray), start).met


def _step(tree: Tree, ray: _Ray, state: _Walk) -> _Walk:
    """Look at the nearest of a node's children; the others wait."""
    level, now, base, waiting, bases, best, met = state
    nodes, nothing = tree.planes.shape[0], _nothing(now)
    least = _least(now)
    child = least & (CHILDREN - 1)
    node = base + child.astype(jnp.int32)
    rest = jnp.where(jnp.arange(CHILDREN, dtype=now.dtype) == child, nothing, now)
    waiting = jax.lax.dynamic_update_slice(waiting, rest[None], (level, jnp.int32(0)))
    bases = jax.lax.dynamic_update_slice(bases, base[None], (level,))
    level = jnp.where(state.over(_least(rest)), level, level + 1)

    def within():
        return _children(tree, ray, node, best), best, met

    def at_leaf():
        return jnp.full(CHILDREN, nothing), *_met_in_leaf(tree, ray, node - nodes, best, met)

    now, best, met = jax.lax.cond(node >= nodes, at_leaf, within)
    # A node's children follow those of all before it; the root has as many as make that so.
    base = CHILDREN * (node - nodes) + nodes + tree.primitive.shape[0]
    return _back(_Walk(level, now, base, waiting, bases, best, met))


def _back(state: _Walk) -> _Walk:
    """Go back to the last node with children that are worth a look, if there is one."""

    def up(s):
        level = s[0] - 1
        here = jax.lax.dynamic_index_in_dim(state.waiting, level, keepdims=False)
        return level, here, state.bases[level]

    none = lambda s: (s[0] > 0) & state.over(_least(s[1]))
    level, now, base = jax.lax.while_loop(none, up, (state.level, state.now, state.base))
    level = jnp.where(state.over(_least(now)), -1, level)
    return state._replace(level=level, now=now, base=base)


def _nothing(like: Int[Array, "*any"]) -> Int[Array, ""]:
    """Return the number that stands for no child."""
    return jnp.array(jnp.iinfo(like.dtype).max, like.dtype)


def _least(numbers: Int[Array, "children"]) -> Int[Array, ""]:
    """Return the least; by halves, which compilers see through as they do not through a loop."""
    values = [numbers[k] for k in range(CHILDREN)]
    while len(values) > 1:
        values = [jnp.minimum(a, b) for a, b in zip(values[::2], values[1::2], strict=True)]
    return values[0]


def _children(tree: Tree, ray: _Ray, node: Int[Array, ""], best: Array) -> Int[Array, "children"]:
    """Return a node's children that a ray may meet before what it met already.

    A triangle seen from its side may be found anywhere between its corners: so what is in a box may
    be met before the box, by the largest primitive's size.
    """

    def passes(k, row, shift):
        planes = jax.lax.dynamic_slice(tree.planes, (node, row[k], jnp.int32(0)), (1, 1, CHILDREN))
        return planes[0, 0] * ray.scale[k] + shift[k]

    x, y, z = (passes(k, ray.near, ray.start) for k in range(3))
    beyond = [passes(k, ray.far, ray.end) for k in range(3)]
    z = jnp.maximum(z, 0)
    enters = jnp.maximum(jnp.maximum(x, y), z)
    leaves = jnp.minimum(jnp.minimum(beyond[0], beyond[1]), beyond[2])
    before = enters - tree.largest
    near = jnp.where(before > z, before, z)
    bits = _bits(near)
    number = bits & -CHILDREN | jnp.arange(CHILDREN, dtype=bits.dtype)
    return jnp.where((enters > leaves) | (near > best), _nothing(bits), number)


def _met_in_leaf(tree: Tree, ray: _Ray, leaf: Int[Array, ""], best: Array, met: Array):
    """Return how deep the nearest of what was met and of what is in a leaf is, and its index."""
    _, rows, columns = tree.data.shape
    slots = tree.primitive.shape[1]

    def row(k):
        values = jax.lax.dynamic_slice(tree.data, (leaf, k, jnp.int32(0)), (1, 1, columns))
        return values.reshape(-1, slots)

    x, y, z = (row(k) for k in ray.axes)
    z = z * ray.scale[2]
    places = [corner for corners in zip(x, y, z, strict=True) for corner in corners]
    if rows == 3:
        depth = triangle_depth(ray.line, places)
    else:
        line = [x[None] for x in ray.line]
        depth = sphere_depth(line, [*places, row(jnp.int32(3))[0]])
    here = jnp.min(depth)

    def nearer(met):
        index = jax.lax.dynamic_index_in_dim(tree.primitive, leaf, keepdims=False)
        first = jnp.min(jnp.where(depth == here, index, jnp.iinfo(jnp.int32).max))
        return jnp.where((here < best) | (first < met), first, met)

    some = (here <= best) & (here < jnp.inf)
    met = jax.lax.cond(some, nearer, lambda met: met, met)  # their indices are rarely read
    return jnp.minimum(here, best), met
