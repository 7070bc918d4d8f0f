"""Knowledge of cameras, objects and joints before a joint fit: as in `fit_camera`, by their names.

A prior of a number is a residual beside those of the masks, in units in which the masks'
noise is its standard deviation.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from .._camera.camera import Camera
from .._camera.poses import Pose, adjoint, inverse
from .._solver.looks import View
from .._solver.moves import Bounds
from .._solver.parameters import LABELS, labels_of
from .._solver.priors import bounds_of, check_positive, pairs
from .views import (
    MOTIONS,
    POSE,
    SCALE,
    TO_B,
    ZERO,
    Eye,
    JointView,
    State,
    lens_reported,
    reported_twist,
)

#: Coordinates of an eye, and of an object.
EYE, PLACE, ORIGIN = ("e_x", "e_y", "e_z"), ("x", "y", "z"), np.zeros(3)
#: The six numbers of an object's pose, as they are reported.
OF_OBJECT = ("rotation_x", "rotation_y", "rotation_z", *PLACE)

#: Means and standard deviations, by labels.
Known = dict[str, tuple[float, ...]]


class Report(NamedTuple):
    """The numbers (p,) by which an unknown is reported: `labels`, `values` (0 for small turns), and
    their derivative (p, n) by the unknown."""

    labels: tuple[str, ...]
    values: np.ndarray
    by_unknown: np.ndarray


def reported(
    state: State, name: str, kind: str, freed: tuple[str, ...], view: View, rig: Pose | None
) -> Report:
    """The report of an unknown.

    A pose is that of a camera fixed to it at `rig`, or of an object (None); parameters of a lens
    (film coordinates in film heights) follow as a `view` with the moves `freed` sees them.
    """
    if kind in MOTIONS:
        labels, axes = (OF_OBJECT, np.eye(3)) if rig is None else (labels_of((kind,)), TO_B)
        rig = np.eye(4) if rig is None else rig
        pose, part = state.poses[name] @ rig, MOTIONS[kind]
        by_twist = reported_twist(pose[:3, :3], axes) @ adjoint(inverse(rig))
        values = np.append(ORIGIN, pose[:3, 3])
        return Report(labels, values[part], by_twist[part, part])
    if kind == SCALE:  # its logarithm is the unknown
        value = np.array([state.scales[name]])
        return Report((SCALE,), value, value[:, None])
    if kind == ZERO:
        return Report((ZERO,), np.array([state.zeros.get(name, 0.0)]), np.eye(1))
    labels = labels_of((kind,))
    known = (value for label in labels if (value := LABELS[label].value) is not None)
    values = [float(value(state.lenses[name])) for value in known]
    return Report(labels, np.array(values), lens_reported(view, freed, kind))


class JointPrior(NamedTuple):
    """Means and standard deviations (k,) of numbers, by their labels, that report one unknown: a
    pose as that of a camera fixed to it at `rig`, or of an object (None)."""

    name: str
    kind: str
    labels: tuple[str, ...]
    mean: np.ndarray
    std: np.ndarray
    rig: Pose | None

    def residuals(self, state: State, eye: Eye, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Deviations from the means, in standard deviations (k,), and their derivative (k, n) by
        the unknown, as a view that depends on it sees it."""
        freed = eye.solver.freed
        found = reported(state, self.name, self.kind, freed, view, self.rig)
        rows = [found.labels.index(label) for label in self.labels]
        off = (found.values[rows] - self.mean) / self.std
        return off, found.by_unknown[rows] / self.std[:, None]


def priors_of(
    prior: Any,
    cameras: Mapping[str, Camera],
    freed: tuple[str, ...],
    eyes: Sequence[Eye],
    objects: Sequence[str],
    scales: Sequence[str],
) -> list[JointPrior]:
    """Priors of cameras, objects and scales: one for each unknown that cameras have in common.

    Raises ValueError for what is no prior of these.
    """
    others = list(dict.fromkeys([*objects, *scales]))

    def parts(name: str) -> Iterator[tuple[str, str, Sequence[str], Pose | None]]:
        """Unknowns by name and kind, the labels that may be known, and where a camera is fixed."""
        if name in others:
            yield from [(name, POSE, PLACE, None)] if name in objects else []
            yield from [(name, SCALE, (SCALE,), None)] if name in scales else []
            return
        eye = next(eye for eye in eyes if eye.shot.camera == name)
        for kind in {POSE, "position"} & {*freed}:
            yield eye.moving, kind, EYE, eye.rig
        for row, owner in eye.owners.items():
            yield owner, row, labels_of((row,)), None

    result: list[JointPrior] = []
    for name, given in by_name("prior", prior, cameras, others).items():
        known = _checked(given, [label for _, _, labels, _ in parts(name) for label in labels])
        for label in (label for label in known if label in LABELS and LABELS[label].unit == "px"):
            known[label] = tuple(x / cameras[name].H for x in known[label])
        for unknown, kind, labels, rig in parts(name):
            result += _prior(unknown, kind, known, labels, rig)
    by_content = {str(prior): prior for prior in result}
    return [*by_content.values()]


