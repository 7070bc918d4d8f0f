"""By how much a mask's outline is off, over which length: read from where a fit's outline lies.

People and networks draw outlines that are off by stretches, and all outwards or inwards. Pixels of
one stretch err together, so they say less about the camera than as many by themselves, and the sum
of squares tells two cameras apart less well. The offset of the mask's outline from the fit's,
stretch by stretch, shows how large such errors are and how far they reach.

The offsets y (px, outwards) at N stretches are taken as X t + b + g + q: the camera's own error t
by the derivatives X, a bias b of the whole outline, errors g with covariance exp(-distance/length)
but for a share that is each stretch's own, and quantisation q. What the camera absorbs does not
show, so sizes and lengths are weighed by their restricted likelihood (Patterson and Thompson 1971:
t and b integrated out), the hypothesis that the mask is computed (q alone) among them; a
covariance is the mean of the hypotheses'.
"""

from typing import Any, NamedTuple

import numpy as np

from .problem import View
from .residuals import HIDDEN, Pixels
from .target import Level, shares

#: About so many stretches. (On 90 masks that err over 2 to 30 px, of three shapes, 95 % intervals
#: held 94 % of the truths with 48 or 60 stretches, 91 % with 80 or 100.)
STRETCHES = 60
#: ... of at least so many px.
SHORTEST = 2.0
#: What a pixel's coverage differs by counts for the stretch nearest to it, so many px away at most.
NEAREST = 16.0
#: Sizes (px) and lengths (px) of errors, and the share of their variance that is each stretch's
#: own. (Twice as fine grids gave the same intervals.)
SIZES, LENGTHS, OWN = (0.08, 0.2, 0.5, 1.2, 3.0), (6.0, 16.0, 40.0, 100.0), (0.0, 0.7)
#: The standard deviation of the bias, in sizes of the other errors, and how likely it is:
#: segmenters are off by as much as they waver, masks that were grown or shrunk by more.
BIASES = ((1.0, 0.5), (5.0, 0.5))
#: How likely it is beforehand that a mask is computed.
COMPUTED = 0.3
#: Quantisation's variance, beside that of pixels which err independently: straight edges that
#: nearly follow the rows err alike.
#: (Of 48 computed masks of one bit all but 1 are told with 1.5, all but 8 with 1.)
ALIKE = 1.5
#: A slope of the coverage below this is none.
FLAT = 1e-3
#: A stretch whose pixels weigh less than this share tells nothing.
LEAST_WEIGHT = 0.2


class Stretches(NamedTuple):
    """Stretches of an outline.

    - `at` (N, 2): their middle (px), `length` (N,) px.
    - `offset` (N,): how far outside them the mask's outline lies (px).
    - `by_move` (N, n): their own offset by the solver's moves.
    - `share` (N,): what they count for in the sum of squares.
    """

    at: np.ndarray
    length: np.ndarray
    offset: np.ndarray
    by_move: np.ndarray
    share: np.ndarray


class OutlineErrors(NamedTuple):
    """How a mask's outline errs, as a fit's own outline shows it.

    - `size`: standard deviation of its offset (px), `length`: over which it is correlated (px),
      both as the likeliest hypothesis has them; 0 for a mask that is computed.
    - `computed`: how likely it is that it has no errors but quantisation.
    - `independent`: as many offsets that are independent would tell sums of squares apart as well.
    - `gradient` (n, n): the covariance of half the gradient of the sum of squares by the solver's
      moves if the mask is not computed, times how likely that is.
    """

    size: float
    length: float
    computed: float
    independent: float
    gradient: np.ndarray

    @property
    def drawn(self) -> bool:
        """Return whether a person or a network is likelier to have made the mask than a program."""
        return self.computed < 0.5


class _Hypotheses(NamedTuple):
    log_likelihood: np.ndarray
    gradient: np.ndarray
    independent: np.ndarray
    size: np.ndarray
    length: np.ndarray


def outline_errors(
    view: View, level: Level, target: np.ndarray, quantisation: float
) -> OutlineErrors | None:
    """Return how the mask's outline errs, None where too little of an outline is seen.

    `target` (H, W) is the level's window of the mask, `quantisation` the mean square residual of an
    outline pixel that quantisation leaves.
    """
    stretches = stretches_of(view, level, target)
    if stretches is None or len(stretches.offset) < 2 * stretches.by_move.shape[1] + 4:
        return None
    return _weighed(stretches, quantisation)


