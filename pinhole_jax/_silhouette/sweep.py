"""A sweep of pixels side by side: the covered area, and the pieces that bound it.

A line moves across each pixel in strips. Where no two neighbours in a strip cross, its pieces keep
their order, so the covered part is a row of trapezoids (with arcs for sides); else the strip is cut
at a crossing. Areas are compared, contact of pieces is never tested: pieces that coincide, end on
one another or have no length only make strips too narrow to matter.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics.safe import safe_divide
from .conics import arc_flux, cut_circle, film_at, nodes, unit_at
from .pieces import Arcs

#: Neighbours cross if they change places by more than this many epsilons (px).
APART = 16


class Lines(NamedTuple):
    """Pieces for a sweep along u, from (u0, v0) to (u1, v1), in px from their pixel's corner.

    `pixel` is a number among those that are swept (past the last: none), `jump` the change of
    layers going up in v. `halts` are places u along the border v = 0, and changes of layers there.
    The conics of `arcs` have rows (u, v, 1); along an arc u `grows` (1) or falls (-1).
    """

    pixel: Int[Array, "N"]
    u0: Float[Array, "N"]
    v0: Float[Array, "N"]
    u1: Float[Array, "N"]
    v1: Float[Array, "N"]
    jump: Float[Array, "N"]
    halts: tuple[tuple[Array, Array], ...]
    grows: Float[Array, "N"]
    arcs: Arcs | None

    def height(self, u: Float[Array, "N"]) -> Float[Array, "N"]:
        """The pieces' v at an abscissa, or at the nearer end."""
        t = jnp.clip(safe_divide(u - self.u0, self.u1 - self.u0), 0, 1)
        v = self.v0 + t * (self.v1 - self.v0)
        if self.arcs is None:
            return v
        v = self.arcs.other_at(0, u, self.grows, v)
        return jnp.clip(v, jnp.minimum(self.v0, self.v1), jnp.maximum(self.v0, self.v1))

    def at_pixel(self, values: Float[Array, "P"]) -> Float[Array, "N"]:
        """Each line's of the pixels' values."""
        return values.at[self.pixel].get(mode="clip")

    def summed(self, values: Float[Array, "N"], like: Float[Array, "P"]) -> Float[Array, "P"]:
        """Each pixel's sum of the lines' values."""
        return jnp.zeros_like(like).at[self.pixel].add(values, mode="drop")

    def next_end(self, u: Float[Array, "P"]) -> Float[Array, "P"]:
        """The first beginning or end of a line beyond u in each pixel; at most 1."""
        own, upto = self.at_pixel(u), jnp.ones_like(u)
        for end in (self.u0, self.u1):
            upto = upto.at[self.pixel].min(jnp.where(end > own, end, 1), mode="drop")
        return upto


class Sweep(NamedTuple):
    """The covered `area` of pixels, and each piece's stretch beside the background.

    Its signed `extent`, its first `moment`, and the area's derivative by an arc's conic (px^2).
    """

    area: Float[Array, "P"]
    extent: Float[Array, "N"]
    moment: Float[Array, "N"]
    flux: Float[Array, "N 3 3"] | None


class _Strip(NamedTuple):
    """A strip of each pixel: from `begin` to `end`, with `first` layers at its lower border.

    Lines that are `here` from the bottom up are numbers `order`, of `pixel` (past the last: not
    here). What is `hidden` is covered whatever its lines do.
    """

    begin: Float[Array, "P"]
    end: Float[Array, "P"]
    first: Float[Array, "P"]
    hidden: Bool[Array, "P"]
    jump: Float[Array, "N"]
    order: Int[Array, "N"]
    pixel: Int[Array, "N"]


def sweep(lines: Lines, corner: Float[Array, "P"], conics: Float[Array, "N 3 3"] | None) -> Sweep:
    """The sweep of pixels with `corner` layers at their lower left corners.

    `conics` are those of arcs on the film, None if derivatives by them are not wanted.
    """
    none, along = jnp.zeros_like(corner), jnp.zeros_like(lines.u0)
    start = Sweep(none, along, along, None if conics is None else jnp.zeros_like(conics))

    def further(state):
        begin, end, total = state
        strip = _strip(lines, corner, begin, end)
        cut = _first_crossing(lines, strip)
        done = cut >= end
        total = _with_strip(total, lines, strip._replace(end=jnp.where(done, end, begin)), conics)
        begin = jnp.where(done, end, begin)
        return begin, jnp.where(done, lines.next_end(begin), cut), total

    start = none, lines.next_end(none), start
    return jax.lax.while_loop(lambda s: jnp.any(s[0] < 1), further, start)[2]


