"""A sweep of cells that hold a few pieces each: the covered area, and the pieces that bound it.

The line halts where a piece begins, ends or crosses another: between two halts the pieces keep
their order, so the covered part is a row of trapezoids (with arcs for sides). Areas are compared,
contact of pieces is never tested: pieces that coincide, end on one another or have no length only
put halts too close to matter.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._numerics.safe import safe_divide
from .conics import arc_flux, cut_circle, film_at, nodes, unit_at
from .pieces import Arcs


class Lines(NamedTuple):
    """Pieces for a sweep along u, from (u0, v0) to (u1, v1), cell by cell, in units of a cell.

    `jump` is the change of layers going up in v. Along the border v = 0 the number of layers
    changes at each `halt` by its `step`. The conics of `arcs` have rows (u, v, 1); along an arc u
    `grows` (1) or falls (-1).
    """

    u0: Float[Array, "C M"]
    v0: Float[Array, "C M"]
    u1: Float[Array, "C M"]
    v1: Float[Array, "C M"]
    jump: Float[Array, "C M"]
    halt: Float[Array, "C N"]
    step: Float[Array, "C N"]
    grows: Float[Array, "C M"]
    arcs: Arcs | None

    def unit_at(self, conic: Float[Array, "C M 3 3"], u: Float[Array, "C"]) -> Array:
        """The points of the unit circle (C, M, 2) of arcs' points with an abscissa."""
        return unit_at(conic, 0, jnp.broadcast_to(u[:, None], self.u0.shape), self.grows)

    def height(self, u: Float[Array, "C"]) -> Float[Array, "C M"]:
        """The pieces' v at an abscissa, or at the nearer end."""
        t = jnp.clip(safe_divide(u[:, None] - self.u0, self.u1 - self.u0), 0, 1)
        v = self.v0 + t * (self.v1 - self.v0)
        if self.arcs is None:
            return v
        conic, there = self.arcs
        bent = film_at(conic, self.unit_at(conic, u))[..., 1]
        low, high = jnp.minimum(self.v0, self.v1), jnp.maximum(self.v0, self.v1)
        return jnp.where(there, jnp.clip(bent, low, high), v)


class Sweep(NamedTuple):
    """The covered `area` of cells, and each piece's stretch beside the background.

    Its signed `extent`, its first `moment`, and the area's derivative by an arc's conic (px^2).
    """

    area: Float[Array, "C"]
    extent: Float[Array, "C M"]
    moment: Float[Array, "C M"]
    flux: Float[Array, "C M 3 3"] | None


def sweep(lines: Lines, corner: Float[Array, "C"], conics: Float[Array, "C M 3 3"] | None) -> Sweep:
    """The sweep of cells with `corner` layers at their lower left corners.

    `conics` are those of arcs on the film, None if derivatives by them are not wanted.
    """
    halts, zero, none = _halts(lines), jnp.zeros_like(corner), jnp.zeros_like(lines.u0)
    start = zero, Sweep(zero, none, none, None if conics is None else jnp.zeros_like(conics))

    def strip(state):
        u0, total = state
        u1 = jnp.min(jnp.where(halts > u0[:, None], halts, 1), axis=1)
        return u1, _with_strip(total, lines, corner, conics, u0, u1)

    return jax.lax.while_loop(lambda s: jnp.any(s[0] < 1), strip, start)[1]


