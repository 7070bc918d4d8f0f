"""Agreement of the views of one problem, and the error bars that it leaves.

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
from .._outline.outline_errors import OutlineErrors
from .._outline.statistics import mask_errors
from .._solver.least_squares import Descent, LinearSolution, Rows, solve
from .._solver.parameters import components
from .._solver.problem import FINE_PX, UNIT_PX
from .._solver.solver import Solver
from .._solver.uncertainty import BLIND
from .estimates import Estimates, forget
from .system import JointProblem, ViewRows

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


class _Error(NamedTuple):
    """An error of the right-hand side, `by` (c, n) of the unknowns `columns`: its covariance."""

    columns: np.ndarray
    by: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, eq=False)
class Agreement:
    """Where the weighed views' squares are least, and how well these agree.

    - `problem`, with the weights of views (V,), at most 1; `descent`: the state, and views there.
    - `solved`: what determines the unknowns; `gradients`: the covariance of each view's J^T r.
    - `excess`: how many times as far apart the views are as their masks' errors say; at least 1.
    - `freedom`: how many numbers say so.
    - `off` (V,): each view's residuals beside the middle one's.
    - `errors`: how each mask's outline errs, None where it is exact, and explained.
    - `prior_rows`: those of priors, which err by `noise`.
    - `sigma` (V,): how surely each view disagrees with the others, as of one normal number.
    """

    problem: JointProblem
    descent: Descent
    solved: LinearSolution
    gradients: list[np.ndarray]
    excess: float
    freedom: int
    off: np.ndarray
    errors: list[OutlineErrors | None]
    prior_rows: list[Rows]
    noise: float
    sigma: np.ndarray

    def without(self, view: int) -> "Agreement":
        """The agreement of the other views, and priors, by themselves."""
        weights = np.where(np.arange(len(self.off)) == view, 0.0, self.problem.weights)
        problem = replace(self.problem, weights=weights)
        solved = _solve(problem, self.descent.seen, self.prior_rows)
        return replace(self, problem=problem, solved=solved)

    @property
    def wider(self) -> float:
        """The factor by which variances grow: as much as the views are farther apart, and as that
        is read from few of them.

        It jumps where the excess passes 1, since few numbers do not tell 1 from 1.5: of intervals
        97 % hold where nothing but masks errs, 93 to 95 % where more does (86 to 90 % where one
        number alone says so). Of 2 to 6 numbers, widened by what is beyond 1 alone 91 to 94 % would
        hold, by Birge's factor 83 to 92 % (`experiments/intervals.py`).
        """
        if self.excess <= 1 or not self.problem.widens:
            return 1.0
        return (self.excess * width_by_few(self.freedom)) ** 2

    def covariance(self, place: np.ndarray) -> np.ndarray:
        """The covariance (p, p) of some unknowns that the masks' errors, and priors, leave (the
        sandwich of Huber 1967, a view at a time)."""
        return self._by_masks.covariance(place) + self._by_priors.covariance(place, self.noise**2)

    def independent(self, place: np.ndarray) -> np.ndarray:
        """The covariance (p, p) were the residuals independent and of one variance."""
        sums = [s.view.sums for s in self.descent.seen]
        squares = sum(float(s.touched_squares) for s in sums)
        count = sum(float(s.touched) for s in sums) - self.problem.size
        variance = squares / max(count, 1)
        variance = max(variance, *(eye.solver.kind.least for eye in self.problem.eyes))
        by_masks = variance * self.solved.inverse(place, place)
        return by_masks + self._by_priors.covariance(place, self.noise**2 - variance)

    def covariance_of(self, estimates: Estimates, independent: bool = False) -> np.ndarray:
        """The covariance (p, p) of reported numbers; infinite, with no covariances, where they move
        along directions that change no mask."""
        place, by_unknowns = estimates.place, estimates.by_unknowns
        known = self.independent(place) if independent else self.covariance(place)
        result = by_unknowns @ known @ by_unknowns.T
        forget(result, by_unknowns @ self.unseen[place])
        return result

    @cached_property
    def unseen(self) -> np.ndarray:
        """Directions of the unknowns (size, d) that change no mask."""
        return self.solved.unseen(BLIND[self.problem.dtype])

    @cached_property
    def _by_masks(self) -> "_Sandwich":
        """The covariance as the masks' own errors, widened, make it."""
        views = zip(self.descent.seen, self.gradients, self.problem.weights, strict=True)
        errors = [
            _Error(self.problem.columns(k), weight * seen.moves.T, self.wider * gradient)
            for k, (seen, gradient, weight) in enumerate(views)
        ]
        return _Sandwich(self.solved, errors)

    @cached_property
    def _by_priors(self) -> "_Sandwich":
        errors = [_Error(p.columns, p.rows.T, np.eye(len(p.left))) for p in self.prior_rows]
        return _Sandwich(self.solved, errors)