def disagreement(
    view: View, level: Level, target: np.ndarray, weight: np.ndarray, cap: float
) -> float:
    """Return by how much a view's outline and a mask's disagree (px^2): the area between them, but
    no more than `cap` px for each px of either.

    Squares grow with the area that an occluder hides. Here it counts by its outline only.
    `target`, `weight` (H, W) are the level's windows of the mask.
    """
    from scipy.spatial import KDTree

    stretches = stretches_of(view, level, target)
    if stretches is None:
        return np.inf
    result = stretches.length @ np.minimum(np.abs(stretches.offset), cap)
    inside = shares(target)[::-1] > 0.5
    edge = np.zeros(inside.shape, bool)
    edge[1:] |= inside[1:] != inside[:-1]
    edge[:, 1:] |= inside[:, 1:] != inside[:, :-1]
    edge &= weight[::-1] > 0
    shown = np.asarray(view.pixels.coverage)
    own = _inside(view.pixels, level) & (shown > HIDDEN) & (shown < 1 - HIDDEN)
    cells, width = np.asarray(view.pixels.cell)[own], target.shape[1] + 2
    row, column = np.divmod(cells, width)
    query: Any = KDTree(np.column_stack([row, column - 1])).query
    far, _ = query(np.argwhere(edge), distance_upper_bound=NEAREST)
    return float(result + cap * np.sum(np.isinf(far)))


