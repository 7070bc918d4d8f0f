"""The image by arrays, and its derivative: the visible outline's length in a pixel times its speed.

The speed is across the outline, and linear between the ends of a straight curve. Visible pieces are
found again for each derivative: no list of them is kept.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._camera.film import FilmMap
from .._native.linear import differentiable_once, linear
from .._numerics.safe import safe_divide
from .._scene.scene import Scene
from .contour import Contour
from .pixels import Pixels, pixels_of
from .surrounding import surrounding
from .sweeps import VisiblePieces, fold_swept


def coverage_in_arrays(film: FilmMap, scene: Scene) -> Float[Array, "H W"]:
    """Exact coverage of each pixel, row 0 on top."""
    return _coverage((film.W, film.H), Contour.from_scene(film, scene), surrounding(film, scene))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _coverage(film: tuple[int, int], curves: Contour, base: Int[Array, ""]) -> Float[Array, "H W"]:
    return _image(film, curves, pixels_of(curves, film, base))


@partial(_coverage.defjvp, symbolic_zeros=True)
def _coverage_jvp(film: tuple[int, int], primals: Any, tangents: Any):
    """The image, and its change by the arrays that move."""
    curves, base = differentiable_once(primals)
    pixels, tree = pixels_of(curves, film, base), jax.tree.structure(curves)
    image = _image(film, curves, pixels)
    velocities = tree.flatten_up_to(tangents[0])

    def push(velocities: list[Any]) -> Array:
        velocity = tree.unflatten(velocities)

        def add(image, swept):
            change = partial(_change, curves, swept.seen)
            more = eqx.filter_jvp(change, (curves,), (velocity,))[1]
            return image.at[swept.seen.pixel].add(more, mode="drop")

        none = jnp.zeros(film[0] * film[1], image.dtype)
        return _upright(fold_swept(curves, pixels, film, add, none, True), film)

    def pull(weights: Array) -> list[Any]:
        flat = jnp.append(weights[::-1].reshape(-1), 0)

        def add(total, swept):
            back = eqx.filter_vjp(partial(_change, curves, swept.seen), curves)[1]
            return jax.tree.map(jnp.add, total, back(flat[swept.seen.pixel])[0])

        none = jax.tree.map(jnp.zeros_like, eqx.filter(curves, eqx.is_inexact_array))
        return tree.flatten_up_to(fold_swept(curves, pixels, film, add, none, True))

    return image, linear(push, pull, velocities, [None] * len(velocities), image)


def _image(film: tuple[int, int], curves: Contour, pixels: Pixels) -> Float[Array, "H W"]:
    add = lambda image, swept: image.at[swept.pixel].add(swept.area, mode="drop")
    image = fold_swept(curves, pixels, film, add, pixels.coverage, False)
    return _upright(jnp.clip(image, 0, 1), film)


def _upright(image: Float[Array, "N"], film: tuple[int, int]) -> Float[Array, "H W"]:
    """Pixels from the bottom row up as an image."""
    return image.reshape(film[1], film[0])[::-1]


def _change(curves: Contour, seen: VisiblePieces, moved: Contour) -> Float[Array, "N"]:
    """A number for each visible piece with the same derivative as the pixel's coverage."""
    _, ids, extent, moment, flux = seen
    m = curves.monotone(ids)
    along = [jnp.where(m.steep, end[:, 1], end[:, 0]) for end in (m.low, m.high)]
    tail, head = (jnp.where(m.rising > 0, *ends) for ends in (along, along[::-1]))
    far = safe_divide(moment - extent * tail, head - tail)
    speeds = curves.speeds(moved, ids)
    change = (extent - far) * speeds[:, 0] + far * speeds[:, 1]
    if m.arcs is None or moved.frames is None or flux is None:
        return change
    turned = jnp.sum(flux * moved.frames[curves.sphere(ids)], axis=(1, 2))
    return jnp.where(m.arcs.there, turned, change)
