"""What is known of a joint fit's cameras and objects before it: as in `fit_camera`, by their names.

A prior of a number is a residual beside those of the masks, in units in which the masks'
noise is its standard deviation.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from .._camera.camera import Camera
from .._camera.poses import skew
from .._solver.looks import View
from .._solver.moves import Bounds
from .._solver.parameters import LABELS, labels_of
from .._solver.priors import bounds_of, check_positive, pairs, prior_of
from .views import MOTIONS, POSE, SCALE, ZERO, Eye, JointView, State, lens_reported

#: Where an eye or an object is, and what these coordinates are called.
EYE, PLACE = ("e_x", "e_y", "e_z"), ("x", "y", "z")


class JointPrior(NamedTuple):
    """What is known of numbers (k,) that follow one unknown: their means and standard deviations.

    `reported` returns the numbers and how they follow the unknown (k, n), at a state, as any view
    that depends on it sees it.
    """

    name: str
    kind: str
    mean: np.ndarray
    std: np.ndarray
    reported: Callable[[State, Eye, View], tuple[np.ndarray, np.ndarray]]

    def residuals(self, state: State, eye: Eye, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Return how many deviations off the means the numbers are, and how that follows."""
        values, rows = self.reported(state, eye, view)
        return (values - self.mean) / self.std, rows / self.std[:, None]


def priors_of(
    prior: Any,
    cameras: Mapping[str, Camera],
    freed: tuple[str, ...],
    owners: Mapping[str, Mapping[str, str]],
    moving: Mapping[str, str],
    rig: Mapping[str, np.ndarray],
    objects: Sequence[str],
    scales: Sequence[str],
) -> list[JointPrior]:
    """Return what is known of cameras, objects and scales, or raise ValueError; `freed` are free of
    each camera, whose lens's parameters are the `owners`', and which goes with the pose that
    `moving` names, at its place on the `rig`. What is the same of one unknown counts once."""
    result, seen = [], set()
    others = list(dict.fromkeys([*objects, *scales]))
    for name, given in by_name("prior", prior, cameras, others).items():
        if name in others:
            labels = [*(PLACE if name in objects else ()), *([SCALE] if name in scales else ())]
            known = _checked(given, labels)
            result += _prior(name, POSE, known, PLACE, partial(_place, name, np.zeros(3)))
            result += _prior(name, SCALE, known, [SCALE], partial(_scale, name))
            continue
        checked = prior_of(given, cameras[name], freed)
        if checked is None:
            continue
        numbers = (np.asarray(x, float).tolist() for x in (checked.mean, checked.std))
        known = dict(zip(checked.labels, zip(*numbers, strict=True), strict=True))
        place = rig[name][:3, 3] if name in rig else np.zeros(3)
        kind = "position" if "position" in freed else POSE
        follows = partial(_place, moving[name], place)
        result += _prior(moving[name], kind, known, EYE, follows, MOTIONS[kind])
        for row, owner in owners[name].items():
            labels = labels_of((row,))
            which = owner, row, tuple((label, known.get(label)) for label in labels)
            if which not in seen:
                result += _prior(owner, row, known, labels, partial(_lens, owner, row))
            seen.add(which)
    return result


def scales_of(prior: Any, views: Sequence[JointView]) -> dict[str, float]:
    """Return where the scales that views name begin: where a prior has them, or at 1; or raise
    ValueError for a scale that is not positive."""
    result = {}
    for name in dict.fromkeys(view.scale for view in views if view.scale is not None):
        given = prior.get(name) if isinstance(prior, Mapping) else None
        known = given.get(SCALE) if isinstance(given, Mapping) else None
        mean = 1.0 if known is None else _checked({SCALE: known}, [SCALE])[SCALE][0]
        if not mean > 0:
            raise ValueError(f"`prior`: expected a positive scale of {name!r}, got {mean}")
        result[name] = mean
    return result


def _checked(given: Any, labels: list[str]) -> dict[str, tuple[float, float]]:
    """Return means and standard deviations by labels, or raise ValueError."""
    mean, std = pairs("prior", given, labels, "(mean, standard deviation)")
    check_positive(given, std)
    return {label: (float(m), float(s)) for label, m, s in zip(given, mean, std, strict=True)}