class _Sandwich:
    """The unknowns' covariance by errors of the right-hand side.

    By those of the shared ones it is summed up once: a block's own unknowns follow these, and only
    the errors of its own views come to that. So the covariances of all blocks cost as much as there
    are views.
    """

    def __init__(self, solved: LinearSolution, errors: Sequence[_Error]):
        self._solved, self._of_block = solved, dict[int, list[_Error]]()
        s = len(solved.shared)
        back = np.linalg.pinv(solved.triangle)
        self._all, self._shared = np.zeros((s, s)), dict[int, np.ndarray]()
        for error in errors:
            influence = back @ (solved.by_shared(error.columns) @ back).T @ error.by
            part = influence @ error.covariance @ influence.T
            self._all += part
            for block in solved.owners(error.columns):
                self._of_block.setdefault(block, []).append(error)
                self._shared[block] = self._shared.get(block, 0) + part

    def covariance(self, place: np.ndarray, times: float = 1.0) -> np.ndarray:
        """The covariance (p, p) of some unknowns, by errors with `times` the covariance."""
        solved = self._solved
        own = [block for block in solved.owners(place) if block in self._of_block]
        by_shared = solved.by_shared(place)
        others = self._all - sum((self._shared[block] for block in own), np.zeros_like(self._all))
        result = by_shared @ others @ by_shared.T
        for error in (error for block in own for error in self._of_block[block]):
            influence = solved.inverse(place, error.columns) @ error.by
            result += influence @ error.covariance @ influence.T
        return times * result


def width_by_few(freedom: float) -> float:
    """The width of a 95 % interval where this many numbers show the variance (Student's t), in that
    of a normal distribution."""
    from scipy.stats import t

    return float(t.ppf(0.975, freedom)) / NORMAL_95


def agree(
    problem: JointProblem, found: Descent, px: float, counts: np.ndarray | None = None
) -> Agreement:
    """The agreement of views where their weighed squares are least, from a descent's end on.

    Steps of `px` are negligible. Views that agree have the weights `counts` (V,): 1, if None.
    """
    counts = np.ones(len(problem.eyes)) if counts is None else counts
    problem = replace(problem, weights=counts, depth=1)
    for _ in range(ROUNDS):
        here = _agreement(problem, found, counts)
        further = counts * np.minimum((HEAVY + 1) / (HEAVY + here.off**2), 1.0)
        if len(counts) < 3 or np.max(np.abs(np.log(further / problem.weights))) < SETTLED:
            return here
        problem = replace(problem, weights=further)
        found = problem.descend(found.state, problem.max_steps, px)
    return _agreement(problem, found, counts)


def weigh_priors(problem: JointProblem, found: Descent) -> JointProblem:
    """The problem whose priors are weighed against the masks so that they are known best: what errs
    along stretches, or all outwards, says less than its residuals do."""
    if not problem.priors:
        return problem
    spreads = []
    for design in DESIGNS:
        here = _agreement(replace(problem, design=design), found, problem.weights)
        spread = sum(
            float(np.trace(p.rows @ here.covariance(p.columns) @ p.rows.T)) for p in here.prior_rows
        )
        spreads.append(spread / here.noise**2)
    return replace(problem, design=DESIGNS[int(np.argmin(spreads))])


