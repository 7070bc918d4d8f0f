"""What solvers of one mask and one scene share: the window looked at, and the mask by levels.

Nothing here changes an answer. The window opens where a camera may show the scene beside it, and
levels are made once.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import numpy as np

from .._mask.edges import Weights, values_of, within
from .._mask.pyramid import LEAST_CELLS, Level, Pyramid, pyramid
from .._mask.target import Window

#: Pyramids of more cells than this (200 MB in float32) are not kept beside the last one.
KEPT_CELLS = 2**23


class Levels(NamedTuple):
    """A mask by levels from coarse to fine; the sum of the weights that lie beside the window, and
    how many pixels of the finest level count."""

    pyramid: Pyramid
    each: list[Level]
    beside: float
    counted: int


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
    _made: list[tuple[np.ndarray, Weights, Any, Levels]] = field(default_factory=list)

    def widen(self, other: "Store") -> None:
        """Look at what a copy looks at, if that has come to see more: the whole film."""
        if other.window.W * other.window.H > self.window.W * self.window.H:
            self.window, self._made = other.window, other._made

    def levels(
        self,
        target: np.ndarray,
        weights: Weights,
        explained: float | None,
        only_finest: bool,
        dtype: Any,
    ) -> Levels:
        """The levels of a mask (H, W) whose pixels count so much, or its finest level alone: the
        first that were asked for, which fits come back to, and the last are kept, but of large
        masks the last alone. `explained`: the residual that its kind explains, if it says so."""
        key = explained, only_finest, self.window
        for image, weighed, before, made in reversed(self._made):
            if image is target and weighed is weights and before == key:
                return made
        host, levels = pyramid(
            target, weights, dtype, window=self.window, least=self.cells, only_finest=only_finest
        )
        if explained is not None:
            levels = [x._replace(explained=np.asarray(explained, dtype)) for x in levels]
        seen = within(weights, levels[-1].window())
        some = values_of(seen)
        beside = float(np.sum(values_of(weights))) - float(np.sum(some))
        made = Levels(jax.device_put(host), levels, beside, int(np.count_nonzero(some)))
        small = host.cells.shape[1] <= KEPT_CELLS
        self._made = [*(self._made[:1] if small else []), (target, weights, key, made)]
        return made
