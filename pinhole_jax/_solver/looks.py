"""A fit's look at one camera: R of its residuals' derivatives, Q^T r, and sums over all pixels.

The compiled library looks at what an outline touches. Elsewhere, and without it, a look is the
whole window's image and its derivatives.
"""

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.camera import Camera, film_map, lens_holds
from .._camera.film import Bend, FilmMap, FilmPart
from .._mask.pyramid import Level, Pyramid, cells_of
from .._native import look as native
from .._native.library import is_available
from .._native.look import MaskLevel, Sight, TouchedPixels, along_each, sight_of
from .._native.rasteriser import model_of
from .._numerics.thin_qr import triangle_of
from .._scene.scene import Scene
from .._silhouette.motion import in_arrays
from .moves import Move, reported
from .problem import Problem

#: A pixel that is covered, or uncovered, but for less than this shows no outline.
HIDDEN = 1e-4
#: Sides of images that are compiled for (px) are multiples of a power of two: at most this many
#: in a side.
SIDES = 4

Size = tuple[int, int]


class Sums(NamedTuple):
    """Weighted sums over all pixels: squared residual, min and max of coverage and target, weight.

    `touched` counts the pixels with weight that the outline crosses, where the background is seen
    beside the object (not contours within it), `touched_squares` is theirs; `off` counts those with
    a residual that the mask's kind does not explain.
    """

    squares: Float[Array, ""]
    overlap: Float[Array, ""]
    union: Float[Array, ""]
    weight: Float[Array, ""]
    touched: Float[Array, ""]
    touched_squares: Float[Array, ""]
    off: Float[Array, ""]


class Look(NamedTuple):
    """What is known at a camera, moved by y.

    - `rows`: R of [J, r], the rows of a prior and of other views among them; J is the residuals'
      derivative by moves about the camera, in units of `scale`, then by the scene's motions.
    - `to_reported`: the reported parameters' derivative by moves.
    - `known`, `prior`: derivatives of the residuals of a prior and other views, and their squares.
    """

    camera: Camera
    rows: Float[Array, "k k"]
    sums: Float[Array, "7"]
    to_reported: Float[Array, "n n"]
    scale: Float[Array, "n"]
    known: Float[Array, "m n"]
    prior: Float[Array, ""]


def size_of_looks(levels: list[Level]) -> Size | None:
    """The size W, H of a look's image on any of some levels; None where the library looks."""
    if is_available() and jax.default_backend() == "cpu":
        return None
    W, H = np.array([(level.W, level.H) for level in levels]).max(axis=0).tolist()
    return _rounded_up(W), _rounded_up(H)


