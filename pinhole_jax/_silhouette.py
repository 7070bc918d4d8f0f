"""`silhouette`: the image of a scene's exact coverage, with its exact derivative."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from ._camera import Camera
from ._contour import Selection, contour_weights, mesh_segments, nth, select, sphere_arcs
from ._coverage import Curves, Pieces, flux, monotone, piece_counts, split
from ._linear_map import linear_map
from ._scene import Scene, astype

CURVES_AT_A_TIME = 2048
PIECES_AT_A_TIME = 4096


def silhouette(camera: Camera, scene: Scene) -> Float[Array, "H W"]:
    """Return the fraction of each pixel's square that the scene covers: (H, W), row 0 on top.

    Exact (box filter, no sampling, no blur) for closed, consistently wound meshes and for spheres,
    with its exact derivative in forward and reverse mode with respect to the camera, vertices,
    centers and radii. Cost follows the occluding contour.

    Not exact yet: pixels in which contours overlap (one part uncovered, another covered twice) and
    the contours of open or inconsistently wound meshes are summed and clamped to [0, 1]; a mesh
    or sphere that reaches behind the eye's plane is cut off without its cut.
    """
    return _silhouette(camera, scene)


@eqx.filter_jit
def _silhouette(camera: Camera, scene: Scene) -> Float[Array, "H W"]:
    return jnp.clip(winding_image(camera, astype(scene, camera.e.dtype)), 0, 1)


def winding_image(camera: Camera, scene: Scene) -> Float[Array, "H W"]:
    """Return for each pixel the mean number of layers (front faces of a closed mesh) over it."""
    total = jnp.zeros((camera.H, camera.W), camera.e.dtype)
    if scene.mesh is not None and scene.mesh.faces.shape[0]:
        weights = contour_weights(scene.mesh, camera.e)
        topology = _MeshTopology(scene.mesh.edge_vertices, weights, select(weights != 0))
        total = total + _cover(_mesh_chunk, (camera, scene.mesh.vertices), topology)
    if scene.spheres is not None and scene.spheres.radii.shape[0]:
        total = total + _cover(_sphere_chunk, (camera, scene.spheres), None)
    return total


class _MeshTopology(NamedTuple):
    edge_vertices: Array
    weights: Array
    contour: Selection


def _mesh_chunk(moving: Any, topology: _MeshTopology, first: Array) -> Curves:
    """Return contour edges number `first` onwards as segments."""
    camera, vertices = moving
    size = min(CURVES_AT_A_TIME, topology.weights.shape[0])
    rank = first + jnp.arange(size, dtype=jnp.int32)
    edge = jnp.minimum(nth(topology.contour, rank), topology.weights.shape[0] - 1)
    weight = jnp.where(rank < topology.contour.total, topology.weights[edge], 0)
    return mesh_segments(camera, vertices, topology.edge_vertices[edge], weight)


def _sphere_chunk(moving: Any, topology: None, first: Array) -> Curves:
    """Return all spheres' arcs."""
    del topology, first
    return sphere_arcs(*moving)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _cover(chunk: Callable, moving: Any, topology: Any) -> Float[Array, "H W"]:
    """Return the winding-weighted coverage of the curves that `chunk` lists.

    `moving` is what can be differentiated (a camera first), `topology` what cannot.
    """
    camera: Camera = moving[0]

    def add(deltas, first, pieces: Pieces):
        del first
        at = jnp.maximum(pieces.column, 0)
        deltas = deltas.at[pieces.row, at].add(pieces.area, mode="drop")
        return deltas.at[pieces.row, at + 1].add(pieces.height - pieces.area, mode="drop")

    deltas = jnp.zeros((camera.H, camera.W), camera.e.dtype)
    deltas = _fold_pieces(chunk, moving, topology, add, deltas)
    return jnp.flip(_row_sums(deltas), axis=0)