def _with_strip(
    total: Sweep, lines: Lines, corner: Array, conics: Array | None, u0: Array, u1: Array
) -> Sweep:
    middle, width = (u0 + u1) / 2, u1 - u0
    u = middle[:, None]
    jump = jnp.where((lines.u0 <= u) & (u < lines.u1), lines.jump, 0)
    v = lines.height(middle)
    first = corner + jnp.sum(jnp.where(lines.halt < u, lines.step, 0), axis=1)
    # (Of pieces at one height the first in the list is the lower.)
    one, other = _pairs(v)
    lower = (other < one) | ((other == one) & jnp.tri(v.shape[1], k=-1, dtype=bool)[None])
    below = first[:, None] + jnp.sum(jnp.where(lower, jump[:, None], 0), axis=2)
    covers = lambda layers: (layers > 0.5).astype(v.dtype)
    change = jnp.where(jump != 0, covers(below + jump) - covers(below), 0)
    under, fluxes = v * width[:, None], total.flux
    if lines.arcs is not None:
        conic, there = lines.arcs
        w0, w1 = (lines.unit_at(conic, u) for u in (u0, u1))
        seen = there & (change != 0) & (width > 0)[:, None]
        q = nodes(conic, w0, w1)
        bent = jnp.sum(q.weight * q.point[..., 1] * q.slope[..., 0], axis=-1)
        under = jnp.where(seen, bent, under)
        if conics is not None and fluxes is not None:
            # An arc has its covered side on its left wherever it is seen.
            more = lines.grows[..., None, None] * arc_flux(conics, w0, w1)
            fluxes = fluxes + jnp.where(seen[..., None, None], more, 0)
    top = covers(first + jnp.sum(jump, axis=1))
    area = total.area + top * width - jnp.sum(under * change, axis=1)
    extent = -change * width[:, None]
    return Sweep(area, total.extent + extent, total.moment + extent * u, fluxes)


def _halts(lines: Lines) -> Float[Array, "C N"]:
    """The u at which pieces begin, end or cross; at most 1."""
    halts = [lines.u0, lines.u1, _straight_crossings(lines)]
    if lines.arcs is not None:
        halts.append(_arc_crossings(lines, lines.arcs))
    return jnp.minimum(jnp.concatenate(halts, axis=1), 1)


def _pairs(x: Array) -> tuple[Array, Array]:
    return x[:, :, None], x[:, None]


def _common(lines: Lines) -> tuple[Array, Array]:
    """The interval of u that both pieces of a pair span."""
    return jnp.maximum(*_pairs(lines.u0)), jnp.minimum(*_pairs(lines.u1))


def _straight_crossings(lines: Lines) -> Float[Array, "C N"]:
    """The u at which straight pieces cross; 1 for pairs that do not."""
    slope = safe_divide(lines.v1 - lines.v0, lines.u1 - lines.u0)
    low, high = _common(lines)

    def gap(u):
        columns = map(_pairs, (lines.v0, lines.u0, slope))
        one, other = (v + (u - u0) * s for v, u0, s in zip(*columns, strict=True))
        return one - other

    before, after = gap(low), gap(high)
    cross = (low < high) & ((before < 0) != (after < 0))
    if lines.arcs is not None:
        one, other = _pairs(lines.arcs.there)
        cross &= ~one & ~other
    u = jnp.where(cross, low + (high - low) * safe_divide(before, before - after), 1)
    return u.reshape(len(u), -1)


def _arc_crossings(lines: Lines, arcs: Arcs) -> Float[Array, "C N"]:
    """The u at which arcs may cross other pieces; more halts do no harm, 1 is none.

    An arc meets a line where the line cuts its circle, and another arc on a line as well: both
    cones hold the rays whose products with the two axes are in the cosines' ratio.
    """
    (low, high), (frame, there) = _common(lines), arcs
    across = jnp.cross(frame[..., 1, :], frame[..., 2, :])
    # Times a unit ray: 1 on the cone.
    cone = safe_divide(across, jnp.sum(across * frame[..., 0, :], axis=-1)[..., None])
    u0, v0, u1, v1 = lines[:4]
    line = jnp.stack([v0 - v1, u1 - u0, u0 * v1 - u1 * v0], axis=-1)
    one, other = _pairs(cone)
    met = jnp.where(there[:, None, :, None], one - other, line[:, None])
    level = jnp.sum(met[..., None, :] * frame[:, :, None], axis=-1)  # (C, arc, other, 3)
    spread = jnp.broadcast_to(frame[:, :, None], (*level.shape[:-1], 3, 3))
    found = []
    for growing in (1.0, -1.0):
        w = cut_circle(level, jnp.full(level.shape[:-1], growing, level.dtype))
        u = film_at(spread, w)[..., 0]
        found.append(jnp.where(there[:, :, None] & (u > low) & (u < high), u, 1))
    return jnp.stack(found, axis=-1).reshape(len(low), -1)
