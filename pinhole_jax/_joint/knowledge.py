"""Knowledge of cameras, objects and joints before a joint fit: as in `fit_camera`, by their names.

A prior of a number is a residual beside those of the masks, in units in which the masks'
noise is its standard deviation.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from .._camera.camera import Camera
from .._solver.moves import Bounds
from .._solver.parameters import PARAMETERS
from .._solver.priors import bounds_of, check_positive, pairs
from .system import JointPrior, JointProblem, Part
from .views import SCALE, ZERO, JointView, Unknown


def priors_of(prior: Any, problem: JointProblem) -> list[JointPrior]:
    """Priors of cameras, objects and scales: one for each unknown that cameras have in common.

    Raises ValueError for what is no prior of these.
    """
    others = dict.fromkeys([*problem.objects(), *problem.start.scales])
    result = []
    for name, given in by_name("prior", prior, problem.cameras, others).items():
        parts = problem.parts_of(name)
        # (A small turn has no value that could be known.)
        labels = [x for part in parts for x in part.labels if not x.startswith("rotation")]
        mean, std = _checked(given, labels)
        for part in parts:
            known = tuple(label for label in part.labels if label in given)
            which = [[*given].index(label) for label in known]
            result += [JointPrior(part, known, mean[which], std[which])] if known else []
    return [*{str(prior): prior for prior in result}.values()]


def _checked(given: Any, labels: list[str]) -> np.ndarray:
    """Means and standard deviations (2, k) of some labels. Raises ValueError for others."""
    known = pairs("prior", given, labels, "(mean, standard deviation)")
    check_positive(given, known[1])
    return known


def scales_of(prior: Any, views: Sequence[JointView]) -> dict[str, float]:
    """Where the scales that views name begin: at the mean of a prior, or at 1.

    Raises ValueError for a scale that is not positive.
    """
    result = {}
    for name in dict.fromkeys(view.scale for view in views if view.scale is not None):
        given = prior.get(name) if isinstance(prior, Mapping) else None
        known = given.get(SCALE) if isinstance(given, Mapping) else None
        mean = 1.0 if known is None else float(_checked({SCALE: known}, [SCALE])[0, 0])
        if not mean > 0:
            raise ValueError(f"`prior`: expected a positive scale of {name!r}, got {mean}")
        result[name] = mean
    return result


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
    result = []
    for name, std in given.items():
        if name not in units:
            raise ValueError(
                f"`joint_zeros`: expected joints among {', '.join(units)}, got {name!r}"
            )
        if not (np.ndim(std) == 0 and np.isfinite(std) and std > 0):
            words = f"expected a positive deviation of {name!r}, got {std!r}"
            raise ValueError(f"`joint_zeros`: {words}")
        result.append(JointPrior(Part(name, ZERO), (ZERO,), np.zeros(1), np.array([float(std)])))
    return result


def bounds_by_name(
    bounds: Any, cameras: Mapping[str, Camera], unknowns: Sequence[Unknown]
) -> dict[str, Bounds | None]:
    """Bounds of each camera's parameters. Raises ValueError for what is no bound of these, or not
    the same for cameras that share a parameter."""
    given = by_name("bounds", bounds, cameras)
    freed = tuple(dict.fromkeys(u.kind for u in unknowns if u.kind in PARAMETERS))
    result = {n: bounds_of(given.get(n), camera, freed) for n, camera in cameras.items()}
    for owner, row, group in unknowns:
        for name in group:
            ends = ((given.get(n) or {}).get(row, ()) for n in (name, owner))
            if not np.array_equal(*ends):
                words = f"expected the same of {row} for {owner} and {name}, which share it"
                raise ValueError(f"`bounds`: {words}")
    return result


def by_name(
    argument: str, given: Any, cameras: Iterable[str], objects: Iterable[str] = ()
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
