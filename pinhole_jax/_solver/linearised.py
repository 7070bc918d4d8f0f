"""A fit's residuals and their derivatives at a camera, as columns, and their triangle R."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._camera.camera import Camera, has_distortion
from .._mask.pyramid import Level
from .._numerics.one_kernel import with_slopes
from .._numerics.thin_qr import BLOCK, triangle_of
from .moves import moved, reported
from .parameters import components
from .problem import Problem, View, move_about
from .residuals import Capacity, Load, Pixels, Sums, film_of, residuals


class Seen(NamedTuple):
    """The few numbers that are known at a camera, beside its residuals (see `View`): the squares of
    a `prior` and of what other views know among them."""

    camera: Camera
    sums: Sums
    load: Load
    to_reported: Float[Array, "n n"]
    scale: Float[Array, "n"]
    prior: Float[Array, ""]

    def view(
        self,
        triangle: tuple[Float[Array, "k n"], Float[Array, "k"]],
        pixels: Pixels,
        columns: Float[Array, "k m"],
    ) -> View:
        """Return the view, with R of its residuals' derivatives and of these."""
        R, r = (x[: len(self.scale)] for x in triangle)
        few, of_moves = (self.sums, self.load), (self.to_reported, self.scale)
        return View(R, r, *few, *of_moves, pixels, columns, self.prior)


def columns_at(
    y: Float[Array, "n"],
    camera: Camera,
    problem: Problem,
    level: Level,
    freed: tuple[str, ...],
    capacity: Capacity,
) -> tuple[Float[Array, "k m"], Seen, Pixels]:
    """Return all residuals' derivatives by moves from a camera, where it is moved by y, and these
    residuals: columns [J, r], those of the touched pixels first, zeros after how many there are."""

    def step(y, camera, about, level):
        move = move_about(camera, *about, scale=level.scale, freed=freed)
        there = moved(move, y, freed)
        film = None if has_distortion(camera) else film_of(there, level)
        return there, reported(camera, there, freed), film, move.scale

    def at(there, values, film):
        here = problem.scene, problem.pyramid, level, capacity
        (r, rest), sums, load, pixels = residuals(there, *here, film)
        known = problem.others.residuals(values)
        if problem.prior is not None:
            known = jnp.concatenate([known, problem.prior.residuals(there, freed)])
        return (r, rest[None], known), (sums, load, pixels, jnp.sum(known * known))

    about = problem.pivot, problem.radius, problem.bounds
    found, slopes = with_slopes(step, y, camera, about, level)
    along = lambda slopes: jax.jvp(at, found[:3], slopes, has_aux=True)
    pushed = jax.vmap(along, out_axes=(None, 0, None))(slopes[:3])
    r, slopes_of_r, (sums, load, pixels, prior) = pushed
    rows = [jnp.concatenate([J, x[None]]) for J, x in zip(slopes_of_r, r, strict=True)]
    number = sum(len(x) for x in r)
    rows.append(jnp.zeros((len(y) + 1, -number % BLOCK), y.dtype))
    seen = Seen(found[0], sums, load, slopes[1].T, found[3], prior)
    return jnp.concatenate(rows, axis=1), seen, pixels


def look(
    camera: Camera, problem: Problem, level: Level, freed: tuple[str, ...], capacity: Capacity
) -> View:
    """Return the view at a camera."""
    n = len(components(freed))
    y = jnp.zeros(n, problem.pyramid.target.dtype)
    columns, seen, pixels = columns_at(y, camera, problem, level, freed, capacity)
    R = triangle_of(columns, n + 1)
    return seen.view((R[:, :n], R[:, n]), pixels, columns)
