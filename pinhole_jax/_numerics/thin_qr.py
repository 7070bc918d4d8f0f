"""QR of tall, thin tables: thousands of rows, a handful of columns.

LAPACK's factorisation spends its time on starting threads there: 1 to 13 ms where Householder
reflections, written as a few passes over the columns, take 0.2 ms.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

#: Rows that are reflected together. (8192 x 8 take 0.31 to 0.44 ms with 256 to 4096: it hardly
#: matters.)
BLOCK = 1024


def triangle(table: Float[Array, "m k"]) -> Float[Array, "k k"]:
    """Return R of table = Q R, upper triangular; m >= k.

    Blocks of rows one after the other, up to the last row that is not all zero: the rest of a table
    with more room than rows costs nothing.
    """
    m, k = table.shape
    if m <= BLOCK + k:
        return _triangle(table)
    blocks = jnp.pad(table, ((0, -m % BLOCK), (0, 0))).reshape(-1, BLOCK, k)
    counts = jnp.any(blocks != 0, axis=(1, 2))
    number = jnp.max(jnp.where(counts, jnp.arange(1, len(blocks) + 1, dtype=jnp.int32), 0))
    further = lambda n, R: _triangle(jnp.concatenate([R, blocks[n]]))
    return jax.lax.fori_loop(jnp.int32(0), number, further, jnp.zeros((k, k), table.dtype))


def _triangle(table: Float[Array, "m k"]) -> Float[Array, "k k"]:
    m, k = table.shape
    row = jnp.arange(m)

    def reflect(j, columns):
        x = jnp.where(row >= j, columns[j], 0)
        length = jnp.sqrt(jnp.sum(x * x))
        v = x.at[j].add(jnp.where(x[j] > 0, length, -length))
        square = jnp.sum(v * v)
        scale = jnp.where(square > 0, 2 / jnp.where(square > 0, square, 1), 0)
        along = jnp.sum(columns * v[None], axis=1) * scale
        return columns - along[:, None] * v[None]

    return jnp.triu(jax.lax.fori_loop(0, k, reflect, table.T)[:, :k].T)


def triangle_and_rhs(
    jacobian: Float[Array, "m n"], residual: Float[Array, "m"]
) -> tuple[Float[Array, "n n"], Float[Array, "n"]]:
    """Return R and the first n entries of Q^T r; m > n."""
    n = jacobian.shape[1]
    R = triangle(jnp.concatenate([jacobian, residual[:, None]], axis=1))
    return R[:n, :n], R[:n, n]
