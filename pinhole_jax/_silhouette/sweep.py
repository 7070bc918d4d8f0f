"""A line sweeps cells that hold a few pieces each: what is covered, and which pieces bound it."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from .._numerics.safe import safe_divide
from .coverage import Pieces
from .curves import arc_flux, cut_circle, edge_flux, edge_fractions, film_at, nodes, unit_at

#: This many lanes sweep at a time: where cells are few, each moves on by several stretches.
LANES = 64
#: As many where it stops at equal distances.
LANES_OF_STOPS = 512


class Cells(NamedTuple):
    """Some pieces in each cell.

    `piece` is a piece's lower and upper end (x, y, x, y), in cell units from the cell's corner; 0
    if its curve does not pass the row's bottom, 2 if it is the first that does, else 1 (see
    `Pieces`); and its `jump`. `owner` is the number of its part, -1 for none, and of its curve
    there.
    """

    piece: Float[Array, "C M 6"]
    owner: Int[Array, "C M 2"]


#: Numbers that say what is visible of a straight piece, and of an arc.
STRAIGHT, ARC = 7, 9


class Visible(NamedTuple):
    """For the pieces of one part: whose curve it is, and what is visible of it, all 0 for nothing.

    Of a straight piece: its ends (px), 1 if it is steep, else 0, its visible length along x (along
    y, if steep), signed by which side is covered, and that length's first moment from the first
    end, as a share of the piece (both px). Of an arc: the derivative of the cell's area (px^2) by
    its frame.
    """

    curve: Int[Array, "*K"]
    part: Float[Array, "*K numbers"]

    def flux(self, homogeneous: Float[Array, "*K n 3"]) -> Float[Array, "*K n 3"]:
        """Return the derivative of the cell's area (px^2) by the curve's homogeneous points."""
        if homogeneous.shape[-2] == 3:
            return self.part.reshape(homogeneous.shape)
        start, end, steep = self.part[..., :2], self.part[..., 2:4], self.part[..., 4] > 0
        first, last = (edge_fractions(homogeneous, steep, point) for point in (start, end))
        length, moment = self.part[..., 5:6], self.part[..., 6:7]
        return edge_flux(homogeneous, steep, -(length * first + moment * (last - first)))


def sweepable(pieces: Pieces) -> tuple[Float[Array, "*P"], ...]:
    """Return what a sweep asks of pieces (see `Cells`), column by column."""
    dtype = pieces.jump.dtype
    column, row = pieces.column.astype(dtype), pieces.row.astype(dtype)
    x0, y0, x1, y1 = (point[..., k] for point in (pieces.start, pieces.end) for k in (0, 1))
    passes = jnp.where(pieces.passes, 1 + pieces.first.astype(jnp.int32), 0).astype(dtype)
    return x0 - column, y0 - row, x1 - column, y1 - row, passes, pieces.jump


class Lines(NamedTuple):
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


def along_x(cells: Cells) -> Lines:
    """Return the pieces as a line sweeps them that moves to the right."""
    x0, y0, x1, y1, passes, jump = jnp.moveaxis(cells.piece, -1, 0)
    right = x1 >= x0
    # The corner is just above the row's bottom, the border here just below what lies on it.
    level = passes == 0
    enters = jnp.where(level | ((y0 == 0) & (passes == 2)), jump, 0)
    leaves = jnp.where(level, -jump, 0)
    halt, step = jnp.concatenate([x0, x1], axis=1), jnp.concatenate([enters, leaves], axis=1)
    return Lines(
        jnp.minimum(x0, x1),
        jnp.where(right, y0, y1),
        jnp.maximum(x0, x1),
        jnp.where(right, y1, y0),
        jnp.where(right, -jump, jump),
        halt,
        step,
    )


def along_y(cells: Cells) -> Lines:
    """Return the pieces as a line sweeps them that moves up."""
    x0, y0, x1, y1, passes, jump = jnp.moveaxis(cells.piece, -1, 0)
    # One that comes in at the corner itself has met the row's bottom in the cell before, and what
    # lies on the row's bottom is below the corner.
    enters = jnp.where((x0 == 0) & ((y0 > 0) | (passes == 1)), -jump, 0)
    leaves = jnp.where((x1 == 0) & (passes > 0), jump, 0)
    halt, step = jnp.concatenate([y0, y1], axis=1), jnp.concatenate([enters, leaves], axis=1)
    return Lines(y0, x0, y1, x1, jump, halt, step)


def sweep(
    cells: Cells,
    corner: Float[Array, "C"],
    frames: list[Callable[[Array], Array] | None],
    scale: Float[Array, ""],
    origin: Float[Array, "C 2"],
    flux: bool,
    stops: Int[Array, ""] | None = None,
) -> tuple[Float[Array, "C"], list[Visible]]:
    """Return the covered share of each cell, and (with `flux`) what of each piece bounds it.

    `corner` is the winding number at the cells' lower left corners `origin` (px), of which `scale`
    make a pixel; `frames` are those of the parts' arcs, None for straight curves. The area comes
    from the sweep along x, and so does the flux of pieces flatter than 45 degrees; that of steep
    ones from one along y.

    With `stops` the line does not halt where the order of pieces changes but this many times, at
    equal distances, and what it meets there stands for its surroundings: an area errs by half a
    distance at most for each unit that what is seen of the pieces reaches along the line. So it
    moves across the pieces if they are steep, taken together.
    """
    owners, arc = [], None
    for number, of in enumerate(frames):
        own = cells.owner[..., 0] == number
        ids = jnp.where(own, cells.owner[..., 1], 0)
        owners.append((own, ids))
        if of is not None:
            frame = jax.lax.stop_gradient(of(ids.reshape(-1))).reshape(*ids.shape, 3, 3)
            arc = (own, _placed(frame, scale, origin))
    one = jnp.ones_like(corner)[:, None]
    if not flux:
        lines = along_x(cells)
        if stops is not None:
            turn = lambda y, x: jnp.where(_steep(cells).reshape(-1, *(1,) * (x.ndim - 1)), y, x)
            lines, one = jax.tree.map(turn, (along_y(cells), -one), (lines, one))
            arc = None if arc is None else (arc[0], turn(arc[1][..., jnp.array([1, 0, 2])], arc[1]))
        curved = None if arc is None else _curved_of(*arc, one, lines)
        return _sweep(lines, corner, curved, False, stops)[0], []

    both = lambda a, b: jax.tree.map(lambda x, y: jnp.concatenate([x, y]), a, b)
    lines, curved = both(along_x(cells), along_y(cells)), None
    if arc is not None:
        own, frame = arc
        placed = both(frame, frame[..., jnp.array([1, 0, 2])])
        curved = _curved_of(both(own, own), placed, both(one, -one), lines)
    area, seen = _sweep(lines, both(corner, corner), curved, True, stops)
    C = corner.shape[0]
    flat, upright = (
        jax.tree.map(lambda x, of=of: x[of], seen) for of in (slice(C), slice(C, None))
    )
    across = jnp.abs(cells.piece[..., 2:4] - cells.piece[..., :2])
    steep = across[..., 1] > across[..., 0]
    visible = []
    for (own, ids), of in zip(owners, frames, strict=True):
        if of is None:
            length = jnp.where(steep[..., None], upright.moments, flat.moments)
            value = _straight_part(cells, steep, length, scale, origin)
        else:
            back = upright.arcs[..., jnp.array([1, 0, 2])]
            value = _unplaced(jnp.where(steep[..., None, None], back, flat.arcs), scale, origin)
            value = value.reshape(*ids.shape, ARC)
        visible.append(Visible(ids, jnp.where(own[..., None], value, 0)))
    area = area[:C] if stops is None else jnp.where(_steep(cells), area[C:], area[:C])
    return area, visible


def _steep(cells: Cells) -> Bool[Array, "C"]:
    """Return which cells' pieces, taken together, reach further along y than along x."""
    reach = jnp.sum(jnp.abs(cells.piece[..., 2:4] - cells.piece[..., :2]), axis=1)
    return reach[:, 1] > reach[:, 0]


