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

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from .._fit.result import Context, gradients
from .._solver.least_squares import Descent, Rows, Solved, solve
from .._solver.looks import View
from .._solver.outline_errors import OutlineErrors
from .._solver.parameters import components
from .._solver.problem import FINE_PX, UNIT_PX
from .._solver.uncertainty import BLIND
from .descent import Layout, descend
from .views import Eye

#: Degrees of freedom of the t distribution of views' residuals: a few bad views count for little.
#: (With 1 a view 3 times as far off as the middle one has a fifth of the weight, one 10 times a
#: fiftieth.)
HEAVY = 1.0
#: Rounds of weights at most; those that change by a smaller share have settled.
ROUNDS, SETTLED = 16, 0.1
#: Of a normal distribution 95 % lie within this many standard deviations.
NORMAL_95 = 1.959964
#: How many times a residual's variance masks may err by, against priors.
DESIGNS = (1.0, 4.0, 16.0, 64.0, 256.0, 1024.0, 4096.0)
#: What of a covariance of gradients counts as nothing, beside its largest.
NOTHING = 1e-10


class _Errs(NamedTuple):
    """Some residuals' part of the right-hand side, `by` (c, n) of the unknowns `columns`, errs with
    this `covariance` (n, n)."""

    columns: np.ndarray
    by: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, eq=False)
class Agreement:
    """Where the weighed views' squares are least, and how well these agree.

    - `layout`: of the unknowns.
    - `descent`: the state, and what is seen there.
    - `solved`: what determines the unknowns; `gradients`: what each view's gradient (n, n) errs by.
    - `excess`: how many times as far apart the views are as their masks' errors say; at least 1.
    - `freedom`: of how many numbers that is the mean.
    - `off` (V,): each view's residuals beside the middle one's; `weights` (V,), at most 1.
    - `errors`: how each mask's outline errs, None where it is exact, and explained.
    - `prior_rows`: those of priors, which err by `noise`.
    - `sigma` (V,): how surely each view disagrees with the others, as of one normal number.
    """

    layout: Layout
    descent: Descent
    solved: Solved
    gradients: list[np.ndarray]
    excess: float
    freedom: int
    off: np.ndarray
    weights: np.ndarray
    errors: list[OutlineErrors | None]
    prior_rows: list[Rows]
    noise: float
    sigma: np.ndarray

    def without(self, view: int) -> "Agreement":
        """Return what the other views, and priors, would tell by themselves."""
        weights = np.where(np.arange(len(self.weights)) == view, 0.0, self.weights)
        parts = self.layout.least_squares(self.descent.seen, weights)
        solved = solve([*parts, *self.prior_rows], self.layout.size, np.zeros(self.layout.size))
        return replace(self, solved=solved, weights=weights)

    @property
    def wider(self) -> float:
        """Return by how much variances grow: as much as the views are farther apart, and as that is
        read from few of them.

        It jumps where the excess passes 1, since few numbers do not tell 1 from 1.5: of intervals
        97 % hold where nothing but masks errs, 93 to 95 % where more does (86 to 90 % where one
        number alone says so). Of 2 to 6 numbers, widened by what is beyond 1 alone 91 to 94 % would
        hold, by Birge's factor 83 to 92 % (`experiments/intervals.py`).
        """
        if self.excess <= 1:
            return 1.0
        from scipy.stats import t

        return (self.excess * float(t.ppf(0.975, self.freedom)) / NORMAL_95) ** 2

    def covariance(self, place: np.ndarray) -> np.ndarray:
        """Return the covariance (p, p) of some unknowns that the masks' errors, and priors,
        leave (the sandwich of Huber 1967, a view at a time)."""
        return self._by_masks.covariance(place) + self._by_priors.covariance(place, self.noise**2)

    def independent(self, place: np.ndarray, variance: float) -> np.ndarray:
        """Return the covariance (p, p) were the residuals independent and of one variance."""
        by_masks = variance * self.solved.inverse(place, place)
        return by_masks + self._by_priors.covariance(place, self.noise**2 - variance)

    @cached_property
    def unseen(self) -> np.ndarray:
        """Return directions of the unknowns (size, d) that change no mask."""
        return self.solved.unseen(BLIND[self.layout.eyes[0].solver.dtype])

    @cached_property
    def _by_masks(self) -> "_Sandwich":
        seen = zip(self.descent.seen, self.gradients, self.weights, strict=True)
        return _Sandwich(
            self.solved,
            [
                _Errs(self.layout.columns(k), weight * view.moves.T, self.wider * gradient)
                for k, (view, gradient, weight) in enumerate(seen)
            ],
        )

    @cached_property
    def _by_priors(self) -> "_Sandwich":
        of = lambda p: _Errs(p.columns, p.rows.T, np.eye(len(p.left)))
        return _Sandwich(self.solved, [of(part) for part in self.prior_rows])


