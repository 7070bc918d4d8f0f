"""Down the tree to what is met first: the nearest of a node's children next, the others wait.

Whoever goes down, a ray or several, says what is worth a look (`look`) and what is met (`test`).
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .bvh import CHILDREN, Tree, levels
from .components import Parts
from .intersect import sphere_depth, triangle_depth


class Walk(NamedTuple):
    """Where a ray's walk is.

    A child that the ray may meet is one number: the bits of how deep that may be, at the least,
    whose last three say which child it is. (Depths of at least 0 compare as their bits do.)

    - `level`: how many nodes wait; -1 when the walk is over.
    - `now`, `base`: a node's children still to look at, and the number of its first.
    - `waiting`, `bases`: the same of the nodes that wait, by levels.
    - `best`, `met`: the depth and the index of the nearest primitive so far, of each ray.
    - `far`: the largest such depth.
    - `left`: how many leaves may be looked at still; -1 when the walk was given up.
    """

    level: Int[Array, ""]
    now: Int[Array, "children"]
    base: Int[Array, ""]
    waiting: Int[Array, "levels children"]
    bases: Int[Array, "levels"]
    best: Float[Array, "*rays"]
    met: Int[Array, "*rays"]
    far: Float[Array, ""]
    left: Int[Array, ""]

    def over(self, number: Array) -> Array:
        """Whether a child is further away than what was met, or there is none."""
        return (number & -CHILDREN) > _bits(self.far)


def _bits(depth: Float[Array, "*any"]) -> Int[Array, "*any"]:
    """Return the bits of numbers."""
    return jax.lax.bitcast_convert_type(
        depth, jnp.int32 if depth.dtype.itemsize == 4 else jnp.int64
    )


def search(
    tree: Tree,
    look: Callable[[Array, Array], Array],
    test: Callable[[Array, Array, Array], tuple[Array, Array]],
    best: Float[Array, "*rays"],
    met: Int[Array, "*rays"],
    some: Bool[Array, ""],
    leaves: int | None = None,
) -> Walk:
    """Return the end of a walk down the tree, of a ray or of several.

    `look` returns a node's children that are worth a look, `test` what is met in a leaf. `some`
    says whether there is any ray; no more `leaves` are tested than said.
    """
    far = jnp.array(jnp.inf, best.dtype)
    depth, nothing = levels(tree) + 1, _nothing(_bits(far))
    start = Walk(
        level=jnp.where(some, 0, -1).astype(jnp.int32),
        now=jnp.where(jnp.arange(CHILDREN) == 0, 0, nothing),  # the root, as if it were a child
        base=jnp.int32(0),
        waiting=jnp.full((depth, CHILDREN), nothing),
        bases=jnp.zeros(depth, jnp.int32),
        best=best,
        met=met,
        far=far,
        left=jnp.int32(0 if leaves is None else leaves),
    )
    one = partial(_step, tree, look, test, leaves is not None)
    return jax.lax.while_loop(lambda s: s.level >= 0, one, start)


def _step(tree: Tree, look: Callable, test: Callable, limited: bool, state: Walk) -> Walk:
    """Look at the nearest of a node's children; the others wait."""
    level, now, base, waiting, bases, best, met, far, left = state
    nodes, nothing = tree.planes.shape[0], _nothing(now)
    least = _least(now)
    child = least & (CHILDREN - 1)
    node = base + child.astype(jnp.int32)
    rest = jnp.where(jnp.arange(CHILDREN, dtype=now.dtype) == child, nothing, now)
    waiting = jax.lax.dynamic_update_slice(waiting, rest[None], (level, jnp.int32(0)))
    bases = jax.lax.dynamic_update_slice(bases, base[None], (level,))
    level = jnp.where(state.over(_least(rest)), level, level + 1)

    def within():
        return look(node, far), best, met, far

    def at_leaf():
        nearest, which = test(node - nodes, best, met)
        return jnp.full(CHILDREN, nothing), nearest, which, jnp.max(nearest)

    leaf = node >= nodes
    now, best, met, far = jax.lax.cond(leaf, at_leaf, within)
    if limited:
        left = left - leaf.astype(jnp.int32)
        level = jnp.where(left < 0, 0, level)
        now = jnp.where(left < 0, nothing, now)
    # A node's children follow those of all before it; the root has as many as make that so.
    base = CHILDREN * (node - nodes) + nodes + tree.primitive.shape[0]
    return _back(Walk(level, now, base, waiting, bases, best, met, far, left))


def _back(state: Walk) -> Walk:
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


def lesser(a: Array, b: Array) -> Array:
    """Return the lesser, in one instruction: `minimum` takes four, for what is not a number."""
    return jnp.where(a < b, a, b)


def larger(a: Array, b: Array) -> Array:
    """Return the larger, as `lesser` does."""
    return jnp.where(a > b, a, b)


def planes_of(tree: Tree, node: Int[Array, ""], row: Int[Array, ""]) -> Float[Array, "children"]:
    """Return planes of the boxes of a node's children."""
    planes = jax.lax.dynamic_slice(tree.planes, (node, row, jnp.int32(0)), (1, 1, CHILDREN))
    return planes[0, 0]


def numbers_of(tree: Tree, enter: Parts, leave: Parts, far: Array) -> Int[Array, "children"]:
    """Return the numbers of children, whose planes are passed at such depths, that may be met
    before a depth.

    A triangle seen from its side may be found anywhere between its corners: so what is in a box may
    be met before the box, by the largest primitive's size.
    """
    x, y, z = enter
    z = larger(z, jnp.zeros_like(z))
    enters = larger(larger(x, y), z)
    leaves = lesser(lesser(leave[0], leave[1]), leave[2])
    near = larger(enters - tree.largest, z)
    bits = _bits(near)
    number = bits & -CHILDREN | jnp.arange(CHILDREN, dtype=bits.dtype)
    return jnp.where((enters > leaves) | (near > far), _nothing(bits), number)


def depths_of(
    tree: Tree, line: Parts, axes: Parts, sign: Array, leaf: Int[Array, ""]
) -> Float[Array, "slots *rays"]:
    """Return how deep rays meet what is in a leaf; the rays' axes are the same."""
    _, rows, columns = tree.data.shape
    slots = tree.primitive.shape[1]
    beside = (1,) * line[0].ndim

    def row(k):
        values = jax.lax.dynamic_slice(tree.data, (leaf, k, jnp.int32(0)), (1, 1, columns))
        return values.reshape(-1, slots, *beside)

    x, y, z = (row(k) for k in axes)
    z = z * sign
    line = [x[None] for x in line]
    places = [corner for corners in zip(x, y, z, strict=True) for corner in corners]
    if rows == 3:
        return triangle_depth(line, places)
    return sphere_depth(line, [*places, row(jnp.int32(3))[0]])
