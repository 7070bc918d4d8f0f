"""`trace` and `occluded`: closest and any hit of arbitrary rays, and of a camera's own.

Arbitrary rays search a tree; what a camera's meet is found by drawing (`raster`). Which primitive
is hit is not differentiated; what is returned is worked out again from that one primitive, so
derivatives flow to the ray and to the primitive exactly.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._camera.camera import Camera, check_camera
from .._camera.rays import Rays, camera_rays
from .._numerics.jitted import jitted
from .._numerics.later import on_each_device
from .._numerics.pointwise import filled_up, may_be_filled_up, room
from .._numerics.safe import binary_inverse, binary_scale, normalize
from .._numerics.tracing import collector_at_rest
from .._scene.scene import Mesh, Scene, Spheres, astype
from . import embree
from .bvh import Tree, mesh_tree, sphere_tree
from .components import Parts, largest, length, outer, parts, unit, whole
from .cores import by_cores
from .intersect import ray_plane, ray_sphere
from .memo import can_memoise, memoised
from .packets import first_met, in_packets, out_of_packets
from .raster import first_seen, view_of


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


@collector_at_rest()
def trace(scene: Scene, rays: Rays | Camera, *, search: str = "tree") -> Hit:
    """Return the closest hit of each ray with the scene's triangles (both sides) and spheres.

    Differentiable in the rays and in the scene, where the hit primitive stays the same. Watertight:
    no ray passes between two faces that share an edge. `t` counts in lengths of the direction.
    Many rays are shared out to all cores of a CPU where nothing is traced, not within `jit`.
    A ray from inside a sphere meets its far wall, one that touches it meets it there: then the
    derivative leaves out the infinite part. A miss has derivative 0.

    A camera in place of rays stands for `camera_rays(camera)`, shape (H, W): the same hits, several
    times as fast, as the faces of an image from one point need not be searched for. (Where it makes
    no camera, while it is traced, no face is met. Distorted ones are as fast as their rays.)

    A unit of length changes nothing: sizes may be anything whose distances are finite numbers. Less
    than 1e-18 of the scene's largest coordinate (float32; 1e-153 in float64) is not seen. A ray
    that is not finite, or without a direction, misses.

    `search="embree"` has Embree (`pip install 'pinhole-jax[embree]'`) find the faces, several times
    as fast for arbitrary rays. Rays that pass an edge so near that float32 cannot tell are searched
    for in the tree again, so hits are the same, but for two cases: of faces that share no edge and
    lie over one another within some 1e-6 of the scene's size the second may be hit, that much
    further; a sliver seen from its side may be missed. Spheres are searched for as before, and all
    derivatives are the same.

    Raises ValueError for another `search`, ImportError where embreex is not installed.

    ```python
    hit = pj.trace(scene, pj.camera_rays(camera))
    hit.t.shape
    ```
    """
    given, number = _with_room(scene, rays)
    return _first(number, hits(scene, found(scene, given, search)))


@collector_at_rest()
def occluded(scene: Scene, rays: Rays | Camera, *, search: str = "tree") -> Bool[Array, "*batch"]:
    """Return whether each ray, or each ray of a camera, meets anything at all.

    `search` as in `trace`.

    ```python
    shadow = pj.occluded(scene, pj.camera_rays(camera))  # any hit, bool
    ```
    """
    given, number = _with_room(scene, rays)
    _, face, sphere = found(scene, given, search)
    return _first(number, (face >= 0) | (sphere >= 0))


class Found(NamedTuple):
    """Rays, and the indices of the face and of the sphere that each meets first; -1 for none."""

    rays: Rays
    face: Int[Array, "*batch"]
    sphere: Int[Array, "*batch"]


def found(scene: Any, rays: Any, search: Any = "tree") -> Found:
    """Return what rays, or a camera's, meet first; of an undistorted one's faces by drawing."""
    if not (isinstance(scene, Scene) and isinstance(rays, Rays | Camera)):
        kinds = f"{type(scene).__name__}, {type(rays).__name__}"
        raise ValueError(f"`scene`, `rays`: expected a Scene and Rays or a Camera, got {kinds}")
    if search not in ("tree", "embree"):
        raise ValueError(f"`search`: expected 'tree' or 'embree', got {search!r}")
    if search == "embree":
        embree.check_installed()
    if isinstance(rays, Camera):
        check_camera(rays, "rays")
        distorted = rays.lens is not None and rays.lens.distortion is not None
        if search == "tree" and not distorted:
            return _find(scene, None, camera_rays(rays), rays)
        rays = camera_rays(rays)
    scene, trees = _searchable(scene, rays, search)
    if search == "embree" or trees is None:
        return _find(scene, trees, rays, None, search)
    primitives = lambda trees, some: _find(None, trees, some, None)[1:]
    return Found(rays, *by_cores(primitives, trees, rays))


def _with_room(scene: Any, rays: Any) -> tuple[Any, int | None]:
    """Return rays in a row filled up to one of few sizes, which are compiled, and how many they
    are; None of what is not filled up (the rays of an image have a size that stays)."""
    if not (isinstance(scene, Scene) and isinstance(rays, Rays) and may_be_filled_up(scene, rays)):
        return rays, None
    origin, direction = rays
    if direction.ndim != 2 or not len(direction) or origin.shape not in ((3,), direction.shape):
        return rays, None
    filled: list[Any] = [
        x if x.ndim == 1 else filled_up(np.asarray(x), room(len(direction))) for x in rays
    ]
    return Rays(*filled), len(direction)


def _first(number: int | None, found: Any) -> Any:
    """Return what there was before it was filled up."""
    if number is None:
        return found
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[:number], x.dtype), found)


class Trees(NamedTuple):
    """Trees over a scene's faces and spheres, in a unit of length about the scene's size.

    World lengths times `scale`, a power of 2, are lengths in this unit. `faces` are what Embree is
    asked about, if it is.
    """

    mesh: Tree | None
    spheres: Tree | None
    scale: Float[Array, ""]
    faces: embree.Faces | None = None


def _searchable(scene: Scene, rays: Rays, search: str) -> tuple[Any, Trees | None]:
    """Return the scene's trees, made once per scene, or a traced scene itself."""
    mesh, spheres = scene.mesh, scene.spheres
    arrays = [] if mesh is None else [mesh.vertices, mesh.faces, mesh.order]
    arrays += [] if spheres is None else [spheres.centers, spheres.radii]
    if not (arrays and can_memoise(arrays)):
        return scene, None
    dtype = jnp.result_type(rays.direction)
    trees = memoised(("trees", dtype, mesh is None), arrays, lambda: _trees_of(scene, dtype))
    if search == "tree" or trees.mesh is None:
        return None, trees
    kind = ("embree", dtype, mesh is None)
    faces, _ = memoised(kind, arrays, lambda: _held(_faces_of(scene, dtype)))
    return None, trees._replace(faces=faces)


