"""A camera's axes in NumPy, in float64: no program is compiled for them."""

from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from .camera import Camera

T = TypeVar("T")


def axes_of(camera: Camera) -> Float[np.ndarray, "3 3"]:
    """Return the camera's axes as rows: right, up, forward."""
    e, p, u = (np.asarray(x, float) for x in (camera.e, camera.p, camera.u))
    v = (p - e) / np.linalg.norm(p - e)
    b1 = skew(v) @ u  # np.cross takes fifty times as long
    b1 /= np.linalg.norm(b1)
    return np.array([b1, skew(b1) @ v, v])


def skew(vector: np.ndarray) -> np.ndarray:
    """Return the matrix (3, 3) of a cross product with a vector."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def angle(a: Camera, b: Camera) -> float:
    """Return the angle between two cameras' orientations (rad)."""
    return float(angles(axes_of(a), axes_of(b)[None])[0])


def angles(axes: Float[np.ndarray, "3 3"], others: Float[np.ndarray, "n 3 3"]) -> np.ndarray:
    """Return the angles (n,) between axes and others (rad)."""
    chord = np.sqrt(np.sum((others - axes) ** 2, axis=(1, 2)) / 8)
    return 2 * np.arcsin(np.minimum(chord, 1))


def distinct(
    places: Iterable[T],
    apart: float,
    camera: Callable[[T], Any] = lambda place: place,
    tried: list[np.ndarray] | None = None,
) -> Iterator[T]:
    """Places, or cameras, that look other ways than all before, by more than an angle (rad), and
    than those `tried` before, whose axes they join."""
    before = [] if tried is None else tried
    for place in places:
        axes = axes_of(camera(place))
        if not np.any(angles(axes, np.reshape(before, (-1, 3, 3))) <= apart):
            before.append(axes)
            yield place


def one_of_each(places: Iterable[T], is_one: Callable[[T, T], bool]) -> Iterator[T]:
    """Places that are not one with any before, asked as (before, place)."""
    kept: list[T] = []
    for place in places:
        if not any(is_one(before, place) for before in kept):
            kept.append(place)
            yield place


def sphere_points(number: int) -> np.ndarray:
    """Unit vectors (number, 3), spread evenly over the sphere (Fibonacci's spiral)."""
    k = np.arange(number) + 0.5
    z = 1 - 2 * k / number
    angle = np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z * z)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle), z])
