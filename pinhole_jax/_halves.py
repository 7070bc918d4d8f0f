"""Two fits, each to half of the data: do they differ by no more than their error bars say?

Real data have no truth to compare with. Two halves that err independently have each other: their
difference has the sum of their covariances, so in standard errors it is about 1 (rms) where error
bars hold. What both halves have in common does not show: a wrong mesh, a wrong lens, a mask that is
too large all the way round.

Poses are compared in the frame of who looks: the scene before the camera, an object in the world.
There a turn of some degrees is nearly linear, about the point whose place is known best.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float

from ._camera.axes import skew
from ._camera.poses import Pose, adjoint, inverse, moved, pose_of
from ._fit.drift import POSE, squared_sigmas
from ._fit.result import CameraResult, MaskError, Result
from ._fit.words import UNIT
from ._joint.joint_fit import JointFit, ObjectFit
from ._joint.views import TO_B
from ._mask.target import check_target, inside_of
from ._numerics.arrays import ArrayLike, Input, check_kind
from ._solver.heading import carried
from ._solver.parameters import LABELS

Half = TypeVar("Half")
#: What a refit returns: a fit of one camera, of one problem, or of views that share parameters.
AnyFit = CameraResult | JointFit | Sequence[CameraResult]

MOTION = ("turn_x", "turn_y", "turn_z", "x", "y", "z")
#: Halves of right error bars differ by more in one of a hundred cases.
CHANCE = 0.01
#: Halves of these statuses are not compared: their error bars say nothing.
LOST = {"max_steps", "no_overlap", "misfit", "non_finite", "behind"}
#: An outline is cut into as many blocks at least, and at most; each is this many times as long as
#: the mask's errors reach, so that neighbours are nearly independent.
LEAST_BLOCKS, MOST_BLOCKS, REACHES = 6, 16, 3.0
#: Errors of masks reach this far (px), where no fit says how far.
REACH_PX = 16.0


class SplitPart(NamedTuple):
    """The difference of two halves in one thing: a camera, an object, or what views share.

    - `name`: the camera's or the object's; "shared" for what views have in common.
    - `names` (n,): what is compared, in the order of `difference` (n,) and `covariance` (n, n), the
      sum of both halves': turns (rad) and places (world units) that a camera sees, by the
      camera's axes right, down, forward, or of an object by the world's; then parameters as `Fit`
      names them.
    - `angle` (rad), `shift` (world units): how far the pose turned and moved, at the point whose
      place the halves know best, about the object's middle; NaN where no pose is compared.

    ```python
    part = check.parts[0]
    print(np.rad2deg(part.angle), dict(zip(part.names, part.sigmas)))
    ```
    """

    name: str
    names: tuple[str, ...]
    difference: Float[np.ndarray, "n"]
    covariance: Float[np.ndarray, "n n"]
    angle: float
    shift: float

    @property
    def sigmas(self) -> Float[np.ndarray, "n"]:
        """Each difference in its own standard errors."""
        return self.difference / np.sqrt(np.diag(self.covariance))

    def __str__(self) -> str:
        """Return it as a table."""
        lines = [
            f"{self.name}: {np.rad2deg(self.angle):.2g} degrees, {self.shift:.2g} {UNIT} apart"
        ]
        if np.isnan(self.angle):
            lines = [f"{self.name}:"]
        for name, value, sigma in zip(self.names, self.difference, self.sigmas, strict=True):
            turns = name in MOTION[:3] or (name in LABELS and LABELS[name].unit == "rad")
            shown, unit = (np.rad2deg(value), " degrees") if turns else (value, "")
            lines.append(f"  {name:<12}{shown:>+10.2g}{unit:<8}  {sigma:+.1f} sigma")
        return "\n".join(lines)


class SplitCheck(NamedTuple):
    """The disagreement of two fits, each to half of the data: are the error bars right?

    - `rms`: the difference in standard errors, root mean square over parameters that count once
      where they go together (Mahalanobis). About 1 where error bars hold; 2: they are half as wide
      as they should be. NaN where the halves determine nothing.
    - `chance`: how often halves differ by more, if error bars are right.
    - `parameters`: how many were compared; with 6 an rms of up to 1.45 is usual.
    - `parts`: camera by camera, object by object.
    - `halves`: the two fits.

    A fit to all of the data errs by about half of the difference. Errors that both halves have in
    common do not show. Where a half has other cameras that explain it as well (`modes`), those of
    the two halves that are nearest to each other are compared.

    ```python
    check.rms, check.agrees, check.parts[0].shift
    ```
    """

    rms: float
    chance: float
    parameters: int
    parts: tuple[SplitPart, ...]
    halves: tuple[AnyFit, AnyFit]

    @property
    def statuses(self) -> tuple[str, ...]:
        """The halves' statuses; of separate cameras all of them."""
        views = ([half] if isinstance(half, Result) else half for half in self.halves)
        return tuple(view.status for each in views for view in each)

    @property
    def is_conclusive(self) -> bool:
        """True if both halves were found, well enough to compare something."""
        return bool(self.parameters) and not {*self.statuses} & LOST

    @property
    def agrees(self) -> bool:
        """True unless the halves differ by more than error bars that are right allow."""
        return not self.chance <= CHANCE

    def __str__(self) -> str:
        """Return it as a table, its verdict first."""
        if not self.is_conclusive:
            why = ", ".join(self.statuses)
            return f"cannot tell: the halves do not both determine a camera (they are {why})"
        verdict = "the error bars hold" if self.agrees else "THE ERROR BARS ARE TOO NARROW"
        words = (
            f"{self.rms:.2g} sigma apart (rms of {self.parameters} parameters; about 1 is right)"
        )
        lines = [f"{verdict}: the halves are {words}", *map(str, self.parts)]
        if {"converged"} != {*self.statuses}:
            lines.append(f"statuses of the halves: {', '.join(self.statuses)}")
        return "\n".join(lines)


