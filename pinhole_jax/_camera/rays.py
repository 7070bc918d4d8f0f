"""From film to rays and back: `generate_rays`, `camera_rays`, `rays_through`, `project`."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from .._numerics.arrays import ArrayLike, Input, as_array, as_count, is_real
from .._numerics.pointwise import pointwise
from .._numerics.safe import safe_divide
from .camera import (
    Camera,
    ResizableCamera,
    basis,
    check_camera,
    film_map,
    focal_px,
    principal_point,
)
from .film import film_points


class Rays(NamedTuple):
    """Half lines: `origin` (..., 3) broadcasts against `direction` (..., 3), of unit length.

    ```python
    one = pj.Rays(camera.e, jnp.array([[0.0, 0.0, -1.0]]))  # any rays of one origin
    ```
    """

    origin: Float[Array, "*#batch 3"]
    direction: Float[Array, "*batch 3"]


def generate_rays(
    e: Input[ArrayLike, "3"],
    p: Input[ArrayLike, "3"],
    u: Input[ArrayLike, "3"],
    phi: Input[ArrayLike, ""],
    d: Input[ArrayLike, ""],
    W: int,
    H: int,
    samples: int | None = None,
    key: PRNGKeyArray | None = None,
) -> Rays:
    """Return the rays of an ideal pinhole camera: origin (3,), direction (H, W, 3), row 0 on top.

    Frisvad's note, eq. 1-6: pure in (e, p, u, phi, d). Without `samples` a ray goes through each
    pixel's centre. With `samples = n` each pixel's square is divided into n x n cells and
    direction is (H, W, n*n, 3): through the cells' centres, or, with a `key`, through one
    uniformly random point of each cell (stratified).

    Raises ValueError where `samples` is below 1 or a `key` comes without `samples`.

    ```python
    rays = pj.generate_rays(camera.e, camera.p, camera.u, camera.phi, camera.d, 96, 80)
    rays.origin, rays.direction.shape  # (3,), (H, W, 3)
    ```
    """
    camera = Camera(e, p, u, phi, d, W, H)
    return camera_rays(camera, samples, key)


def camera_rays(
    camera: Camera, samples: int | None = None, key: PRNGKeyArray | None = None
) -> Rays:
    """Return the camera's rays: origin (3,), direction (H, W, 3) or (H, W, samples**2, 3).

    As `generate_rays` for a `Camera`, lens included: it shifts, stretches and bends the film.

    ```python
    rays = pj.camera_rays(camera)
    ```
    """
    check_camera(camera)
    if samples is None and key is not None:
        raise ValueError("`key`: expected `samples` to go with it, got None")
    if samples is not None:
        as_count("samples", samples)
    return _rays(camera, samples, key)


@eqx.filter_jit
def _rays(camera: Camera, samples: int | None, key: PRNGKeyArray | None) -> Rays:
    x, y = _film_samples(camera.W, camera.H, samples, key, camera.e.dtype)
    return Rays(camera.e, directions(camera, x, y))


def rays_through(camera: Camera, points: Input[ArrayLike, "*batch 2"]) -> Rays:
    """Return the rays through film points (..., 2): px from the bottom left, y up; a lens's
    distortion is undone. `project` is the way back.

    ```python
    middle = pj.rays_through(camera, jnp.array([48.0, 40.0]))
    distance = pj.trace(pj.Scene(mesh=pj.shapes.bumpy(3)), middle).t
    ```
    """
    check_camera(camera)
    return Rays(camera.e, _directions(ResizableCamera(camera), _real_points(points, 2)))


def _real_points(points: ArrayLike, size: int) -> Array | np.ndarray:
    """Return points as an array (..., size) of real numbers; or raise ValueError."""
    array = as_array(points)
    if array.shape[-1:] != (size,):
        raise ValueError(f"`points`: expected shape (..., {size}), got shape {array.shape}")
    if not is_real(array):
        raise ValueError(f"`points`: expected real numbers, got dtype {array.dtype}")
    return array


@pointwise
def _directions(
    camera: ResizableCamera, points: Float[Array, "*batch 2"]
) -> Float[Array, "*batch 3"]:
    x, y = points.reshape(-1, 2).T
    return directions(camera, x, y).reshape(*points.shape[:-1], 3)


def directions(
    camera: Camera, x: Float[Array, "*#batch"], y: Float[Array, "*#batch"]
) -> Float[Array, "*batch 3"]:
    """Return the unit directions `q/|q|` of the rays through film points (x, y) in px."""
    axes = basis(camera.e, camera.p, camera.u)
    (cx, cy), (fx, fy) = principal_point(camera), focal_px(camera)
    film_x, film_y = (x - cx) / fx, (y - cy) / fy  # of a film at distance 1: d changes no ray
    if camera.distortion is not None:
        film_x, film_y = camera.distortion.undistorted(*jnp.broadcast_arrays(film_x, film_y))
    # Each ray's three components lie side by side on one long last axis: the compiler runs through
    # it in vectors, which an axis of length 3 prevents (jax 0.10: 38 ms, so 1 ms, for 1920 x 1080).
    n = max(film_x.shape[-1], film_y.shape[-1])
    lead = (1,) * (film_x.ndim - 1)
    b1, b2, v = (jnp.tile(axis, n).reshape(*lead, -1) for axis in axes)
    film_x, film_y = (f if f.shape[-1] == 1 else jnp.repeat(f, 3, -1) for f in (film_x, film_y))
    # ... the barrier keeps the index arithmetic of these few thousand numbers out of that loop.
    ahead, square = b1 * film_x + v, film_x * film_x + 1
    ahead, square, b2, film_y = jax.lax.optimization_barrier((ahead, square, b2, film_y))
    # The basis is orthonormal: |q|^2 is the sum of the squares of its coordinates.
    direction = (ahead + b2 * film_y) * jax.lax.rsqrt(square + film_y * film_y)
    return direction.reshape(*direction.shape[:-1], n, 3)


def project(camera: Camera, points: Input[ArrayLike, "*batch 3"]) -> Float[Array, "*batch 2"]:
    """Return the film coordinates (px, origin bottom left, y up) of world points (..., 3).

    A point behind the eye projects through it, as the equations say; one in the eye's own plane
    gives the principal point. In front of the eye `(points - camera.e) @ camera_basis(camera).v` is
    above 0. Where a lens's polynomial would fold back it goes on straight (see `distortion`).

    ```python
    corner = jnp.array([0.5, 0.5, 0.5])
    x, y = pj.project(camera, corner)  # film coordinates: px from the bottom left, y up
    row, column = 80 - 1 - int(y), int(x)  # of the array
    ```
    """
    check_camera(camera)
    return _projected(ResizableCamera(camera), _real_points(points, 3))


@pointwise
def _projected(
    camera: ResizableCamera, points: Float[Array, "*batch 3"]
) -> Float[Array, "*batch 2"]:
    film = film_map(camera)
    seen = film_points(film, points)
    z = seen[..., 2:]
    seen = jnp.where(z == 0, principal_point(camera), safe_divide(seen[..., :2], z))
    return seen if film.bend is None else film.bend(seen)


def _film_samples(
    W: int, H: int, samples: int | None, key: PRNGKeyArray | None, dtype: jnp.dtype
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return film coordinates of the samples; they broadcast to (H, W) or (H, W, samples**2)."""
    column = jnp.arange(W, dtype=dtype)
    row = jnp.arange(H - 1, -1, -1, dtype=dtype)
    if samples is None:
        return column[None, :] + 0.5, row[:, None] + 0.5
    cell = jnp.arange(samples, dtype=dtype)
    cell_x, cell_y = jnp.tile(cell, samples), jnp.repeat(cell, samples)
    if key is None:
        jitter = jnp.full((2, 1, 1, 1), 0.5, dtype)
    else:
        jitter = jax.random.uniform(key, (2, H, W, samples**2), dtype)
    x = column[None, :, None] + (cell_x[None, None] + jitter[0]) / samples
    y = row[:, None, None] + (cell_y[None, None] + jitter[1]) / samples
    return x, y