def zeros_of(given: Any, views: Sequence[JointView]) -> dict[str, float]:
    """Return how surely the zeros of joints are known (standard deviations), by the names of those
    that are sought; or raise ValueError."""
    if given is None:
        return {}
    units = {
        name: unit
        for view in views
        if view.posture is not None
        for name, unit in zip(view.posture.joints, view.posture.units, strict=True)
    }
    if not units:
        raise ValueError("`joint_zeros`: expected views with a `posture`, got none")
    for k, view in enumerate(views):
        if view.posture is not None and view.mount is not None:
            words = "expected no `mount` beside a `posture`, as joints move it too"
            raise ValueError(f"`joint_zeros`: {words}, got both in views[{k}]")
    if not isinstance(given, Mapping):
        given = {name: given for name, unit in units.items() if unit == "rad"}
    if unknown := [name for name in given if name not in units]:
        known = ", ".join(units)
        raise ValueError(f"`joint_zeros`: expected joints among {known}, got {unknown[0]!r}")
    for name, std in given.items():
        if not (np.ndim(std) == 0 and np.isfinite(std) and std > 0):
            words = f"expected a positive deviation of {name!r}, got {std!r}"
            raise ValueError(f"`joint_zeros`: {words}")
    return {name: float(std) for name, std in given.items()}


def prior_of_zero(name: str, std: float) -> JointPrior:
    """Return that the zero of a joint is about where its readings have it."""
    return JointPrior(name, ZERO, np.zeros(1), np.full(1, std), partial(_zero, name))


def _zero(name: str, state: State, *_: Any):
    return np.array([state.zeros.get(name, 0.0)]), np.eye(1)


def bounds_by_name(
    bounds: Any,
    cameras: Mapping[str, Camera],
    freed: tuple[str, ...],
    owners: Mapping[str, Mapping[str, str]],
) -> dict[str, Bounds | None]:
    """Return the bounds of each camera's parameters, or raise ValueError."""
    given = by_name("bounds", bounds, cameras, ())
    result = {n: bounds_of(given.get(n), camera, freed) for n, camera in cameras.items()}

    def ends(name: str, row: str) -> tuple[float, ...]:
        of = result[name]
        if of is None or row not in of.labels:
            return ()
        k = of.labels.index(row)
        return float(of.low[k]), float(of.high[k])

    for name, of in owners.items():
        for row, owner in of.items():
            if ends(name, row) != ends(owner, row):
                words = f"expected the same of {row} for {owner} and {name}, which share it"
                raise ValueError(f"`bounds`: {words}")
    return result


def by_name(
    argument: str, given: Any, cameras: Mapping[str, Camera], objects: Sequence[str]
) -> dict[str, Any]:
    """Return what is given for each camera and object: by their names, or the same for each camera.

    Raises ValueError for names of neither.
    """
    if not given:
        return {}
    if not (isinstance(given, Mapping) and any(isinstance(x, Mapping) for x in given.values())):
        return dict.fromkeys(cameras, given)
    known = [*cameras, *objects]
    if unknown := [name for name in given if name not in known]:
        raise ValueError(
            f"`{argument}`: expected names among {', '.join(known)}, got {unknown[0]!r}"
        )
    return dict(given)


def _prior(
    name: str,
    kind: str,
    known: Mapping[str, tuple[float, float]],
    labels: Sequence[str],
    reported: Callable[..., tuple[np.ndarray, np.ndarray]],
    part: slice = MOTIONS[POSE],
) -> list[JointPrior]:
    """Return what is known of some of the labels, which `reported` tells by their numbers; or none.
    They follow a `part` of what moves."""
    chosen = [k for k, label in enumerate(labels) if label in known]
    if not chosen:
        return []
    mean, std = np.array([known[labels[k]] for k in chosen]).T
    return [JointPrior(name, kind, mean, std, partial(reported, chosen, part))]


def _place(name: str, point: np.ndarray, chosen: list[int], part: slice, state: State, *_: Any):
    """Return where a point that goes with a pose is."""
    pose = state.poses[name]
    rows = pose[:3, :3] @ np.concatenate([-skew(point), np.eye(3)], axis=1)
    return (pose[:3, :3] @ point + pose[:3, 3])[chosen], rows[chosen, part]


def _scale(name: str, chosen: list[int], part: slice, state: State, *_: Any):
    """Return a scale; its logarithm is what is sought."""
    del chosen, part
    return np.array([state.scales[name]]), np.array([[state.scales[name]]])


def _lens(name: str, kind: str, chosen: list[int], _: slice, state: State, eye: Eye, view: View):
    """Return what is reported of a lens's parameter, in film heights."""
    labels = labels_of((kind,))
    value: Any = [LABELS[labels[k]].value for k in chosen]
    values = np.array([float(of(state.lenses[name])) for of in value])
    return values, lens_reported(view, eye.solver.freed, kind)[chosen]
