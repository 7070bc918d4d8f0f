"""What is known of a camera before it is fitted, as users say it: priors and bounds."""

import functools
from collections.abc import Iterable, Mapping
from dataclasses import KW_ONLY
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.camera import Camera
from .._numerics.arrays import ArrayLike, check_kind, check_known, check_positive, is_number
from .._rules import RULES
from .moves import Bounds
from .parameters import LABELS, PARAMETERS, labels_of

#: What a parameter is known by: mean and standard deviation, or low and high.
Pair = tuple[ArrayLike, ArrayLike]
#: Between which values parameters make a camera, where not all do.
VALID = {"phi": (0.0, np.pi), "aspect": (0.0, np.inf)}
#: What is known beside a prior is nothing if that says all but this share.
NOTHING_ELSE = 1e-4


class Prior(eqx.Module):
    """What is known of reported parameters (n,) beforehand, or by other views: residuals that are
    linear in these; whether they are in standard deviations, or count as the mask's do."""

    rows: Float[Array, "n n"]
    at: Float[Array, "n"]
    left: Float[Array, "n"]
    _: KW_ONLY
    in_sigmas: bool = eqx.field(static=True, default=False)

    def residuals(self, values: Float[Array, "n"]) -> Float[Array, "n"]:
        """The residuals at the parameters' values."""
        return self.rows @ (values - self.at) + self.left

    def times(self, noise: np.ndarray) -> "Prior":
        """The same, as residuals of a mask that errs by a noise."""
        return Prior(self.rows * noise, self.at, self.left * noise)


@functools.lru_cache  # (asked for at each new weight image)
def no_prior(free: tuple[str, ...], dtype: Any) -> Prior:
    """A `Prior` that knows nothing."""
    n = len(labels_of(free))
    return Prior(*(jnp.asarray(np.zeros(shape, dtype), dtype) for shape in ((n, n), n, n)))


def prior_of(prior: Mapping[str, Any] | None, base: Camera, freed: tuple[str, ...]) -> Prior | None:
    """Return the prior in film heights, its residuals in standard deviations, or raise
    ValueError."""
    if not prior:
        return None
    labels = labels_of(freed)
    known = [label for label in labels if LABELS[label].value is not None]
    mean, std = measured(prior, known)
    place = [labels.index(label) for label in prior]
    unit = np.array([base.H if LABELS[label].unit == "px" else 1 for label in prior])
    size, at = np.zeros((2, len(labels)))
    size[place], at[place] = unit / std, mean / unit
    to = lambda x: jnp.asarray(x, base.e.dtype)
    return Prior(to(np.diag(size)), to(at), to(0 * at), in_sigmas=True)


def contradictions(
    labels: Iterable[str], off: np.ndarray, known: np.ndarray, by: str
) -> tuple[str, ...]:
    """A sentence on each prior that lies too far from what else is known `by` the mask, say.

    Parameters end `off` (k,) standard deviations from their means, and have this share `known` (k,)
    of their priors' variances. Without these they would be off by N(0, 1 / (1 - known)) times that.
    """
    apart = np.abs(off) / np.sqrt(np.maximum(1 - known, NOTHING_ELSE))
    return tuple(
        f"the prior of {label} is {far:.0f} standard deviations from what {by}: one is wrong"
        for label, far in zip(labels, apart, strict=True)
        if far > RULES.times
    )


def bounds_of(
    bounds: Mapping[str, Any] | None, base: Camera, freed: tuple[str, ...]
) -> Bounds | None:
    """Return the bounds, or raise ValueError."""
    if not bounds:
        return None
    labels = [name for name in freed if PARAMETERS[name].bounded]
    low, high = pairs("bounds", bounds, labels, "(low, high)")
    for label, a, b in zip(bounds, low, high, strict=True):
        least, most = VALID.get(label, (-np.inf, np.inf))
        if not least <= a < b <= most:
            within = f" within {least:g} to {most:g}" if label in VALID else ""
            words = f"expected low < high of {label!r}{within}"
            raise ValueError(f"`bounds`: {words}, got ({a}, {b})")
    return Bounds(tuple(bounds), *(jnp.asarray(x, base.e.dtype) for x in (low, high)))


def measured(prior: Any, known: list[str]) -> np.ndarray:
    """The means and standard deviations (2, k) of a prior on parameters that are `known`, or raise
    ValueError."""
    result = pairs("prior", prior, known, "(mean, standard deviation)")
    for label, value in zip(prior, result[1].tolist(), strict=True):
        check_positive("prior", value, f"a positive deviation of {label!r}")
    return result


def pairs(name: str, given: Any, known: list[str], words: str) -> np.ndarray:
    """Return the pairs (2, k) that free parameters are given, or raise ValueError."""
    check_kind(name, given, Mapping, f"a dict of names and their {words}")
    check_known(name, given, known, "free parameters")
    for label, pair in given.items():
        numbers = pair if isinstance(pair, tuple | list) or np.ndim(pair) else ()
        if len(numbers) != 2 or not all(is_number(x) and np.isfinite(x) for x in numbers):
            raise ValueError(f"`{name}`: expected {words} of {label!r}, got {pair!r}")
    return np.array([*given.values()], float).reshape(-1, 2).T
