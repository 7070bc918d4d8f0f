"""`trace` and `occluded`: closest and any hit of arbitrary rays, and of a camera's own.

Arbitrary rays search a tree; a camera's are told what they meet by drawing (`raster`). The search
finds which primitive is hit and is not differentiated; what is returned is worked out
again from that one primitive, so derivatives flow to the ray and to the primitive exactly.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._camera.camera import Camera, check_camera
from .._camera.rays import Rays, camera_rays
from .._numerics.safe import binary_inverse, binary_scale, norm, normalize
from .._numerics.tracing import collector_at_rest
from .._scene.scene import Mesh, Scene, Spheres, astype
from .bvh import Tree, mesh_tree, sphere_tree
from .intersect import perpendicular, ray_plane, ray_sphere
from .packets import first_met, in_packets, out_of_packets
from .raster import first_seen, view_of


class Hit(NamedTuple):
    """What rays meet first.

    - `t`: distance along the ray in lengths of its direction (world units if unit); inf on a miss.
    - `primitive`: the face's index, or F + the sphere's; -1 on a miss.
    - `barycentric`: weights of the face's three vertices; 0 for spheres and misses.
    - `normal`: the geometric unit normal, of a face as it is wound, of a sphere outwards; 0 on a
      miss.
    """

    t: Float[Array, "*batch"]
    primitive: Int[Array, "*batch"]
    barycentric: Float[Array, "*batch 3"]
    normal: Float[Array, "*batch 3"]


@collector_at_rest()
def trace(scene: Scene, rays: Rays | Camera) -> Hit:
    """Return the closest hit of each ray with the scene's triangles (both sides) and spheres.

    Differentiable in the rays and in the scene, where the hit primitive stays the same. Watertight:
    no ray passes between two faces that share an edge. `t` counts in lengths of the direction.
    A ray from inside a sphere meets its far wall, one that touches it meets it there: then the
    derivative leaves out the infinite part. A miss has derivative 0.

    A camera in place of rays stands for `camera_rays(camera)`, shape (H, W): the same hits, several
    times as fast, as the faces of an image from one point need not be searched for. (Where it makes
    no camera, while it is traced, no face is met. Distorted ones are as fast as their rays.)

    A unit of length changes nothing: sizes may be anything whose distances are finite numbers. Less
    than 1e-18 of the scene's largest coordinate (float32; 1e-153 in float64) is not seen. A ray
    that is not finite, or without a direction, misses.
    """
    rays, camera = _checked(scene, rays)
    return _hits(scene, rays, _find(scene, rays, camera))


@collector_at_rest()
def occluded(scene: Scene, rays: Rays | Camera) -> Bool[Array, "*batch"]:
    """Return whether each ray, or each ray of a camera, meets anything at all."""
    rays, camera = _checked(scene, rays)
    face, sphere = _find(scene, rays, camera)
    return (face >= 0) | (sphere >= 0)


def _checked(scene: Any, rays: Any) -> tuple[Rays, Camera | None]:
    """Return the rays, and the camera if they are of one whose faces can be drawn."""
    if not (isinstance(scene, Scene) and isinstance(rays, Rays | Camera)):
        kinds = f"{type(scene).__name__}, {type(rays).__name__}"
        raise ValueError(f"`scene`, `rays`: expected a Scene and Rays or a Camera, got {kinds}")
    if isinstance(rays, Rays):
        return rays, None
    check_camera(rays, "rays")
    distorted = rays.lens is not None and rays.lens.distortion is not None
    return _rays_of(rays), None if distorted else rays


_rays_of = eqx.filter_jit(camera_rays)


@eqx.filter_jit
def _find(
    scene: Scene, rays: Rays, camera: Camera | None
) -> tuple[Int[Array, "*batch"], Int[Array, "*batch"]]:
    """Return the face and the sphere that each ray meets first, -1 for none; not differentiated.

    A program of its own: `trace` and `occluded` share it.
    """
    scene, rays, camera = jax.lax.stop_gradient((scene, rays, camera))
    scene = astype(scene, rays.direction.dtype)
    # Exact, and then the products of coordinates neither overflow nor vanish.
    scene, scale = _to_unit_size(scene)
    flat, shape = _in_binary_units(rays, scale)
    face = sphere = jnp.full(shape, -1, jnp.int32)
    mesh, spheres = scene.mesh, scene.spheres
    if mesh is not None and mesh.faces.shape[0] and camera is not None:
        direction = flat.direction.reshape(*shape, 3)
        eye = rays.origin * scale
        face = first_seen(mesh.vertices, mesh.faces, view_of(camera), eye, direction)
    elif mesh is not None and mesh.faces.shape[0]:
        face = _search(mesh_tree(mesh), flat, shape)
    if spheres is not None and spheres.radii.shape[0]:
        sphere = _search(sphere_tree(spheres), flat, shape)
    return face, sphere


def _in_binary_units(rays: Rays, scale: Float[Array, ""]) -> tuple[Rays, tuple[int, ...]]:
    """Return the rays as a list, in another unit of length and with directions of about unit length,
    and their shape. Nothing is rounded, so what is met depends on origin and direction alone."""
    shape = jnp.broadcast_shapes(rays.origin.shape, rays.direction.shape)[:-1]
    unit = binary_inverse(jnp.max(jnp.abs(rays.direction), axis=-1, keepdims=True))
    sized = (rays.origin * scale, rays.direction * unit)
    origin, direction = (jnp.broadcast_to(x, (*shape, 3)).reshape(-1, 3) for x in sized)
    return Rays(origin, direction), shape


def _to_unit_size(scene: Scene) -> tuple[Scene, Float[Array, ""]]:
    """Return the scene in a unit of length about its largest coordinate's size, and the factor."""
    where = lambda s: [
        *([] if s.mesh is None else [s.mesh.vertices]),
        *([] if s.spheres is None else [s.spheres.centers, s.spheres.radii]),
    ]
    sizes = [jnp.max(jnp.abs(x), initial=0) for x in where(scene)]
    scale = binary_scale(jnp.stack(sizes)) if sizes else jnp.ones(())
    return eqx.tree_at(where, scene, [x * scale for x in where(scene)]), scale


