"""Pixels that faces and spheres surely cover: whatever contours lie in them need not be looked at.

Where contours overlap things are stacked, and nearly every such pixel is covered by one of them
alone, or by one from its left side and one from its right. A face or a sphere that lies before the
eye is convex on the film: what it covers of a row of the film between two lines is what both lines
have in common. So each adds an interval to each row that it crosses: the pixels that it covers from
side to side are counted; of others it is remembered how far they are covered from either side.

Nothing is called covered that is not: rows and intervals are larger than what is asked for by what
rounding may move an outline.
"""

import functools
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from .._camera.film import FilmMap, film_points
from .._numerics.batches import in_chunks
from .._numerics.bitset import any_bit, count_upto, words_of
from .._numerics.bounds import least, most, within
from .._numerics.one_kernel import on_cpu, put
from .._numerics.running import running_sum
from .._numerics.safe import norm, safe_divide, safe_sqrt
from .._scene.scene import Spheres
from .asked import in_words, words_in_row
from .curves import film_at, unit_at
from .spheres import ARCS_PER_SPHERE, sphere_frames

#: Things, and rows of them, looked at together.
THINGS, ROWS = 1024, 4096
#: What outlines begin with: lowest y, highest y, leftmost x, rightmost x.
BOX = 4
#: Into how many rows a pixel is cut, if there are no more of all pixels than this.
FINE, ROOM = 4, 1 << 19
#: Roundings that outlines may be off by, and how far off the film (in its sizes) things may reach.
SLACK, REACH = 64, 2
#: Fewer pieces than this in all overlapping pixels are not worth it, nor fewer than one for this
#: many things, nor where fewer layers than this lie one behind the other (the mean).
LEAST_LAYERS, THINGS_A_LAYER, DEEP = 2048, 5, 1.5
#: Scenes of fewer never hold enough layers to be worth what is compiled for it.
LEAST_FACES, LEAST_SPHERES = 1 << 13, 1 << 10
#: Counts are exact in every float type up to here.
MOST_THINGS = 1 << 23


class Convex(NamedTuple):
    """Things that are convex on the film, `number` of them, all before the eye or not at all.

    `outlines()(ids)` holds what their chords are worked out from, after their `BOX` (the first call
    works out what is asked for again and again: it costs nothing where nobody asks);
    `chords(outline, y)` where lines at two heights meet each, from and to.
    """

    number: int
    outlines: Callable[[], Callable[[Int[Array, "K"]], Float[Array, "K n"]]]
    chords: Callable[[Float[Array, "K n"], Float[Array, "K 2"]], tuple[Array, Array]]


def faces_of(film: FilmMap, vertices: Float[Array, "V 3"], faces: Int[Array, "F 3"]) -> Convex:
    """Return a mesh's faces, from whichever side they are seen."""

    def outlines():
        points = film_points(film, vertices)
        x, y = (safe_divide(points[:, k], points[:, 2]) for k in (0, 1))
        far = jnp.maximum(jnp.abs(x), jnp.abs(y)) >= REACH * (film.W + film.H)
        y = jnp.where((points[:, 2] > 0) & ~far, y, jnp.nan)
        # (Behind barriers: else each column of an outline would work them out anew.)
        x, y = jax.lax.optimization_barrier((x, y))

        def outline(ids):
            corners = jax.lax.optimization_barrier(faces[ids])
            each = [[v[corners[:, k]] for k in range(3)] for v in (y, x)]
            ys, xs = jax.lax.optimization_barrier(each)
            ends = [functools.reduce(f, v) for v in (ys, xs) for f in (jnp.minimum, jnp.maximum)]
            ends[1] = jnp.where(jnp.isnan(ends[1]), -1, ends[1])
            return jnp.stack([*ends, *xs, *ys], axis=1)

        return outline

    return Convex(faces.shape[0], outlines, _face_chords)


def _face_chords(outline: Float[Array, "K 10"], y: Float[Array, "K 2"]) -> tuple[Array, Array]:
    first, last = jnp.full_like(y, jnp.inf), jnp.full_like(y, -jnp.inf)
    for k, m in ((0, 1), (1, 2), (2, 0)):
        x0, x1, y0, y1 = (outline[:, BOX + c, None] for c in (k, m, 3 + k, 3 + m))
        crosses = (least(y0, y1) <= y) & (y <= most(y0, y1))
        x = x0 + within(safe_divide(y - y0, y1 - y0), 0, 1) * (x1 - x0)
        first = jnp.where(crosses, least(first, x), first)
        last = jnp.where(crosses, most(last, x), last)
    return first, last