def split_check(refit: Callable[[Half], AnyFit], halves: tuple[Half, Half]) -> SplitCheck:
    """The disagreement of two fits, each to half of the data, in standard errors, mm and degrees.

    - `refit`: makes a fit from a half: a function of it that calls `fit_camera`, `fit_joint`,
      `fit_cameras` or `fit_points`. Let it start from the fit to all of the data.
    - `halves`: what it is called with. Of many views, every other one: `(views[::2], views[1::2])`;
      of one mask two weights, as `outline_halves` makes them. Each half alone has to determine what
      is asked.

    Of separate cameras that share parameters (`fit_cameras`, several views of `fit_points`) the
    shared ones are compared: those with one value in all views of a half.

    Raises ValueError for halves that have nothing in common to compare.

    ```python
    halves = pj.outline_halves(mask, fit.mask_error)
    check = pj.split_check(lambda w: pj.fit_camera(scene, mask, fit.camera, weight=w), halves)
    print(check)
    ```
    """
    check_kind("refit", refit, Callable, "a function that makes a fit from a half")
    first, second = map(refit, halves)
    check_kind("refit", first, Result | Sequence, "it to return a fit")
    checks = [_compared(a, b) for a in _rivals(first) for b in _rivals(second)]
    best = min(checks, key=lambda check: (not check.parameters, check.rms))
    if not any(part.names for part in best.parts):
        words = "expected fits with a camera, an object or a parameter in common, got none"
        raise ValueError(f"`refit`: {words}")
    return best