@eqx.filter_jit
def _hits(scene: Scene, rays: Rays, met: tuple[Array, Array]) -> Hit:
    """Return what is to be said of the rays' hits with what they are known to meet."""
    scene = astype(scene, rays.direction.dtype)
    flat, length, shape = _flatten(rays)
    face, sphere = (x.reshape(-1) for x in met)
    hit, first = _miss(flat), 0
    if scene.mesh is not None and scene.mesh.faces.shape[0]:
        hit, first = _meet_face(scene.mesh, flat, face), scene.mesh.faces.shape[0]
    if scene.spheres is not None and scene.spheres.radii.shape[0]:
        hit = _nearer(hit, _meet_sphere(scene.spheres, flat, sphere, first))
    far = jnp.isinf(hit.t)
    hit = hit._replace(t=jnp.where(far, jnp.inf, jnp.where(far, 0, hit.t) / length))
    return jax.tree.map(lambda x: x.reshape(shape + x.shape[1:]), hit)


def _flatten(rays: Rays) -> tuple[Rays, Float[Array, "N"], tuple[int, ...]]:
    """Return the rays as a list with unit directions, the directions' lengths, and the shape."""
    shape = jnp.broadcast_shapes(rays.origin.shape, rays.direction.shape)[:-1]
    origin, direction = (jnp.broadcast_to(x, (*shape, 3)).reshape(-1, 3) for x in rays)
    return Rays(origin, normalize(direction)), norm(direction), shape


def _search(tree: Tree, rays: Rays, shape: tuple[int, ...]) -> Int[Array, "*batch"]:
    """Return the index of what each ray meets first; images are searched tile by tile."""
    origin, direction = (in_packets(x.reshape(*shape, 3)) for x in rays)
    return out_of_packets(first_met(tree, origin, direction), shape)


def _miss(rays: Rays) -> Hit:
    zeros = jnp.zeros_like(rays.direction)
    N = zeros.shape[0]
    return Hit(jnp.full(N, jnp.inf, zeros.dtype), jnp.full(N, -1, jnp.int32), zeros, zeros)


def _meet_face(mesh: Mesh, rays: Rays, face: Int[Array, "N"]) -> Hit:
    """Return the hits of rays with the faces that they are known to meet (-1: none)."""
    corners = mesh.vertices[mesh.faces[jnp.maximum(face, 0)]]
    corners, scale, met = _from_origin(corners, rays, face >= 0)
    a, b, c = (corners[:, k] for k in range(3))
    axes = perpendicular(rays.direction)
    origin = jnp.zeros_like(rays.direction)
    t, barycentric = ray_plane(origin, rays.direction, axes, a, b, c)
    sides = jnp.stack([b - a, c - a], axis=1)
    sides = sides * binary_inverse(jnp.max(jnp.abs(sides), axis=(1, 2)))[:, None, None]
    normal = normalize(jnp.cross(sides[:, 0], sides[:, 1]))
    return _choose(met, Hit(t / scale, face, barycentric, normal), _miss(rays))


def _meet_sphere(spheres: Spheres, rays: Rays, sphere: Int[Array, "N"], first: int) -> Hit:
    """Return the hits of rays with the spheres that they are known to meet (-1: none)."""
    index = jnp.maximum(sphere, 0)
    center, scale, met = _from_origin(spheres.centers[index][:, None], rays, sphere >= 0)
    center, radius = center[:, 0], spheres.radii[index] * scale
    t, barycentric = ray_sphere(jnp.zeros_like(center), rays.direction, center, radius)
    met &= jnp.isfinite(t)
    finite = jnp.where(met, t, 0)
    normal = normalize(finite[:, None] * rays.direction - center)
    return _choose(met, Hit(finite / scale, first + sphere, barycentric, normal), _miss(rays))


def _from_origin(
    points: Float[Array, "N k 3"], rays: Rays, met: Bool[Array, "N"]
) -> tuple[Float[Array, "N k 3"], Float[Array, "N"], Bool[Array, "N"]]:
    """Return points as the rays' origins see them, times a power of 2 for each ray that brings them
    to about 1, that power, and whether the ray meets what it sees; harmless points if it does not.
    """
    points = points - rays.origin[:, None]
    far = jnp.max(jnp.abs(points), axis=(1, 2))
    met = met & jnp.isfinite(far) & jnp.all(jnp.isfinite(rays.direction), axis=1)
    scale = binary_inverse(far)
    return jnp.where(met[:, None, None], points * scale[:, None, None], 1), scale, met


def _nearer(a: Hit, b: Hit) -> Hit:
    """Return the hit that comes first; of two at the same distance, a."""
    return _choose(b.t < a.t, b, a)


def _choose(where: Bool[Array, "N"], a: Hit, b: Hit) -> Hit:
    pick = lambda x, y: jnp.where(where.reshape(-1, *(1,) * (x.ndim - 1)), x, y)
    return Hit(*(pick(x, y) for x, y in zip(a, b, strict=True)))