def _placed(frame: Float[Array, "C M 3 3"], scale: Array, origin: Array) -> Array:
    """Return frames in units of a cell, from its corner."""
    xy, z = frame[..., :2], frame[..., 2:]
    return jnp.concatenate([(xy - origin[:, None, None] * z) * scale, z], axis=-1)


def _unplaced(flux: Float[Array, "C M 3 3"], scale: Array, origin: Array) -> Array:
    """Return the derivative of px^2 by frames in px, from that of cells by `_placed` frames."""
    xy = flux[..., :2] / scale
    z = flux[..., 2:] / (scale * scale) - jnp.sum(xy * origin[:, None, None], -1, keepdims=True)
    return jnp.concatenate([xy, z], axis=-1)


def _straight_part(cells: Cells, steep: Array, seen: Array, scale: Array, origin: Array) -> Array:
    """Return what is visible of straight pieces (see `Visible`) that lie in cells.

    `seen` holds the visible length along u, signed, and its first moment.
    """
    start, end = cells.piece[..., :2], cells.piece[..., 2:4]
    u0, u1 = (jnp.where(steep, p[..., 1], p[..., 0]) for p in (start, end))
    ends = [origin[:, None] + point / scale for point in (start, end)]
    length, moment = seen[..., 0], safe_divide(seen[..., 1] - seen[..., 0] * u0, u1 - u0)
    visible = jnp.stack([length, moment], axis=-1) / scale
    parts = [*ends, steep[..., None].astype(visible.dtype), visible]
    there = jnp.any(visible != 0, axis=-1, keepdims=True)
    return jnp.where(there, jnp.concatenate(parts, axis=-1), 0)


