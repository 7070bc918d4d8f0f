"""`trace` and `occluded`: closest and any hit of arbitrary rays, and of a camera's own.

The search for the primitive is not differentiated; the hit is recomputed from that primitive, so
derivatives flow to the ray and to the primitive exactly.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._camera.camera import Camera, camera_basis, check_camera
from .._camera.rays import Rays, camera_rays
from .._native.library import is_available
from .._native.walker import walked
from .._numerics.components import Parts, largest, outer, parts, unit, whole
from .._numerics.pointwise import may_be_padded, padded, room
from .._numerics.safe import binary_inverse, length
from .._scene.scene import Mesh, Scene, Spheres, astype
from .heap import first_met
from .intersect import ray_plane, ray_sphere


class Hit(NamedTuple):
    """What rays meet first.

    - `t`: distance along the ray in lengths of its direction (world units if unit); inf on a miss.
    - `primitive`: the face's index, or F + the sphere's; -1 on a miss.
    - `barycentric`: weights of the face's three vertices; 0 for spheres and misses.
    - `normal`: the geometric unit normal, of a face as it is wound, of a sphere outwards; 0 on a
      miss.

    ```python
    hit.t, hit.primitive, hit.normal
    ```
    """

    t: Float[Array, "*batch"]
    primitive: Int[Array, "*batch"]
    barycentric: Float[Array, "*batch 3"]
    normal: Float[Array, "*batch 3"]


def trace(scene: Scene, rays: Rays | Camera, *, search: str = "tree") -> Hit:
    """Return the closest hit of each ray with the scene's triangles (both sides) and spheres.

    Differentiable in the rays and in the scene, where the hit primitive stays the same. Watertight:
    no ray passes between two faces that share an edge. `t` counts in lengths of the direction.
    A ray from inside a sphere meets its far wall, one that touches it meets it there: then the
    derivative leaves out the infinite part. A miss has derivative 0.

    A camera in place of rays stands for `camera_rays(camera)`, shape (H, W). (Where it makes no
    camera, while it is traced, nothing is met.)

    A unit of length changes nothing: sizes may be anything whose distances are finite numbers. Less
    than 1e-18 of the scene's largest coordinate (float32; 1e-153 in float64) is not seen. A ray
    that is not finite, or without a direction, misses.

    On a CPU a compiled library searches a tree in float64, on all cores where rays are many. It
    keeps the trees of the last four scenes; they are known by what their arrays hold. Elsewhere,
    and where the library was not built, arrays search in the rays' own float type.

    Raises ValueError for another `search` than "tree" ("embree" was removed).

    ```python
    hit = pj.trace(scene, pj.camera_rays(camera))
    hit.t.shape
    ```
    """
    _check_search(search)
    return _in_few_sizes(scene, rays, lambda rays: hits(scene, first_hits(scene, rays)))


def occluded(scene: Scene, rays: Rays | Camera, *, search: str = "tree") -> Bool[Array, "*batch"]:
    """Return True for each ray, or each ray of a camera, that hits anything.

    `search` as in `trace`.

    ```python
    shadow = pj.occluded(scene, pj.camera_rays(camera))  # any hit, bool
    ```
    """
    _check_search(search)
    met = lambda rays: first_hits(scene, rays, any_hit=True).primitive >= 0
    return _in_few_sizes(scene, rays, met)


def _check_search(search: Any) -> None:
    if search != "tree":
        raise ValueError(
            f"`search`: expected 'tree', got {search!r}; 'embree' was removed, as the tree is about"
            " as fast now: leave `search` out"
        )


class FirstHits(NamedTuple):
    """Rays, and the primitive that each hits first: the face, or F + the sphere; -1 for none."""

    rays: Rays
    primitive: Int[Array, "*batch"]


def first_hits(scene: Any, rays: Any, any_hit: bool = False) -> FirstHits:
    """Return the primitives that rays, or a camera's, hit first; with `any_hit` any of these."""
    if not (isinstance(scene, Scene) and isinstance(rays, Rays | Camera)):
        kinds = f"{type(scene).__name__}, {type(rays).__name__}"
        raise ValueError(f"`scene`, `rays`: expected a Scene and Rays or a Camera, got {kinds}")
    if isinstance(rays, Rays):
        return _find(scene, rays, None, any_hit)
    check_camera(rays, "rays")
    return _find(scene, camera_rays(rays), rays, any_hit)


def _in_few_sizes(scene: Any, rays: Any, run: Callable[[Any], Any]) -> Any:
    """Return the results of rays, those in a row filled up to one of few sizes meanwhile.

    Others, as those of an image, whose size stays, are not filled up.
    """
    if not (isinstance(scene, Scene) and isinstance(rays, Rays) and may_be_padded(scene, rays)):
        return run(rays)
    origin, direction = rays
    if direction.ndim != 2 or not len(direction) or origin.shape not in ((3,), direction.shape):
        return run(rays)
    number = len(direction)
    filled: list[Any] = [x if x.ndim == 1 else padded(np.asarray(x), room(number)) for x in rays]
    own = lambda x: jnp.asarray(np.asarray(x)[:number], x.dtype)
    return jax.tree.map(own, run(Rays(*filled)))


