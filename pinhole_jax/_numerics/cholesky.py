"""Small systems of normal equations, written out: side by side, many of them are a few kernels,
where LAPACK is called for one after the other."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def solve_normal(A: Float[Array, "*N n n"], b: Float[Array, "*N n"]) -> Float[Array, "*N n"]:
    """Return x of A x = b by Cholesky's L L^T = A; NaN where A is not positive definite."""
    n = b.shape[-1]
    L: dict[tuple[int, int], Array] = {}
    for j in range(n):
        rest = A[..., j, j] - sum(L[j, k] ** 2 for k in range(j))
        L[j, j] = jnp.sqrt(rest)
        for i in range(j + 1, n):
            rest = A[..., i, j] - sum(L[i, k] * L[j, k] for k in range(j))
            L[i, j] = rest / L[j, j]

    z: list[Array] = []
    for i in range(n):
        z.append((b[..., i] - sum(L[i, k] * z[k] for k in range(i))) / L[i, i])
    x: list[Array] = [z[0]] * n
    for i in reversed(range(n)):
        x[i] = (z[i] - sum(L[k, i] * x[k] for k in range(i + 1, n))) / L[i, i]
    return jnp.stack(x, axis=-1)