class _Curved(NamedTuple):
    """Which of the pieces are arcs, their frames with rows (u, v, 1), and their sense.

    Along the arc's own direction u grows where `grows` is 1, and falls where it is -1;
    `orientation` is 1 where going from u to v is counter-clockwise, else -1.
    """

    own: Bool[Array, "C M"]
    frame: Float[Array, "C M 3 3"]
    grows: Float[Array, "C M"]
    orientation: Float[Array, "C 1"]

    def at(self, u: Float[Array, "C"]) -> Float[Array, "C M 2"]:
        """Return the arcs' points of the unit circle at an abscissa."""
        return unit_at(self.frame, 0, jnp.broadcast_to(u[:, None], self.grows.shape), self.grows)


def _curved_of(own: Array, frame: Array, orientation: Array, lines: Lines) -> _Curved:
    # Going up in v, cover begins (jump > 0) at an arc that runs along u, if u, v are turned so.
    grows = jnp.where((lines.jump > 0) == (orientation > 0), 1, -1).astype(frame.dtype)
    return _Curved(own, frame, grows, orientation)


class _Seen(NamedTuple):
    """Of each piece the visible length along u and its first moment, and an arc's flux; signed."""

    moments: Float[Array, "C M 2"]
    arcs: Float[Array, "C M 3 3"] | None


