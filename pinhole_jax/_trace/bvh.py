"""A bounding volume hierarchy without pointers, and a list's wanted entries.

Primitives in the order of a space-filling curve, spread evenly over 2^k leaves, make a complete
binary tree. Of its levels every third is kept, so a node has eight children (the root as many as
make that come out even), and one node's boxes fill vectors. Boxes are made from the vertices at
hand by a few reductions, so they are never stale; only the order is worked out once per mesh.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._numerics.bitset import words_of
from .._numerics.running import running_sum
from .._scene.scene import Mesh, Spheres, morton_order
from .components import Parts

LEAF = 4  # primitives in a leaf, at most; a vector of them is tested at once
BITS = 3
CHILDREN = 1 << BITS  # of a node


class Tree(NamedTuple):
    """Boxes of the children of each inner node, and what is in the leaves.

    Nodes are numbered level by level from the root, 0, the leaves last; boxes of children that a
    root does not have are empty, and come first.

    - `planes`: the boxes' low and high x, y, z by rows.
    - `primitive`: indices of what is in the leaves; the last may be there several times.
    - `data`: its x, y and z by rows, of one corner after the other, or of centres, and radii.
    - `largest`: the largest extent of a primitive along an axis.
    """

    planes: Float[Array, "nodes 6 children"]
    primitive: Int[Array, "leaves leaf"]
    data: Float[Array, "leaves rows columns"]
    largest: Float[Array, ""]


def mesh_tree(mesh: Mesh) -> Tree:
    """Return the tree over a mesh of at least one face."""
    corners = jax.lax.stop_gradient(mesh.vertices)[mesh.faces]
    low, high = jnp.min(corners, axis=1), jnp.max(corners, axis=1)
    return _build(mesh.order, low, high, jnp.swapaxes(corners, 1, 2))


def sphere_tree(spheres: Spheres) -> Tree:
    """Return the tree over at least one sphere."""
    centers, radii = jax.lax.stop_gradient((spheres.centers, spheres.radii[:, None]))
    rows = jnp.concatenate([centers, radii], axis=1)[:, :, None]
    return _build(morton_order(centers), centers - radii, centers + radii, rows)


def levels(tree: Tree) -> int:
    """Return how many levels of nodes there are above the leaves."""
    return -(-(tree.primitive.shape[0].bit_length() - 1) // BITS)


def _build(order, low, high, rows: Float[Array, "F rows corners"]) -> Tree:
    F = rows.shape[0]
    leaves = max(2, 1 << (-(-F // LEAF) - 1).bit_length())
    first = np.arange(leaves + 1, dtype=np.int64) * F // leaves
    slots = first[:-1, None] + np.arange(LEAF)
    slots = np.minimum(slots, np.maximum(first[1:, None] - 1, 0))  # the last is there again
    index = order[jnp.asarray(slots.astype(np.int32), np.int32)]
    data = jnp.moveaxis(rows[index], 1, -1).reshape(leaves, rows.shape[1], -1)
    eps, extent = jnp.finfo(low.dtype).eps, jnp.max(high - low, axis=1, keepdims=True)
    # Slivers are met up to the root of the rounding beside them: so much their test leaves open.
    pad = 4 * eps * jnp.maximum(jnp.abs(low), jnp.abs(high)) + 16 * eps**0.5 * extent
    low, high = jnp.min((low - pad)[index], axis=1), jnp.max((high + pad)[index], axis=1)
    return Tree(_planes(low, high), index, data, jnp.max(extent))


def _planes(low: Float[Array, "leaves 3"], high: Float[Array, "leaves 3"]) -> Array:
    """Return the planes of boxes of all nodes' children, from those of the leaves."""
    nodes = []
    while low.shape[0] > 1:
        fill = ((-low.shape[0] % CHILDREN, 0), (0, 0))  # the root may have fewer: its last ones
        low = jnp.pad(low, fill, constant_values=jnp.inf).reshape(-1, CHILDREN, 3)
        high = jnp.pad(high, fill, constant_values=-jnp.inf).reshape(-1, CHILDREN, 3)
        nodes.append(jnp.swapaxes(jnp.concatenate([low, high], axis=2), 1, 2))
        low, high = jnp.min(low, axis=1), jnp.max(high, axis=1)
    return jnp.concatenate(nodes[::-1])


def permuted(vector: Parts, axis: Array, sign: Array | int) -> tuple[Array, Array, Array]:
    """Return the components, turned so that `axis` comes last, and that one times `sign`."""
    x, y, z = vector
    pick = lambda a, b, c: jnp.where(axis == 0, a, jnp.where(axis == 1, b, c))
    return pick(y, z, x), pick(z, x, y), pick(x, y, z) * sign


def packed(mask: Bool[Array, "n"], values: Int[Array, "n"]) -> tuple[Array, Array]:
    """Return the values where the mask is set, in order and at the front, and how many these are.

    n is a multiple of 32. Ranks come from 32-bit words: a prefix sum over words, and the number of
    bits set below each bit.
    """
    n = mask.shape[0]
    shift = jnp.arange(32, dtype=jnp.uint32)[None]
    words = words_of(mask)
    end = running_sum(jax.lax.population_count(words).astype(jnp.int32))
    below = words[:, None] & ((jnp.uint32(1) << shift) - 1)
    start = end - jax.lax.population_count(words).astype(jnp.int32)
    rank = start[:, None] + jax.lax.population_count(below).astype(jnp.int32)
    place = jnp.where(mask, rank.reshape(-1), n)
    out = jnp.zeros(n + 1, values.dtype).at[place].set(values, mode="promise_in_bounds")
    return out[:n], end[-1]
