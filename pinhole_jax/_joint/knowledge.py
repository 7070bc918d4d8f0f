"""Knowledge of cameras, objects and joints before a joint fit: as in `fit_camera`, by their names.

A prior of a number is a residual beside those of the masks, in units in which the masks'
noise is its standard deviation.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from .._camera.camera import Camera
from .._camera.poses import skew
from .._solver.looks import View
from .._solver.moves import Bounds
from .._solver.parameters import LABELS, labels_of
from .._solver.priors import bounds_of, check_positive, pairs
from .views import MOTIONS, POSE, SCALE, ZERO, Eye, JointView, State, lens_reported

#: Coordinates of an eye, and of an object.
EYE, PLACE, ORIGIN = ("e_x", "e_y", "e_z"), ("x", "y", "z"), np.zeros(3)

#: Means and standard deviations, by labels.
Known = dict[str, tuple[float, float]]


class JointPrior(NamedTuple):
    """Means and standard deviations (k,) of numbers that follow one unknown: these `rows` of all
    that it reports. A pose reports the place of a `point` in its frame."""

    name: str
    kind: str
    rows: list[int]
    mean: np.ndarray
    std: np.ndarray
    point: np.ndarray

    def residuals(self, state: State, eye: Eye, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Deviations from the means, in standard deviations (k,), and their derivative (k, n) by
        the unknown, as a view that depends on it sees it."""
        values, by_unknown = self._reported(state, eye, view)
        off = (values[self.rows] - self.mean) / self.std
        return off, by_unknown[self.rows] / self.std[:, None]

    def _reported(self, state: State, eye: Eye, view: View) -> tuple[np.ndarray, np.ndarray]:
        if self.kind in MOTIONS:
            rotation, shift = state.poses[self.name][:3, :3], state.poses[self.name][:3, 3]
            by_twist = rotation @ np.concatenate([-skew(self.point), np.eye(3)], axis=1)
            return rotation @ self.point + shift, by_twist[:, MOTIONS[self.kind]]
        if self.kind == SCALE:
            value = np.array([state.scales[self.name]])  # whose logarithm is sought
            return value, value[:, None]
        if self.kind == ZERO:
            return np.array([state.zeros.get(self.name, 0.0)]), np.eye(1)
        labels = (LABELS[label].value for label in labels_of((self.kind,)))
        values = [float(value(state.lenses[self.name])) for value in labels if value is not None]
        return np.array(values), lens_reported(view, eye.solver.freed, self.kind)


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

    def parts(name: str) -> Iterator[tuple[str, str, Sequence[str], np.ndarray]]:
        """Unknowns by name and kind, the numbers that they report, and the point of a pose."""
        if name in others:
            yield from [(name, POSE, PLACE, ORIGIN)] if name in objects else []
            yield from [(name, SCALE, (SCALE,), ORIGIN)] if name in scales else []
            return
        eye = next(eye for eye in eyes if eye.shot.camera == name)
        for kind in {POSE, "position"} & {*freed}:
            yield eye.moving, kind, EYE, eye.rig[:3, 3]
        for row, owner in eye.owners.items():
            yield owner, row, labels_of((row,)), ORIGIN

    result: list[JointPrior] = []
    for name, given in by_name("prior", prior, cameras, others).items():
        known = _checked(given, [label for _, _, labels, _ in parts(name) for label in labels])
        for label in (label for label in known if label in LABELS and LABELS[label].unit == "px"):
            known[label] = tuple(x / cameras[name].H for x in known[label])
        for unknown, kind, labels, point in parts(name):
            result += _prior(unknown, kind, known, labels, point)
    by_content = {str(prior): prior for prior in result}
    return [*by_content.values()]


def _prior(
    name: str, kind: str, known: Known, labels: Sequence[str], point: np.ndarray = ORIGIN
) -> list[JointPrior]:
    """The prior of an unknown that reports these labels; none where nothing is known of them."""
    rows = [k for k, label in enumerate(labels) if label in known]
    if not rows:
        return []
    mean, std = np.array([known[labels[k]] for k in rows]).T
    return [JointPrior(name, kind, rows, mean, std, point)]


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
                words = "expected no `mount` beside a `posture`, as joints move it too"
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