def _sweep(
    lines: Lines,
    corner: Float[Array, "C"],
    curved: _Curved | None,
    flux: bool,
    stops: Int[Array, ""] | None,
) -> tuple[Float[Array, "C"], _Seen | None]:
    """Return the covered area, and (with `flux`) what of each piece bounds it.

    Cells are the last axis here: that is several times faster.
    """
    C, dtype = len(corner), corner.dtype
    across = jax.tree.map(jnp.transpose, lines)
    if stops is None:
        halts = _halts(lines, across, curved)
        after = lambda u: jnp.min(jnp.where(halts > u[None], halts, 1), axis=0)
    else:
        apart = 1 / stops.astype(dtype)
        after = lambda u: jnp.minimum(u + apart, 1)
    strides = max((LANES if stops is None else LANES_OF_STOPS) // C, 1)
    lines = across
    lines = jax.tree.map(lambda x: jnp.tile(x, strides), lines)
    corner = jnp.tile(corner, strides)
    if curved is not None:
        curved = jax.tree.map(lambda x: jnp.tile(x, (strides,) + (1,) * (x.ndim - 1)), curved)

    # Where it stops it may stop at an end: that is of what comes, on the border as well.
    before = jnp.less if stops is None else jnp.less_equal
    index = jnp.arange(len(lines.jump), dtype=jnp.int32)[:, None]
    most = jnp.max(jnp.where(lines.jump != 0, index + 1, 0))

    def halt(u, _):
        u1 = after(u)
        return u1, u1

    def body(state):
        begin, area, seen = state
        u, ends = jax.lax.scan(halt, begin, None, length=strides)
        u0, u1 = jnp.concatenate([begin[None], ends[:-1]]).reshape(-1), ends.reshape(-1)
        middle, width = ((u0 + u1) / 2)[None], (u1 - u0)[None]
        active = (lines.u0 <= middle) & (middle < lines.u1)
        v = _heights(lines, curved, middle)
        jump = jnp.where(active, lines.jump, 0)
        first = corner + jnp.sum(jnp.where(before(lines.halt, middle), lines.step, 0), axis=0)
        below = first[None] + _sums_below(v, jump, most)
        change = jnp.where(active, _covers(below + jump) - _covers(below), 0)
        top = _covers(first + jnp.sum(jump, axis=0))
        under = v * width
        if curved is not None:
            w0, w1 = curved.at(u0), curved.at(u1)
            visible = curved.own & (change.T != 0) & (width.T > 0)
            if stops is None:
                q = nodes(curved.frame, w0, w1)
                true = jnp.sum(q.weight * q.point[..., 1] * q.slope[..., 0], axis=-1)
                under = jnp.where(visible.T, true.T, under)
            if seen is not None:
                # An arc has its covered side on its left wherever it is visible.
                oriented = (curved.grows * curved.orientation)[..., None, None] * arc_flux(
                    curved.frame, w0, w1
                )
                gain = jnp.where(visible[..., None, None], oriented, 0)
                seen = seen._replace(arcs=seen.arcs + gain)
        area = area + top * width[0] - jnp.sum(under * change, axis=0)
        if seen is not None:
            share = change * width
            gain = jnp.stack([share, share * middle], axis=-1)
            seen = seen._replace(moments=seen.moments + gain)
        return u, area, seen

    shape = lines.u0.shape
    arcs = None if curved is None else jnp.zeros((*shape[::-1], 3, 3), dtype)
    nothing = _Seen(jnp.zeros((*shape, 2), dtype), arcs) if flux else None
    start = (jnp.zeros(C, dtype), jnp.zeros_like(corner), nothing)
    _, area, seen = jax.lax.while_loop(lambda s: jnp.any(s[0] < 1), body, start)
    whole = lambda x: jnp.sum(x.reshape(strides, C, *x.shape[1:]), axis=0)
    if seen is not None:
        moments = whole(jnp.moveaxis(seen.moments, 1, 0))
        seen = _Seen(moments, None if seen.arcs is None else whole(seen.arcs))
    return jnp.clip(whole(area), 0, 1), seen


def _halts(lines: Lines, across: Lines, curved: _Curved | None) -> Float[Array, "K C"]:
    """Return where pieces begin, end or cross; `across` are the lines, cells as their last axis."""
    crossings = _straight_crossings(across, None if curved is None else ~curved.own.T)
    if curved is not None:
        of_arcs = _arc_crossings(lines, curved).reshape(len(lines.jump), -1).T
        crossings = jnp.concatenate([crossings, of_arcs])
    # (Put beside the others in one kernel they are worked out several times over.)
    crossings = jax.lax.optimization_barrier(crossings)
    return jnp.minimum(jnp.concatenate([across.u0, across.u1, crossings]), 1)


def _sums_below(
    v: Float[Array, "M C"], jump: Float[Array, "M C"], most: Int[Array, ""]
) -> Float[Array, "M C"]:
    """Return for each piece the sum of the jumps of those with smaller v; of equal ones the first
    in the list is the lower. From the one number `most` on, jumps are 0."""
    index = jnp.arange(len(v), dtype=jnp.int32)[:, None]

    some = 4 if len(v) % 4 == 0 else 1

    # A loop: written at once, the compiler works out each v anew for every pair.
    def add(n, total):
        for k in (n * some + i for i in range(some)):
            other = v[k][None]
            below = (other < v) | ((other == v) & (k < index))
            total = total + jnp.where(below, jump[k][None], 0)
        return total

    return jax.lax.fori_loop(jnp.int32(0), -(-most // some), add, jnp.zeros_like(v))


def _heights(lines: Lines, curved: _Curved | None, u: Float[Array, "1 C"]) -> Float[Array, "M C"]:
    """Return the pieces' v at an abscissa; at the nearer end where it is beyond one."""
    t = jnp.clip(safe_divide(u - lines.u0, lines.u1 - lines.u0), 0, 1)
    v = lines.v0 + t * (lines.v1 - lines.v0)
    if curved is None:
        return v
    low, high = jnp.minimum(lines.v0, lines.v1), jnp.maximum(lines.v0, lines.v1)
    true = film_at(curved.frame, curved.at(u[0]))[..., 1].T
    return jnp.where(curved.own.T, jnp.clip(true, low, high), v)


def _covers(layers: Array) -> Array:
    return (layers > 0.5).astype(layers.dtype)


def _pairs(x: Array) -> tuple[Array, Array]:
    return x[:, :, None], x[:, None]


def _common(u0: Array, u1: Array) -> tuple[Array, Array, Array]:
    """Return where both pieces of a pair are: from and to; and which pairs to look at once."""
    M = u0.shape[1]
    once = jnp.arange(M)[:, None] < jnp.arange(M)[None]
    return jnp.maximum(*_pairs(u0)), jnp.minimum(*_pairs(u1)), once[None]


def _straight_crossings(lines: Lines, straight: Bool[Array, "M C"] | None) -> Float[Array, "K C"]:
    """Return the u at which pieces (these are straight, None: all) cross; 1 for pairs
    that do not. `lines` have the cells as their last axis."""
    slope = safe_divide(lines.v1 - lines.v0, lines.u1 - lines.u0)
    low = jnp.maximum(lines.u0[None], _turned(lines.u0))
    high = jnp.minimum(lines.u1[None], _turned(lines.u1))
    other_v, other_u, other_slope = (_turned(x) for x in (lines.v0, lines.u0, slope))

    def gap(u):
        other = other_v + (u - other_u) * other_slope
        return lines.v0[None] + (u - lines.u0[None]) * slope[None] - other

    before, after = gap(low), gap(high)
    cross = (low < high) & ((before < 0) != (after < 0))
    if straight is not None:
        cross &= straight[None] & _turned(straight)
    u = jnp.where(cross, low + (high - low) * safe_divide(before, before - after), 1)
    return u.reshape(-1, u.shape[-1])


def _turned(x: Shaped[Array, "M C"]) -> Shaped[Array, "K M C"]:
    """Return the rows turned round by one place, by two, and so on: so each pair meets once (at the
    most, twice)."""
    M, K = len(x), len(x) // 2
    # (Repeated, and cut into rows that are one longer than the list: each begins one later in it.)
    again = jnp.tile(x, (K + 2, 1))[: (K + 1) * (M + 1)]
    return again.reshape(K + 1, M + 1, -1)[1:, :M]


def _arc_crossings(lines: Lines, curved: _Curved) -> Float[Array, "C M M 2"]:
    """Return the u at which arcs may cross other pieces; others without harm, or 1.

    An arc meets a line where the line cuts its circle, and another arc on a line as well: both
    cones hold the rays whose products with the two axes are in the cosines' ratio.
    """
    low, high, once = _common(lines.u0, lines.u1)
    own, frame = curved.own, curved.frame
    across = jnp.cross(frame[..., 1, :], frame[..., 2, :])
    # Times a unit ray: 1 on the cone.
    cone = safe_divide(across, jnp.sum(across * frame[..., 0, :], axis=-1)[..., None])
    u0, v0, u1, v1 = lines.u0, lines.v0, lines.u1, lines.v1
    line = jnp.stack([v0 - v1, u1 - u0, u0 * v1 - u1 * v0], axis=-1)
    met = jnp.where(own[:, None, :, None], cone[:, :, None] - cone[:, None], line[:, None])
    level = jnp.sum(met[..., None, :] * frame[:, :, None], axis=-1)  # (C, arc, other, 3)
    spread = jnp.broadcast_to(frame[:, :, None], (*level.shape[:-1], 3, 3))
    found = []
    for growing in (1.0, -1.0):
        w = cut_circle(level, jnp.full(level.shape[:-1], growing, level.dtype))
        u = film_at(spread, w)[..., 0]
        there = own[:, :, None] & (once | ~own[:, None]) & (u > low) & (u < high)
        found.append(jnp.where(there, u, 1))
    return jnp.stack(found, axis=-1)