def _held(faces: embree.Faces) -> tuple[embree.Faces, embree.Held]:
    """Return faces that Embree holds, and what has to live as long."""
    held = embree.Held(np.asarray(faces.vertices), np.asarray(faces.faces))
    return faces._replace(held=jnp.int32(held.number)), held


@jitted
def _trees_of(scene: Scene, dtype: Any) -> Trees:
    """Return the trees of a scene for rays of a float type."""
    # Exact, and then the products of coordinates neither overflow nor vanish.
    scene, scale = _to_unit_size(astype(jax.lax.stop_gradient(scene), dtype))
    return _trees(scene, scale)


@jitted
def _faces_of(scene: Scene, dtype: Any) -> embree.Faces:
    """Return the faces in the trees' unit, which Embree does not hold yet."""
    scene, _ = _to_unit_size(astype(jax.lax.stop_gradient(scene), dtype))
    return _faces(scene)


def _faces(scene: Any) -> embree.Faces:
    return embree.Faces(scene.mesh.vertices, scene.mesh.faces, jnp.int32(-1))


def _trees(scene: Scene, scale: Float[Array, ""]) -> Trees:
    mesh, spheres = scene.mesh, scene.spheres
    of_mesh = None if mesh is None or not mesh.faces.shape[0] else mesh_tree(mesh)
    of_spheres = None if spheres is None or not spheres.radii.shape[0] else sphere_tree(spheres)
    return Trees(of_mesh, of_spheres, scale)