def _strip(lines: Lines, corner: Array, begin: Array, end: Array) -> _Strip:
    middle = lines.at_pixel((begin + end) / 2)
    here = (lines.u0 <= middle) & (middle < lines.u1)
    steps = sum(jnp.where(halt < middle, step, 0) for halt, step in lines.halts)
    first = corner + lines.summed(jnp.asarray(steps), corner)
    jump = jnp.where(here, lines.jump, 0)
    hidden = first + lines.summed(jnp.minimum(jump, 0), corner) > 0.5
    # (Of pieces at one height the first in the list is the lower.)
    pixel, numbers = jnp.where(here, lines.pixel, len(corner)), jnp.arange(len(jump))
    keys = pixel, lines.height(middle), numbers.astype(jnp.int32)
    pixel, _, order = jax.lax.sort(keys, num_keys=2)
    return _Strip(begin, end, first, hidden, jump, order, pixel)


def _first_crossing(lines: Lines, strip: _Strip) -> Float[Array, "P"]:
    """Where the first two neighbours found to cross in each strip do; no less than its end if none.

    Neighbours in the middle of a strip are the first to cross on either side of it.
    """
    pixel, below, above = strip.pixel[1:], strip.order[:-1], strip.order[1:]
    begin, end = (x.at[pixel].get(mode="clip") for x in (strip.begin, strip.end))
    heights = (lines.height(lines.at_pixel(u)) for u in (strip.begin, strip.end))
    before, after = (v[above] - v[below] for v in heights)
    cuts = [begin + (end - begin) * safe_divide(before, before - after)]
    cross = jnp.minimum(before, after) < -APART * jnp.finfo(before.dtype).eps
    meet = [cross]
    if lines.arcs is not None:
        bent = lines.arcs.there[below] | lines.arcs.there[above]
        cuts += _arc_crossings(lines, lines.arcs, below, above)
        meet = [cross & ~bent, bent, bent]
    together = (pixel == strip.pixel[:-1]) & ~strip.hidden.at[pixel].get(mode="clip")
    result = strip.end
    for cut, there in zip(cuts, meet, strict=True):
        inside = together & there & (cut > begin) & (cut < end)
        result = result.at[pixel].min(jnp.where(inside, cut, jnp.inf), mode="drop")
    return result


def _arc_crossings(
    lines: Lines, arcs: Arcs, one: Int[Array, "K"], other: Int[Array, "K"]
) -> list[Float[Array, "K"]]:
    """Two u at which arcs may cross other pieces; more cuts do no harm.

    An arc meets a line where the line cuts its circle, and another arc on a line as well: both
    cones hold the rays whose products with the two axes are in the cosines' ratio.
    """
    frame, there = arcs
    across = jnp.cross(frame[:, 1], frame[:, 2])
    # Times a unit ray: 1 on the cone.
    cone = safe_divide(across, jnp.sum(across * frame[:, 0], axis=1)[:, None])
    u0, v0, u1, v1 = lines[1:5]
    line = jnp.stack([v0 - v1, u1 - u0, u0 * v1 - u1 * v0], axis=-1)
    one, other = jnp.where(there[one], one, other), jnp.where(there[one], other, one)
    met = jnp.where(there[other][:, None], cone[one] - cone[other], line[other])
    level = jnp.sum(met[:, None] * frame[one], axis=-1)
    return [film_at(frame[one], cut_circle(level, growing))[:, 0] for growing in (1.0, -1.0)]


def _with_strip(total: Sweep, lines: Lines, strip: _Strip, conics: Array | None) -> Sweep:
    """The sums with a strip more; of strips without width nothing is added."""
    begin, end, first, hidden, jump, order, pixel = strip
    covers = lambda layers: (layers > 0.5).astype(first.dtype)
    layers = lines.summed(jump, first)
    before = first - (jnp.cumsum(layers) - layers)
    above = before.at[pixel].get(mode="clip") + jnp.cumsum(jump[order])
    change = covers(above) - covers(above - jump[order])
    change = jnp.zeros_like(jump).at[order].set(change)
    seen = (jump != 0) & ~hidden.at[lines.pixel].get(mode="clip")
    change = jnp.where(seen, change, 0)

    width, middle = end - begin, lines.at_pixel((begin + end) / 2)
    extent, fluxes = -change * lines.at_pixel(width), total.flux
    under = lines.height(middle) * extent
    if lines.arcs is not None:
        conic, there = lines.arcs
        ends = (lines.at_pixel(u) for u in (begin, end))
        w0, w1 = (unit_at(conic, 0, u, lines.grows) for u in ends)
        there &= extent != 0
        q = nodes(conic, w0, w1)
        bent = jnp.sum(q.weight * q.point[..., 1] * q.slope[..., 0], axis=-1)
        under = jnp.where(there, -change * bent, under)
        if conics is not None and fluxes is not None:
            # An arc has its covered side on its left wherever it is seen.
            more = lines.grows[:, None, None] * arc_flux(conics, w0, w1)
            fluxes = fluxes + jnp.where(there[:, None, None], more, 0)
    top = jnp.where(hidden, 1, covers(first + layers)) * width
    area = total.area + top + lines.summed(under, first)
    return Sweep(area, total.extent + extent, total.moment + extent * middle, fluxes)