class _Sandwich:
    """What errors of the right-hand side make of the unknowns.

    What they make of the shared ones is summed up once: what is a block's own follows these, and
    only the errors of its own views come to that. So the covariances of all blocks cost as much as
    there are views.
    """

    def __init__(self, solved: Solved, errs: Sequence[_Errs]):
        self._solved, self._of_block = solved, dict[int, list[_Errs]]()
        s = len(solved.shared)
        back = np.linalg.pinv(solved.triangle)
        self._all, self._shared = np.zeros((s, s)), dict[int, np.ndarray]()
        for err in errs:
            influence = back @ (solved.by_shared(err.columns) @ back).T @ err.by
            part = influence @ err.covariance @ influence.T
            self._all += part
            for block in solved.owners(err.columns):
                self._of_block.setdefault(block, []).append(err)
                self._shared[block] = self._shared.get(block, 0) + part

    def covariance(self, place: np.ndarray, times: float = 1.0) -> np.ndarray:
        """Return the covariance (p, p) of some unknowns, of errors with `times` the covariance."""
        solved = self._solved
        own = [block for block in solved.owners(place) if block in self._of_block]
        by_shared = solved.by_shared(place)
        others = self._all - sum((self._shared[block] for block in own), np.zeros_like(self._all))
        result = by_shared @ others @ by_shared.T
        for err in (err for block in own for err in self._of_block[block]):
            influence = solved.inverse(place, err.columns) @ err.by
            result += influence @ err.covariance @ influence.T
        return times * result


def agreed(
    layout: Layout, found: Descent, most: int, px: float, counts: np.ndarray | None = None
) -> Agreement:
    """Return how far views agree where the squares of views with weights (V,) are least, from a
    descent's end on: `most` steps a time, those of `px` are negligible. Views that agree have the
    weights `counts` (V,): 1, if None."""
    counts = np.ones(len(layout.eyes)) if counts is None else counts
    weights = counts
    for _ in range(ROUNDS):
        here = _at(layout, found, weights, counts)
        further = counts * np.minimum((HEAVY + 1) / (HEAVY + here.off**2), 1.0)
        if len(weights) < 3 or np.max(np.abs(np.log(further / weights))) < SETTLED:
            return here
        weights = further
        found = descend(layout, found.state, 1, weights, most, px)
    return _at(layout, found, weights, counts)


def priors_weighed(layout: Layout, found: Descent) -> Layout:
    """Return the layout in which priors are weighed against the masks so that they are told best:
    what errs along stretches, or all outwards, says less than its residuals do."""
    if not layout.priors:
        return layout
    spreads, ones = [], np.ones(len(layout.eyes))
    for design in DESIGNS:
        here = _at(layout.weighing(design), found, ones, ones)
        spreads.append(
            sum(
                float(np.trace(p.rows @ here.covariance(p.columns) @ p.rows.T))
                for p in here.prior_rows
            )
            / here.noise**2
        )
    return layout.weighing(DESIGNS[int(np.argmin(spreads))])


