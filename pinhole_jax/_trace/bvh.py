"""A bounding volume hierarchy without pointers, and which of its leaves a beam of rays reaches.

Primitives in the order of a space-filling curve, spread evenly over 2^k leaves, make a complete
binary tree in heap layout: node n has the children 2n and 2n+1. Boxes are made from the vertices at
hand by a few reductions, so they are never stale; only the order is worked out once per mesh.

Rays are traced in packets. A packet's beam holds all its rays: they leave from a box of origins,
their directions are an interval of slopes against the axis along which all of them run. A list of
pairs (packet, node) goes down the tree a level at a time and keeps what may meet: no ray waits for
another, and the work is done by long vector operations.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._numerics.bitset import words_of
from .._numerics.running import running_sum
from .._scene.scene import Mesh, Spheres, morton_order
from .components import Parts, parts

LEAF = 4  # primitives in a leaf, at most
BLOCK = 4096  # pairs looked at in one go; a multiple of 32


class Tree(NamedTuple):
    """Boxes of the two children of each inner node, and what is in the leaves.

    A box is its low and its high corner; row 0 is not used. `data` holds the primitives by columns:
    nine coordinates of corners, or centre and radius.
    """

    boxes: Float[Array, "leaves 12"]
    primitive: Int[Array, "leaves leaf"]
    data: Float[Array, "leaves columns leaf"]


class Beams(NamedTuple):
    """Packets' bounds: origins, slopes d / |d[axis]|, the axis along which all rays of one run.

    `columns` are the least and greatest origin, the least and greatest slopes, the direction's sign
    on the axis, and the axis.
    """

    columns: Float[Array, "packets 14"]

    @property
    def axis(self) -> Int[Array, "packets"]:
        """The axis, 0 to 2."""
        return self.columns[:, 13].astype(jnp.int32)

    @property
    def sign(self) -> Float[Array, "packets"]:
        """The sign of the directions on the axis."""
        return self.columns[:, 12]


def mesh_tree(mesh: Mesh) -> Tree:
    """Return the tree over a mesh of at least one face."""
    corners = jax.lax.stop_gradient(mesh.vertices)[mesh.faces]
    low, high = jnp.min(corners, axis=1), jnp.max(corners, axis=1)
    return _build(mesh.order, low, high, corners.reshape(-1, 9))


def sphere_tree(spheres: Spheres) -> Tree:
    """Return the tree over at least one sphere."""
    centers, radii = jax.lax.stop_gradient((spheres.centers, spheres.radii[:, None]))
    data = jnp.concatenate([centers, radii], axis=1)
    return _build(morton_order(centers), centers - radii, centers + radii, data)


def _build(order, low, high, data) -> Tree:
    F = data.shape[0]
    leaves = max(2, 1 << (-(-F // LEAF) - 1).bit_length())
    first = np.arange(leaves + 1, dtype=np.int64) * F // leaves
    slots = first[:-1, None] + np.arange(-(-F // leaves))
    slots = np.minimum(slots, np.maximum(first[1:, None] - 1, 0))  # the last may be there twice
    index = order[jnp.asarray(slots.astype(np.int32))]
    pad = 4 * jnp.finfo(low.dtype).eps * jnp.maximum(jnp.abs(low), jnp.abs(high))
    low = jnp.min((low - pad)[index], axis=1)
    high = jnp.max((high + pad)[index], axis=1)
    levels = [jnp.concatenate([low, high], axis=1)]
    while levels[-1].shape[0] > 2:
        low, high = jnp.min(low.reshape(-1, 2, 3), axis=1), jnp.max(high.reshape(-1, 2, 3), axis=1)
        levels.append(jnp.concatenate([low, high], axis=1))
    boxes = jnp.concatenate([jnp.zeros((2, 6), low.dtype), *levels[::-1]])
    return Tree(boxes.reshape(leaves, 12), index, jnp.swapaxes(data[index], 1, 2))


def beams(
    origin: Float[Array, "packets rays 3"],
    direction: Float[Array, "packets rays 3"],
    axis: Int[Array, "packets"],
) -> Beams:
    """Return the beams of packets whose rays all run along an axis, all the same way."""
    along = permuted(parts(direction), axis[:, None], jnp.ones((), direction.dtype))[2]
    tiny = jnp.finfo(direction.dtype).tiny
    slope = direction / jnp.maximum(jnp.abs(along), tiny)[..., None]
    sign = jnp.where(along[:, :1] < 0, -1, 1).astype(direction.dtype)
    bounds = [f(x, axis=1) for x in (origin, slope) for f in (jnp.min, jnp.max)]
    return Beams(jnp.concatenate([*bounds, sign, axis[:, None].astype(direction.dtype)], axis=1))


def permuted(vector: Parts, axis: Array, sign: Array | int) -> tuple[Array, Array, Array]:
    """Return the components, turned so that `axis` comes last, and that one times `sign`."""
    x, y, z = vector
    pick = lambda a, b, c: jnp.where(axis == 0, a, jnp.where(axis == 1, b, c))
    return pick(y, z, x), pick(z, x, y), pick(x, y, z) * sign


def _may_meet(beam: list[Array], box: list[Array]) -> Bool[Array, "pairs"]:
    """Return whether some ray of a beam may meet a box; never False by rounding.

    Along the beam's axis the box lies between `near` and `far`; there the beam's slopes say how
    wide it is. The slack is some times the rounding of these terms and of the primitives' tests.
    """
    slack = 16 * jnp.finfo(box[0].dtype).eps
    o_low, o_high, s_low, s_high = (beam[3 * k : 3 * k + 3] for k in range(4))
    sign, axis = beam[12], beam[13]
    pick = lambda x: jnp.where(axis == 0, x[0], jnp.where(axis == 1, x[1], x[2]))
    low, high = pick(box[:3]) - pick(o_high), pick(box[3:]) - pick(o_low)
    near, far = jnp.where(sign > 0, low, -high), jnp.where(sign > 0, high, -low)
    near = jnp.maximum(near - slack * jnp.abs(near), 0)
    far = far + slack * jnp.abs(far)
    meet = far >= 0
    for k in range(3):
        low, most = box[k] - o_high[k], jnp.maximum(s_high[k] * near, s_high[k] * far)
        high, least = box[3 + k] - o_low[k], jnp.minimum(s_low[k] * near, s_low[k] * far)
        meet &= low - most <= slack * (jnp.abs(low) + jnp.abs(most) + far)
        meet &= least - high <= slack * (jnp.abs(high) + jnp.abs(least) + far)
    return meet


def packed(mask: Bool[Array, "n"], values: Int[Array, "n"]) -> tuple[Array, Array]:
    """Return the values where the mask is set, in order and at the front, and how many these are.

    n is a multiple of 32. Ranks come from 32-bit words: a prefix sum over words, and the number of
    bits set below each bit.
    """
    n = mask.shape[0]
    shift = jnp.arange(32, dtype=jnp.uint32)[None]
    words = words_of(mask)
    end = running_sum(jax.lax.population_count(words).astype(jnp.int32))
    below = words[:, None] & ((jnp.uint32(1) << shift) - 1)
    start = end - jax.lax.population_count(words).astype(jnp.int32)
    rank = start[:, None] + jax.lax.population_count(below).astype(jnp.int32)
    place = jnp.where(mask, rank.reshape(-1), n)
    out = jnp.zeros(n + 1, values.dtype).at[place].set(values, mode="promise_in_bounds")
    return out[:n], end[-1]


class Reached(NamedTuple):
    """Pairs `packet << bits | leaf node`, ascending from `start`; too many where number > room."""

    pairs: Int[Array, "buffer"]
    start: Int[Array, ""]
    number: Int[Array, ""]


def capacity(tree: Tree) -> int:
    """Return how many pairs `reach` has room for: always enough for one packet."""
    return max(tree.primitive.shape[0], 128 * BLOCK)


def node_bits(tree: Tree) -> int:
    """Return how many bits a node's number has."""
    return tree.primitive.shape[0].bit_length()


