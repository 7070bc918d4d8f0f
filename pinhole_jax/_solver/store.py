"""What solvers of one mask and one scene share: the window looked at, and the mask by levels.

Nothing here changes an answer. The window opens where a camera may show the scene beside it, and
levels are made once.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import numpy as np

from .._mask.edges import Weights, counted, total, within
from .._mask.pyramid import LEAST_CELLS, Level, Pyramid, pyramid
from .._mask.target import Window

#: Pyramids of more cells than this (200 MB in float32) are not kept beside the last one.
KEPT_CELLS = 2**23


class LevelsKey(NamedTuple):
    """What the levels of a mask depend on: the mask (H, W), the weights of its pixels, the residual
    that its kind explains (if it says so), the window, and whether only the finest level is
    wanted."""

    target: np.ndarray
    weights: Weights
    explained: float | None
    window: Window
    only_finest: bool

    def same(self, other: "LevelsKey") -> bool:
        """Whether another one's levels are the same."""
        if self.target is not other.target or self[2:] != other[2:]:
            return False
        a, b = self.weights, other.weights
        if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
            return a is b or np.array_equal(a, b)
        return a is b


class Levels(NamedTuple):
    """A mask by levels from coarse to fine; the sum of the weights that lie beside the window, and
    how many pixels of the finest level count."""

    pyramid: Pyramid
    each: list[Level]
    beside: float
    counted: float


@dataclass(eq=False)
class Store:
    """What all solvers of one mask and one scene share.

    - `window`: the part of the film that is looked at.
    - `cells`: room for at least this many cells in a pyramid: so there are few programs.
    - `noise`: what a residual of the mask errs by, as it was last seen: a prior is weighed by it.
    """

    window: Window
    cells: int = LEAST_CELLS
    noise: float | None = None
    _made: list[tuple[LevelsKey, Levels]] = field(default_factory=list)

    def copy(self) -> "Store":
        """The same window and noise, for another mask."""
        return Store(self.window, self.cells, self.noise)

    def levels(self, key: LevelsKey, dtype: Any) -> Levels:
        """A mask's levels: the first that were asked for, which fits come back to, and the last are
        kept, but of large masks the last alone."""
        for before, made in reversed(self._made):
            if before.same(key):
                return made
        made = _made(key, self.cells, dtype)
        small = made.pyramid.cells.shape[1] <= KEPT_CELLS
        self._made = [*(self._made[:1] if small else []), (key, made)]
        return made


def _made(key: LevelsKey, cells: int, dtype: Any) -> Levels:
    image, weights, explained, window, only_finest = key
    host, levels = pyramid(
        image, weights, dtype, window=window, least=cells, only_finest=only_finest
    )
    seen = within(weights, levels[-1].window())
    beside = total(weights) - total(seen)
    if explained is not None:
        levels = [x._replace(explained=np.asarray(explained, dtype)) for x in levels]
    return Levels(jax.device_put(host), levels, beside, counted(seen))