def stretches_of(view: View, level: Level, target: np.ndarray) -> Stretches | None:
    """Return stretches of the outline that a view shows, None where it shows none."""
    from scipy.spatial import KDTree

    coverage, pixels = coverage_of(view, level), view.pixels
    weight, share = (np.asarray(x, float) for x in (pixels.weight, pixels.coverage))
    shown = np.flatnonzero((share > HIDDEN) & (share < 1 - HIDDEN) & _inside(pixels, level))
    weight = weight[shown]
    if not np.any(weight):
        return None
    W = coverage.shape[1]
    row, column = np.divmod(np.asarray(pixels.cell)[shown], W + 2)
    place = np.column_stack([row, column - 1])

    slopes = np.gradient(np.pad(coverage, 1, mode="edge"))
    up, right = (slope[1:-1, 1:-1] for slope in slopes)
    steepness = np.hypot(up, right)
    # Both sides of a thin part are stretches of their own.
    side = np.round(np.arctan2(up, right)[row, column - 1] / (np.pi / 2)) % 4
    reach = max(SHORTEST, float(np.sum(steepness)) / STRETCHES)
    key = np.column_stack([place // reach, side])
    _, stretch = np.unique(key, axis=0, return_inverse=True)
    stretch, count = stretch.ravel(), int(stretch.max()) + 1
    add = lambda values, of=stretch: np.bincount(of, values, count)

    tree = KDTree(place)

    def near(image: np.ndarray, least: float) -> np.ndarray:
        """Return what an image holds near each stretch."""
        where = np.argwhere(np.abs(image) > least)
        found: Any = tree.query(where, distance_upper_bound=NEAREST)
        distance, nearest = found
        some = distance < np.inf
        return add(image[tuple(where[some].T)], stretch[nearest[some]])

    length = near(steepness, FLAT)
    area = near(shares(target)[::-1] - coverage, HIDDEN)
    crossed = add(None)
    at = np.stack([add(x) for x in place.T], axis=1) / crossed[:, None]

    # By a move, only pixels with weight tell.
    root = np.sqrt(weight)
    rows = np.asarray(view.jacobian, float)[shown] / np.where(root > 0, root, 1)[:, None]
    counted = add(root > 0)
    told = length * counted / crossed
    by_move = np.stack([add(x) for x in rows.T], axis=1) / np.maximum(told, 0.5)[:, None]
    # How much of the outline is in a pixel: what a move covers there for one px.
    within = np.sum(rows * by_move[stretch], axis=1)
    within /= np.maximum(np.sum(by_move**2, axis=1), 1e-300)[stretch]
    share = add(weight * np.clip(within, 0, 1.5) ** 2)
    good = (told > 0.5) & (add(weight) > LEAST_WEIGHT * crossed)
    offset = area / np.maximum(length, 0.5)
    return Stretches(*(x[good] for x in (at, length, offset, by_move, share)))


def _inside(pixels: Pixels, level: Level) -> np.ndarray:
    """Return which pixels lie in a level's window, not beside it."""
    W, H = int(level.W), int(level.H)
    column = np.asarray(pixels.cell) % (W + 2)
    return (np.asarray(pixels.cell) < H * (W + 2)) & (column > 0) & (column <= W)


def coverage_of(view: View, level: Level) -> np.ndarray:
    """Return the coverage (H, W) of a level's window as a view has it, row 0 at the bottom."""
    H, W = int(level.H), int(level.W)
    cell, share, after = (np.asarray(x) for x in view.pixels[:2] + view.pixels[3:4])
    used = cell < H * (W + 2)
    cell, share, after = cell[used], share[used], after[used]
    # What a row begins with, and what follows a touched pixel, lasts until the next one.
    starts = np.arange(H) * (W + 2)
    place = np.concatenate([starts, cell])
    value = np.concatenate([np.full(H, bool(view.pixels.covered_before)), after])
    order = np.argsort(place, kind="stable")
    ends = np.append(place[order][1:], H * (W + 2))
    image = np.repeat(value[order].astype(float), ends - place[order])
    image[cell] = share
    return image.reshape(H, W + 2)[:, 1:-1]


def _weighed(stretches: Stretches, quantisation: float) -> OutlineErrors:
    """Return the mean of the hypotheses, each as likely as the offsets are under it."""
    model = _Model(stretches, quantisation)
    none = np.zeros(1)
    exact = model.hypotheses(0.0, none, none, none, np.full(1, COMPUTED))
    found = [exact._replace(independent=np.full(1, np.sum(stretches.length)))]
    bias, likely = np.array(BIASES).T
    sizes, own, bias = (x.ravel() for x in np.meshgrid(SIZES, OWN, bias, indexing="ij"))
    each = (1 - COMPUTED) / (len(SIZES) * len(LENGTHS) * len(OWN))
    prior, bias = each * np.resize(likely, sizes.shape), bias * sizes
    for length in LENGTHS:
        found.append(model.hypotheses(length, sizes, own, bias, prior))
    together = _Hypotheses(*map(np.concatenate, zip(*found, strict=True)))
    logs = together.log_likelihood
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    likeliest = int(np.argmax(weights))
    return OutlineErrors(
        size=float(together.size[likeliest]),
        length=float(together.length[likeliest]),
        computed=float(weights[0]),
        independent=float(weights @ together.independent),
        gradient=np.tensordot(weights[1:], together.gradient[1:], axes=1),
    )


class _Model:
    """Offsets at stretches, and what hypotheses make of them."""

    def __init__(self, stretches: Stretches, quantisation: float):
        X, self.count = stretches.by_move, len(stretches.offset)
        between = stretches.at[:, None] - stretches.at[None]
        self._distance = np.sqrt(np.sum(between**2, axis=-1))
        self._quantisation = ALIKE * quantisation / float(np.mean(stretches.length))
        units = X / np.maximum(np.linalg.norm(X, axis=0), 1e-300)
        self._columns = np.column_stack([units, np.ones(self.count), stretches.offset])
        self._pull = X.T * stretches.share

    def hypotheses(
        self,
        length: float,
        size: np.ndarray,
        own: np.ndarray,
        bias: np.ndarray,
        prior: np.ndarray,
    ) -> _Hypotheses:
        """Return what errors of sizes (h,), over a length, with biases and shares of their own make
        of the offsets."""
        correlation = np.exp(-self._distance / length) if length else np.eye(self.count)
        values, vectors = np.linalg.eigh(correlation)
        columns, pull = vectors.T @ self._columns, self._pull
        far, near = size**2 * (1 - own), size**2 * own + self._quantisation
        variance = far[:, None] * np.maximum(values, 0) + near[:, None]

        # The camera's error and the bias integrated out: by their normal equations.
        products = np.einsum("ki,hk,kj->hij", columns, 1 / variance, columns)
        inner, right, squares = products[:, :-1, :-1], products[:, :-1, -1], products[:, -1, -1]
        tight = np.maximum(bias, 1e-6)
        inner[:, -1, -1] += tight**-2
        inner += (
            1e-12
            * np.trace(inner[:, :-1, :-1], axis1=1, axis2=2)[:, None, None]
            * np.eye(inner.shape[1])
        )
        left = squares - np.sum(right * np.linalg.solve(inner, right[..., None])[..., 0], axis=1)
        logs = np.sum(np.log(variance), axis=1) + 2 * np.log(tight)
        logs += np.linalg.slogdet(inner)[1]

        total = pull.sum(axis=1)
        parts = pull @ correlation @ pull.T, pull @ pull.T, np.outer(total, total)
        gradient = np.tensordot(np.stack([far, near, bias**2], axis=1), np.stack(parts), axes=1)
        # How much sums of squares vary: correlations count by their squares.
        alike = far**2 * np.sum(correlation**2) + (2 * far * near + near**2) * self.count
        independent = (self.count * (far + near)) ** 2 / alike
        lengths = np.full(size.shape, length)
        return _Hypotheses(np.log(prior) - (logs + left) / 2, gradient, independent, size, lengths)
