"""Lens distortion: OpenCV's models, continued so that they can always be inverted.

A model maps the ideal image to the one on the film, in normalised coordinates: those of a film at
distance 1, from the principal point, x right and y UP. OpenCV's y runs down, which turns the sign
of its p1 in the formulas; the coefficients themselves are OpenCV's. Sources: D. C. Brown,
"Close-Range Camera Calibration" (1971); J. Kannala and S. Brandt, "A Generic Camera Model and
Calibration Method" (2006); as OpenCV's `projectPoints` and `fisheye` have them.

The polynomials fold back far from the axis, where no lens does. Up to the radius where they begin
to (`trusted_radius`) they count as they are; beyond, the image goes on straight, at the slope it
has there (C1). A camera whose film shows more than that is refused.
"""

import abc
from collections.abc import Callable, Mapping
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._numerics.arrays import ArrayLike, Input, float_array, float_dtype
from .._numerics.on_devices import spread
from .._numerics.safe import length, safe_divide, safe_sqrt

Real = Input[ArrayLike, ""]
Coefficient = Float[Array, ""]

#: The coefficients of all models, in OpenCV's order.
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
#: Where the image grows by less than this share of its growth on the axis it is about to fold;
#: where it grows by more than this multiple of it, no lens is left.
LEAST_SLOPE, MOST_SLOPE = 0.05, 100.0
#: Radii of the ideal image that are tried: the last is a tenth of a degree from the eye's plane.
RADII = np.geomspace(1e-3, 600.0, 1024)
#: The most steps of Newton's method.
NEWTON_STEPS = 40


