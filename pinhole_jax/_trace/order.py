"""In which order rays are best searched for.

What one ray has read of the tree the next one finds in the processor's cache, if it comes near the
scene where that one did.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics.one_kernel import on_cpu, put
from .bvh import Tree
from .components import inner

Vectors = Float[Array, "N 3"]
CELLS = 16  # along an axis; more gain nothing
FEW = 2048  # rays: fewer than these are taken as they come, for the sake of the compile time


def order_of(tree: Tree, origin: Vectors, direction: Vectors) -> Int[Array, "N"]:
    """Return the order in which to search for what rays meet."""
    N = direction.shape[0]
    return jnp.arange(N, dtype=jnp.int32) if N < FEW else near_order(tree, origin, direction)


def near_order(
    tree: Tree, origin: Vectors, direction: Vectors, together: Bool[Array, "N"] | None = None
) -> Int[Array, "N"]:
    """Return the order of rays by the cell where they enter the ellipsoid in the scene's box, start
    within it, or pass it nearest; after those that are `together`."""
    low, high = jnp.min(tree.planes[0, :3], axis=1), jnp.max(tree.planes[0, 3:], axis=1)
    half = jnp.maximum((high - low) / 2, jnp.finfo(low.dtype).tiny)
    o = [(origin[:, k] - (low[k] + high[k]) / 2) / half[k] for k in range(3)]
    d = [direction[:, k] / half[k] for k in range(3)]
    square = jnp.maximum(inner(d, d), jnp.finfo(low.dtype).tiny)
    nearest = -inner(o, d) / square
    root = jnp.sqrt(jnp.maximum(nearest * nearest - (inner(o, o) - 1) / square, 0))
    enters = jnp.maximum(nearest - root, 0)
    place = [
        jnp.clip((x + enters * y + 1) * (CELLS / 2), 0, CELLS - 1)
        for x, y in zip(o, d, strict=True)
    ]
    x, y, z = (_spread(jnp.where(p == p, p, 0).astype(jnp.int32)) for p in place)
    cell = (x | y << 1 | z << 2) + 1
    key = cell if together is None else jnp.where(together, 0, cell)
    in_order = lambda key, _: jnp.argsort(key).astype(jnp.int32)
    nothing = jnp.zeros(direction.shape[0], jnp.int32)
    return on_cpu(_counted, key, nothing, elsewhere=in_order)


def _spread(x: Int[Array, "N"]) -> Int[Array, "N"]:
    """Return numbers below `CELLS` with two zeros between their bits."""
    x = (x | x << 4) & 0xC3
    return (x | x << 2) & 0x249


def _counted(key: Int[Array, "N"], order: Int[Array, "N"]) -> Int[Array, "N"]:
    """Return the order of keys by counting: a tenth of the time that XLA takes to sort."""
    N, total = key.shape[0], CELLS**3 + 1
    one_more = lambda number, k: put(number, number[k] + 1, k)
    number = jnp.zeros(total, jnp.int32)
    number = jax.lax.fori_loop(0, N, lambda i, number: one_more(number, key[i]), number)

    def add(k, state):
        start, number = state
        start += number[k]
        return start, put(number, start, k)

    def place(k, state):
        end, order = state
        i = N - 1 - k  # of equal keys the last is the last
        end = put(end, end[key[i]] - 1, key[i])  # (read after it is written to: else it is copied)
        return end, put(order, jnp.int32(i), end[key[i]])

    _, end = jax.lax.fori_loop(0, total, add, (jnp.int32(0), number))
    return jax.lax.fori_loop(0, N, place, (end, order))[1]
