"""The image by arrays, and its derivative: the visible outline's length in a pixel times its speed.

The speed is across the outline, and linear between the ends of a straight curve. Visible pieces are
found again for each derivative: no list of them is kept.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._camera.film import FilmMap
from .._native.linear import differentiable_once, linear, moves_of
from .._numerics.safe import safe_divide
from .._scene.scene import Scene
from .contour import Contour, Moving
from .pixels import Pixels, pixels_of
from .surrounding import surrounding
from .sweeps import VisiblePieces, fold_swept


def in_arrays(film: FilmMap, scene: Scene) -> Float[Array, "H W"]:
    """Exact coverage of each pixel, row 0 on top, by vectors of pieces.

    On accelerators, and where there is no compiled library; the film and the scene of one type.
    """
    mesh, spheres = scene.mesh, scene.spheres
    if mesh is not None and not mesh.edge_faces.shape[0]:
        mesh = None
    if spheres is not None and not spheres.radii.shape[0]:
        spheres = None
    if mesh is None and spheres is None:
        return jnp.zeros((film.H, film.W), film.eye.dtype)
    scene = Scene(mesh=mesh, spheres=spheres)
    moving = Moving.from_scene(film, scene)
    held, film, scene = jax.lax.stop_gradient((moving, film, scene))
    given = Contour.from_scene(held, film, scene), surrounding(film, scene)
    return _coverage((film.W, film.H), moving, given)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _coverage(
    film: tuple[int, int], moving: Moving, given: tuple[Contour, Array]
) -> Float[Array, "H W"]:
    curves, base = given
    return _image(film, curves, pixels_of(curves, film, base))


@partial(_coverage.defjvp, symbolic_zeros=True)
def _coverage_jvp(film: tuple[int, int], primals: Any, tangents: Any):
    """The image, and its change by the arrays that move; others cost nothing."""
    moves = moves_of(tangents[0])
    held, (curves, base) = differentiable_once(primals)
    pixels = pixels_of(curves, film, base)
    image = _image(film, curves, pixels)

    at = eqx.filter(held, moves)

    def change_by(seen: VisiblePieces) -> Callable:
        return lambda x: _change(curves, eqx.combine(x, held), seen)

    def push(velocity: Moving) -> Array:
        def add(image, swept):
            more = jax.jvp(change_by(swept.seen), (at,), (velocity,))[1]
            return image.at[swept.seen.pixel].add(more, mode="drop")

        none = jnp.zeros(film[0] * film[1], image.dtype)
        return _upright(fold_swept(curves, pixels, film, add, none, True), film)

    def pull(weights: Array) -> Moving:
        flat = jnp.append(weights[::-1].reshape(-1), 0)

        def add(total, swept):
            back = jax.vjp(change_by(swept.seen), at)[1]
            return jax.tree.map(jnp.add, total, back(flat[swept.seen.pixel])[0])

        none = jax.tree.map(jnp.zeros_like, at)
        return fold_swept(curves, pixels, film, add, none, True)

    like = jax.ShapeDtypeStruct(image.shape, image.dtype)
    return image, linear(push, pull, eqx.filter(tangents[0], moves), like)


def _image(film: tuple[int, int], curves: Contour, pixels: Pixels) -> Float[Array, "H W"]:
    add = lambda image, swept: image.at[swept.pixel].add(swept.area, mode="drop")
    image = fold_swept(curves, pixels, film, add, pixels.coverage, False)
    return _upright(jnp.clip(image, 0, 1), film)


def _upright(image: Float[Array, "N"], film: tuple[int, int]) -> Float[Array, "H W"]:
    """Pixels from the bottom row up as an image."""
    return image.reshape(film[1], film[0])[::-1]


def _change(curves: Contour, moving: Moving, seen: VisiblePieces) -> Float[Array, "N"]:
    """A number for each visible piece with the same derivative as the pixel's coverage."""
    _, ids, extent, moment, flux = seen
    m = curves.monotone(ids)
    along = [jnp.where(m.steep, end[:, 1], end[:, 0]) for end in (m.low, m.high)]
    tail, head = (jnp.where(m.rising > 0, *ends) for ends in (along, along[::-1]))
    far = safe_divide(moment - extent * tail, head - tail)
    width, height = (m.high - m.low).T
    slope = jnp.where(m.steep, safe_divide(width, height), safe_divide(height, width))
    # Across a part: upwards if it is flat, to the right if it is steep.
    tail, head = (
        jnp.where(m.steep, x - slope * y, y - slope * x)
        for x, y in (end.T for end in curves.carried(moving, ids))
    )
    change = (extent - far) * tail + far * head
    if m.arcs is None or moving.frames is None or flux is None:
        return change
    turned = jnp.sum(flux * moving.frames[curves.sphere(ids)], axis=(1, 2))
    return jnp.where(m.arcs.there, turned, change)
