"""Which primitives the rays of a packet meet first, who go down the tree together.

Rays near one another, as an image's, look at the same nodes and leaves. A packet reads each once: a
node's boxes are tested against bounds of all its rays, a leaf's primitives against each of them.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .bvh import Tree
from .components import Parts
from .search import depths_of, larger, lesser, numbers_of, planes_of, search
from .turned import Ray

RAYS = 16  # in a packet
LEAVES = 256  # that a packet may look at before its rays go on one by one
ALONE = 8  # packets whose rays do so before the next one tries


class Beam(NamedTuple):
    """Bounds of the rays of a packet, or of many; by axes, as in `Ray`.

    - `near`, `far`: which planes of a box they all pass first and last.
    - `least`, `most`: bounds of their `scale`. Of one ray they are two equal arrays: the loop over
      boxes is then long enough for LLVM to make vectors of it; a shorter one it unrolls instead.
    - `first`, `last`: the bounds of their origins from which near planes are the least way off, and
      far ones the longest.
    - `slack`: by which a plane may be passed sooner or later than that.
    - `whole`: whether there are such bounds.
    """

    near: Parts
    far: Parts
    least: Parts
    most: Parts
    first: Parts
    last: Parts
    slack: Parts
    whole: Bool[Array, "*packets"]


def beams(rays: Ray) -> Beam:
    """Return bounds of each packet of rays that follow one another; a rest has none."""
    N = rays.scale[0].shape[0]
    packets = jax.tree.map(lambda x: x[: N - N % RAYS].reshape(-1, RAYS), rays)
    low, high = partial(jnp.min, axis=1), partial(jnp.max, axis=1)
    x, y, z = packets.line[:3]
    origin = [x, y, z * packets.scale[2]]
    whole = high(packets.axes[2]) == low(packets.axes[2])
    least, most, first, last, slack = [], [], [], [], []
    for k, o in enumerate(origin):
        a, b = low(packets.scale[k]), high(packets.scale[k])
        whole &= (a < 0) == (b < 0)
        least.append(a)
        most.append(b)
        first.append(jnp.where(a < 0, low(o), high(o)))
        last.append(jnp.where(a < 0, high(o), low(o)))
        slack.append(high(packets.slack[k]))
    whole &= jnp.all(packets.real, axis=1)
    whole = jnp.pad(whole, (0, int(N % RAYS > 0)))
    row = lambda parts: [x[:, 0] for x in parts]
    return Beam(row(packets.near), row(packets.far), least, most, first, last, slack, whole)


def beam_of(ray: Ray) -> Beam:
    """Return the bounds of a single ray."""
    x, y, z = ray.line[:3]
    origin = [x, y, z * ray.scale[2]]
    return Beam(ray.near, ray.far, ray.scale, ray.again, origin, origin, ray.slack, ray.real)


def first_met_of_packet(tree: Tree, rays: Ray, beam: Beam) -> tuple[Int[Array, "rays"], Array]:
    """Return the index of the primitive that each ray of a packet meets first, -1 for none; and
    whether the packet came to an end."""
    dtype = rays.scale[0].dtype
    best = jnp.full(RAYS, jnp.inf, dtype)
    met = jnp.full(RAYS, -1, jnp.int32)
    end = search(
        tree,
        partial(children, tree, beam),
        partial(_met_in_leaf, tree, rays),
        best,
        met,
        beam.whole,
        LEAVES,
    )
    return end.met, beam.whole & (end.left >= 0)


def children(tree: Tree, beam: Beam, node: Int[Array, ""], far: Array) -> Int[Array, "children"]:
    """Return a node's children that some ray may meet before what all met already."""

    def passes(k, rows, origin):
        way = planes_of(tree, node, rows[k]) - origin[k]
        return way * beam.least[k], way * beam.most[k]

    enter = [lesser(*passes(k, beam.near, beam.first)) - beam.slack[k] for k in range(3)]
    leave = [larger(*passes(k, beam.far, beam.last)) + beam.slack[k] for k in range(3)]
    return numbers_of(tree, enter, leave, far)


def _met_in_leaf(
    tree: Tree, rays: Ray, leaf: Int[Array, ""], best: Array, met: Array
) -> tuple[Array, Array]:
    """Return how deep the nearest of what was met and of what is in a leaf is, and its index."""
    axes = [x[0] for x in rays.axes]
    depth = depths_of(tree, rays.line, axes, rays.scale[2][0], leaf)
    index = jax.lax.dynamic_index_in_dim(tree.primitive, leaf, keepdims=False)
    for k in range(index.shape[0]):
        nearer = (depth[k] < best) | ((depth[k] == best) & (index[k] < met))
        best = jnp.where(nearer, depth[k], best)
        met = jnp.where(nearer, index[k], met)
    return best, met
