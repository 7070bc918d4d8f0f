"""A line sweeps cells that hold a few pieces each: what is covered, and which pieces bound it."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._coverage import Pieces
from ._curves import (
    Arcs,
    Curves,
    Segments,
    arc_flux,
    cut_circle,
    film_at,
    fraction,
    nodes,
    placed,
    segment_flux,
    unit_at,
)
from ._safe import safe_divide

#: Pieces of a cell; one with more is cut into smaller cells.
MOST = 8


class Cells(NamedTuple):
    """Up to `MOST` pieces in each cell, from lower to upper end, in cell units from its corner.

    `curve` and `part` name what a piece belongs to; `jump` and `passes` as in `Pieces`. `count`
    may exceed `MOST`.
    """

    start: Float[Array, "C M 2"]
    end: Float[Array, "C M 2"]
    jump: Float[Array, "C M"]
    passes: Bool[Array, "C M"]
    curve: Int[Array, "C M"]
    part: Int[Array, "C M"]
    count: Int[Array, "C"]


class Visible(NamedTuple):
    """For the pieces of one part: whose curve it is, and the derivative of the cell's area by it."""

    curve: Int[Array, "C M"]
    flux: Float[Array, "C M n m"]


def empty_cells(number: int, dtype) -> Cells:
    """Return cells without pieces."""
    ends = jnp.zeros((number, MOST, 2), dtype)
    whole = jnp.zeros((number, MOST), jnp.int32)
    return Cells(
        ends, ends, ends[..., 0], whole > 0, whole, whole - 1, jnp.zeros(number, jnp.int32)
    )


def insert(cells: Cells, cell: Int[Array, "P"], pieces: Pieces, curve: Array, part: int) -> Cells:
    """Return the cells with more pieces; `cell` past the end drops one, equal ones are merged."""
    number = cells.count.shape[0]
    return jax.lax.cond(
        jnp.any(cell < number), lambda: _insert(cells, cell, pieces, curve, part), lambda: cells
    )


def _insert(cells: Cells, cell: Int[Array, "P"], pieces: Pieces, curve: Array, part: int) -> Cells:
    number = cells.count.shape[0]
    origin = jnp.stack([pieces.column, pieces.row], axis=-1).astype(pieces.start.dtype)
    start, end = pieces.start - origin, pieces.end - origin
    # Equal pieces come together by a key made of their ends; if others do, no harm is done.
    name = start[:, 0] + 0.37 * start[:, 1] + 1.73 * end[:, 0] + 2.91 * end[:, 1]
    index = jnp.arange(cell.shape[0], dtype=jnp.int32)
    cell, name, order = jax.lax.sort((cell, name, index), num_keys=2)
    start, end, jump, passes, curve = (
        x[order] for x in (start, end, pieces.jump, pieces.passes, curve)
    )
    differs = (cell[1:] != cell[:-1]) | jnp.any(
        (start[1:] != start[:-1]) | (end[1:] != end[:-1]), axis=1
    )
    leads = jnp.append(jnp.ones(1, bool), differs)
    leader = jax.lax.cummax(jnp.where(leads, index, 0))
    jump = jnp.zeros_like(jump).at[leader].add(jump)

    there = jnp.minimum(cell, number - 1)
    same = (cells.part[there] == part) & jnp.all(
        (cells.start[there] == start[:, None]) & (cells.end[there] == end[:, None]), axis=-1
    )
    known = jnp.any(same, axis=1)
    fresh = leads & ~known & (cell < number)
    one = fresh.astype(jnp.int32)
    newcomers = jnp.cumsum(one, dtype=jnp.int32)
    opens = jnp.append(jnp.ones(1, bool), cell[1:] != cell[:-1])
    before = jax.lax.cummax(jnp.where(opens, newcomers - one, 0))
    slot = jnp.where(known, jnp.argmax(same, axis=1).astype(jnp.int32), cells.count[there] + newcomers - 1 - before)
    slot = jnp.where(fresh | (known & leads), slot, MOST)
    at = (cell, slot)
    whole = jnp.full_like(curve, part)
    put = lambda array, value: array.at[cell, jnp.where(fresh, slot, MOST)].set(value, mode="drop")
    return Cells(
        put(cells.start, start),
        put(cells.end, end),
        cells.jump.at[at].add(jump, mode="drop"),
        put(cells.passes, passes),
        put(cells.curve, curve),
        put(cells.part, whole),
        cells.count.at[cell].add(one, mode="drop"),
    )