def outline_halves(
    target: Input[ArrayLike, "H W"],
    mask_error: MaskError | None = None,
    weight: Input[ArrayLike | None, "H W"] = None,
) -> tuple[Float[np.ndarray, "H W"], Float[np.ndarray, "H W"]]:
    """Two weights (H, W) that share out a mask's outline, block by block about its middle.

    All 6 to 16 blocks have the same length. Each half goes all the way round, so that it determines
    what the whole outline does, less well.

    - `target`: a mask as in `fit_camera`; `weight`: what its pixels count, shared out as well.
    - `mask_error`: of a fit to it. Blocks are three times as long as errors reach, where the
      outline allows, so that the halves err independently. None: errors reach over 16 px.

    Raises ValueError for a mask that `fit_camera` refuses.

    ```python
    odd, even = pj.outline_halves(mask, fit.mask_error)
    ```
    """
    from scipy.ndimage import binary_erosion

    H, W = np.shape(target) if np.ndim(target) == 2 else (0, 0)
    image, weights = check_target(target, weight, W, H)
    inside = inside_of(image)
    edge = inside & (weights > 0) & np.logical_not(binary_erosion(inside, border_value=1))
    middle = np.mean(np.nonzero(edge), axis=1)
    row, column = np.indices((H, W))
    around = np.arctan2(row - middle[0], column - middle[1])
    reach = mask_error.over_px if mask_error is not None and mask_error.over_px else REACH_PX
    pairs = np.sum(edge) / (2 * REACHES * reach)
    blocks = 2 * int(np.clip(pairs, LEAST_BLOCKS // 2, MOST_BLOCKS // 2))
    ends = np.quantile(around[edge], np.arange(1, blocks) / blocks)
    odd = np.searchsorted(ends, around) % 2 == 1
    return np.where(odd, weights, 0.0), np.where(odd, 0.0, weights)


def _rivals(fit: AnyFit) -> Sequence[AnyFit]:
    """A fit and its modes, which explain its half as well: any of them may be the other's."""
    return (fit, *fit.modes) if isinstance(fit, Result) else (fit,)


def _compared(first: AnyFit, second: AnyFit) -> SplitCheck:
    """The disagreement of two fits."""
    from scipy.stats import chi2

    a, b = _answers(first), _answers(second)
    parts = tuple(_part(name, a[name], b[name]) for name in a if name in b)
    known = (squared_sigmas(part.difference, part.covariance) for part in parts)
    total, count = map(sum, zip((0.0, 0), *known, strict=True))
    rms = (total / count) ** 0.5 if count else float("nan")
    return SplitCheck(rms, float(chi2.sf(total, count)), count, parts, (first, second))


class _HalfAnswer(NamedTuple):
    """A half's answer: the pose (4, 4) that a viewer sees, in its frame, if any; other
    values (k,); names, and their covariance, first of the pose's twist in the viewer's frame."""

    pose: Pose | None
    values: np.ndarray
    names: tuple[str, ...]
    covariance: np.ndarray


def _answers(fit: AnyFit) -> Mapping[str, _HalfAnswer]:
    """The answers of a fit, by the names of its cameras and objects."""
    if isinstance(fit, CameraResult):
        return {"camera": _camera_answer(fit)}
    if not isinstance(fit, JointFit):
        return {"shared": _shared_answer(fit)}
    found = {name: _camera_answer(camera) for name, camera in fit.cameras.items() if camera.names}
    found |= {name: _object_answer(placed) for name, placed in fit.objects.items()}
    if (zeros := fit.joint_zeros) is not None:
        found["joint zeros"] = _HalfAnswer(None, zeros.values, zeros.names, zeros.covariance)
    return found


def _camera_answer(fit: CameraResult) -> _HalfAnswer:
    """The scene's pose before a camera, and the camera's other parameters."""
    others = [k for k, name in enumerate(fit.names) if name not in POSE]
    values = np.array(
        [float(value(fit.camera)) for k in others if (value := LABELS[fit.names[k]].value)]
    )
    names, covariance = tuple(fit.names[k] for k in others), np.asarray(fit.covariance, float)
    if fit.names[: len(POSE)] != POSE:
        return _HalfAnswer(None, values, names, covariance[np.ix_(others, others)])
    pose = inverse(pose_of(fit.camera))
    # A turn about right, up, forward moves what is seen the other way, about right, down, forward.
    by_reported = np.eye(len(fit.names))
    by_reported[:3, :3], by_reported[3:6, 3:6] = -TO_B, -pose[:3, :3]
    return _HalfAnswer(pose, values, (*MOTION, *names), carried(covariance, by_reported))


def _object_answer(placed: ObjectFit) -> _HalfAnswer:
    """An object's pose in the world."""
    by_reported = np.eye(6)
    by_reported[:, :3] = adjoint(placed.pose)[:, :3]
    return _HalfAnswer(placed.pose, np.zeros(0), MOTION, carried(placed.covariance, by_reported))


def _shared_answer(fits: Sequence[CameraResult]) -> _HalfAnswer:
    """What separate cameras have in common: parameters of one value in all of them."""
    answers = [_camera_answer(fit) for fit in fits]
    first, values = answers[0], np.array([answer.values for answer in answers])
    place = np.flatnonzero(np.all(values == values[:1], axis=0)) - values.shape[1]  # from the end
    names = tuple(first.names[k] for k in place)
    return _HalfAnswer(None, values[0, place], names, first.covariance[np.ix_(place, place)])


def _part(name: str, a: _HalfAnswer, b: _HalfAnswer) -> SplitPart:
    """The difference of two answers about the same thing."""
    if a.names != b.names:
        words = f"expected fits of the same parameters, got {a.names} and {b.names}"
        raise ValueError(f"`refit`: {words}")
    difference, covariance = a.values - b.values, a.covariance + b.covariance
    if a.pose is None or b.pose is None:
        return SplitPart(name, a.names, difference, covariance, np.nan, np.nan)
    from scipy.spatial.transform import Rotation

    point, about_point = _known_best(covariance[:6, :6], b.pose[:3, 3]), np.eye(len(a.names))
    about_point[3:6, :3] = -skew(point)
    of_body = moved(inverse(b.pose), point)
    turn = Rotation.from_matrix(a.pose[:3, :3] @ b.pose[:3, :3].T).as_rotvec()
    shift = moved(a.pose, of_body) - moved(b.pose, of_body)
    difference = np.concatenate([turn, shift, difference])
    angle, distance = (float(np.linalg.norm(x)) for x in (turn, shift))
    return SplitPart(name, a.names, difference, carried(covariance, about_point), angle, distance)


def _known_best(covariance: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """The point (3,) that a twist of this covariance (6, 6) moves least; another one where the
    twist is not determined."""
    if not np.all(np.isfinite(covariance)):
        return otherwise
    # The variance of turn x r + shift is least where its derivative by r is 0.
    turns, across = covariance[:3, :3], covariance[:3, 3:]
    curl = np.array([across[1, 2] - across[2, 1], across[2, 0] - across[0, 2],
                     across[0, 1] - across[1, 0]])  # fmt: skip
    return np.linalg.lstsq(np.trace(turns) * np.eye(3) - turns, curl, rcond=None)[0]