@eqx.filter_jit
def _find(scene: Scene, rays: Rays, camera: Camera | None, any_hit: bool) -> FirstHits:
    """The primitives that rays, of a camera or of none, hit first; not differentiated.

    A program of its own: `trace`, `occluded`, `depth` and `normals` share it.
    """
    held = jax.lax.stop_gradient((astype(scene, rays.direction.dtype), rays))
    met = _first_met(*held, any_hit)
    if camera is not None:  # (where a traced one is none, no ray meets anything)
        axes = jnp.stack(jax.lax.stop_gradient(camera_basis(camera)))
        met = jnp.where(jnp.all(jnp.any(axes != 0, axis=1)), met, -1)
    return FirstHits(rays, met)


def _first_met(scene: Scene, rays: Rays, any_hit: bool) -> Int[Array, "*batch"]:
    """The first hits, by the library on CPUs if there is one, else by arrays."""
    shape = jnp.broadcast_shapes(rays.origin.shape, rays.direction.shape)
    nothing = scene.mesh is None and scene.spheres is None
    if nothing or not math.prod(shape):
        return jnp.full(shape[:-1], -1, jnp.int32)
    shared = rays.origin.ndim == 1
    origin = rays.origin if shared else jnp.broadcast_to(rays.origin, shape)
    given = scene, origin.reshape(-1, 3), jnp.broadcast_to(rays.direction, shape).reshape(-1, 3)
    native = partial(walked, any_hit=any_hit)
    if not is_available():
        met = first_met(*given)
    elif jax.default_backend() == "cpu":
        met = native(*given)
    else:
        met = jax.lax.platform_dependent(*given, cpu=native, default=first_met)
    return met.reshape(shape[:-1])


@eqx.filter_jit
def hits(scene: Scene, met: FirstHits) -> Hit:
    """Recompute each hit differentiably from the primitive already found."""
    rays, which = met.rays, met.primitive.reshape(-1)
    scene = astype(scene, rays.direction.dtype)
    shape = jnp.broadcast_shapes(rays.origin.shape, rays.direction.shape)[:-1]
    flat = lambda x: jnp.broadcast_to(x, shape).reshape(-1)
    origin, along = ([flat(x) for x in parts(v)] for v in rays)
    direction, step = unit(along), length(*along)
    none = jnp.zeros_like(step)
    here, first = _Meeting(none < 0, none, [none] * 3, [none] * 3), 0
    if scene.mesh is not None and scene.mesh.faces.shape[0]:
        first = scene.mesh.faces.shape[0]
        here = _meet_face(scene.mesh, origin, direction, jnp.where(which < first, which, -1))
    if scene.spheres is not None and scene.spheres.radii.shape[0]:
        sphere = _meet_sphere(scene.spheres, origin, direction, which - first)
        here = jax.tree.map(lambda a, b: jnp.where(which < first, a, b), here, sphere)
    kept = lambda x: jnp.where(here.met, x, 0)
    t = jnp.where(here.met, kept(here.t) / step, jnp.inf)
    vectors = (whole([*map(kept, vector)]) for vector in (here.barycentric, here.normal))
    hit = Hit(t, jnp.where(here.met, which, -1), *vectors)
    return jax.tree.map(lambda x: x.reshape(shape + x.shape[1:]), hit)


class _Meeting(NamedTuple):
    """Rays with the primitives that they are known to meet, and True where they do."""

    met: Bool[Array, "N"]
    t: Float[Array, "N"]
    barycentric: Parts
    normal: Parts


def _meet_face(mesh: Mesh, origin: Parts, direction: Parts, face: Int[Array, "N"]) -> _Meeting:
    """Return the hits of faces (-1: none)."""
    vertex = [mesh.faces[jnp.maximum(face, 0), k] for k in range(3)]
    corners = [[mesh.vertices[v, k] - origin[k] for k in range(3)] for v in vertex]
    met, scale, (a, b, c) = _about_one(face >= 0, direction, *corners)
    t, weights = ray_plane(direction, a, b, c)
    sides = [[q - p for p, q in zip(a, other, strict=True)] for other in (b, c)]
    size = binary_inverse(largest(*sides))
    normal = unit(outer(*([x * size for x in side] for side in sides)))
    return _Meeting(met, t / scale, [*weights], normal)


def _meet_sphere(
    spheres: Spheres, origin: Parts, direction: Parts, sphere: Int[Array, "N"]
) -> _Meeting:
    """Return the hits of spheres (below 0: none)."""
    index = jnp.maximum(sphere, 0)
    center = [x - o for x, o in zip(parts(spheres.centers[index]), origin, strict=True)]
    met, scale, (center,) = _about_one(sphere >= 0, direction, center)
    t = ray_sphere(direction, center, spheres.radii[index] * scale)
    met &= jnp.isfinite(t)
    t = jnp.where(met, t, 0)
    normal = unit([t * way - x for way, x in zip(direction, center, strict=True)])
    return _Meeting(met, t / scale, [jnp.zeros_like(t)] * 3, normal)


def _about_one(
    met: Bool[Array, "N"], direction: Parts, *points: Parts
) -> tuple[Bool[Array, "N"], Float[Array, "N"], list[Parts]]:
    """Return True where all is finite, the factor that brings points to a size of about 1, and the
    points at this size (1 elsewhere)."""
    far = largest(*points)
    met &= jnp.isfinite(far) & jnp.isfinite(sum(direction))
    scale = binary_inverse(far)
    return met, scale, [[jnp.where(met, x * scale, 1) for x in point] for point in points]