def _agreement(problem: JointProblem, found: Descent, counts: np.ndarray) -> Agreement:
    """The agreement of weighed views; those that agree had the weights `counts`."""
    # What is at an end of its bounds, nothing determines.
    held = problem.ways_out(found.state, found.seen) != 0
    seen = [
        s._replace(moves=np.where(held[problem.columns(k)], 0.0, s.moves))
        for k, s in enumerate(found.seen)
    ]
    noise = problem.noise(seen)
    prior_rows = problem.prior_rows(found.state, seen, noise)
    rows = []
    for eye, s in zip(problem.eyes, seen, strict=True):
        errors = mask_errors(eye.solver, s.view)
        gradient = _gradient(eye.solver, s, errors)
        misfit = max(s.view.touched_misfit, eye.solver.kind.least)
        felt = 1.0 if errors is None else errors.felt
        rows.append((errors, gradient, misfit, *_distance(eye.solver, s, gradient * felt**2)))
    errors, gradients, misfits, squares, ranks = map(list, zip(*rows, strict=True))

    freedom = sum(ranks) + sum(len(part.left) for part in prior_rows) - problem.size
    freedom = max(freedom, 1)
    of_priors = sum(part.squares for part in prior_rows) / noise**2
    excess = max((float(problem.weights @ np.array(squares)) + of_priors) / freedom, 1.0) ** 0.5
    misfit = np.array(misfits) * counts
    prior_rows = [part.without(held) for part in prior_rows]
    return Agreement(
        problem=problem,
        descent=found._replace(seen=seen),
        solved=_solve(problem, seen, prior_rows),
        gradients=gradients,
        excess=excess if len(seen) > 1 else 1.0,  # (One view has none that it could differ from.)
        freedom=freedom,
        off=(misfit / np.median(misfit)) ** 0.5,
        errors=errors,
        prior_rows=prior_rows,
        noise=noise,
        sigma=np.array([*map(_sigma, squares, ranks)]),
    )


def _solve(problem: JointProblem, seen: list[ViewRows], prior_rows: list[Rows]) -> LinearSolution:
    rows = [problem.view_rows(k, s).times(problem.weights[k] ** 0.5) for k, s in enumerate(seen)]
    return solve([*rows, *prior_rows], problem.size, np.zeros(problem.size))


def _sigma(squares: float, rank: float) -> float:
    """The probability of chi-squared of this many numbers, as the distance of a normal number."""
    from scipy.stats import chi2, norm

    if not (rank > 0 and np.isfinite(squares)):
        return 0.0
    log = float(chi2.logsf(squares, rank))
    return float(norm.isf(np.exp(log) / 2)) if log > -600 else float(np.sqrt(squares))


def _gradient(solver: Solver, seen: ViewRows, errors: OutlineErrors | None) -> np.ndarray:
    """The covariance (n, n) of J^T r in a view."""
    sums, triangle = seen.view.sums, np.asarray(seen.view.triangle, float)
    noise = float(sums.touched_squares) / max(float(sums.touched) - len(triangle), 1)
    context = Context(solver.kind, errors=errors)
    of_mask = gradients(seen.view, max(noise, solver.kind.least), context)[1]
    # The last step was off by as much as is negligible.
    normal = FINE_PX[solver.dtype] / UNIT_PX * triangle.T @ triangle
    return of_mask + normal @ normal.T


def _distance(solver: Solver, seen: ViewRows, covariance: np.ndarray) -> tuple[float, int]:
    """A view's g' G^-1 g, its gradient by its own camera's moves, and the number of these.

    (What joints move is a few stretches of the outline, whose errors are not known well enough: a
    round flange that turns made views differ by 32 times what they err.)
    """
    own = len(components(solver.freed))
    covariance = covariance[:own, :own]
    triangle = np.asarray(seen.view.triangle, float)[:, :own]
    size = np.linalg.norm(triangle, axis=0)
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    counted = values > NOTHING * max(values[-1], 1e-300)
    parts = vectors[:, counted].T @ (triangle.T @ np.asarray(seen.view.along, float) / size)
    return float(np.sum(parts**2 / values[counted])), int(np.count_nonzero(counted))