def spheres_of(film: FilmMap, spheres: Spheres) -> Convex:
    """Return spheres; those that reach through the plane of the eye are left out."""

    def outline(ids):
        frame = sphere_frames(film, spheres, ARCS_PER_SPHERE * ids)
        z = frame[..., 2]
        outside = norm(spheres.centers[ids] - film.eye[None]) > spheres.radii[ids]
        square = z[:, 0] * z[:, 0] - z[:, 1] * z[:, 1] - z[:, 2] * z[:, 2]
        there = outside & (z[:, 0] > 0) & (square > 0.01 * z[:, 0] * z[:, 0])

        def ends(axis):
            # Where lines touch the conic, from a place within it: nothing cancels.
            middle = safe_divide(frame[:, 0, axis], z[:, 0])
            across = frame[:, 1:, axis] - middle[:, None] * z[:, 1:]
            along = -jnp.sum(across * z[:, 1:], axis=1)
            half = safe_sqrt(along * along + square * jnp.sum(across * across, axis=1))
            return [middle + safe_divide(along + s * half, square) for s in (-1, 1)]

        (low, high), (left, right) = ends(1), ends(0)
        box = jnp.stack([low, jnp.where(there, high, -1), left, right], axis=1)
        return jnp.concatenate([box, frame.reshape(-1, 9)], axis=1)

    return Convex(spheres.radii.shape[0], lambda: outline, _sphere_chords)


def _sphere_chords(outline: Float[Array, "K 13"], y: Float[Array, "K 2"]) -> tuple[Array, Array]:
    frame = jnp.repeat(outline[:, BOX:].reshape(-1, 1, 3, 3), 2, axis=1)
    ends = [film_at(frame, unit_at(frame, 1, y, jnp.full_like(y, s)))[..., 0] for s in (-1, 1)]
    return least(*ends), most(*ends)


class _Rows(NamedTuple):
    """Of each row, column by column: how many more things cover the pixel from side to side than
    the one before (`more`), and how far it is covered from its left side and from its right."""

    more: Float[Array, "N"]
    sides: Float[Array, "2N"]


