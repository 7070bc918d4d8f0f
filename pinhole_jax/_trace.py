"""`trace` and `occluded`: closest and any hit of arbitrary rays.

The search finds which primitive is hit and is not differentiated; what is returned is worked out
again from that one primitive, so derivatives flow to the ray and to the primitive exactly.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._bvh import Tree, after, build
from ._intersect import perpendicular, ray_box, ray_sphere, ray_triangle
from ._rays import Rays
from ._safe import norm, normalize
from ._scene import Scene, astype

RAYS_AT_A_TIME = 1024


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


def trace(scene: Scene, rays: Rays) -> Hit:
    """Return the closest hit of each ray with the scene's triangles (both sides) and spheres.

    Differentiable in the rays and in the scene, where the hit primitive stays the same. Watertight:
    no ray passes between two faces that share an edge. `t` counts in lengths of the direction.
    A ray from inside a sphere meets its far wall.
    """
    return _trace(scene, rays)


def occluded(scene: Scene, rays: Rays) -> Bool[Array, "*batch"]:
    """Return whether each ray meets anything at all; stops at the first thing found."""
    return _occluded(scene, rays)


@eqx.filter_jit
def _trace(scene: Scene, rays: Rays) -> Hit:
    scene = astype(scene, rays.direction.dtype)
    flat, length, shape = _flatten(rays)
    primitive = _search(scene, flat, any_hit=False)
    hit = _meet(scene, flat, primitive)
    met = primitive >= 0
    hit = hit._replace(t=jnp.where(met, jnp.where(met, hit.t, 0) / length, jnp.inf))
    return jax.tree.map(lambda x: x.reshape(shape + x.shape[1:]), hit)


@eqx.filter_jit
def _occluded(scene: Scene, rays: Rays) -> Bool[Array, "*batch"]:
    flat, _, shape = _flatten(rays)
    scene = astype(scene, rays.direction.dtype)
    return (_search(scene, flat, any_hit=True) >= 0).reshape(shape)


def _flatten(rays: Rays) -> tuple[Rays, Float[Array, "N"], tuple[int, ...]]:
    """Return the rays as a list with unit directions, the directions' lengths, and the shape."""
    shape = jnp.broadcast_shapes(rays.origin.shape, rays.direction.shape)[:-1]
    origin, direction = (jnp.broadcast_to(x, (*shape, 3)).reshape(-1, 3) for x in rays)
    return Rays(origin, normalize(direction)), norm(direction), shape


def _search(scene: Scene, rays: Rays, any_hit: bool) -> Int[Array, "N"]:
    """Return the primitive that each ray meets first (or just any), -1 for none."""
    scene, rays = jax.lax.stop_gradient((scene, rays))
    N = rays.direction.shape[0]
    faces = 0 if scene.mesh is None else scene.mesh.faces.shape[0]
    tree = build(scene.mesh) if scene.mesh is not None and faces else None

    def batch(rays: Rays):
        best = jnp.full(rays.direction.shape[0], jnp.inf, rays.direction.dtype)
        primitive = jnp.full(rays.direction.shape[0], -1, jnp.int32)
        if scene.spheres is not None and scene.spheres.radii.shape[0]:
            best, primitive = _search_spheres(scene.spheres, rays, faces)
        if tree is not None:
            primitive = _search_tree(tree, rays, best, primitive, any_hit)
        return primitive

    size = min(RAYS_AT_A_TIME, N)
    if size == 0:
        return jnp.zeros(0, jnp.int32)
    padding = -N % size
    padded = jax.tree.map(lambda x: jnp.pad(x, ((0, padding), (0, 0)), mode="edge"), rays)
    batches = jax.tree.map(lambda x: x.reshape(-1, size, 3), padded)
    return jax.lax.map(batch, batches).reshape(-1)[:N]


def _search_spheres(spheres, rays: Rays, faces: int):
    def nearer(best, sphere):
        center, radius, index = sphere
        t = ray_sphere(rays.origin, rays.direction, center[None], radius[None]).t
        return (jnp.minimum(best[0], t), jnp.where(t < best[0], index, best[1])), None

    N, dtype = rays.direction.shape[0], rays.direction.dtype
    start = (jnp.full(N, jnp.inf, dtype), jnp.full(N, -1, jnp.int32))
    index = faces + jnp.arange(spheres.radii.shape[0], dtype=jnp.int32)
    return jax.lax.scan(nearer, start, (spheres.centers, spheres.radii, index))[0]