class _Lines(NamedTuple):
    """Pieces as a line sweeps them along u: from (u0, v0) to (u1, v1), v across.

    `jump` is met going up in v. `halt` and `step` say where along the border v = 0 the number of
    layers changes, and by how much.
    """

    u0: Float[Array, "C M"]
    v0: Float[Array, "C M"]
    u1: Float[Array, "C M"]
    v1: Float[Array, "C M"]
    jump: Float[Array, "C M"]
    halt: Float[Array, "C E"]
    step: Float[Array, "C E"]


def _along_x(cells: Cells) -> _Lines:
    """Return the pieces as a line sweeps them that moves to the right."""
    (x0, y0), (x1, y1) = (jnp.moveaxis(p, -1, 0) for p in (cells.start, cells.end))
    right = x1 >= x0
    jump = jnp.where(right, -cells.jump, cells.jump)
    rises = (y0 == 0) & cells.passes
    return _Lines(
        jnp.minimum(x0, x1),
        jnp.where(right, y0, y1),
        jnp.maximum(x0, x1),
        jnp.where(right, y1, y0),
        jump,
        x0,
        jnp.where(rises, cells.jump, 0),
    )


def _along_y(cells: Cells) -> _Lines:
    """Return the pieces as a line sweeps them that moves up."""
    (x0, y0), (x1, y1) = (jnp.moveaxis(p, -1, 0) for p in (cells.start, cells.end))
    enters = jnp.where((x0 == 0) & (y0 > 0), -cells.jump, 0)
    leaves = jnp.where(x1 == 0, cells.jump, 0)
    halt, step = jnp.concatenate([y0, y1], axis=1), jnp.concatenate([enters, leaves], axis=1)
    return _Lines(y0, x0, y1, x1, cells.jump, halt, step)


def sweep(
    cells: Cells,
    corner: Float[Array, "C"],
    curves: list[Callable[[Array], Curves]],
    scale: Float[Array, ""],
    origin: Float[Array, "C 2"],
    flux: bool,
) -> tuple[Float[Array, "C"], list[Visible]]:
    """Return the covered share of each cell, and (with `flux`) what of each piece bounds it.

    `corner` is the winding number at the cells' lower left corners `origin` (px), of which `scale`
    make a pixel. The cells' area comes from the sweep along x, and so does
    the flux of pieces flatter than 45 degrees; that of steep ones from a sweep along y.
    """
    kinds, held = [], []
    for number, of in enumerate(curves):
        own = cells.part == number
        ids = jnp.where(own, cells.curve, 0)
        plain = jax.tree.map(
            lambda x: x.reshape(*ids.shape, *x.shape[1:]),  # noqa: B023
            jax.lax.stop_gradient(of(ids.reshape(-1))),
        )
        kinds.append((own, ids))
        held.append(placed(plain, scale, origin[:, None]))
    arcs = [(own, h.frame) for (own, _), h in zip(kinds, held, strict=True) if isinstance(h, Arcs)]
    arc = arcs[0] if arcs else None

    across = jnp.abs(cells.end - cells.start)
    steep = across[..., 1] > across[..., 0]
    area, flat_seen = _sweep(_along_x(cells), corner, arc, 0, flux)
    if not flux:
        return area, []
    _, steep_seen = _sweep(_along_y(cells), corner, arc, 1, flux)
    visible = []
    for (own, ids), h in zip(kinds, held, strict=True):
        if isinstance(h, Segments):
            seen = jnp.where(steep[..., None], steep_seen[0], flat_seen[0])
            seen = jnp.where(own[..., None], seen, 0)
            value = _segment_visible(h, cells, steep, seen)
        else:
            value = jnp.where(steep[..., None, None], steep_seen[1], flat_seen[1])
            value = jnp.where(own[..., None, None], value, 0)
        # The flux is by the curve in cells; the curve in pixels moves 1/scale as much.
        visible.append(Visible(ids, _unplaced(h, value, scale, origin)))
    return area, visible


