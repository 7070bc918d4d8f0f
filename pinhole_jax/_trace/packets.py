"""Which primitive each ray meets first: packets of rays against the leaves that they reach.

A packet of rays whose beam is narrow goes down the tree as one; the rays of other packets go one by
one. Then each lane of a vector takes a packet, and all lanes test their packet's rays against the
packet's next leaf; packets with as many leaves share the lanes, so few lanes are idle.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Num

from .._numerics.batches import in_turn
from .bvh import (
    Beams,
    Reached,
    Tree,
    beams,
    capacity,
    new_buffer,
    node_bits,
    packed,
    permuted,
    reach,
)
from .components import Parts, parts
from .intersect import sphere_depth, triangle_depth

TILE = 4  # rays of an image are searched in packets of TILE x TILE
RAYS = TILE * TILE  # in a packet
PACKETS = 4096  # at a time: the tree's parts that they reach stay in the processor's cache
LANES = 256
FEW = 2048  # rays: fewer than these all go one by one, for the sake of the compile time
WIDE = 64  # leaves of a surface that a packet may cover before its rays go one by one

Vectors = Float[Array, "N 3"]


@jax.custom_batching.custom_vmap
def first_met(tree: Tree, origin: Vectors, direction: Vectors) -> Int[Array, "N"]:
    """Return the index of the primitive that each ray meets first, -1 for none.

    Directions are of about unit length. Of primitives that are met at the same distance the one
    with the lowest index counts. Rays that are near one another should follow one another.
    """
    N = direction.shape[0]
    if N == 0:
        return jnp.zeros(0, jnp.int32)
    axis, common = axes_of(parts(direction))
    origin, direction, axis = _filled_up(origin), _filled_up(direction), _filled_up(axis)
    met = jnp.full((origin.shape[0] + 1, RAYS), -1, jnp.int32)
    narrow = jnp.zeros(origin.shape[0], bool)
    if N >= FEW:
        narrow = common & _is_narrow(tree, beams(origin, direction, axis[:, 0]))
        met = _search(tree, origin, direction, axis, narrow, met, split=False)
    met = _search(tree, origin, direction, axis, ~narrow, met, split=True)
    return met[:-1].reshape(-1)[:N]


def one_by_one(
    tree: Tree, origin: Vectors, direction: Vectors, axis: Int[Array, "N"], number: Array
) -> Int[Array, "N"]:
    """Return what `first_met` does of the first `number` rays or a few more, each one's axis given;
    -1 for the others."""
    N = direction.shape[0]
    origin, direction, axis = _filled_up(origin), _filled_up(direction), _filled_up(axis)
    met = jnp.full((origin.shape[0] + 1, RAYS), -1, jnp.int32)
    wanted = RAYS * jnp.arange(origin.shape[0], dtype=jnp.int32) < number
    met = _search(tree, origin, direction, axis, wanted, met, split=True)
    return met[:-1].reshape(-1)[:N]


@first_met.def_vmap
def _batched(size: int, batched: list, tree: Tree, origin: Array, direction: Array):
    """One batch of rays is more rays; many trees are searched in turn."""
    if any(batched[0]):
        return in_turn(first_met, batched, (tree, origin, direction)), True
    spread = lambda x, b: x if b else jnp.broadcast_to(x, (size, *x.shape))
    origin, direction = spread(origin, batched[1]), spread(direction, batched[2])
    return first_met(tree, origin.reshape(-1, 3), direction.reshape(-1, 3)).reshape(size, -1), True


def axes_of(direction: Parts) -> tuple[Int[Array, "N"], Bool[Array, "packets"]]:
    """Return the axis along which each ray is tested, 0 to 2, and in which packets it is common.

    Directions are x, y and z, (N,) each. The axis is that along which all rays of a packet run, or
    else each ray's own. What a ray meets depends on it by rounding, so it depends on directions
    alone.
    """
    N = direction[0].shape[0]
    by_packet = [_filled_up(x) for x in direction]
    least = [jnp.maximum(jnp.min(x, axis=1), -jnp.max(x, axis=1)) for x in by_packet]
    common = jnp.maximum(jnp.maximum(least[0], least[1]), least[2]) > 0.3
    of_ray = _largest_of(*(jnp.abs(x) for x in by_packet))
    axis = jnp.where(common[:, None], _largest_of(*least)[:, None], of_ray)
    return axis.reshape(-1)[:N], common


def _largest_of(x: Array, y: Array, z: Array) -> Array:
    """Return which is the largest, 0 to 2; of equal ones the first."""
    return jnp.where((x >= y) & (x >= z), 0, jnp.where(y >= z, 1, 2)).astype(jnp.int32)


def _filled_up(x: Num[Array, "N *rest"]) -> Num[Array, "packets rays *rest"]:
    """Return what rays have by packets; the last ray fills up the last packet."""
    rest = x.shape[1:]
    fill = ((0, -x.shape[0] % RAYS), *((0, 0) for _ in rest))
    return jnp.pad(x, fill, mode="edge").reshape(-1, RAYS, *rest)


def in_packets(x: Num[Array, "*shape"]) -> Num[Array, "N"]:
    """Return what rays have in the order in which they are searched: of images tile by tile.

    Tiles at the image's right and lower border are filled up with its last column and row.
    """
    if not _has_tiles(x.shape):
        return x.reshape(-1)
    H, W = x.shape[-2:]
    rows, columns = -(-H // TILE), -(-W // TILE)
    fill = ((0, 0), (0, rows * TILE - H), (0, columns * TILE - W))
    x = jnp.pad(x.reshape(-1, H, W), fill, mode="edge")
    return jnp.swapaxes(x.reshape(-1, rows, TILE, columns, TILE), 2, 3).reshape(-1)


def out_of_packets(values: Array, shape: tuple[int, ...]) -> Array:
    """Return values, in the order of `in_packets`, in the rays' shape."""
    if not _has_tiles(shape):
        return values.reshape(shape)
    H, W = shape[-2:]
    rows, columns = -(-H // TILE), -(-W // TILE)
    values = jnp.swapaxes(values.reshape(-1, rows, columns, TILE, TILE), 2, 3)
    return values.reshape(-1, rows * TILE, columns * TILE)[:, :H, :W].reshape(shape)


def _has_tiles(shape: tuple[int, ...]) -> bool:
    return len(shape) >= 2 and min(shape[-2:]) >= TILE


def _is_narrow(tree: Tree, packets: Beams) -> Bool[Array, "packets"]:
    """Return which packets are better traced as one: they cover few leaves of a surface."""
    low = jnp.minimum(tree.boxes[1, :3], tree.boxes[1, 6:9])[None]
    high = jnp.maximum(tree.boxes[1, 3:6], tree.boxes[1, 9:])[None]
    o_low, o_high, s_low, s_high = (packets.columns[:, 3 * k : 3 * k + 3] for k in range(4))
    leaf = jnp.max(high - low) / tree.primitive.shape[0] ** 0.5
    far = jnp.maximum(jnp.max(high - o_low, axis=1), jnp.max(o_high - low, axis=1))
    width = (o_high - o_low) + (s_high - s_low) * jnp.maximum(far, 0)[:, None]
    return jnp.prod(1 + width / jnp.maximum(leaf, 1e-30), axis=1) <= WIDE


def _search(
    tree: Tree, origin, direction, axis, wanted, met, split: bool
) -> Int[Array, "packets rays"]:
    """Return `met` with the wanted packets' rows filled in; its last row takes what is not wanted.

    Takes some packets at a time; where they reach more leaves than there is room for, half as many.
    """
    total = wanted.shape[0]
    beams_of_one = RAYS if split else 1
    most = min(4 * PACKETS if split else PACKETS, 1 << (30 - node_bits(tree)))  # bits of a pair
    size = max(32, min(most, beams_of_one << (total - 1).bit_length())) // beams_of_one
    some = jnp.arange(-(-total // 32) * 32, dtype=jnp.int32)
    wanted = jnp.pad(wanted, (0, some.shape[0] - total))
    ids, number = packed(wanted, some)

    def chunk(state):
        start, step, met, buffer = state
        k = jnp.arange(size, dtype=jnp.int32)
        take = (k < step) & (start + k < number)
        row = jnp.where(take, ids[jnp.minimum(start + k, some.shape[0] - 1)], total)
        o, d, along = (x[jnp.where(take, row, 0)] for x in (origin, direction, axis))
        if split:
            take, o, d = jnp.repeat(take, RAYS), o.reshape(-1, 1, 3), d.reshape(-1, 1, 3)
        bounds = beams(o, d, along.reshape(-1) if split else along[:, 0])
        found = reach(tree, bounds, take, buffer)
        full = found.number > capacity(tree)
        hits = _closest(tree, o, d, bounds, found._replace(number=jnp.where(full, 0, found.number)))
        met = met.at[jnp.where(full, total, row)].set(hits.reshape(size, RAYS))
        start, step = jnp.where(full, start, start + step), jnp.where(full, step // 2, step)
        return start, step, met, found.pairs

    more = lambda state: state[0] < number
    begin = (jnp.int32(0), jnp.int32(size), met, new_buffer(tree))
    return jax.lax.while_loop(more, chunk, begin)[2]


def _closest(tree: Tree, origin, direction, bounds: Beams, found: Reached) -> Int[Array, "n rays"]:
    """Return the primitive that each ray of each packet meets first, -1 for none."""
    n, rays = origin.shape[:2]
    lanes = min(LANES * RAYS // rays, n)
    first = _first_at_least(found, jnp.arange(n + 1, dtype=jnp.int32) << node_bits(tree))
    leaves, order = jax.lax.sort(
        (first[:-1] - first[1:], jnp.arange(n, dtype=jnp.int32)), num_keys=1
    )
    permute = partial(permuted, axis=bounds.axis[:, None], sign=bounds.sign[:, None])
    o, d = permute(parts(origin)), permute(parts(direction))
    columns = jnp.stack([*o, d[0] / d[2], d[1] / d[2]], axis=1)

    def group(state):
        k, met = state
        ids = jax.lax.dynamic_slice(order, (k,), (lanes,))
        number = -jax.lax.dynamic_slice(leaves, (k,), (lanes,))
        load = _loader(tree, found, first[ids], number, bounds.axis[ids], bounds.sign[ids])
        hits = _lanes(tree, load, number[0], jnp.transpose(columns[ids], (1, 2, 0))[:, :, None])
        return k + lanes, met.at[ids].set(hits.T, mode="promise_in_bounds")

    more = lambda s: (s[0] < n) & (leaves[jnp.minimum(s[0], n - 1)] < 0)
    return jax.lax.while_loop(more, group, (jnp.int32(0), jnp.full((n, rays), -1, jnp.int32)))[1]


def _first_at_least(found: Reached, keys: Int[Array, "n"]) -> Int[Array, "n"]:
    """Return the place of the first pair that is no less than each key, by bisection."""

    def halve(_, ends):
        low, high = ends
        middle = (low + high) // 2
        less = (low < high) & (found.pairs[found.start + middle] < keys)
        return jnp.where(less, middle + 1, low), jnp.where(less | (low >= high), high, middle)

    steps = found.pairs.shape[0].bit_length()
    start = (jnp.zeros_like(keys), jnp.full_like(keys, found.number))
    return jax.lax.fori_loop(0, steps, halve, start)[0]


def _loader(tree: Tree, found: Reached, first, number, axis, sign) -> Callable:
    """Return a function of j: the j-th leaf's primitives for each lane, turned, and their indices.

    A lane that has no j-th leaf gets indices of -1.
    """
    bits = node_bits(tree)
    _, columns, slots = tree.data.shape
    order = jnp.stack(permuted([jnp.int32(k) for k in range(3)], axis, 1))  # (3, lanes)
    whole = columns // 3
    column = (3 * jnp.arange(whole, dtype=jnp.int32)[:, None, None] + order[None]).reshape(
        3 * whole, -1
    )
    factor = jnp.tile(jnp.stack([jnp.ones_like(sign), jnp.ones_like(sign), sign]), (whole, 1))
    if columns % 3:
        last = jnp.full((1, column.shape[1]), columns - 1, jnp.int32)
        column = jnp.concatenate([column, last])
        factor = jnp.concatenate([factor, jnp.ones((1, column.shape[1]), factor.dtype)])
    slot = jnp.arange(slots, dtype=jnp.int32)[:, None]

    def load(j):
        has = j < number
        node = found.pairs[found.start + jnp.where(has, first + j, 0)] & ((1 << bits) - 1)
        leaf = jnp.where(has, node - (1 << (bits - 1)), 0)
        at = ((leaf * columns)[None] + column)[:, None] * slots + slot[None]
        data = tree.data.reshape(-1).at[at].get(mode="promise_in_bounds")
        index = (
            tree.primitive.reshape(-1).at[leaf[None] * slots + slot].get(mode="promise_in_bounds")
        )
        return (data * factor[:, None])[:, None], jnp.where(has[None], index, -1)

    return load


def _lanes(tree: Tree, load: Callable, steps, rays: Float[Array, "5 rays 1 lanes"]) -> Array:
    """Return what each lane's rays meet first among its leaves.

    A pipeline of three stages: what one step loads is tested in the next and counted in the one
    after that. Each stage reads what the loop carries, else the compiler would merge the stages and
    do the work of one for each element of the next.
    """
    depth_of = sphere_depth if tree.data.shape[1] == 4 else triangle_depth

    def step(state):
        j, primitives, index, depth, tested, best, met = state
        for k in range(tested.shape[0]):
            here = jnp.where(tested[k][None] < 0, jnp.inf, depth[:, k])
            closer = (here < best) | ((here == best) & (tested[k][None] < met))
            met = jnp.where(closer, tested[k][None], met)
            best = jnp.minimum(here, best)
        return j + 1, *load(j), depth_of(rays, primitives), index, best, met

    leaf = tree.primitive.shape[1]
    shape = (rays.shape[1], leaf, rays.shape[3])
    primitives = jnp.ones((tree.data.shape[1], 1, *shape[1:]), rays.dtype)
    index = jnp.full(shape[1:], -1, jnp.int32)
    depth = jnp.full(shape, jnp.inf, rays.dtype)
    met = jnp.full((shape[0], shape[2]), -1, jnp.int32)
    start = (jnp.int32(0), primitives, index, depth, index, depth[:, 0], met)
    return jax.lax.while_loop(lambda s: s[0] < steps + 2, step, start)[-1]