def surely_covered(
    film: FilmMap, things: list[Convex], worth: Bool[Array, ""], asked: UInt32[Array, "words"]
) -> UInt32[Array, "words"]:
    """Return pixels that things cover wholly, of those that are `asked` for (as bits, each row in
    whole words, from the bottom up); none if it is not `worth` it: then nothing is gone through."""
    fine = max(min(FINE, ROOM // (film.W * film.H)), 1)
    H, W, dtype = film.H * fine, film.W, film.eye.dtype
    things = [x for x in things if x.number < MOST_THINGS]
    if film.bend is not None or not things:
        return jnp.zeros_like(asked)  # what is seen through a lens that bends is not convex

    N = H * (W + 1)
    rows = _Rows(jnp.zeros(N, dtype), jnp.zeros(2 * N, dtype))
    for kind in things:
        rows = _drawn(film, kind, H, fine, rows, worth, asked)
    shaped = lambda x: x.reshape(-1, H, W + 1)[..., :W]
    whole = running_sum(shaped(rows.more)[0]) > 0.5
    left, right = shaped(rows.sides)
    found = jnp.all((whole | (left + right >= 1)).reshape(film.H, fine, W), axis=1)
    return asked & words_of(in_words(found))


def _slack(film: FilmMap) -> Float[Array, ""]:
    """Return by how many px rounding may move what is seen in the film or near it."""
    size = film.W + film.H + jnp.max(jnp.abs(film.matrix))
    return SLACK * jnp.finfo(film.eye.dtype).eps * size


def _drawn(
    film: FilmMap,
    kind: Convex,
    H: int,
    fine: int,
    rows: _Rows,
    worth: Bool[Array, ""],
    asked: UInt32[Array, "words"],
) -> _Rows:
    """Return the rows with all things of a kind."""
    slack, outline_of = _slack(film), kind.outlines()
    size = _Size(film.W, H, fine)

    def chunk(rows, begin):
        ids = begin + jnp.arange(THINGS, dtype=jnp.int32)
        outline = outline_of(jnp.minimum(ids, kind.number - 1))
        inside = lambda y: jnp.clip(y, 0, H).astype(jnp.int32)
        first = inside(jnp.ceil((outline[:, 0] + slack) * fine))
        after = inside(jnp.floor((outline[:, 1] - slack) * fine))
        after = jnp.where(ids < kind.number, after, 0)
        table = jax.lax.optimization_barrier(outline)
        of_each, of_all = (partial(f, kind.chords, size) for f in (_of_each, _of_all))
        return on_cpu(of_each, first, after, table, asked, slack, rows, elsewhere=of_all)

    return in_chunks(chunk, rows, THINGS, jnp.where(worth, kind.number, 0))


class _Size(NamedTuple):
    """Columns of a film, and rows, so many of them in a pixel."""

    W: int
    H: int
    fine: int


def _chord(
    chords: Callable, size: _Size, outline: Array, row: Int[Array, "K"], slack: Array
) -> tuple[Array, Array]:
    """Return from where and up to where things cover rows for sure."""
    low = row.astype(outline.dtype) / size.fine - slack
    y = jnp.stack([low, low + 1 / size.fine + 2 * slack], axis=1)
    left, right = chords(outline, y)
    left = within(jnp.max(left, axis=1) + slack, 0, size.W)
    return left, within(jnp.min(right, axis=1) - slack, 0, size.W)


def _of_each(
    chords: Callable, size: _Size, first: Array, after: Array, table: Array, asked, slack, rows
) -> _Rows:
    """Return the rows with things' intervals, one after the other, where pixels are asked for."""
    words = words_in_row(size.W)

    def of_thing(k, rows):
        outline = jax.lax.dynamic_slice_in_dim(table, k, 1)
        column = lambda x: jnp.clip(x, 0, size.W - 1).astype(jnp.int32)
        ends = column(outline[0, 2] - slack), column(outline[0, 3] + slack)

        def of_row(state):
            row, rows = state

            def add(state):
                left, right = _chord(chords, size, outline, row[None], slack)
                rows = _with_interval(state[1], row * (size.W + 1), left[0], right[0])
                return jnp.array(False), rows

            wanted = any_bit(asked, row // size.fine * words, *ends)
            return row + 1, jax.lax.while_loop(lambda s: s[0], add, (wanted, rows))[1]

        return jax.lax.while_loop(lambda s: s[0] < after[k], of_row, (first[k], rows))[1]

    return jax.lax.fori_loop(0, len(first), of_thing, rows)


def _with_interval(rows: _Rows, begin: Array, left: Array, right: Array) -> _Rows:
    """Return the rows with another interval of the row that begins at this place."""
    more, sides = rows
    ceil, floor = (f(x).astype(jnp.int32) for f, x in ((jnp.ceil, left), (jnp.floor, right)))
    one = jnp.where(ceil < floor, 1, 0).astype(left.dtype)
    for at, step in ((begin + ceil, one), (begin + floor, -one)):
        more = put(more, more[at] + step, at)
    low, across = jnp.floor(left), jnp.floor(left) < jnp.floor(right)
    own = begin + low.astype(jnp.int32), len(rows.more) + begin + floor
    reach = 1 - (left - low), right - jnp.floor(right)
    for at, value in zip(own, reach, strict=True):
        sides = put(sides, jnp.maximum(sides[at], jnp.where(across, value, 0)), at)
    return _Rows(more, sides)


def _of_all(
    chords: Callable, size: _Size, first: Array, after: Array, table: Array, asked, slack, rows
) -> _Rows:
    """Return the rows with things' intervals, as vectors of these."""
    del asked
    number = jnp.maximum(after - first, 0)
    upto = running_sum(number)
    before = upto - number

    def some(rows, begin):
        slot = begin + jnp.arange(ROWS, dtype=jnp.int32)
        own = jnp.minimum(count_upto(upto, slot), THINGS - 1)
        row = jnp.where(slot < upto[-1], first[own] + slot - before[own], size.H)
        left, right = _chord(chords, size, table[own], row, slack)
        return _with_intervals(rows, row, left, right, size.W)

    return in_chunks(some, rows, ROWS, upto[-1])


def _with_intervals(rows: _Rows, row: Array, left: Array, right: Array, W: int) -> _Rows:
    """Return the rows with more intervals; rows past the end are dropped."""
    N, (ceil, floor) = rows.more.shape[0], (jnp.ceil, jnp.floor)
    at = lambda x, which: jnp.where(which, row * (W + 1) + x.astype(jnp.int32), 2 * N)
    one = jnp.ones_like(left)
    wide, across = ceil(left) < floor(right), floor(left) < floor(right)
    more = rows.more.at[jnp.concatenate([at(ceil(left), wide), at(floor(right), wide)])]
    own = at(floor(left), across), at(floor(right), across)
    own = jnp.concatenate([own[0], jnp.where(own[1] < N, own[1] + N, 2 * N)])
    reach = jnp.concatenate([1 - (left - floor(left)), right - floor(right)])
    return _Rows(
        more.add(jnp.concatenate([one, -one]), mode="drop"),
        rows.sides.at[own].max(reach, mode="drop"),
    )


def worth(
    things: list[Convex], layers: Float[Array, ""], depth: Float[Array, ""]
) -> Bool[Array, ""]:
    """Return whether overlapping pixels hold enough layers, one behind the other, that it takes
    less to look for what is covered: where a surface is rough but not folded, no face covers much.

    `layers` is the sum of their pieces' layers, `depth` of what their mean winding numbers are
    above `DEEP`.
    """
    number = sum(x.number for x in things)
    return (layers > max(LEAST_LAYERS, number / THINGS_A_LAYER)) & (depth > 0)
