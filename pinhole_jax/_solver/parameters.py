"""The table of parameters: what a fit may change about a camera, with labels and units.

A row is what `free` may name. All else that depends on a parameter reads it from here: moves,
units, bounds, what views may share, the table of a fit and its words. Another coefficient of a
lens is another field of its model (`distortion`); the rows of coefficients are made of these.

Pose moves are taken about a pivot, the middle of the scene. So turns of the camera around the
object, its shifts and its distance move the outline in ways of their own.
Focal length and distance are logarithmic: no step makes them negative.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from operator import attrgetter
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from .._camera.camera import Camera, principal_point
from .._camera.distortion import COEFFICIENTS, BrownConrady
from .._camera.lens import Lens, check_lens
from .._numerics.arrays import check_known


class Scale(NamedTuple):
    """What a pixel is, where a camera is.

    - `pixel`: the angle (rad) that a pixel takes in the middle of the film; `far`: the same as the
      object's radius has it, seen from where the camera is.
    - `film`: a pixel in film heights.
    - `corner`: the film's corner in focal lengths from the middle.
    - `powers`: the power of the radius that each coefficient of the distortion bends with.
    """

    pixel: Array
    far: Array
    film: Array
    corner: Array
    powers: Mapping[str, int]


class Component(NamedTuple):
    """A component of a move: its name, its words (the parts of a vector share them), the size that
    moves the outline by about a pixel, and whether a rotation vector has it."""

    name: str
    words: str
    size: Callable[[Scale], Array]
    is_turn: bool = False


class Label(NamedTuple):
    """A parameter as it is reported: its name, its unit ("rad", "world", "px" or ""), and its
    value, None for a small turn."""

    name: str
    unit: str
    value: Callable[[Camera], Array] | None = None


class Leaf(NamedTuple):
    """A number of the camera that a move sets, and what a step (k,) makes of it."""

    of: Callable[[Camera], Array]
    moved: Callable[[Array, Array], Array]


class Parameter(NamedTuple):
    """A row of the table: what `free` may name.

    - `components`: of a move, that it frees.
    - `labels`: under which it is reported.
    - `leaves`: what it sets; none for a pose, which moves rigidly.
    - `bounded`, `shared`: whether it may have bounds, and whether views may share it.
    """

    name: str
    components: tuple[Component, ...]
    labels: tuple[Label, ...]
    leaves: tuple[Leaf, ...] = ()
    bounded: bool = False
    shared: bool = False


def _added(value: Array, step: Array) -> Array:
    return value + (step if value.ndim else step[0])


def _stretched(value: Array, step: Array) -> Array:
    return value * jnp.exp(step[0])


def _narrowed(phi: Array, step: Array) -> Array:
    return 2 * jnp.arctan(jnp.tan(phi / 2) / jnp.exp(step[0]))


PIXEL, FAR_PIXEL, FILM_PIXEL = map(attrgetter, ("pixel", "far", "film"))
AXES = ("b1", "b2", "v")
TURNS = tuple(Component(f"turn_{b}", "rotation", FAR_PIXEL, is_turn=True) for b in AXES)
SPINS = tuple(
    Component(f"spin_{b}", "the camera's turn", size, is_turn=True)
    for b, size in zip(AXES, (PIXEL, PIXEL, FAR_PIXEL), strict=True)
)
PLACE = (
    *(Component(f"shift_{b}", "the sideways shift", PIXEL) for b in AXES[:2]),
    Component("log_distance", "the distance", FAR_PIXEL),
)
FOCAL = Component("log_focal", "the focal length", FAR_PIXEL)

ROTATION = tuple(Label(f"rotation_{b}", "rad") for b in AXES)
EYE = tuple(Label(f"e_{x}", "world", lambda c, k=k: c.e[k]) for k, x in enumerate("xyz"))
D, PHI, ASPECT, PRINCIPAL_POINT = map(
    attrgetter, ("d", "phi", "lens.aspect", "lens.principal_point")
)


def _number(
    name: str,
    component: Component,
    unit: str,
    value: Callable[[Camera], Array],
    moved: Callable[[Array, Array], Array],
) -> Parameter:
    return Parameter(
        name, (component,), (Label(name, unit, value),), (Leaf(value, moved),), True, True
    )


def _coefficient(name: str) -> Parameter:
    size = lambda scale: scale.pixel / scale.corner ** scale.powers[name]
    value = attrgetter(f"lens.distortion.{name}")
    return _number(name, Component(name, name, size), "", value, _added)


TABLE = (
    Parameter("pose", (*TURNS, *PLACE), (*ROTATION, *EYE)),
    Parameter("position", PLACE, EYE),
    Parameter("orientation", SPINS, ROTATION),
    _number("phi", FOCAL, "rad", PHI, _narrowed),
    Parameter(
        "d",
        (FOCAL,),
        (Label("d", "world", D),),
        (Leaf(D, _stretched), Leaf(PHI, _narrowed)),
        shared=True,
    ),
    Parameter(
        "principal_point",
        tuple(Component(f"principal_{x}", f"the principal point's {x}", FILM_PIXEL) for x in "xy"),
        tuple(
            Label(f"principal_{x}", "px", lambda c, k=k: PRINCIPAL_POINT(c)[k])
            for k, x in enumerate("xy")
        ),
        (Leaf(PRINCIPAL_POINT, _added),),
        shared=True,
    ),
    _number(
        "aspect", Component("log_aspect", "the pixel aspect", FAR_PIXEL), "", ASPECT, _stretched
    ),
    *map(_coefficient, COEFFICIENTS),
)

PARAMETERS = {row.name: row for row in TABLE}
LABELS = {label.name: label for row in TABLE for label in row.labels}
COMPONENTS = {component.name: component for row in TABLE for component in row.components}

#: All that `free` may name.
NAMES = (*PARAMETERS, "distortion")


def as_names(names: Any, argument: str = "free") -> tuple[str, ...]:
    """Return names as a tuple; a text holds one, or several with commas between."""
    if isinstance(names, str):
        names = [name.strip() for name in names.split(",") if name.strip()]
    if not isinstance(names, Iterable):
        words = f"names like 'pose', or several: 'pose,phi' or ('pose', 'phi'), got {names!r}"
        raise ValueError(f"`{argument}`: expected {words}")
    return tuple(names)


def focal_is_free(free: Sequence[str]) -> bool:
    """True if the focal length is fitted, under either of its names."""
    return not {"phi", "d"}.isdisjoint(free)


def check_free(
    free: str | Sequence[str],
    camera: Camera | None = None,
    lens: Lens | None = None,
    argument: str = "free",
) -> tuple[str, ...]:
    """Return an argument's names in a fixed order, or raise ValueError for unknown or conflicting
    ones.

    The coefficients are those of the camera's distortion (or, without one, the lens's); where there
    is none, of a `BrownConrady`.
    """
    check_lens(lens)
    lens = lens if camera is None else camera.lens
    model = BrownConrady if lens is None or lens.distortion is None else type(lens.distortion)
    own = [field.name for field in fields(model)]
    names = as_names(free, argument)
    freed = tuple(n for name in names for n in (own if name == "distortion" else [name]))
    check_known(argument, freed, NAMES)
    for name in freed:
        if name in COEFFICIENTS and name not in own:
            raise ValueError(
                f"`{argument}`: expected coefficients of a {model.__name__} ({', '.join(own)}),"
                f" got {name!r}"
            )
    if not freed:
        raise ValueError(f"`{argument}`: expected at least one of {', '.join(NAMES)}, got none")
    if {"phi", "d"} <= set(freed):
        raise ValueError(f"`{argument}`: expected phi or d (both set the focal length), got both")
    if "pose" in freed and {"position", "orientation"} & set(freed):
        raise ValueError(f"`{argument}`: expected pose, or position or orientation, got both")
    return tuple(name for name in PARAMETERS if name in freed)


def in_one(freed: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names with the pose in place of position and orientation, where both are free."""
    both = {"position", "orientation"}
    if not both <= {*freed}:
        return freed
    return ("pose", *(name for name in freed if name not in both))


def with_lens(camera: Camera, freed: tuple[str, ...]) -> Camera:
    """Return the camera with what these names need: a lens, a distortion (that bends nothing)."""
    lens, distorted = camera.lens, not set(COEFFICIENTS).isdisjoint(freed)
    if lens is None and (distorted or {"principal_point", "aspect"} & {*freed}):
        lens = Lens(principal_point(camera))
    if lens is not None and lens.distortion is None and distorted:
        lens = Lens(lens.principal_point, lens.aspect, BrownConrady())
    return camera if lens is camera.lens else camera.replace(lens=lens)


def labels_of(freed: tuple[str, ...]) -> tuple[str, ...]:
    """Return the reported parameters of the names that are free."""
    return tuple(label.name for name in freed for label in PARAMETERS[name].labels)


def components(free: tuple[str, ...]) -> list[str]:
    """Return the components of a move that these names free."""
    return [component.name for name in free for component in PARAMETERS[name].components]
