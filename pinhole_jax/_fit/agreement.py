"""How far the views of one problem agree, and what that leaves open.

The mask of a view errs, and so does its gradient g of the sum of squares, with the covariance G
that `outline_errors` reads from its outline. Where all views' squares are least, g' G^-1 g says how
far a view is from what the others say: chi-squared where nothing but the masks errs. Where it is
more, something errs that no outline shows: joint angles, meshes, transforms, the lens. Then the
covariance grows by as much (Birge 1932).

A view whose residuals are larger than most views' counts less (weights of Student's t): its mask is
worse, or its joint angles or transforms are wrong.

Views weighed by their G (Hansen's generalised moments, 1982) were tried in place of squares: on a
robot's ten masks the eye moved by 6 mm with where the descent began, and it was no nearer.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .joint_descent import Descent, Layout, Solved, solve
from .joint_views import Eye
from .outline_errors import OutlineErrors
from .problem import FINE_PX, UNIT_PX, View
from .result import Known, gradients

#: Degrees of freedom of the t distribution of views' residuals: a few bad views count for little.
HEAVY = 1.0
#: Rounds of weights at most; those that change by a smaller share have settled.
ROUNDS, SETTLED = 16, 0.1
#: What of a covariance of gradients counts as nothing, beside its largest.
NOTHING = 1e-10


class Agreement(NamedTuple):
    """Where the weighed views' squares are least, and how well these agree.

    - `descent`: the state, and what is seen there.
    - `solved`: what determines the unknowns; `gradients`: what each view's gradient (n, n) errs by.
    - `excess`: how many times as far apart the views are as their masks' errors say; at least 1.
    - `freedom`: of how many numbers that is the mean.
    - `off` (V,): each view's residuals beside the middle one's; `weights` (V,), at most 1.
    - `errors`: how each mask's outline errs, None where it is exact, and explained.
    """

    descent: Descent
    solved: Solved
    gradients: list[np.ndarray]
    excess: float
    freedom: int
    off: np.ndarray
    weights: np.ndarray
    errors: list[OutlineErrors | None]

    def covariance(self, layout: Layout, place: np.ndarray) -> np.ndarray:
        """Return the covariance (p, p) of some unknowns that the masks' errors leave (the sandwich
        of Huber 1967, a view at a time)."""
        result = np.zeros((len(place), len(place)))
        seen = zip(self.descent.seen, self.gradients, self.weights, strict=True)
        for k, (view, gradient, weight) in enumerate(seen):
            influence = self.solved.inverse(place, layout.columns(k)) @ (weight * view.moves.T)
            result += influence @ gradient @ influence.T
        return result


def agreed(
    layout: Layout, found: Descent, descend: Callable[[Descent, np.ndarray], Descent]
) -> Agreement:
    """Return how far views agree where their squares are least; `descend` goes there from a descent
    by the squares of views with weights (V,)."""
    weights = np.ones(len(layout.eyes))
    for _ in range(ROUNDS):
        here = _at(layout, found, weights)
        further = np.minimum((HEAVY + 1) / (HEAVY + here.off**2), 1.0)
        if len(weights) < 3 or np.max(np.abs(np.log(further / weights))) < SETTLED:
            return here
        weights = further
        found = descend(found, weights)
    return _at(layout, found, weights)


def _at(layout: Layout, found: Descent, weights: np.ndarray) -> Agreement:
    """Return how far views with these weights agree."""
    views = [seen.view for seen in found.seen]
    pairs = list(zip(layout.eyes, views, strict=True))
    errors = [eye.solver.errors(view) for eye, view in pairs]
    each = [_gradient(*pair, e) for pair, e in zip(pairs, errors, strict=True)]
    squares, ranks = np.array([_distance(v, g) for v, g in zip(views, each, strict=True)]).T
    freedom = max(int(ranks.sum()) - layout.size, 1)
    excess = max(float(weights @ squares) / freedom, 1.0) ** 0.5
    misfit = np.array([max(v.touched_misfit, e.solver.kind.least) for e, v in pairs])
    off = (misfit / np.median(misfit)) ** 0.5
    parts = layout.least_squares(found.seen, weights)
    solved = solve(parts, layout.size, np.zeros(layout.size))
    return Agreement(found, solved, each, excess, freedom, off, weights, errors)


def _gradient(eye: Eye, view: View, errors: OutlineErrors | None) -> np.ndarray:
    """Return the covariance (n, n) of J^T r in a view."""
    touched, squares = float(view.sums.touched), float(view.sums.touched_squares)
    n = len(np.asarray(view.along))
    noise = max(squares / max(touched - n, 1), eye.solver.kind.least)
    of_mask = gradients(view, noise, Known(eye.solver.kind, errors=errors))[1]
    # The last step was off by as much as is negligible.
    triangle = np.asarray(view.triangle, float)
    normal = FINE_PX[eye.solver.dtype] / UNIT_PX * triangle.T @ triangle
    return of_mask + normal @ normal.T


def _distance(view: View, covariance: np.ndarray) -> tuple[float, int]:
    """Return g' G^-1 g of a view's gradient, and of how many numbers."""
    triangle, along = np.asarray(view.triangle, float), np.asarray(view.along, float)
    size = np.linalg.norm(triangle, axis=0)
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    kept = values > NOTHING * max(values[-1], 1e-300)
    parts = vectors[:, kept].T @ (triangle.T @ along / size)
    return float(np.sum(parts**2 / values[kept])), int(np.count_nonzero(kept))