def new_buffer(tree: Tree) -> Int[Array, "buffer"]:
    """Return room for `reach` to work in; what is in it does not matter."""
    return jnp.zeros(2 * (capacity(tree) + 2 * BLOCK), jnp.int32)


def reach(tree: Tree, beams: Beams, wanted: Bool[Array, "packets"], buffer: Array) -> Reached:
    """Return the leaves that the wanted packets' beams may meet, by packet.

    The list goes down the tree a level at a time, between the two halves of the buffer. It stops
    where it outgrows its room: then `number` is above `capacity`, and fewer packets must be asked
    for.
    """
    bits, limit, half = node_bits(tree), capacity(tree), buffer.shape[0] // 2
    root = (jnp.arange(wanted.shape[0], dtype=jnp.int32) << bits) | 1
    first, count = packed(wanted, root)
    buffer = jax.lax.dynamic_update_slice(buffer, first, (0,))

    def block(state):
        k, found, buffer, start, count = state
        live = k + jnp.arange(BLOCK, dtype=jnp.int32) < count
        pairs = jnp.where(live, jax.lax.dynamic_slice(buffer, (start + k,), (BLOCK,)), 1)
        node = pairs & ((1 << bits) - 1)
        beam, box = beams.columns[pairs >> bits], tree.boxes[node]
        beam, box = ([x[:, k] for k in range(x.shape[1])] for x in (beam, box))
        meet = jnp.stack([_may_meet(beam, box[:6]) & live, _may_meet(beam, box[6:]) & live], axis=1)
        children = jnp.stack([pairs + node, pairs + node + 1], axis=1)
        met, number = packed(meet.reshape(-1), children.reshape(-1))
        buffer = jax.lax.dynamic_update_slice(buffer, met, (half - start + found,))
        return k + BLOCK, found + number, buffer, start, count

    def level(state):
        depth, buffer, start, count = state
        going = lambda s: (s[0] < s[4]) & (s[1] <= limit)
        _, found, buffer, _, _ = jax.lax.while_loop(
            going, block, (jnp.int32(0), jnp.int32(0), buffer, start, count)
        )
        return depth + 1, buffer, half - start, found

    going = lambda s: (s[0] < bits - 1) & (s[3] <= limit) & (s[3] > 0)
    state = jax.lax.while_loop(going, level, (jnp.int32(0), buffer, jnp.int32(0), count))
    return Reached(*state[1:])