@jitted
def _find(scene: Any, trees: Trees | None, given: Rays, camera: Any, search: str = "tree") -> Found:
    """Return what rays meet first, with the camera that they are of; not differentiated.

    Give the scene or its trees. A program of its own: `trace`, `occluded`, `depth` and `normals`
    share it.
    """
    held = jax.lax.stop_gradient((scene, trees, given, camera))
    return Found(given, *on_each_device(partial(_first_of, search), *held))


def _first_of(
    search: str, scene: Any, trees: Trees | None, rays: Rays, camera: Any
) -> tuple[Int[Array, "*batch"], Int[Array, "*batch"]]:
    """Return the indices of the face and of the sphere that each ray meets first."""
    mesh = None
    if trees is None:
        scene, scale = _to_unit_size(astype(scene, rays.direction.dtype))
        mesh = scene.mesh if camera is not None else None
        drawn = scene if camera is None else Scene(spheres=scene.spheres)
        trees = _trees(drawn, scale)
        if search == "embree" and trees.mesh is not None:
            trees = trees._replace(faces=_faces(scene))
    shape = jnp.broadcast_shapes(rays.origin.shape, rays.direction.shape)[:-1]
    direction = [jnp.broadcast_to(x, shape) for x in _of_size_one(parts(rays.direction))]
    origin = parts(rays.origin * trees.scale)
    face = sphere = jnp.full(shape, -1, jnp.int32)
    if camera is not None and mesh is not None and mesh.faces.shape[0]:
        eye, film = jnp.stack(origin), view_of(camera)
        face = first_seen(mesh.vertices, mesh.faces, film, eye, direction)
    if trees.faces is not None:
        ask = partial(embree.first_met, trees.mesh, trees.faces)
        face = _search(ask, origin, direction, shape)
    elif trees.mesh is not None:
        face = _search(partial(first_met, trees.mesh), origin, direction, shape)
    if trees.spheres is not None:
        sphere = _search(partial(first_met, trees.spheres), origin, direction, shape)
    return face, sphere


def _of_size_one(direction: Parts) -> Parts:
    """Return directions of about unit length, without rounding."""
    size = binary_inverse(largest(direction))
    return [x * size for x in direction]


def _to_unit_size(scene: Scene) -> tuple[Scene, Float[Array, ""]]:
    """Return the scene in a unit of length about its largest coordinate's size, and the factor."""
    where = lambda s: [
        *([] if s.mesh is None else [s.mesh.vertices]),
        *([] if s.spheres is None else [s.spheres.centers, s.spheres.radii]),
    ]
    sizes = [jnp.max(jnp.abs(x), initial=0) for x in where(scene)]
    scale = binary_scale(jnp.stack(sizes)) if sizes else jnp.ones(())
    return eqx.tree_at(where, scene, [x * scale for x in where(scene)]), scale


@jitted
def hits(scene: Scene, met: Found) -> Hit:
    """Return what is to be said of the rays' hits with what they are known to meet."""
    rays = met.rays
    scene = astype(scene, rays.direction.dtype)
    shape = jnp.broadcast_shapes(rays.origin.shape, rays.direction.shape)[:-1]
    flat = lambda x: jnp.broadcast_to(x, shape).reshape(-1)
    origin, along = ([flat(x) for x in parts(v)] for v in rays)
    direction, step = unit(along), length(along)
    face, sphere = met.face.reshape(-1), met.sphere.reshape(-1)
    hit, first = _miss(step), 0
    if scene.mesh is not None and scene.mesh.faces.shape[0]:
        hit, first = _meet_face(scene.mesh, origin, direction, face), scene.mesh.faces.shape[0]
    if scene.spheres is not None and scene.spheres.radii.shape[0]:
        ray = Rays(whole(origin), whole(direction))
        hit = _nearer(hit, _meet_sphere(scene.spheres, ray, sphere, first))
    far = jnp.isinf(hit.t)
    hit = hit._replace(t=jnp.where(far, jnp.inf, jnp.where(far, 0, hit.t) / step))
    return jax.tree.map(lambda x: x.reshape(shape + x.shape[1:]), hit)


