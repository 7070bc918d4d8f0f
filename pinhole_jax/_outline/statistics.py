"""What squares a right camera may leave in a mask: functions of a view, and of the mask that a
solver fits (its kind, target and weights)."""

from weakref import WeakKeyDictionary

import numpy as np

from .._mask.edges import Weights
from .._rules import RULES
from .._solver.looks import View
from .._solver.solver import Solver
from .outline_errors import OutlineErrors, is_drawn, outline_errors
from .stretches import stretches_of

#: What a hard edge leaves in a pixel of the outline, and what 8 bits do.
ONE_BIT, LEAST_VARIANCE = 1 / 12, 1 / 12 / 255**2

#: By fewer stretches nothing shows whether pixels err alike.
LEAST_STRETCHES = 8
#: The target and the weights that a view was last held against, whether all of it was believed, and
#: the errors found.
_last: WeakKeyDictionary[View, tuple[tuple[np.ndarray, Weights, bool], OutlineErrors | None]]
_last = WeakKeyDictionary()


def misfit_above_noise(solver: Solver, view: View) -> float:
    """The mean square residual of an outline pixel, all squares put on these pixels but what noise
    leaves in others."""
    touched = float(view.sums.touched)
    noise = solver.kind.far * max(solver.counted - touched, 0.0)
    return max(view.squares - noise, 0.0) / max(touched, 1.0)


def is_explained(solver: Solver, view: View) -> bool:
    """True if a right camera may leave these squares in a mask of this kind.

    Noise that is even says how much it leaves in all, and how exactly: what is beyond that is
    something else, as a handle that only the mask shows.
    """
    misfit, kind = misfit_above_noise(solver, view), solver.kind
    if not kind.spread:
        return bool(misfit <= kind.most)
    excess = (misfit - kind.variance) * max(float(view.sums.touched), 1.0)
    return bool(excess <= RULES.times * kind.spread)


def err_alike(solver: Solver, view: View) -> bool:
    """True if neighbouring pixels of an exact mask err alike, by more than its steps explain: not
    as a renderer's samples do, but as by a lens, a camera constant or a mesh that is wrong."""
    kind, misfit = solver.kind, view.touched_misfit
    if not kind.exact or kind.spread or not RULES.times * kind.variance < misfit <= kind.most:
        return False
    stretches = stretches_of(view, solver.target, solver.weights)
    alike = np.zeros(0) if stretches is None else stretches.alike[np.isfinite(stretches.alike)]
    chance = (2 / max(len(alike), 1)) ** 0.5
    return len(alike) >= LEAST_STRETCHES and bool(np.mean(alike) > 1 + RULES.times * chance)


def quantisation(variance: float, weight: float) -> float:
    """The mean square residual of an outline pixel of weight 1 by that of pixels with a weight:
    between what 8 bits and a hard edge leave. (More is no noise of pixels.)"""
    return float(np.clip(variance / weight, LEAST_VARIANCE, ONE_BIT))


def mask_errors(solver: Solver, view: View, believed: bool = True) -> OutlineErrors | None:
    """The errors of the mask's outline, as a view shows them, if all of it is `believed`; None for
    a mask that is computed and explained, and where too little is seen."""
    kind, mask = solver.kind, (solver.target, solver.weights, believed)
    if kind.exact and kind.explains(view.touched_misfit, False):
        return None
    before, found = _last.get(view, (None, None))
    if before is None or any(a is not b for a, b in zip(before, mask, strict=True)):
        weight = np.asarray(view.pixels.weight)
        scale = float(np.median(weight[weight > 0])) if np.any(weight > 0) else 1.0
        noise = quantisation(max(kind.variance, view.touched_misfit), scale)
        found = outline_errors(view, *mask[:2], noise, kind.hard, believed)
        _last[view] = mask, found
    return found


def residual_variance(solver: Solver, view: View) -> float:
    """By what, times two, squares at two cameras differ for each standard error between them: a
    residual's variance, larger where neighbours err together."""
    result, known = max(solver.kind.variance, view.touched_misfit), mask_errors(solver, view)
    if known is None:
        return result
    if is_drawn(known):  # what lies beside the outline is of these errors, too
        return view.squares / known.independent
    return result * max(float(view.sums.touched) / known.independent, 1.0)