def _search_tree(tree: Tree, rays: Rays, best, primitive, any_hit: bool) -> Int[Array, "N"]:
    """Return the closest (or any) primitive after a depth-first walk, all rays in step."""
    axes = perpendicular(rays.direction)
    tiny = jnp.asarray(jnp.finfo(rays.direction.dtype).tiny ** 0.5, rays.direction.dtype)
    inverse = 1 / jnp.where(
        jnp.abs(rays.direction) < tiny, jnp.copysign(tiny, rays.direction), rays.direction
    )
    spread = lambda x: x[:, None]

    def descend(state):
        """Go on to the next node, past boxes that are missed; wait at a leaf."""
        node, _, best = state
        enter = ray_box(rays.origin, inverse, tree.low[node], tree.high[node], best)
        at_leaf = enter & (node >= tree.leaves)
        onward = jnp.where(enter, 2 * node, after(node))
        onward = jnp.where(onward == 1, 0, onward)
        return jnp.where(at_leaf, node, onward), at_leaf, best

    def walk(state):
        """Take every ray to its next leaf, then test the faces there, all rays at once."""
        node, best, primitive = state
        moving = lambda s: jnp.any((s[0] > 0) & ~s[1])
        hold = lambda s: jax.tree.map(
            lambda new, old: jnp.where((s[0] > 0) & ~s[1], new, old), descend(s), s
        )
        node, _, _ = jax.lax.while_loop(moving, hold, (node, jnp.zeros_like(node, bool), best))
        active = node > 0
        leaf = jnp.where(active, node - tree.leaves, 0)
        a, b, c = (tree.corners[leaf, :, k] for k in range(3))
        t = ray_triangle(
            spread(rays.origin), spread(rays.direction), (spread(axes[0]), spread(axes[1])), a, b, c
        ).t
        t = jnp.where(active[:, None], t, jnp.inf)
        nearest = jnp.min(t, axis=1)
        # Of faces that are hit at the same distance the first in the mesh counts.
        face = jnp.min(
            jnp.where(t == nearest[:, None], tree.faces[leaf], jnp.iinfo(jnp.int32).max), axis=1
        )
        closer = (nearest < best) | ((nearest == best) & jnp.isfinite(nearest) & (face < primitive))
        best = jnp.where(closer, nearest, best)
        primitive = jnp.where(closer, face, primitive)
        onward = after(node)
        finished = ~active | (onward == 1) | (any_hit & (primitive >= 0))
        return jnp.where(finished, 0, onward), best, primitive

    start = jnp.ones(best.shape[0], jnp.int32)
    if any_hit:
        start = jnp.where(primitive >= 0, 0, start)
    return jax.lax.while_loop(lambda s: jnp.any(s[0] > 0), walk, (start, best, primitive))[2]


def _meet(scene: Scene, rays: Rays, primitive: Int[Array, "N"]) -> Hit:
    """Return the hit of each ray with its primitive, differentiably."""
    dtype = rays.direction.dtype
    N = primitive.shape[0]
    hit = Hit(
        jnp.full(N, jnp.inf, dtype), primitive, jnp.zeros((N, 3), dtype), jnp.zeros((N, 3), dtype)
    )
    faces = 0 if scene.mesh is None else scene.mesh.faces.shape[0]
    if scene.mesh is not None and faces:
        on_face = (primitive >= 0) & (primitive < faces)
        face = jnp.where(on_face, primitive, 0)
        a, b, c = (scene.mesh.vertices[scene.mesh.faces[face, k]] for k in range(3))
        axes = perpendicular(rays.direction)
        t, barycentric = ray_triangle(rays.origin, rays.direction, axes, a, b, c)
        hit = _choose(on_face, t, barycentric, normalize(jnp.cross(b - a, c - a)), hit)
    if scene.spheres is not None and scene.spheres.radii.shape[0]:
        on_sphere = primitive >= faces
        sphere = jnp.where(on_sphere, primitive - faces, 0)
        center, radius = scene.spheres.centers[sphere], scene.spheres.radii[sphere]
        t, barycentric = ray_sphere(rays.origin, rays.direction, center, radius)
        finite = jnp.where(on_sphere, t, 0)[:, None]
        normal = normalize(rays.origin + finite * rays.direction - center)
        hit = _choose(on_sphere, t, barycentric, normal, hit)
    return hit


def _choose(where: Bool[Array, "N"], t, barycentric, normal, hit: Hit) -> Hit:
    return Hit(
        jnp.where(where, t, hit.t),
        hit.primitive,
        jnp.where(where[:, None], barycentric, hit.barycentric),
        jnp.where(where[:, None], normal, hit.normal),
    )