def _search(
    first: Callable, origin: Parts, direction: Parts, shape: tuple[int, ...]
) -> Int[Array, "*batch"]:
    """Return the index of what each ray meets first; images are searched tile by tile."""
    ordered = lambda vector: whole([in_packets(jnp.broadcast_to(x, shape)) for x in vector])
    return out_of_packets(first(ordered(origin), ordered(direction)), shape)


def _miss(like: Float[Array, "N"]) -> Hit:
    """Return as many hits of nothing."""
    N = like.shape[0]
    zeros = jnp.zeros((N, 3), like.dtype)
    return Hit(jnp.full(N, jnp.inf, like.dtype), jnp.full(N, -1, jnp.int32), zeros, zeros)


def _meet_face(mesh: Mesh, origin: Parts, direction: Parts, face: Int[Array, "N"]) -> Hit:
    """Return the hits of rays with the faces that they are known to meet (-1: none)."""
    vertex = [mesh.faces[jnp.maximum(face, 0), k] for k in range(3)]
    corners = [[mesh.vertices[v, k] - origin[k] for k in range(3)] for v in vertex]
    far = largest(*corners)
    met = (face >= 0) & jnp.isfinite(far) & jnp.isfinite(sum(direction))
    scale = binary_inverse(far)  # and all is about 1
    a, b, c = ([jnp.where(met, x * scale, 1) for x in corner] for corner in corners)
    t, weights = ray_plane(direction, a, b, c)
    sides = [[q - p for p, q in zip(a, other, strict=True)] for other in (b, c)]
    size = binary_inverse(largest(*sides))
    normal = unit(outer(*([x * size for x in side] for side in sides)))
    keep = lambda vector: whole([jnp.where(met, x, 0) for x in vector])
    t, face = jnp.where(met, t / scale, jnp.inf), jnp.where(met, face, -1)
    return Hit(t, face, keep(weights), keep(normal))


def _meet_sphere(spheres: Spheres, rays: Rays, sphere: Int[Array, "N"], first: int) -> Hit:
    """Return the hits of rays with the spheres that they are known to meet (-1: none)."""
    index = jnp.maximum(sphere, 0)
    center = spheres.centers[index] - rays.origin
    far = jnp.max(jnp.abs(center), axis=1)
    met = (sphere >= 0) & jnp.isfinite(far) & jnp.all(jnp.isfinite(rays.direction), axis=1)
    scale = binary_inverse(far)
    center = jnp.where(met[:, None], center * scale[:, None], 1)
    radius = spheres.radii[index] * scale
    t, barycentric = ray_sphere(jnp.zeros_like(center), rays.direction, center, radius)
    met &= jnp.isfinite(t)
    finite = jnp.where(met, t, 0)
    normal = normalize(finite[:, None] * rays.direction - center)
    hit = Hit(finite / scale, first + sphere, barycentric, normal)
    return _choose(met, hit, _miss(far))


def _nearer(a: Hit, b: Hit) -> Hit:
    """Return the hit that comes first; of two at the same distance, a."""
    return _choose(b.t < a.t, b, a)


def _choose(where: Bool[Array, "N"], a: Hit, b: Hit) -> Hit:
    pick = lambda x, y: jnp.where(where.reshape(-1, *(1,) * (x.ndim - 1)), x, y)
    return Hit(*(pick(x, y) for x, y in zip(a, b, strict=True)))
