"""How far a camera has moved from where a calibration, or another fit, had it, and how surely."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from .._camera.axes import axes_of
from .._camera.camera import Camera
from .._numerics.arrays import check_kind
from .places import turned_by
from .result import Fit, check_fit
from .words import UNIT

#: The reported names of a pose's six parameters, in the order of `Drift.by`.
POSE = ("rotation_b1", "rotation_b2", "rotation_v", "e_x", "e_y", "e_z")
#: A drift of more standard errors than this is one.
MOVED = 3.0
#: Cameras this close (rad), or within this many standard errors (an interval of 95 %), are one, but
#: none that are so far apart (rad): who chooses among modes is to see both.
SAME, SAME_SIGMAS, ANOTHER = np.deg2rad(0.5), 2.0, np.deg2rad(10)


class Drift(NamedTuple):
    """How far a fit's camera is from a reference.

    - `angle` (rad), `distance` (world units): as `pose_error` has them.
    - `turn` (3,), `shift` (3,): of the camera about, and along, its own axes right, up, forward as
      the reference has them (rad; world units).
    - `by` (6,): turn and shift by the parameters of `Fit.names`, each in its own standard errors:
      NaN where it was not fitted, 0 where the masks do not determine it.
    - `sigma`: how surely it has moved, as of one normal number: from all parameters together and
      their covariance (chi-squared), so that errors which go together count once.

    ```python
    found.moved, found.sigma, np.rad2deg(found.turn), found.shift
    ```
    """

    angle: float
    distance: float
    turn: Float[np.ndarray, "3"]
    shift: Float[np.ndarray, "3"]
    by: Float[np.ndarray, "6"]
    sigma: float

    @property
    def moved(self) -> bool:
        """True if this is more than errors make of a camera that stands still."""
        return self.sigma > MOVED

    @property
    def size(self) -> str:
        """The size of the move, in standard errors, as words."""
        return "less than 1 sigma" if self.sigma < 1 else f"{self.sigma:.1f} sigma"

    def __str__(self) -> str:
        """Return it in a line; pitch is up, yaw to the left, roll the right side down."""
        if not np.any(np.nan_to_num(self.by)) and self.angle + self.distance > 0:
            return "cannot tell: the masks do not determine where the camera is"
        verdict = "moved" if self.moved else "not moved"
        turn = ", ".join(
            f"{name} {np.rad2deg(x):+.2g}"
            for name, x in zip(("pitch", "yaw", "roll"), self.turn, strict=True)
        )
        shift = ", ".join(
            f"{name} {x:+.2g}"
            for name, x in zip(("right", "up", "forward"), self.shift, strict=True)
        )
        return (
            f"{verdict}: {self.size}; turned by {np.rad2deg(self.angle):.2g} degrees"
            f" ({turn}), shifted by {self.distance:.2g} {UNIT} ({shift})"
        )


def drift(fit: Fit, reference: Camera | Fit) -> Drift:
    """The move of a fit's camera from a reference, and its significance.

    - `reference`: a camera that is taken as exact, or a fit of other masks, whose covariance counts
      as well.

    Was the camera, or the object before it, pushed? One more mask checks a calibration.

    Raises ValueError for other arguments, and for a fit whose pose was not free.

    ```python
    found = pj.drift(fit, truth)  # the calibration that was: a camera, or a fit of other masks
    print(found)
    ```
    """
    check_fit(fit)
    check_kind("reference", reference, Camera | Fit, "a Camera or a Fit")
    fitted = [k for k, name in enumerate(POSE) if name in fit.names]
    if not fitted:
        raise ValueError(f"`fit`: expected one whose pose was free, got {', '.join(fit.names)}")
    before = reference.camera if isinstance(reference, Fit) else reference
    axes = axes_of(before)
    turn = axes @ turned_by(before, fit.camera)
    shift = np.asarray(fit.camera.e, float) - np.asarray(before.e, float)
    covariance = _covariance(fit)
    if isinstance(reference, Fit):
        covariance = covariance + _covariance(reference, held=fit.names)
    change = np.concatenate([turn, shift])
    std = np.sqrt(np.diagonal(covariance))
    by = np.full(len(POSE), np.nan)
    by[fitted] = change[fitted] / std[fitted]
    return Drift(
        float(np.linalg.norm(turn)),
        float(np.linalg.norm(shift)),
        turn,
        axes @ shift,
        by,
        sigma_of(*squared_sigmas(change[fitted], covariance[np.ix_(fitted, fitted)])),
    )


def other_places(
    fit: Fit,
    modes: Sequence[Fit],
    free: Sequence[Float[np.ndarray, "3"]],
    minima: bool,
    are_one: Callable[[Camera, Camera], bool],
) -> list[Fit]:
    """Return the modes that the mask's own noise tells from the fit, and from one another; where it
    tells none of them from the fit, the farthest, if all are `minima` of the squares.

    What descents from several sides end at may be one place, told several times: within the fit's
    error bars, or but for a turn about an axis of the world that is `free`. Where the mask leaves a
    parameter open, there is no noise to ask. (One that stays keeps the status: it is not to hang on
    whether a mode is 1.9 or 2.1 standard errors away.)
    """
    if fit.status == "non_finite" or not modes:
        return [*modes]
    limit = ANOTHER if np.all(np.isfinite(fit.covariance)) else 0.0
    kept = [fit]
    for mode in modes:
        away = [drift(k._replace(covariance=fit.covariance), mode.camera) for k in kept]
        same = any(d.angle < limit and d.sigma < SAME_SIGMAS for d in away)
        same = same or any(are_one(k.camera, mode.camera) for k in kept)
        if not (same or any(_turned_about(k, mode, axis) for k in kept for axis in free)):
            kept.append(mode)
    farthest = [max(modes, key=lambda mode: drift(fit, mode.camera).angle)] if minima else []
    return kept[1:] or farthest


def _turned_about(a: Fit, b: Fit, axis: np.ndarray) -> bool:
    """True if two cameras are the same but for a turn about an axis (3,) of the world."""
    turned = axes_of(b.camera).T @ axes_of(a.camera) @ axis
    return bool(np.linalg.norm(turned - axis) < SAME)


def _covariance(fit: Fit, held: Sequence[str] | None = None) -> Any:
    """The covariance (6, 6) of a fit's pose; 0 for parts that were not fitted.

    Another fit that held parameters where this one found them (all but `held`'s names) has this
    one's errors there: they are taken as known, and the pose's covariance is conditioned on them.
    """
    own = [k for k, name in enumerate(fit.names) if name in POSE]
    place = [POSE.index(fit.names[k]) for k in own]
    whole = np.asarray(fit.covariance, float)
    inner = whole[np.ix_(own, own)]
    common = [
        k
        for k, name in enumerate(fit.names)
        if held is not None and name not in POSE and name not in held and np.isfinite(whole[k, k])
    ]
    if common:
        across = np.nan_to_num(whole[np.ix_(own, common)])
        explained = np.linalg.pinv(whole[np.ix_(common, common)], hermitian=True)
        inner = inner - across @ explained @ across.T
    covariance = np.zeros((len(POSE), len(POSE)))
    covariance[np.ix_(place, place)] = inner
    return covariance


def squared_sigmas(change: np.ndarray, covariance: np.ndarray) -> tuple[float, int]:
    """The square of a change in standard errors (Mahalanobis), and how many of its numbers are
    determined: chi-squared with as many degrees of freedom."""
    known = np.isfinite(np.diagonal(covariance))
    change, covariance = change[known], covariance[np.ix_(known, known)]
    if not change.size:
        return 0.0, 0
    scale = np.sqrt(np.diagonal(covariance))
    scale = np.where(scale > 0, scale, 1)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    # (What rounding leaves of a direction that is exactly known is no error bar.)
    values = np.maximum(values, 1e-12 * values[-1])
    return float(np.sum((vectors.T @ (change / scale)) ** 2 / values)), change.size


def sigma_of(squares: float, count: int) -> float:
    """The probability of chi-squared of this many numbers, as the distance of a normal number from
    its mean; 0 where they tell nothing."""
    from scipy.stats import chi2, norm

    if not (count > 0 and np.isfinite(squares)):
        return 0.0
    log = float(chi2.logsf(squares, count))
    return float(norm.isf(np.exp(log) / 2)) if log > -600 else float(np.sqrt(squares))
