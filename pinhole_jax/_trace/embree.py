"""Which face each ray meets first: Embree is asked, and the tree where its answer is in doubt.

Embree reckons in float32. It is given faces that are somewhat larger than they are, so that a ray
that meets a face by our test meets it there too, unless the face is seen from its side. What it
finds is in doubt where our own test does not say that the ray passes well within the face, where
another face has the same corners, and for rays that start far away or next to a face. Such rays are
searched for in the tree, so ties are resolved as there.

What is left: faces that lie over one another within about 1e-6 of the scene's size, without an edge
in common, of which Embree may name the second, whose hit is that much further; and slivers seen
from their side, which it may miss. (The margins are estimates of float32's errors, not bounds: of
160 000 rays none differed.)
"""

import importlib
import itertools
import weakref
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._numerics.batches import in_turn
from .bvh import Tree, packed, permuted
from .components import largest, parts
from .order import order_of
from .packets import Vectors, axes_of
from .walk import walk

#: By how much faces are larger, and within which distance of an edge, or of the ray's origin, a hit
#: is in doubt; the scene's size is about 1.
LARGER, DOUBT = 2e-6, 6e-6
#: A face is enlarged at most this many times: a sliver's corners would go far away.
AT_MOST = 3.0
#: From so far away (in scenes) on, float32 says too little of where a ray is.
FAR = 8.0


class Faces(NamedTuple):
    """Corners' places, which of these are a face's, and the number of the `Held` made of them."""

    vertices: Float[Array, "V 3"]
    faces: Int[Array, "F 3"]
    held: Int[Array, ""]


def check_installed() -> None:
    """Raise ImportError unless Embree can be called."""
    try:
        importlib.import_module("embreex.rtcore_scene")
    except ImportError as error:
        raise ImportError(
            "`search`: expected 'tree', as embreex is not installed, got 'embree'; "
            "pip install 'pinhole-jax[embree]'"
        ) from error


class Held:
    """A mesh as Embree holds it. `number` is what a compiled program knows it by."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        scenes = importlib.import_module("embreex.rtcore_scene")
        meshes = importlib.import_module("embreex.mesh_construction")
        corners = np.asarray(vertices)[np.asarray(faces)]
        self._scene = scenes.EmbreeScene(robust=True)
        self._mesh = meshes.TriangleMesh(self._scene, _larger(corners).astype(np.float32))
        self._twin = _has_twin(corners)
        self.number = next(_numbers)
        _held[self.number] = self

    def first(self, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the first face of each ray, -1 for none, and whether it has a twin."""
        rays = (np.ascontiguousarray(x, np.float32) for x in (origin, direction))
        face = np.asarray(self._scene.run(*rays), np.int32)
        return face, self._twin[face] & (face >= 0)


_numbers = itertools.count()
_held: weakref.WeakValueDictionary[int, Held] = weakref.WeakValueDictionary()


@jax.custom_batching.custom_vmap
def first_met(tree: Tree, mesh: Faces, origin: Vectors, direction: Vectors) -> Int[Array, "N"]:
    """Return the index of the face that each ray meets first, -1 for none.

    The arguments of `packets.first_met`, and its answers; the scene's size is about 1.
    """
    N = direction.shape[0]
    if N == 0:
        return jnp.zeros(0, jnp.int32)
    like = jax.ShapeDtypeStruct((N,), jnp.int32), jax.ShapeDtypeStruct((N,), jnp.bool_)
    # From a little behind: what is met next to the origin is in doubt, and must not be passed by.
    behind = origin - 2 * DOUBT * direction
    # In such an order Embree takes half as long, too.
    order = order_of(tree, origin, direction)
    face, twin = jax.pure_callback(
        _ask, like, mesh, behind, direction, order, vmap_method="sequential"
    )
    axis = axes_of(parts(direction))
    sure = _near_and_real(origin, direction)
    sure &= (face < 0) | (~twin & _well_within(mesh, origin, direction, axis, face))
    return _searched_again(tree, origin, direction, axis, face, ~sure)


@first_met.def_vmap
def _batched(size: int, batched: list, tree: Tree, mesh: Faces, origin: Array, direction: Array):
    """One batch of rays is more rays; many meshes are asked in turn."""
    if any(jax.tree.leaves(batched[:2])):
        return in_turn(first_met, batched, (tree, mesh, origin, direction)), True
    spread = lambda x, b: x if b else jnp.broadcast_to(x, (size, *x.shape))
    origin, direction = spread(origin, batched[2]), spread(direction, batched[3])
    met = first_met(tree, mesh, origin.reshape(-1, 3), direction.reshape(-1, 3))
    return met.reshape(size, -1), True


