"""QR of tall, thin tables: thousands of rows, a handful of columns.

LAPACK's factorisation spends its time on starting threads there: 1 to 13 ms where Householder
reflections, written as a few passes over the columns, take 0.2 ms.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .one_kernel import on_cpu

#: Rows that are reflected together. (More are no faster: 4104 x 8 take 0.13 ms, in blocks of 1024
#: that are no single kernel 0.18.)
BLOCK = 128


def triangle(table: Float[Array, "m k"]) -> Float[Array, "k k"]:
    """Return R of table = Q R, upper triangular; m >= k.

    Blocks of rows one after the other, up to the last row that is not all zero: the rest of a table
    with more room than rows costs nothing.
    """
    m, k = table.shape
    blocks = jnp.pad(table, ((0, -m % BLOCK), (0, 0))).reshape(-1, BLOCK, k)
    counts = jnp.any(blocks != 0, axis=(1, 2))
    number = jnp.max(jnp.where(counts, jnp.arange(1, len(blocks) + 1, dtype=jnp.int32), 0))
    return on_cpu(_one_by_one, blocks, number, jnp.zeros((k, k), table.dtype))


def _one_by_one(blocks: Float[Array, "B rows k"], number: Int[Array, ""], R: Float[Array, "k k"]):
    def further(n, R):
        rows = jax.lax.dynamic_index_in_dim(blocks, n, keepdims=False)
        return _triangle(jnp.concatenate([R, rows]))

    return jax.lax.fori_loop(jnp.int32(0), number, further, R)


def solved(table: Float[Array, "m k"]) -> Float[Array, "n"]:
    """Return x that minimises |J x - r| of a short table [J, r], of at most `BLOCK` rows."""
    return on_cpu(_solved, table)


def _solved(table: Float[Array, "m k"]) -> Float[Array, "n"]:
    R = _triangle(table)
    n = R.shape[0] - 1

    def back(k, x):
        j = n - 1 - k
        return x.at[j].set((R[j, n] - jnp.sum(R[j, :n] * x)) / R[j, j])

    return jax.lax.fori_loop(0, n, back, jnp.zeros(n, R.dtype))


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