def _rounded_up(side: int) -> int:
    unit = 2 ** max((side // SIDES).bit_length() - 1, 3)
    return -(-side // unit) * unit


def look(
    y: Float[Array, "n"],
    move: Move,
    problem: Problem,
    level: Level,
    freed: tuple[str, ...],
    size: Size | None,
) -> Look:
    """The look at a camera moved by y. Where its lens folds within what is looked at all is NaN, so
    that a solver does not step there."""

    def quantities(y: Array) -> tuple[Any, Any]:
        camera, scene = problem.moved(move, y, freed)
        values = reported(move.camera, camera, freed)
        drawn = _drawn(camera, scene, problem, level, size)
        return (values, problem.prior.residuals(values), *drawn), camera

    (_, left, *drawn), by_move, camera = along_each(quantities, y)
    to_reported, J, *drawn_by_move = by_move
    known = jnp.concatenate([J.T, left[:, None]], axis=1)
    if size is None:
        sight = Sight(*drawn, *drawn_by_move)
        of_mask = _mask_of(jnp, problem.pyramid, level)
        rows, sums = native.look(sight, known, problem.scene, of_mask, model_of(camera.lens))
    else:
        (coverage,), (moves,) = drawn, drawn_by_move
        _, table, sums = _weighed(coverage, moves, problem.pyramid, level, size)
        rows = triangle_of(jnp.concatenate([table, known]))
    ok = jnp.where(lens_holds(camera, _part(level)), 1, jnp.nan).astype(y.dtype)
    facts = to_reported[: len(move.scale)].T, move.scale, J.T, left @ left
    return Look(camera, rows * ok, sums * ok, *facts)


def _drawn(
    camera: Camera, scene: Scene, problem: Problem, level: Level, size: Size | None
) -> tuple[Array, ...]:
    """What a look is made of: the numbers of a sight, or where the library does not look, coverage
    of the whole window."""
    film = film_of(camera, level, size)
    return sight_of(film, scene, not problem.motions) if size is None else _image(film, scene)


def film_of(camera: Camera, level: Level, size: Size | None) -> FilmMap:
    """A camera as a map to the level's window, in its pixels, and to a film of a size that holds
    it; None: to no film."""
    film, scale, origin = film_map(camera), jnp.asarray(level.scale), jnp.asarray(level.origin)
    placed = lambda xyz: jnp.concatenate(
        [xyz[:2] * scale - origin.reshape(2, *(1,) * (xyz.ndim - 1)) * xyz[2:], xyz[2:]]
    )
    bend = film.bend
    if bend is not None:
        bend = Bend(bend.distortion, bend.trusted, bend.focal * scale, bend.centre * scale - origin)
    numbers = film.eye, film.view, placed(film.matrix), placed(film.base)
    film, part = FilmMap(*numbers, *(size or (1, 1)), bend), FilmPart(0, level.W, 0, level.H)
    return film if size is None or bend is None else film.looking_at(part)


def _part(level: Level) -> FilmPart:
    """A level's window in film heights."""
    scale = jnp.asarray(level.scale)
    left, bottom = jnp.asarray(level.origin) / scale
    W, H = (jnp.asarray(x, scale.dtype) / scale for x in (level.W, level.H))
    return FilmPart(left, left + W, bottom, bottom + H)


def _mask_of(xp: Any, pyramid: Pyramid, level: Level) -> MaskLevel:
    """A level as the library reads it, by `jax.numpy` or NumPy."""
    W, H, start, explained = map(xp.asarray, (level.W, level.H, level.start, level.explained))
    return MaskLevel(xp.stack([W, H]), start[None], explained[None], *pyramid)


# --- the whole window -----------------------------------------------------------------------------


def _image(film: FilmMap, scene: Scene) -> tuple[Float[Array, "P"]]:
    """Coverage of each pixel of a film, from its bottom."""
    return (in_arrays(film, scene)[::-1].reshape(-1),)


def _weighed(
    coverage: Float[Array, "P"],
    moves: Float[Array, "n P"],
    pyramid: Pyramid,
    level: Level,
    size: Size,
) -> tuple[Float[Array, "P"], Float[Array, "P k"], Float[Array, "7"]]:
    """Weight of each pixel of an image that holds the level's window, by its coverage and the
    derivatives of that; the table [J, r] of weighted residuals, and the sums."""
    W, H = size
    row, column = (x.reshape(-1) for x in jnp.indices((H, W), jnp.int32))
    inside = (row < level.H) & (column < level.W)
    cell = jnp.where(inside, level.start + row * (level.W + 2) + column + 1, level.start)
    target, weight = cells_of(pyramid, cell)
    weight = jnp.where(inside, weight, 0)
    r = jnp.sqrt(weight) * (coverage - target)
    shown = (coverage > HIDDEN) & (coverage < 1 - HIDDEN) & (weight > 0)
    table = jnp.concatenate([jnp.sqrt(weight)[None] * moves, r[None]]).T
    each = (
        r * r,
        weight * jnp.minimum(coverage, target),
        weight * jnp.maximum(coverage, target),
        weight,
        shown,
        jnp.where(shown, r * r, 0),
        shown & (jnp.abs(r) > level.explained),
    )
    return weight, table, jnp.stack([jnp.sum(x, dtype=r.dtype) for x in each])


@partial(jax.jit, static_argnames=("freed", "size"))
def _all_pixels(
    camera: Camera, problem: Problem, level: Level, freed: tuple[str, ...], size: Size | None
) -> Sight | Float[Array, "H W c"]:
    """Coverage, weight and weighted [J, r] of all pixels of a level, row 0 at the bottom; where the
    library looks, what it draws."""
    move = problem.move(camera, level, freed)

    def drawn(y: Array) -> tuple[Any, Any]:
        return _drawn(*problem.moved(move, y, freed), problem, level, size), ()

    values, moves, _ = along_each(drawn, problem.still(freed))
    if size is None:
        return Sight(*values, *moves)
    (coverage,), (moves,), (W, H) = values, moves, size
    weight, table, _ = _weighed(coverage, moves, problem.pyramid, level, size)
    seen = jnp.stack([coverage, weight], axis=1)
    return jnp.concatenate([seen, table], axis=1).reshape(H, W, -1)


def _touched(seen: np.ndarray, level: Level) -> TouchedPixels:
    """Those of all pixels (H, W, c) that an outline touches."""
    seen = seen[: int(level.H), : int(level.W)].astype(float)
    coverage, moves = seen[..., 0], seen[..., 2:-1]
    touched = ((coverage > 0) & (coverage < 1)) | np.any(moves != 0, axis=-1)
    covered = ~touched & (coverage > 0.5)
    # (Where a row's first pixel is covered, what lies left of it says so.)
    chosen = np.column_stack([covered[:, 0], touched, np.zeros(len(seen), bool)])
    after = np.pad(covered, ((0, 0), (0, 2)))[chosen]
    rows = np.pad(seen, ((0, 0), (1, 1), (0, 0)))[chosen]
    coverage, weight, residual = rows[:, [0, 1, -1]].T
    cell = np.flatnonzero(chosen)
    return TouchedPixels(cell, coverage, weight, residual, after, False, rows[:, 2:-1])


# --- what a fit keeps -----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Origin:
    """Where a look is taken, and the pixels that it touches once they are asked for."""

    camera: Camera
    problem: Problem
    level: Level
    freed: tuple[str, ...]
    size: Size | None

    @cached_property
    def pixels(self) -> TouchedPixels:
        """The pixels that the outline touches, with the residuals' derivatives."""
        if self.size is None:
            return native.pixels(*self._given_to_library)
        return _touched(np.asarray(self._all_pixels), self.level)

    @property
    def outline(self) -> Float[np.ndarray, "P k"] | None:
        """The outline by the library, as `native.outline` has it; None where that does not look."""
        return None if self.size is not None else native.outline(*self._given_to_library)

    @property
    def _all_pixels(self) -> Any:
        return _all_pixels(self.camera, self.problem, self.level, self.freed, self.size)

    @property
    def _given_to_library(self) -> tuple[Sight, Scene, MaskLevel, int]:
        of_mask = _mask_of(np, self.problem.pyramid, self.level)
        return self._all_pixels, self.problem.scene, of_mask, model_of(self.camera.lens)


@dataclass(frozen=True, eq=False)
class View:
    """What a fit keeps of a look (see `Look`), in float64: R of J = QR, Q^T r, sums, and where it
    was taken.

    J is the residuals' derivative by moves, in the solver's units (`UNIT_PX` pixels): `scale`; then
    by the scene's motions, if any.
    """

    triangle: np.ndarray
    along: np.ndarray
    sums: Sums
    to_reported: np.ndarray
    scale: np.ndarray
    known: np.ndarray
    prior: float
    origin: Origin | None = None

    @classmethod
    def from_look(cls, look: Look, origin: Origin) -> "View":
        """The view of a look."""
        given = (np.asarray(x, float) for x in jax.device_get(look[1:]))
        rows, sums, to_reported, scale, known, prior = given
        own = rows[:-1, :-1], rows[:-1, -1], Sums(*sums)
        return cls(*own, to_reported, scale, known, float(prior), origin)

    @property
    def camera(self) -> Camera:
        """The camera that it is of (canonical)."""
        assert self.origin is not None
        return self.origin.camera

    @property
    def level(self) -> Level:
        """The level that it is of."""
        assert self.origin is not None
        return self.origin.level

    @property
    def pixels(self) -> TouchedPixels:
        """The pixels that the outline touches."""
        assert self.origin is not None
        return self.origin.pixels

    @property
    def jacobian(self) -> Float[np.ndarray, "P n"]:
        """The touched pixels' rows of J."""
        return self.pixels.jacobian

    @property
    def squares(self) -> float:
        """The sum of weighted squared residuals, those of a prior and of other views among them."""
        return float(self.sums.squares) + self.prior

    @property
    def touched_misfit(self) -> float:
        """The mean square residual of the touched pixels."""
        return float(self.sums.touched_squares) / max(float(self.sums.touched), 1.0)

    @property
    def misfit(self) -> float:
        """The mean square residual of a touched pixel, all squares put on these pixels."""
        return self.squares / max(float(self.sums.touched), 1.0)
