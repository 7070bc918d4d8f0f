"""A bounding volume hierarchy that has no pointers.

Faces in the mesh's Morton order, `LEAF` to a leaf, are the leaves of a complete binary tree in heap
layout: node n has children 2n and 2n+1, and the node after n's subtree in depth-first order is n+1
with its trailing zero bits shifted out. Boxes are made from the vertices at hand by a few
reductions, so they are never stale; only the order is worked out ahead, once per mesh.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ._scene import Mesh

LEAF = 4


class Tree(NamedTuple):
    """Boxes of a heap of 2 * `leaves` nodes (number 0 unused), and the faces of each leaf."""

    low: Float[Array, "N 3"]
    high: Float[Array, "N 3"]
    faces: Int[Array, "leaves leaf"]
    corners: Float[Array, "leaves leaf 3 3"]

    @property
    def leaves(self) -> int:
        return self.faces.shape[0]


def build(mesh: Mesh) -> Tree:
    """Return the tree over a mesh of at least one face; the last leaves may repeat a face."""
    F = mesh.faces.shape[0]
    leaves = 1 << max(-(-F // LEAF) - 1, 0).bit_length()
    slot = jnp.minimum(jnp.arange(leaves * LEAF), F - 1)
    faces = mesh.order[slot].reshape(leaves, LEAF)
    corners = jax.lax.stop_gradient(mesh.vertices)[mesh.faces[faces]]
    low, high = jnp.min(corners, axis=(1, 2)), jnp.max(corners, axis=(1, 2))
    pad = 4 * jnp.finfo(low.dtype).eps * jnp.maximum(jnp.abs(low), jnp.abs(high))
    lows, highs = [low - pad], [high + pad]
    while lows[0].shape[0] > 1:
        lows.insert(0, jnp.min(lows[0].reshape(-1, 2, 3), axis=1))
        highs.insert(0, jnp.max(highs[0].reshape(-1, 2, 3), axis=1))
    unused = jnp.zeros((1, 3), low.dtype)
    return Tree(jnp.concatenate([unused, *lows]), jnp.concatenate([unused, *highs]), faces, corners)


def after(node: Int[Array, "*batch"]) -> Int[Array, "*batch"]:
    """Return the node that follows a node's subtree in depth-first order; 1 after the last."""
    following = node + 1
    return following >> jax.lax.population_count(~following & (following - 1))
