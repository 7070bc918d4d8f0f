"""QR of tall, thin tables: thousands of rows, a handful of columns.

LAPACK's factorisation spends its time on starting threads there: 1 to 13 ms where Householder
reflections, written as a few passes over the columns, take 0.2 ms.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .one_kernel import on_cpu

#: Rows that are reflected together. (More are no faster: 4104 x 8 take 0.13 ms, in blocks of 1024
#: that are no single kernel 0.18.)
BLOCK = 128


def triangle(table: Float[Array, "m k"]) -> Float[Array, "k k"]:
    """Return R of table = Q R, upper triangular; m >= k."""
    return triangle_of(jnp.pad(table, ((0, -len(table) % BLOCK), (0, 0))).T, table.shape[1])


def triangle_of(columns: Float[Array, "c m"], k: int) -> Float[Array, "k k"]:
    """Return R of the first k of some columns, of a multiple of `BLOCK` rows.

    Blocks of rows one after the other, but those that are all zero: what a table has more room
    than rows costs next to nothing.
    """
    return on_cpu(_one_by_one, columns, jnp.zeros((k, k), columns.dtype))


def _one_by_one(columns: Float[Array, "c m"], R: Float[Array, "k k"]) -> Float[Array, "k k"]:
    k = len(R)

    def further(n, R):
        block = jax.lax.dynamic_slice(columns, (jnp.int32(0), n * BLOCK), (k, BLOCK))
        taken = lambda R: _triangle(jnp.concatenate([R.T, block], axis=1))
        return jax.lax.cond(jnp.any(block != 0), taken, lambda R: R, R)

    return jax.lax.fori_loop(jnp.int32(0), jnp.int32(columns.shape[1] // BLOCK), further, R)


def solved(table: Float[Array, "m k"]) -> Float[Array, "n"]:
    """Return x that minimises |J x - r| of a short table [J, r], of at most `BLOCK` rows, in
    what can be one kernel."""
    R = _triangle(table.T)
    n = R.shape[0] - 1

    def back(k, x):
        j = n - 1 - k
        return x.at[j].set((R[j, n] - jnp.sum(R[j, :n] * x)) / R[j, j])

    return jax.lax.fori_loop(0, n, back, jnp.zeros(n, R.dtype))


def _triangle(columns: Float[Array, "k m"]) -> Float[Array, "k k"]:
    k, m = columns.shape
    row = jnp.arange(m)

    def reflect(j, columns):
        x = jnp.where(row >= j, columns[j], 0)
        length = jnp.sqrt(jnp.sum(x * x))
        v = x.at[j].add(jnp.where(x[j] > 0, length, -length))
        square = jnp.sum(v * v)
        scale = jnp.where(square > 0, 2 / jnp.where(square > 0, square, 1), 0)
        along = jnp.sum(columns * v[None], axis=1) * scale
        return columns - along[:, None] * v[None]

    return jnp.triu(jax.lax.fori_loop(0, k, reflect, columns)[:, :k].T)


def triangle_and_rhs(
    jacobian: Float[Array, "m n"], residual: Float[Array, "m"]
) -> tuple[Float[Array, "n n"], Float[Array, "n"]]:
    """Return R and the first n entries of Q^T r; m > n."""
    n = jacobian.shape[1]
    R = triangle(jnp.concatenate([jacobian, residual[:, None]], axis=1))
    return R[:n, :n], R[:n, n]
