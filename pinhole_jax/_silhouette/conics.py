"""Conics that spheres are seen as: their points, and the area beside them.

An arc is the image of an arc of a circle in space: `frame[0] + frame[1] w_1 + frame[2] w_2` are
homogeneous film points (x z, y z, z), w on the unit circle. So one form holds ellipses, parabolas
and hyperbolas, and a point with a given abscissa or height is found by a line that cuts the unit
circle.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._numerics.safe import dot, safe_divide

#: What stands for infinity on the film; far beyond any frame, and its square is still finite.
FAR = 1e15

#: Gauss-Legendre nodes and weights on [0, 1]; exact to 1e-14 over a quarter turn.
_NODES, _WEIGHTS = (x / 2 for x in np.polynomial.legendre.leggauss(8))
_NODES = _NODES + 0.5


def homogeneous(frame: Float[Array, "*#K 3 3"], w: Float[Array, "*K 2"]) -> Float[Array, "*K 3"]:
    """Return the homogeneous film point of w."""
    return frame[..., 0, :] + frame[..., 1, :] * w[..., :1] + frame[..., 2, :] * w[..., 1:]


def film_at(frame: Float[Array, "*#K 3 3"], w: Float[Array, "*K 2"]) -> Float[Array, "*K 2"]:
    """Return the film point of w (px)."""
    point = homogeneous(frame, w)
    return safe_divide(point[..., :2], point[..., 2:])


def arc_end(
    frame: Float[Array, "*K 3 3"], w: Float[Array, "*K 2"], inward: int
) -> Float[Array, "*K 2"]:
    """Return the film point of an arc's end w, at infinity by its next points `inward`."""
    point = homogeneous(frame, w)
    xy, z, tiny = point[..., :2], point[..., 2:], 64 * jnp.finfo(frame.dtype).eps
    change = (frame[..., 2, :2] * w[..., :1] - frame[..., 1, :2] * w[..., 1:]) * inward
    none = jnp.abs(xy) <= tiny * jnp.max(jnp.abs(frame[..., :2]), axis=-2)
    far = jnp.copysign(FAR, jnp.where(none, change, xy))
    at_infinity = z <= tiny
    return jnp.where(at_infinity, far, xy / jnp.where(at_infinity, 1, z))


# --- points of an arc ----------------------------------------------------------------------------


def unit_at(
    frame: Float[Array, "*K 3 3"], axis: int, value: Float[Array, "*K"], growing: Float[Array, "*K"]
) -> Float[Array, "*K 2"]:
    """Return the w whose film point has coordinate number `axis` equal to `value`.

    Of the two `growing` (1 or -1) chooses the one where that coordinate grows or falls along the
    arc; where the curve does not reach the value, the point nearest to it.
    """
    level = frame[..., axis] - value[..., None] * frame[..., 2]
    return cut_circle(level, growing)


def cut_circle(
    level: Float[Array, "*K 3"], growing: Float[Array, "*K"] | float
) -> Float[Array, "*K 2"]:
    """Return w on the unit circle with `level . (1, w_1, w_2) = 0`, growing there or falling."""
    b, x, y = -level[..., 0], level[..., 1], level[..., 2]
    length = jnp.sqrt(x * x + y * y)
    found = length > 0
    length = jnp.where(found, length, 1)
    x, y, b = jnp.where(found, x / length, 1), y / length, jnp.clip(b / length, -1, 1)
    root = growing * jnp.sqrt((1 - b) * (1 + b))
    return jnp.stack([x * b + y * root, y * b - x * root], axis=-1)


def turned_by(
    angle: Float[Array, "*K"], x: Float[Array, "*#K"], y: Float[Array, "*#K"]
) -> Float[Array, "*K 2"]:
    """Return points (x, y) turned about 0, counter-clockwise."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([x * c - y * s, y * c + x * s], axis=-1)


class Nodes(NamedTuple):
    """Quadrature over a stretch of an arc: an integral is the sum of `weight` times the integrand.

    `w` on the unit circle, `point` on the film, `slope` the film point's derivative by the angle,
    and z.
    """

    w: Float[Array, "*K q 2"]
    point: Float[Array, "*K q 2"]
    slope: Float[Array, "*K q 2"]
    z: Float[Array, "*K q"]
    weight: Float[Array, "*K q"]


def nodes(
    frame: Float[Array, "*K 3 3"], w0: Float[Array, "*K 2"], w1: Float[Array, "*K 2"]
) -> Nodes:
    """Return the quadrature nodes from w0 to w1, whichever way is shorter."""
    turn = jnp.arctan2(w0[..., 0] * w1[..., 1] - w0[..., 1] * w1[..., 0], dot(w0, w1))
    spread = lambda x: jnp.asarray(x, turn.dtype).reshape((1,) * turn.ndim + (-1,))
    w = turned_by(turn[..., None] * spread(_NODES), w0[..., :1], w0[..., 1:])
    across = jnp.stack([-w[..., 1], w[..., 0]], axis=-1)
    frame = frame[..., None, :, :]
    point = homogeneous(frame, w)
    change = frame[..., 1, :] * across[..., :1] + frame[..., 2, :] * across[..., 1:]
    z = point[..., 2:]
    film = safe_divide(point[..., :2], z)
    slope = safe_divide(change[..., :2] - film * change[..., 2:], z)
    weight = turn[..., None] * spread(_WEIGHTS)
    return Nodes(w, film, slope, z[..., 0], weight)


def arc_flux(
    frame: Float[Array, "*K 3 3"], w0: Float[Array, "*K 2"], w1: Float[Array, "*K 2"]
) -> Float[Array, "*K 3 3"]:
    """Return the derivative, by the frame, of the area on the left of the arc from w0 to w1."""
    n = nodes(frame, w0, w1)
    nx, ny = n.slope[..., 1], -n.slope[..., 0]
    nz = -(n.point[..., 0] * nx + n.point[..., 1] * ny)
    normal = safe_divide(jnp.stack([nx, ny, nz], axis=-1), n.z[..., None])
    one = jnp.ones_like(n.weight)
    basis = jnp.stack([one, n.w[..., 0], n.w[..., 1]], axis=-1) * n.weight[..., None]
    return jnp.sum(basis[..., :, None] * normal[..., None, :], axis=-3)
