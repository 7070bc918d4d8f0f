"""The image by arrays, and its derivative: the visible outline's length in a pixel times its speed.

The speed is across the outline, and linear between the ends of a straight curve. Visible pieces are
found again for each derivative: no list of them is kept.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from .._camera.film import FilmMap
from .._native.linear import differentiable_once, linear, merged, moving_of
from .._numerics.batches import Total
from .._numerics.safe import safe_divide
from .._scene.scene import Scene
from .conics import arc_flux, unit_of
from .contour import Contour, Moving
from .crowds import CellCoverage, VisiblePieces, fold_crowded
from .pieces import Monotone, Pieces
from .pixels import Pixels, drawn, fold_film, place
from .surrounding import surrounding


class Drawing(NamedTuple):
    """A film's view of a scene: curves, pixels, and the image."""

    curves: Contour
    pixels: Pixels
    image: Float[Array, "H W"]


def coverage_in_arrays(film: FilmMap, scene: Scene, overlaps: bool) -> Float[Array, "H W"]:
    """Exact coverage of each pixel, row 0 on top; `overlaps` as in `silhouette`."""
    moving = Moving.from_scene(film, scene)
    return _coverage(overlaps, moving, jax.lax.stop_gradient((film, scene)))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _coverage(overlaps: bool, moving: Moving, given: tuple[FilmMap, Scene]) -> Array:
    return _view(overlaps, moving, given).image


@partial(_coverage.defjvp, symbolic_zeros=True)
def _coverage_jvp(overlaps: bool, primals: Any, tangents: Any):
    """The image, and its change by the arrays that move; others cost nothing."""
    moving, given = primals
    leaves, tree = jax.tree.flatten(moving)
    velocities = tree.flatten_up_to(tangents[0])
    moves = [not isinstance(v, SymbolicZero) for v in velocities]
    view = _view(overlaps, *differentiable_once((moving, given)))
    held, film = differentiable_once(leaves), (given[0].W, given[0].H)
    like = jax.ShapeDtypeStruct(view.image.shape, view.image.dtype)

    def change_by(view: Drawing, held: list[Array], seen: VisiblePieces) -> Callable:
        every = lambda moving: tree.unflatten(merged(moving, held, moves))
        return lambda moving: _change(view.curves, every(moving), seen)

    def push(view: Drawing, held: list[Array], velocity: list[Array]) -> Array:
        def add(image, seen):
            more = jax.jvp(change_by(view, held, seen), (moving_of(held, moves),), (velocity,))[1]
            return image.at[seen.pixel].add(more, mode="drop")

        none = jnp.zeros(film[0] * film[1], like.dtype)
        return _upright(_fold_seen(view, film, add, none), film)

    def pull(view: Drawing, held: list[Array], weights: Array) -> list[Array]:
        flat = jnp.append(weights[::-1].reshape(-1), 0)

        def add(total, seen):
            back = jax.vjp(change_by(view, held, seen), moving_of(held, moves))[1]
            return jax.tree.map(jnp.add, total, back(flat[seen.pixel])[0])

        none = jax.tree.map(jnp.zeros_like, moving_of(held, moves))
        return _fold_seen(view, film, add, none)

    forward, back = partial(push, view, held), partial(pull, view, held)
    return view.image, linear(forward, back, moving_of(velocities, moves), like)


def _upright(image: Float[Array, "N"], film: tuple[int, int]) -> Float[Array, "H W"]:
    """Pixels from the bottom row up as an image."""
    return image.reshape(film[1], film[0])[::-1]


def _change(curves: Contour, moving: Moving, seen: VisiblePieces) -> Float[Array, "N"]:
    """A number for each visible piece with the same derivative as the pixel's coverage."""
    _, ids, extent, moment, flux = seen
    curves, extent, moment, flux = jax.lax.stop_gradient((curves, extent, moment, flux))
    m = curves.monotone(ids)
    along = [jnp.where(m.steep, end[:, 1], end[:, 0]) for end in (m.low, m.high)]
    tail, head = (jnp.where(m.rising > 0, *ends) for ends in (along, along[::-1]))
    far = safe_divide(moment - extent * tail, head - tail)
    speeds = curves.speeds(moving, ids)
    change = (extent - far) * speeds[:, 0] + far * speeds[:, 1]
    if m.arcs is None or moving.frames is None or flux is None:
        return change
    turned = jnp.sum(flux * moving.frames[curves.sphere(ids)], axis=(1, 2))
    return jnp.where(m.arcs.there, turned, change)


def _view(overlaps: bool, moving: Moving, given: tuple[FilmMap, Scene]) -> Drawing:
    (film, scene), size = given, (given[0].W, given[0].H)
    curves = Contour.from_scene(moving, film, scene)
    pixels = drawn(curves, size, surrounding(film, scene), overlaps)

    def add(image, cells: CellCoverage):
        return image.at[cells.pixel].add(cells.area, mode="drop")

    image = fold_crowded(curves, size, pixels, add, pixels.coverage, False)
    return Drawing(curves, pixels, _upright(jnp.clip(image, 0, 1), size))


def _fold_seen(
    view: Drawing, film: tuple[int, int], add: Callable[[Total, VisiblePieces], Total], start: Total
) -> Total:
    """`start` after `add(total, seen)` over all visible pieces."""
    curves, pixels, _ = view

    def whole(total, m: Monotone, pieces: Pieces):
        return add(total, _whole(m, pieces, pixels, film))

    def in_cells(total, cells: CellCoverage):
        return total if cells.seen is None else add(total, cells.seen)

    total = fold_film(curves, film, whole, start)
    return fold_crowded(curves, film, pixels, in_cells, total, True)


def _whole(m: Monotone, pieces: Pieces, pixels: Pixels, film: tuple[int, int]) -> VisiblePieces:
    """The visible pieces of pixels where the background is beside all pieces."""
    W, H = film
    pixel = place(film, pieces)
    alone = (pixel < W * H) & pixels.alone[jnp.minimum(pixel, W * H - 1)]
    dx, dy = (pieces.high - pieces.low).T
    extent = jnp.where(m.steep, -pieces.jump * dy, -pieces.up * jnp.abs(dx))
    x, y = (pieces.corner + (pieces.low + pieces.high) / 2).T
    moment, flux = extent * jnp.where(m.steep, y, x), None
    if m.arcs is not None:
        conic = m.arcs.conic
        ends = (unit_of(conic, pieces.corner + p) for p in (pieces.low, pieces.high))
        flux = -pieces.jump[:, None, None] * arc_flux(conic, *ends)
    return VisiblePieces(jnp.where(alone, pixel, W * H), pieces.curve, extent, moment, flux)