def _prior(
    name: str, kind: str, known: Known, labels: Sequence[str], rig: Pose | None = None
) -> list[JointPrior]:
    """The prior of an unknown that reports these labels; none where nothing is known of them."""
    labels = tuple(label for label in labels if label in known)
    if not labels:
        return []
    mean, std = np.array([known[label] for label in labels]).T
    return [JointPrior(name, kind, labels, mean, std, rig)]


def scales_of(prior: Any, views: Sequence[JointView]) -> dict[str, float]:
    """Where the scales that views name begin: at the mean of a prior, or at 1.

    Raises ValueError for a scale that is not positive.
    """
    result = {}
    for name in dict.fromkeys(view.scale for view in views if view.scale is not None):
        given = prior.get(name) if isinstance(prior, Mapping) else None
        known = given.get(SCALE) if isinstance(given, Mapping) else None
        mean = 1.0 if known is None else _checked({SCALE: known}, [SCALE])[SCALE][0]
        if not mean > 0:
            raise ValueError(f"`prior`: expected a positive scale of {name!r}, got {mean}")
        result[name] = mean
    return result


def _checked(given: Any, labels: list[str]) -> Known:
    mean, std = pairs("prior", given, labels, "(mean, standard deviation)")
    check_positive(given, std)
    return {label: (float(m), float(s)) for label, m, s in zip(given, mean, std, strict=True)}


def zeros_of(given: Any, views: Sequence[JointView]) -> list[JointPrior]:
    """Priors of the zeros of joints that are sought: about where their readings have them.

    Raises ValueError for what is no standard deviation of a joint.
    """
    if given is None:
        return []
    units = {}
    for k, view in enumerate(views):
        if view.posture is not None:
            units |= dict(zip(view.posture.joints, view.posture.units, strict=True))
            if view.mount is not None:
                words = "expected no `mount` with a `posture`, as joints move it too"
                raise ValueError(f"`joint_zeros`: {words}, got both in views[{k}]")
    if not units:
        raise ValueError("`joint_zeros`: expected views with a `posture`, got none")
    if not isinstance(given, Mapping):
        given = {name: given for name, unit in units.items() if unit == "rad"}
    if unknown := [name for name in given if name not in units]:
        known = ", ".join(units)
        raise ValueError(f"`joint_zeros`: expected joints among {known}, got {unknown[0]!r}")
    for name, std in given.items():
        if not (np.ndim(std) == 0 and np.isfinite(std) and std > 0):
            words = f"expected a positive deviation of {name!r}, got {std!r}"
            raise ValueError(f"`joint_zeros`: {words}")
    return [_prior(name, ZERO, {ZERO: (0.0, std)}, (ZERO,))[0] for name, std in given.items()]


def bounds_by_name(
    bounds: Any,
    cameras: Mapping[str, Camera],
    freed: tuple[str, ...],
    owners: Mapping[str, Mapping[str, str]],
) -> dict[str, Bounds | None]:
    """Bounds of each camera's parameters. Raises ValueError for what is no bound of these, or not
    the same for cameras that share a parameter."""
    given = by_name("bounds", bounds, cameras, ())
    result = {n: bounds_of(given.get(n), camera, freed) for n, camera in cameras.items()}

    def ends(name: str, row: str) -> tuple[float, ...]:
        own = result[name]
        if own is None or row not in own.labels:
            return ()
        k = own.labels.index(row)
        return float(own.low[k]), float(own.high[k])

    for name, owner_of in owners.items():
        for row, owner in owner_of.items():
            if ends(name, row) != ends(owner, row):
                words = f"expected the same of {row} for {owner} and {name}, which share it"
                raise ValueError(f"`bounds`: {words}")
    return result


def by_name(
    argument: str, given: Any, cameras: Mapping[str, Camera], objects: Sequence[str]
) -> dict[str, Any]:
    """Values for each camera and object: by their names, or the same for each camera.

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