def _unplaced(curves: Curves, flux: Array, scale: Array, origin: Array) -> Array:
    """Return the derivative by curves in pixels, from that by the curves `placed` in cells."""
    _, pull = jax.vjp(lambda c: placed(c, scale, origin[:, None]), curves)
    if isinstance(curves, Segments):
        back = Segments(flux[..., 0, :], flux[..., 1, :], jnp.zeros_like(curves.weight))
        (by,) = pull(back)
        return jnp.stack([by.a, by.b], axis=-2)
    zero = jnp.zeros_like(curves.start)
    (by,) = pull(Arcs(flux, zero, zero, jnp.zeros_like(curves.weight)))
    return by.frame


def _segment_visible(held: Segments, cells: Cells, steep: Array, seen: Array) -> Array:
    """Return the flux of the visible parts of segments.

    `seen` holds the visible length along u, signed by which side is covered, and its first moment.
    """
    pick = lambda p: jnp.where(steep, p[..., 1], p[..., 0])
    u0, u1 = pick(cells.start), pick(cells.end)
    s0, s1 = fraction(held, cells.start), fraction(held, cells.end)
    slope = safe_divide(s1 - s0, u1 - u0)
    length = seen[..., 0] * slope
    middle = seen[..., 0] * s0 * slope + slope * slope * (seen[..., 1] - seen[..., 0] * u0)
    # Above a flat piece, or left of a steep one, is its left if it runs rightwards, or upwards;
    # `seen` counts what gains cover going up in v.
    sign = jnp.where(steep, -1, 1).astype(length.dtype)
    return segment_flux(held, sign * length, sign * middle)


def _sweep(lines: _Lines, corner: Array, arc: tuple | None, axis: int, flux: bool):
    """Return the covered area, and of each piece what bounds it: moments along u, arcs' flux."""
    C, M = lines.u0.shape
    dtype = corner.dtype
    crossings = _crossings(lines, arc, axis)
    halts = jnp.concatenate([lines.u0, lines.u1, lines.halt, crossings.reshape(C, -1)], axis=1)
    earlier = jnp.arange(M)[:, None] < jnp.arange(M)[None]  # [j, i]: j before i
    grows = jnp.ones_like(lines.u0)
    if arc is not None:
        own, frame = arc
        grows = _growing(lines, axis)

    def at(u):
        u = u[:, None]
        t = jnp.clip(safe_divide(u - lines.u0, lines.u1 - lines.u0), 0, 1)
        v = lines.v0 + t * (lines.v1 - lines.v0)
        if arc is None:
            return v, None
        w = unit_at(frame, axis, jnp.broadcast_to(u, v.shape), grows)
        low, high = jnp.minimum(lines.v0, lines.v1), jnp.maximum(lines.v0, lines.v1)
        return jnp.where(own, jnp.clip(film_at(frame, w)[..., 1 - axis], low, high), v), w

    def body(state):
        u, area, seen = state
        ahead = jnp.where(halts > u[:, None], halts, 1)
        u1 = jnp.minimum(jnp.min(ahead, axis=1), 1)
        middle = (u + u1) / 2
        m = middle[:, None]
        active = (lines.u0 <= m) & (m < lines.u1)
        v, _ = at(middle)
        jump = jnp.where(active, lines.jump, 0)
        first = corner + jnp.sum(jnp.where(lines.halt < m, lines.step, 0), axis=1)
        lower = (v[:, :, None] < v[:, None]) | ((v[:, :, None] == v[:, None]) & earlier[None])
        below = first[:, None] + jnp.sum(jnp.where(lower, jump[:, :, None], 0), axis=1)
        change = jnp.where(active, _covers(below + jump) - _covers(below), 0)
        top = _covers(first + jnp.sum(jump, axis=1))
        width = jnp.maximum(u1 - u, 0)
        length = top - jnp.sum(v * change, axis=1)
        area = area + width * length
        if flux:
            share = change * width[:, None]
            seen = (seen[0] + jnp.stack([share, share * m], axis=-1), seen[1])
        if arc is not None:
            seen_arc = own & (change != 0) & (width[:, None] > 0)
            w0, w1 = at(jnp.maximum(u, 0))[1], at(u1)[1]
            q = nodes(frame, w0, w1)
            true = jnp.sum(q.weight * q.point[..., 1 - axis] * q.slope[..., axis], axis=-1)
            area = area - jnp.sum(jnp.where(seen_arc, change * (true - v * width[:, None]), 0), axis=1)
            if flux:
                # An arc has its covered side on its left wherever it is visible.
                turned = jnp.where((grows > 0)[..., None, None], arc_flux(frame, w0, w1), -arc_flux(frame, w0, w1))
                seen = (seen[0], seen[1] + jnp.where(seen_arc[..., None, None], turned, 0))
        return u1, area, seen

    seen = None
    if flux:
        seen = (jnp.zeros((C, M, 2), dtype), None if arc is None else jnp.zeros((C, M, 3, 3), dtype))
    start = (jnp.zeros(C, dtype), jnp.zeros(C, dtype), seen)
    _, area, seen = jax.lax.while_loop(lambda s: jnp.any(s[0] < 1), body, start)
    return jnp.clip(area, 0, 1), seen