class Distortion(eqx.Module):
    """The interface of all models: their fields are coefficients.

    `powers` has the power of the radius that each coefficient bends with, in the fields' order.
    """

    powers: ClassVar[Mapping[str, int]]

    @abc.abstractmethod
    def polynomial(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return the distorted point by the model's formula."""

    @abc.abstractmethod
    def slope(self, radius: Array) -> Array:
        """Return a lower bound of the image's growth at a radius, 1 on the axis."""

    def coefficients(self) -> dict[str, float]:
        """Return the coefficients by name."""
        return {name: float(getattr(self, name)) for name in self.powers}

    def trusted_radius(self) -> Float[Array, ""]:
        """Return the radius of the ideal image up to which the formula counts (a constant)."""
        held = jax.lax.stop_gradient(self)
        radii = jnp.asarray(RADII, jax.tree.leaves(self)[0].dtype)
        slope = held.slope(radii)
        holds = (slope > LEAST_SLOPE) & (slope < MOST_SLOPE)
        first = jnp.argmin(jnp.append(holds, jnp.zeros(1, bool)))
        return radii[jnp.maximum(first - 1, 0)]

    @eqx.filter_jit
    def __call__(self, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> tuple[Array, Array]:
        """Return the distorted points of ideal ones."""
        return self.continued(self.trusted_radius(), x, y)

    def continued(self, trusted: Array, x: Array, y: Array) -> tuple[Array, Array]:
        """Return the distorted points, by the formula up to a radius and straight on beyond it."""
        radius = safe_sqrt(x * x + y * y)
        share = jnp.minimum(safe_divide(trusted, radius), 1)
        share = jnp.where(radius > 0, share, 1)
        inner = (x * share, y * share)
        value, rise = jax.jvp(self.polynomial, inner, (x - inner[0], y - inner[1]))
        return value[0] + rise[0], value[1] + rise[1]

    def trusts(self, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> Bool[Array, "*n"]:
        """Return True for distorted points where the formula counts."""
        radius = safe_sqrt(x * x + y * y)
        share = jnp.where(radius > 0, safe_divide(self.trusted_radius(), radius), 0)
        edge = self.polynomial(x * share, y * share)
        return radius <= safe_sqrt(edge[0] * edge[0] + edge[1] * edge[1])

    def undistorted(self, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> tuple[Array, Array]:
        """Return the ideal points of distorted ones."""
        return _undistorted(self, x, y)


class RadialTangential(Distortion):
    """Brown's models: a radial factor, and tangential terms of a lens off its axis (p1, p2)."""

    k1: Coefficient
    k2: Coefficient
    p1: Coefficient
    p2: Coefficient
    k3: Coefficient

    def radial(self, s: Array) -> Array:
        """Return the radial factor at a squared radius."""
        return 1 + _powers(s, self.k1, self.k2, self.k3)

    def polynomial(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return the distorted point by the formula. (OpenCV's, with y up.)"""
        s, cross = x * x + y * y, 2 * x * y
        radial = self.radial(s)
        return (
            x * radial - self.p1 * cross + self.p2 * (s + 2 * x * x),
            y * radial - self.p1 * (s + 2 * y * y) + self.p2 * cross,
        )

    def slope(self, radius: Array) -> Array:
        """Return a lower bound of the image's growth at a radius."""
        return _growth(self.radial, radius) - 6 * length(self.p1, self.p2) * radius


class BrownConrady(RadialTangential):
    """OpenCV's `distCoeffs`, in its order: radial k1, k2, k3 and tangential p1, p2.

    `x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)`, and so for y, with OpenCV's y
    (down). Raises ValueError for values that are not finite numbers.

    ```python
    pj.BrownConrady(k1=-0.27, k2=0.05, p1=1e-3, p2=0.0, k3=0.0).coefficients()
    ```
    """

    powers: ClassVar[Mapping[str, int]] = {"k1": 3, "k2": 5, "p1": 2, "p2": 2, "k3": 7}

    def __init__(
        self,
        k1: Real = 0.0,
        k2: Real = 0.0,
        p1: Real = 0.0,
        p2: Real = 0.0,
        k3: Real = 0.0,
    ):
        _set_coefficients(self, k1, k2, p1, p2, k3)


class Rational(RadialTangential):
    """OpenCV's rational model (`CALIB_RATIONAL_MODEL`), in the order of its `distCoeffs`.

    `BrownConrady` with the radial factor
    `(1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)`. Raises ValueError for values
    that are not finite numbers.

    ```python
    pj.Rational(k1=-0.27, k4=0.01)
    ```
    """

    powers: ClassVar[Mapping[str, int]] = {**BrownConrady.powers, "k4": 3, "k5": 5, "k6": 7}

    k4: Coefficient
    k5: Coefficient
    k6: Coefficient

    def __init__(
        self,
        k1: Real = 0.0,
        k2: Real = 0.0,
        p1: Real = 0.0,
        p2: Real = 0.0,
        k3: Real = 0.0,
        k4: Real = 0.0,
        k5: Real = 0.0,
        k6: Real = 0.0,
    ):
        _set_coefficients(self, k1, k2, p1, p2, k3, k4, k5, k6)

    def radial(self, s: Array) -> Array:
        """Return the radial factor at a squared radius."""
        return safe_divide(super().radial(s), self._denominator(s))

    def slope(self, radius: Array) -> Array:
        """Return a lower bound of the image's growth at a radius; -1 beyond a pole."""
        return jnp.where(self._denominator(radius * radius) > 0, super().slope(radius), -1)

    def _denominator(self, s: Array) -> Array:
        return 1 + _powers(s, self.k4, self.k5, self.k6)


class Fisheye(Distortion):
    """Kannala-Brandt, as OpenCV's `fisheye` has it: an angle from the axis becomes a radius.

    `theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)`, theta in rad. Only points in
    front of the eye are seen: less than 90 degrees from the axis. Raises ValueError for values that
    are not finite numbers.

    ```python
    pj.Fisheye(k1=0.02, k2=-0.01)
    ```
    """

    powers: ClassVar[Mapping[str, int]] = {"k1": 3, "k2": 5, "k3": 7, "k4": 9}

    k1: Coefficient
    k2: Coefficient
    k3: Coefficient
    k4: Coefficient

    def __init__(
        self,
        k1: Real = 0.0,
        k2: Real = 0.0,
        k3: Real = 0.0,
        k4: Real = 0.0,
    ):
        _set_coefficients(self, k1, k2, k3, k4)

    def polynomial(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return the distorted point by the formula."""
        s = x * x + y * y
        radius = safe_sqrt(s)
        theta = jnp.arctan(radius)
        # theta / radius, by its series where the quotient would lose its derivatives.
        series = 1 - s * (1 / 3 - s * (1 / 5 - s / 7))
        per_radius = jnp.where(s < 1e-4, series, safe_divide(theta, radius))
        scale = self.angular(theta * theta) * per_radius
        return x * scale, y * scale

    def slope(self, radius: Array) -> Array:
        """Return the image's growth with the angle at a radius of the ideal image."""
        return _growth(self.angular, jnp.arctan(radius))

    def angular(self, s: Array) -> Array:
        """Return the distorted radius over the angle, at a squared angle."""
        return 1 + _powers(s, self.k1, self.k2, self.k3, self.k4)


#: All models, by their names in files and in the command.
MODELS: dict[str, type[BrownConrady | Rational | Fisheye]] = {
    model.__name__: model for model in (BrownConrady, Rational, Fisheye)
}


def _powers(s: Array, *factors: Array) -> Array:
    """Return a s + b s^2 + ... (Horner)."""
    total = s * factors[-1]
    for factor in reversed(factors[:-1]):
        total = s * (factor + total)
    return total


def _growth(factor: Callable[[Array], Array], x: Array) -> Array:
    """Return the derivative of `x factor(x^2)` by x."""
    s = x * x
    value, rise = jax.jvp(factor, (s,), (2 * s,))
    return value + rise


def _set_coefficients(model: Distortion, *values: ArrayLike) -> None:
    """Set a new model's fields, all of one float type."""
    dtype = float_dtype(*values)
    for name, value in zip(model.powers, values, strict=True):
        setattr(model, name, float_array(name, value, (), dtype))


def _solved(push: Callable[[Array], Array], right: Float[Array, "2 *n"]) -> Float[Array, "2 *n"]:
    """Return (dx, dy) with push((dx, dy)) = right, a linear map of each point."""
    one, none = jnp.ones_like(right[0]), jnp.zeros_like(right[0])
    by_x, by_y = push(jnp.stack([one, none])), push(jnp.stack([none, one]))
    det = by_x[0] * by_y[1] - by_x[1] * by_y[0]
    dx = right[0] * by_y[1] - right[1] * by_y[0]
    dy = by_x[0] * right[1] - by_x[1] * right[0]
    return jnp.stack([safe_divide(dx, det), safe_divide(dy, det)])


@jax.jit  # outside of other programs the loop would be compiled at each call
def _undistorted(model: Distortion, x: Array, y: Array) -> tuple[Array, Array]:
    """Return the ideal points: Newton's method, from a table for the lens without p1 and p2.

    The number of right digits doubles from step to step: what follows a step that changes less than
    half of them is rounding, and where the image hardly grows no less than that step. The inverse's
    derivative is by the implicit function theorem.
    """
    goal, trusted = jnp.stack([x, y]), model.trusted_radius()
    radii = jnp.asarray(RADII, goal.dtype)
    right, left = (model.continued(trusted, r, jnp.zeros_like(r))[0] for r in (radii, -radii))
    seen = (right - left) / 2  # (p1 and p2 bend both the same way)
    start = goal * jnp.interp(jnp.hypot(x, y), seen, radii / seen)[None]

    def newton(beyond: Callable[[Array], Array], start: Array) -> Array:
        def further(state):
            number, at, _ = state
            value, push = jax.linearize(beyond, at)
            move = _solved(push, -value)
            share = jnp.abs(move) / (1 + jnp.hypot(*at))[None]
            return number + 1, at + move, jnp.max(share)

        tiny = float(jnp.finfo(start.dtype).eps) ** 0.5 / 4
        going = lambda state: (state[0] < NEWTON_STEPS) & (state[2] > tiny)
        first = spread([jnp.int32(0), start, jnp.asarray(jnp.inf, start.dtype)], [start])
        return jax.lax.while_loop(going, further, tuple(first))[1]

    beyond = lambda ideal: jnp.stack(model.continued(trusted, *ideal)) - goal
    x, y = jax.lax.custom_root(beyond, start, newton, _solved)
    return x, y
