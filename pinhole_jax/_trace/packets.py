"""Which primitive each ray meets first, and what that depends on of the rays near it.

Of rays near one another, a packet, all are tested along one axis where that can be: then an image's
rays meet what drawing it meets.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Num

from .._numerics.batches import in_turn
from .bvh import Tree
from .components import Parts, parts
from .order import FEW, near_order
from .together import RAYS
from .walk import walk

TILE = 4  # rays of an image that are near one another: TILE x TILE = RAYS
APART = (
    0.25  # how far a packet's rays may be apart, in directions, and origins over the scene's size
)

Vectors = Float[Array, "N 3"]


@jax.custom_batching.custom_vmap
def first_met(tree: Tree, origin: Vectors, direction: Vectors) -> Int[Array, "N"]:
    """Return the index of the primitive that each ray meets first, -1 for none.

    Directions are of about unit length. Of primitives that are met at the same distance the one
    with the lowest index counts.
    """
    if direction.shape[0] == 0:
        return jnp.zeros(0, jnp.int32)
    axis = axes_of(parts(direction))
    if direction.shape[0] < FEW:
        return walk(tree, origin, direction, axis, jnp.arange(direction.shape[0], dtype=jnp.int32))
    order = near_order(tree, origin, direction, stay_together(parts(origin), parts(direction)))
    return walk(tree, origin, direction, axis, order, together=True)


@first_met.def_vmap
def _batched(size: int, batched: list, tree: Tree, origin: Array, direction: Array):
    """One batch of rays is more rays; many trees are searched in turn."""
    if any(batched[0]):
        return in_turn(first_met, batched, (tree, origin, direction)), True
    spread = lambda x, b: x if b else jnp.broadcast_to(x, (size, *x.shape))
    origin, direction = spread(origin, batched[1]), spread(direction, batched[2])
    return first_met(tree, origin.reshape(-1, 3), direction.reshape(-1, 3)).reshape(size, -1), True


def axes_of(direction: Parts) -> Int[Array, "N"]:
    """Return the axis along which each ray is tested, 0 to 2.

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
    return axis.reshape(-1)[:N]


def stay_together(origin: Parts, direction: Parts) -> Bool[Array, "N"]:
    """Return which rays are of packets that start near one another, and go the same way.

    The last packet is none if rays do not fill it.
    """
    N = origin[0].shape[0]
    near = jnp.arange(-(-N // RAYS)) < N // RAYS
    for x in (*origin, *direction):
        by_packet = _filled_up(x)
        near &= jnp.max(by_packet, axis=1) - jnp.min(by_packet, axis=1) < APART
    return jnp.repeat(near, RAYS)[:N]


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


def begins_anew(shape: tuple[int, ...]) -> int:
    """Return a number of steps along the first axis after which packets begin anew."""
    if not _has_tiles(shape):
        return RAYS
    return TILE if len(shape) == 2 else 1


def _has_tiles(shape: tuple[int, ...]) -> bool:
    return len(shape) >= 2 and min(shape[-2:]) >= TILE