def _covers(layers: Array) -> Array:
    return (layers > 0.5).astype(layers.dtype)


def _growing(lines: _Lines, axis: int) -> Array:
    """Return +1 where u grows along the arc's own direction, -1 where it falls.

    The covered side is on the left: above where the arc runs rightwards, and left where it runs
    upwards; `jump` is positive where cover begins going up in v.
    """
    return jnp.where((lines.jump > 0) == (axis == 0), 1, -1).astype(lines.u0.dtype)


def _crossings(lines: _Lines, arc: tuple | None, axis: int) -> Float[Array, "C M M k"]:
    """Return the u at which pieces may cross one another; where they do not, some u without harm."""
    u0, v0, u1, v1 = lines.u0, lines.v0, lines.u1, lines.v1
    pair = lambda x: (x[:, :, None], x[:, None])
    low, high = jnp.maximum(*pair(u0)), jnp.minimum(*pair(u1))
    slope = safe_divide(v1 - v0, u1 - u0)
    gap = lambda u: (pair(v0)[0] + (u - pair(u0)[0]) * pair(slope)[0]) - (
        pair(v0)[1] + (u - pair(u0)[1]) * pair(slope)[1]
    )
    before, after = gap(low), gap(high)
    M = u0.shape[1]
    once = (jnp.arange(M)[:, None] < jnp.arange(M)[None])[None]
    cross = once & (low < high) & ((before < 0) != (after < 0))
    straight = jnp.where(cross, low + (high - low) * safe_divide(before, before - after), 1)[..., None]
    if arc is None:
        return straight
    own, frame = arc
    det = jnp.cross(frame[..., 1, :], frame[..., 2, :])
    covector = safe_divide(det, jnp.sum(det * frame[..., 0, :], axis=-1)[..., None])
    points = [jnp.stack([u0, v0], -1), jnp.stack([u1, v1], -1)]
    if axis == 1:
        points = [p[..., ::-1] for p in points]
    (ax, ay), (bx, by) = (jnp.moveaxis(p, -1, 0) for p in points)
    line = jnp.stack([ay - by, bx - ax, ax * by - bx * ay], axis=-1)
    other = jnp.where(own[:, None, :, None], covector[:, :, None] - covector[:, None], line[:, None])
    level = jnp.sum(other[..., None, :] * frame[:, :, None], axis=-1)  # (C, arc, other, 3)
    found = []
    for growing in (1.0, -1.0):
        w = cut_circle(level, jnp.full(level.shape[:-1], growing, level.dtype))
        spread = jnp.broadcast_to(frame[:, :, None], (*level.shape[:-1], 3, 3))
        u = film_at(spread, w)[..., axis]
        both = own[:, :, None] & (low < high) & (u > low) & (u < high)
        both &= ~(own[:, None] & ~once)
        found.append(jnp.where(both, u, 1))
    bent = own[:, :, None] | own[:, None]
    return jnp.concatenate([jnp.where(bent[..., None], 1, straight), jnp.stack(found, -1)], axis=-1)