def _ask(
    mesh: Faces, origin: Array, direction: Array, order: Array
) -> tuple[np.ndarray, np.ndarray]:
    """Return Embree's answers; of a mesh that is not held (a traced one) it is made now."""
    held = _held.get(int(mesh.held))
    held = held or Held(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    ray = np.asarray(order)
    face, twin = np.empty(len(ray), np.int32), np.empty(len(ray), bool)
    face[ray], twin[ray] = held.first(np.asarray(origin)[ray], np.asarray(direction)[ray])
    return face, twin


def _near_and_real(origin: Vectors, direction: Vectors) -> Bool[Array, "N"]:
    """Return which rays Embree can be asked about; not one that is not finite."""
    size = largest(parts(direction))
    return (largest(parts(origin)) < FAR) & (size > 0.25) & (size < 4)


def _well_within(
    mesh: Faces, origin: Vectors, direction: Vectors, axis: Int[Array, "N"], face: Int[Array, "N"]
) -> Bool[Array, "N"]:
    """Return whether rays pass well within the faces and well ahead of their origins."""
    x, y, z = permuted(parts(direction), axis, 1)
    index = jnp.maximum(face, 0)
    seen = []
    for k in range(3):
        corner = mesh.faces[index, k]
        offset = [mesh.vertices[corner, i] - origin[:, i] for i in range(3)]
        u, v, w = permuted(offset, axis, 1)
        seen.append((u - x / z * w, v - y / z * w, w / z))
    p, q, r = seen
    areas, well = [], True
    for a, b in ((q, r), (r, p), (p, q)):
        area, side = a[0] * b[1] - a[1] * b[0], (b[0] - a[0], b[1] - a[1])
        areas.append(area)
        well &= jnp.abs(area) > DOUBT * jnp.sqrt(side[0] * side[0] + side[1] * side[1])
    u, v, w = areas
    well &= ((u > 0) & (v > 0) & (w > 0)) | ((u < 0) & (v < 0) & (w < 0))
    depth = (u * p[2] + v * q[2] + w * r[2]) / jnp.where(u + v + w == 0, 1, u + v + w)
    return well & (depth > 4 * DOUBT)


def _searched_again(tree: Tree, origin, direction, axis, face, doubt) -> Int[Array, "N"]:
    """Return the faces, those in doubt as the tree finds them."""
    N = face.shape[0]
    fill = -N % 32
    ids, number = packed(jnp.pad(doubt, (0, fill)), jnp.arange(N + fill, dtype=jnp.int32))
    order = jnp.where(jnp.arange(N, dtype=jnp.int32) < number, ids[:N], -1)
    return jnp.where(doubt, walk(tree, origin, direction, axis, order), face)


def _has_twin(corners: np.ndarray) -> np.ndarray:
    """Return which faces (F, 3, 3) have their three corners in common with another; those whose
    checksums are equal by chance, too."""
    bits = np.ascontiguousarray(corners + 0.0).view(np.uint32).reshape(*corners.shape[:2], -1)
    weights = np.random.default_rng(0).integers(1, 1 << 63, bits.shape[2], np.uint64) | np.uint64(1)
    mixed = (bits * weights).sum(axis=2, dtype=np.uint64)
    mixed = (mixed ^ (mixed >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
    checksum = (mixed ^ (mixed >> np.uint64(32))).sum(axis=1, dtype=np.uint64)
    _, which, number = np.unique(checksum, return_inverse=True, return_counts=True)
    return number[which] > 1


def _larger(corners: np.ndarray) -> np.ndarray:
    """Return triangles (F, 3, 3) whose edges are further out, by `LARGER` where that can be."""
    a, b, c = (corners[:, k].astype(float) for k in range(3))
    sides = np.stack([np.linalg.norm(x - y, axis=1) for x, y in ((b, c), (c, a), (a, b))], axis=1)
    around = np.maximum(sides.sum(axis=1), np.finfo(float).tiny)
    centre = np.einsum("fk,fkx->fx", sides, corners.astype(float)) / around[:, None]
    radius = np.linalg.norm(np.cross(b - a, c - a), axis=1) / around  # of the circle within
    factor = 1 + np.minimum(LARGER / np.maximum(radius, 1e-30), AT_MOST - 1)
    return centre[:, None] + factor[:, None, None] * (corners - centre[:, None])