def _at(layout: Layout, found: Descent, weights: np.ndarray, counts: np.ndarray) -> Agreement:
    """Return how far views with these weights agree; those that do had the weights `counts`."""
    # What is at an end of its bounds, nothing determines.
    held = layout.ways_out(found.state, found.seen) != 0
    seen = [
        s._replace(moves=np.where(held[layout.columns(k)], 0.0, s.moves))
        for k, s in enumerate(found.seen)
    ]
    found = found._replace(seen=seen)
    views = [one.view for one in seen]
    pairs = list(zip(layout.eyes, views, strict=True))
    errors = [eye.solver.errors(view) for eye, view in pairs]
    each = [_gradient(*pair, e) for pair, e in zip(pairs, errors, strict=True)]
    own = [len(components(eye.solver.freed)) for eye in layout.eyes]
    distances = [_distance(*one) for one in zip(views, each, own, strict=True)]
    squares, ranks = np.array(distances).T
    noise = layout.noise(found.seen)
    prior_rows = layout.prior_rows(found.state, found.seen, noise)
    of_priors = sum(part.squares for part in prior_rows) / noise**2
    freedom = int(ranks.sum()) + sum(len(part.left) for part in prior_rows) - layout.size
    freedom = max(freedom, 1)
    excess = max((float(weights @ squares) + of_priors) / freedom, 1.0) ** 0.5
    excess = excess if len(views) > 1 else 1.0  # (One view has none that it could differ from.)
    misfit = np.array([max(v.touched_misfit, e.solver.kind.least) for e, v in pairs])
    off = (misfit * counts / np.median(misfit * counts)) ** 0.5
    parts = layout.least_squares(found.seen, weights)
    prior_rows = [part.without(held) for part in prior_rows]
    solved = solve([*parts, *prior_rows], layout.size, np.zeros(layout.size))
    sigma = np.array([_sigma(*pair) for pair in zip(squares, ranks, strict=True)])
    rest = excess, freedom, off, weights, errors, prior_rows, noise, sigma
    return Agreement(layout, found, solved, each, *rest)


def _sigma(squares: float, rank: float) -> float:
    """Return how unlikely chi-squared of this many numbers is, as the distance of a normal one."""
    from scipy.stats import chi2, norm

    if not (rank > 0 and np.isfinite(squares)):
        return 0.0
    log = float(chi2.logsf(squares, rank))
    return float(norm.isf(np.exp(log) / 2)) if log > -600 else float(np.sqrt(squares))


def _gradient(eye: Eye, view: View, errors: OutlineErrors | None) -> np.ndarray:
    """Return the covariance (n, n) of J^T r in a view."""
    touched, squares = float(view.sums.touched), float(view.sums.touched_squares)
    n = len(np.asarray(view.along))
    noise = max(squares / max(touched - n, 1), eye.solver.kind.least)
    of_mask = gradients(view, noise, Context(eye.solver.kind, errors=errors))[1]
    # The last step was off by as much as is negligible.
    triangle = np.asarray(view.triangle, float)
    normal = FINE_PX[eye.solver.dtype] / UNIT_PX * triangle.T @ triangle
    return of_mask + normal @ normal.T


def _distance(view: View, covariance: np.ndarray, own: int) -> tuple[float, int]:
    """Return g' G^-1 g of a view's gradient by its own camera's moves, and of how many numbers.

    (What joints move is a few stretches of the outline, whose errors are not told well enough: a
    round flange that turns made views differ by 32 times what they err.)
    """
    covariance = covariance[:own, :own]
    triangle, along = np.asarray(view.triangle, float)[:, :own], np.asarray(view.along, float)
    size = np.linalg.norm(triangle, axis=0)
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    counted = values > NOTHING * max(values[-1], 1e-300)
    parts = vectors[:, counted].T @ (triangle.T @ along / size)
    return float(np.sum(parts**2 / values[counted])), int(np.count_nonzero(counted))
