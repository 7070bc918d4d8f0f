"""Rays' first hits by arrays: on accelerators, without the library, and as the tests' reference.

Primitives in the order of a space-filling curve are leaves of a complete binary tree, in a row
as a heap is: node n has the children 2n and 2n + 1. A ray visits it from left to right; where it
misses a box goes on behind it, at a node whose number follows from n. So rays need no stack, and go
side by side.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics.components import parts
from .._numerics.safe import binary_scale, normalize
from .._scene.scene import Scene, morton_codes
from .intersect import ray_sphere, ray_triangle

#: Rays side by side.
BESIDE = 1 << 16


class Tree(NamedTuple):
    """Boxes by nodes (node 0 is none); the last half are leaves, of a primitive each.

    - `box`: low corners, and high ones times -1: a box about two is the least of theirs.
    - `data`: corners of faces, or centres.
    - `radius`: of spheres; no entries of faces.
    """

    box: Float[Array, "nodes 2 3"]
    primitive: Int[Array, "leaves"]
    data: Float[Array, "leaves points 3"]
    radius: Float[Array, "leaves"] | None


class Ray(NamedTuple):
    """A ray, or many, in the form of the tests of boxes and primitives.

    - `origin`, `direction`: as they are, of unit length.
    - `scale`: its distance per unit along each axis.
    - `slack`: the largest error of the distance of a plane.
    - `real`: True if all this is finite.
    """

    origin: Float[Array, "*rays 3"]
    direction: Float[Array, "*rays 3"]
    scale: Float[Array, "*rays 3"]
    slack: Float[Array, "*rays 3"]
    real: Bool[Array, "*rays"]


def first_met(
    scene: Scene, origin: Float[Array, "m 3"], direction: Float[Array, "N 3"]
) -> Int[Array, "N"]:
    """The face that each ray hits first, or F + the sphere; -1 for none."""
    scene, unit = _to_unit_size(scene)
    rays = jax.vmap(_ray)(jnp.broadcast_to(origin * unit, direction.shape), direction)
    distance, met = jnp.full(direction.shape[:1], jnp.inf, direction.dtype), jnp.int32(-1)
    kinds = []
    if scene.mesh is not None:
        kinds.append((scene.mesh.vertices[scene.mesh.faces], None))
    if scene.spheres is not None:
        kinds.append((scene.spheres.centers[:, None], scene.spheres.radii))
    number = 0
    for data, radius in kinds:
        if data.shape[0]:
            walk = partial(_walk, _tree(data, radius))
            here, which = jax.lax.map(walk, rays, batch_size=min(BESIDE, direction.shape[0]))
            met = jnp.where(here < distance, number + which, met)
            distance = jnp.minimum(here, distance)
        number += data.shape[0]
    return jnp.broadcast_to(met, distance.shape)


def _to_unit_size(scene: Scene) -> tuple[Scene, Float[Array, ""]]:
    """The scene in a unit of length about its largest coordinate's size, and the factor."""
    lengths, rest = eqx.partition(scene, eqx.is_inexact_array)
    sizes = [jnp.max(jnp.abs(x), initial=0) for x in jax.tree.leaves(lengths)]
    scale = binary_scale(jnp.stack(sizes))
    return eqx.combine(jax.tree.map(lambda x: x * scale, lengths), rest), scale


def _tree(data: Float[Array, "N points 3"], radius: Float[Array, "N"] | None) -> Tree:
    """A complete binary tree over boxes in Morton order, its levels one after another."""
    size = 0 if radius is None else radius[:, None]
    box = jnp.stack([jnp.min(data, axis=1) - size, -jnp.max(data, axis=1) - size], axis=1)
    order = jnp.argsort(morton_codes(jnp.mean(data, axis=1))).astype(jnp.int32)
    eps, extent = jnp.finfo(box.dtype).eps, -jnp.min(jnp.sum(box, axis=1), axis=1)
    # Slivers are met up to the root of the rounding beside them: so much their test leaves open.
    pad = 4 * eps * jnp.max(jnp.abs(box), axis=1) + 16 * eps**0.5 * extent[:, None]
    real = jnp.all(jnp.isfinite(box), axis=(1, 2), keepdims=True)
    box = jnp.where(real, box - pad[:, None], jnp.inf)
    empty = (1 << (order.shape[0] - 1).bit_length()) - order.shape[0]
    box = jnp.pad(box[order], ((0, empty), (0, 0), (0, 0)), constant_values=jnp.inf)
    levels = [box]
    while box.shape[0] > 1:
        box = jnp.minimum(box[::2], box[1::2])
        levels = [box, *levels]
    box = jnp.concatenate([box, *levels])
    return Tree(box, order, data[order], None if radius is None else radius[order])


def _ray(origin: Float[Array, "3"], direction: Float[Array, "3"]) -> Ray:
    """A ray as it goes through a tree, whose lengths are about 1. The slack is some times the
    rounding of the tests of boxes and primitives: what the latter find the former never hide."""
    direction = normalize(direction)
    eps, reach = jnp.finfo(direction.dtype).eps, 4 + jnp.max(jnp.abs(origin))
    size = jnp.maximum(jnp.abs(direction), eps)  # flatter ones go aside by less than the slack
    scale = jnp.where(direction < 0, -1 / size, 1 / size)
    slack = 16 * eps * reach * (1 + size) / size
    real = jnp.all(jnp.isfinite(origin * scale + slack)) & jnp.any(direction != 0)
    return Ray(origin, direction, scale, slack, real)


def _walk(tree: Tree, ray: Ray) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """The distance of a ray's first hit (inf for a miss), and its primitive."""
    leaves, number = tree.box.shape[0] // 2, tree.primitive.shape[0]

    def visit(state):
        node, best, met = state
        low, high = tree.box[node]
        a, b = (low - ray.origin) * ray.scale, (-high - ray.origin) * ray.scale
        enter = jnp.max(jnp.minimum(a, b) - ray.slack)
        leave = jnp.min(jnp.maximum(a, b) + ray.slack)
        passes = (enter <= leave) & (leave >= 0) & (enter <= best)
        slot = jnp.clip(node - leaves, 0, number - 1)
        distance = jnp.where(passes & (node >= leaves), _distance(tree, ray, slot), jnp.inf)
        which = tree.primitive[slot]
        nearer = (distance < best) | ((distance == best) & (distance < jnp.inf) & (which < met))
        # Behind a node: up as long as it is a right child, then to the right.
        behind = node + 1
        behind = behind >> jax.lax.population_count((behind & -behind) - 1)
        behind = jnp.where(behind == 1, 0, behind)
        node = jnp.where(passes & (node < leaves), 2 * node, behind)
        return node, jnp.where(nearer, distance, best), jnp.where(nearer, which, met)

    start = ray.real.astype(jnp.int32), jnp.array(jnp.inf, ray.slack.dtype), jnp.int32(-1)
    return jax.lax.while_loop(lambda state: state[0] > 0, visit, start)[1:]


def _distance(tree: Tree, ray: Ray, slot: Int[Array, ""]) -> Float[Array, ""]:
    """The distance of a ray's hit of a primitive; inf for a miss."""
    direction = parts(ray.direction)
    points = [parts(point - ray.origin) for point in tree.data[slot]]
    if tree.radius is None:
        return ray_triangle(direction, *points)
    return ray_sphere(direction, points[0], tree.radius[slot])
