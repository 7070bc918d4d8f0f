"""What is known of a camera before it is fitted, as users say it: priors and bounds."""

import functools
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.camera import Camera
from .._numerics.arrays import ArrayLike
from .moves import Bounds, reported
from .parameters import LABELS, PARAMETERS, labels_of

#: What a parameter is known by: mean and standard deviation, or low and high.
Pair = tuple[ArrayLike, ArrayLike]


class Prior(eqx.Module):
    """What is known of reported parameters beforehand (canonical units), and a residual's noise."""

    labels: tuple[str, ...] = eqx.field(static=True)
    mean: Float[Array, "k"]
    std: Float[Array, "k"]
    noise: Float[Array, ""]

    def residuals(self, camera: Camera, free: tuple[str, ...]) -> Float[Array, "k"]:
        """The parameters' distances from their means, in units in which noise is a residual's."""
        known = labels_of(free)
        values = reported(camera, camera, free)
        off = jnp.stack([values[known.index(label)] for label in self.labels]) - self.mean
        return off * (self.noise / self.std)


class OtherViews(eqx.Module):
    """What other views know of reported parameters (n,): residuals that are linear in these."""

    rows: Float[Array, "n n"]
    at: Float[Array, "n"]
    left: Float[Array, "n"]

    def residuals(self, values: Float[Array, "n"]) -> Float[Array, "n"]:
        """The residuals of the other views' knowledge at the parameters' values."""
        return self.rows @ (values - self.at) + self.left


@functools.lru_cache  # (asked for at each new weight image)
def no_others(free: tuple[str, ...], dtype: Any) -> OtherViews:
    """An empty `OtherViews`."""
    n = len(labels_of(free))
    return OtherViews(*(jnp.asarray(np.zeros(shape, dtype), dtype) for shape in ((n, n), n, n)))


def prior_of(
    prior: Mapping[str, Any] | None,
    base: Camera,
    freed: tuple[str, ...],
    common: tuple[str, ...] = (),
    views: int = 1,
) -> Prior | None:
    """Return the prior in film heights, or raise ValueError.

    Each of the views that share what is `common` gets its part of that knowledge.
    """
    if not prior:
        return None
    labels = [x for x in labels_of(freed) if LABELS[x].value is not None]
    mean, std = pairs("prior", prior, labels, "(mean, standard deviation)")
    check_positive(prior, std)
    unit = np.array([base.H if LABELS[label].unit == "px" else 1 for label in prior])
    parts = np.array([views if label in labels_of(common) else 1 for label in prior])
    to = lambda x: jnp.asarray(x, base.e.dtype)
    return Prior(tuple(prior), to(mean / unit), to(std / unit * np.sqrt(parts)), to(0.1))


def bounds_of(
    bounds: Mapping[str, Any] | None, base: Camera, freed: tuple[str, ...]
) -> Bounds | None:
    """Return the bounds, or raise ValueError."""
    if not bounds:
        return None
    labels = [name for name in freed if PARAMETERS[name].bounded]
    low, high = pairs("bounds", bounds, labels, "(low, high)")
    for label, a, b in zip(bounds, low, high, strict=True):
        if not a < b:
            raise ValueError(f"`bounds`: expected low < high of {label!r}, got ({a}, {b})")
    return Bounds(tuple(bounds), *(jnp.asarray(x, base.e.dtype) for x in (low, high)))


def check_positive(given: Mapping[str, Any], std: np.ndarray) -> None:
    """Raise ValueError unless the standard deviations of a prior are positive."""
    for label, value in zip(given, std, strict=True):
        if not value > 0:
            raise ValueError(f"`prior`: expected a positive deviation of {label!r}, got {value}")


def pairs(name: str, given: Any, known: list[str], words: str) -> np.ndarray:
    """Return the pairs (2, k) that free parameters are given, or raise ValueError."""
    if not isinstance(given, Mapping):
        raise ValueError(
            f"`{name}`: expected a dict of names and their {words}, got {type(given).__name__}"
        )
    for label, pair in given.items():
        if label not in known:
            raise ValueError(
                f"`{name}`: expected free parameters among {', '.join(known)}, got {label!r}"
            )
        if np.shape(pair) != (2,) or not np.all(np.isfinite(np.asarray(pair, float))):
            raise ValueError(f"`{name}`: expected {words} of {label!r}, got {pair!r}")
    return np.array([*given.values()], float).T