@partial(_cover.defjvp, symbolic_zeros=True)
def _cover_jvp(chunk: Callable, primals: Any, tangents: Any):
    """Return the image and its boundary integral for the leaves that move; others cost nothing."""
    moving, topology = primals
    leaves, tree = jax.tree.flatten(moving)
    velocities = tree.flatten_up_to(tangents[0])
    moves = [not isinstance(t, SymbolicZero) for t in velocities]
    camera: Camera = moving[0]

    def rebuild(still: list, moved: list):
        still, moved = still.copy(), moved.copy()
        return tree.unflatten([(moved if m else still).pop(0) for m in moves])

    def growth(residuals, first, pieces: Pieces):
        """Return the moving leaves and each piece's area as a function of them."""
        still, moved, topology = residuals

        def area(moved):
            curves = chunk(rebuild(still, moved), topology, first)
            return flux(jax.tree.map(lambda x: x[pieces.curve], curves), pieces, camera.W)

        return moved, area

    def forward(residuals, velocity):
        def add(image, first, pieces: Pieces):
            moved, area = growth(residuals, first, pieces)
            _, change = jax.jvp(area, (moved,), (velocity,))
            return image.at[pieces.row, jnp.maximum(pieces.column, 0)].add(change, mode="drop")

        still, moved, topology = residuals
        image = jnp.zeros((camera.H, camera.W), camera.e.dtype)
        image = _fold_pieces(chunk, rebuild(still, moved), topology, add, image)
        return jnp.flip(image, axis=0)

    def transpose(residuals, cotangent):
        cotangent = jnp.flip(cotangent, axis=0)

        def add(total, first, pieces: Pieces):
            moved, area = growth(residuals, first, pieces)
            _, pull = jax.vjp(area, moved)
            at_piece = cotangent[pieces.row, jnp.clip(pieces.column, 0, camera.W - 1)]
            return jax.tree.map(jnp.add, total, pull(at_piece)[0])

        still, moved, topology = residuals
        zeros = jax.tree.map(jnp.zeros_like, moved)
        return _fold_pieces(chunk, rebuild(still, moved), topology, add, zeros)

    still = [x for x, m in zip(leaves, moves, strict=True) if not m]
    moved = [x for x, m in zip(leaves, moves, strict=True) if m]
    velocity = [t for t, m in zip(velocities, moves, strict=True) if m]
    image = _cover(chunk, moving, topology)
    return image, linear_map(forward, transpose, (still, moved, topology), velocity)


def _fold_pieces(chunk: Callable, moving: Any, topology: Any, add: Callable, start: Any) -> Any:
    """Return `start` after `add(total, first, pieces)` over all pieces of all curves.

    A fixed number of curves, and of their pieces, is held at a time; the loop goes on until none is
    left, so no view has too many.
    """
    camera: Camera = moving[0]
    W, H = camera.W, camera.H
    size = chunk(moving, topology, jnp.int32(0)).weight.shape[0]
    count = jnp.int32(size) if topology is None else topology.contour.total

    def body(state):
        first, slot, total = state
        m = monotone(chunk(moving, topology, first))
        upto = jnp.cumsum(piece_counts(m, W, H))
        slots = slot + jnp.arange(PIECES_AT_A_TIME, dtype=jnp.int32)
        total = add(total, first, split(m, upto, slots, W, H, H))
        last = slot + PIECES_AT_A_TIME >= upto[-1]
        first = jnp.where(last, first + size, first)
        return first, jnp.where(last, 0, slot + PIECES_AT_A_TIME), total

    state = (jnp.int32(0), jnp.int32(0), start)
    return jax.lax.while_loop(lambda s: s[0] < count, body, state)[2]


def _row_sums(deltas: Float[Array, "H W"]) -> Float[Array, "H W"]:
    """Return the running sum of each row; by blocks and a small matrix, 5 times `jnp.cumsum`."""
    H, W = deltas.shape
    block = 32
    upper = jnp.triu(jnp.ones((block, block), deltas.dtype))
    blocks = jnp.pad(deltas, ((0, 0), (0, -W % block))).reshape(H, -1, block)
    within = jnp.matmul(blocks, upper, precision=jax.lax.Precision.HIGHEST)
    before = jnp.cumsum(within[..., -1], axis=1) - within[..., -1]
    return (within + before[..., None]).reshape(H, -1)[:, :W]
