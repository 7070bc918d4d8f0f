"""What a fit's programs need beside its values: room for what a view takes, the mask by levels.

Nothing here changes an answer. Buffers grow where a view outgrows them, the window of the film that
is looked at opens where a camera may show the scene beside it, and pyramids are made once.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import numpy as np

from .._mask.edges import Weights, counted, total, within
from .._mask.pyramid import LEAST_CELLS, Level, Pyramid, first_of, pyramid
from .._mask.target import Window
from .capacity import GROWTH, LEAST_CAPACITY, grown, size_of
from .kinds import Kind
from .residuals import Capacity

#: A pixel of the outline is off if its residual is this many standard deviations of the kind's.
OFF_TIMES = 3.0
#: This many levels of a large mask, on the last of which the object has 128 to 256 px, may have a
#: pyramid and buffers of their own: those of a mask of that size, whose program takes a fifth of
#: the time.
COARSE = 4
#: Pyramids of more cells than this (200 MB in float32) are not kept beside the last one.
KEPT_CELLS = 2**23


class Asked(NamedTuple):
    """What the levels of a mask are made of: the mask (H, W) and how much its pixels count, its
    kind, the window that is looked at, the least number of cells that a pyramid has room for, and
    whether the finest level is all that is asked for."""

    target: np.ndarray
    weights: Weights
    kind: Kind
    window: Window
    least: int
    only_finest: bool

    def same(self, other: "Asked") -> bool:
        """Return whether another one's levels are the same."""
        if self.target is not other.target or self[2:] != other[2:]:
            return False
        a, b = self.weights, other.weights
        if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
            return a is b or np.array_equal(a, b)
        return a is b


class Levels(NamedTuple):
    """A mask by levels from coarse to fine; the sum of the weights that lie beside the window, and
    how many pixels of the finest level count. Of a large mask the first levels, up to a cell of
    the raster, stand in a `small` pyramid as well."""

    pyramid: Pyramid
    each: list[Level]
    beside: float
    counted: float
    small: Pyramid | None
    until: int


@dataclass(eq=False)
class Buffers:
    """Room for views of one mask and one scene, shared by all solvers of these.

    - `capacity`: what a view has room for.
    - `window`: the part of the film that is looked at.
    - `cells`: room for at least this many cells in a pyramid of the smallest size.
    - `least`: since a view outgrew its buffers: room for this many.
    - `noise`: what a residual of the mask errs by, as it was last seen: a prior is weighed by it.
    - `small`: what a view of the coarse levels of a large mask has room for, once so many are to be
      looked at that a program of their own pays.
    """

    capacity: Capacity
    window: Window
    cells: int = LEAST_CELLS
    least: int = 0
    noise: float | None = None
    small: Capacity | None = None
    _made: list[tuple[Asked, Levels]] = field(default_factory=list)

    def copy(self) -> "Buffers":
        """Return buffers of the same size, for another mask."""
        sizes = self.capacity, self.window, self.cells, self.least, self.noise, self.small
        return Buffers(*sizes)

    def least_cells(self) -> int:
        """Return how many cells a pyramid has room for at least, beside buffers of this size: so
        there are few programs."""
        return self.cells * 4 ** ((size_of(self.capacity.pieces) + 1) // 2)

    def grow(self, load: Iterable[Any]) -> bool:
        """Give a view that takes so much half as much room again; return whether it lacked any."""
        before, self.capacity = self.capacity, grown(self.capacity, load)
        if size_of(self.capacity.pieces) > size_of(before.pieces):
            self.least = self.least_cells()
        return self.capacity != before

    def grow_small(self, load: Iterable[Any]) -> bool:
        """As `grow`, for a view of a level in the small pyramid."""
        before = self.small
        if before is not None:
            self.small = grown(before, load)
        return self.small != before

    def levels(self, asked: Asked, dtype: Any) -> Levels:
        """Return a mask's levels: the first that were asked for, which fits come back to, and the
        last are kept, but of large masks the last alone."""
        for before, made in reversed(self._made):
            if before.same(asked):
                return made
        made = _made(asked, dtype)
        small = made.pyramid.target.size <= KEPT_CELLS
        self._made = [*(self._made[:1] if small else []), (asked, made)]
        # The larger image's program has room for the longer outline, and the other way round.
        if self.capacity.pieces > 1:
            size = (made.pyramid.cells // LEAST_CELLS).bit_length() // 2
            pieces = max(self.capacity.pieces, LEAST_CAPACITY.pieces * GROWTH**size)
            self.capacity = self.capacity._replace(pieces=pieces)
        return made


def _made(asked: Asked, dtype: Any) -> Levels:
    host, levels = pyramid(
        asked.target,
        asked.weights,
        dtype,
        window=asked.window,
        least=asked.least,
        only_finest=asked.only_finest,
    )
    seen = within(asked.weights, levels[-1].window())
    beside = total(asked.weights) - total(seen)
    each = explained_by(asked.kind, levels, dtype)
    small, until = None, 0
    if len(levels) > COARSE and host.cells > LEAST_CELLS:
        until = int(levels[COARSE].start)
        small = first_of(host, until)
        until = until if small is not None else 0
    pyramids = jax.device_put((host, small))
    return Levels(pyramids[0], each, beside, counted(seen), pyramids[1], until)


def explained_by(kind: Kind, levels: list[Level], dtype: Any) -> list[Level]:
    """Return levels that know what residual a mask's kind explains, where it says so."""
    if not kind.exact:
        return levels
    explained = np.asarray(OFF_TIMES * kind.variance**0.5, dtype)
    return [level._replace(explained=explained) for level in levels]
