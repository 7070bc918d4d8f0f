"""Which primitive each ray meets first: down the tree, packet after packet or ray after ray.

What a ray does next depends on what it met: vectors of many rays wait for the slowest, or look at
all that each may meet. A compiled loop over rays does neither, and XLA's CPU compiler makes one of
a call that it is told to make a single kernel of. In it a vector is the eight boxes of a node, the
primitives of a leaf or, of rays that stay together, the rays of a packet. On other
machines rays go side by side (`_side_by_side`).
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._numerics.one_kernel import by_machine, one_kernel
from .bvh import Tree
from .components import parts
from .search import depths_of, search
from .together import ALONE, RAYS, Beam, beam_of, beams, children, first_met_of_packet
from .turned import Ray, turned

Vectors = Float[Array, "N 3"]
BESIDE = 1 << 15  # rays side by side: memory for what each has still to look at


def walk(
    tree: Tree,
    origin: Vectors,
    direction: Vectors,
    axis: Int[Array, "N"],
    order: Int[Array, "N"],
    together: bool = False,
) -> Int[Array, "N"]:
    """Return the index of the primitive that each ray meets first, -1 for none; each ray's axis,
    along which it is tested, is given.

    `order` is that in which rays are taken; a ray that is not in it gets -1. Where all are, those
    that follow one another may be searched for `together`.
    """
    # Rays are turned first: what is read where it is would be waited for.
    ray = jnp.maximum(order, 0)
    rays = turned(parts(origin[ray]), parts(direction[ray]), axis[ray])
    nothing = jnp.full(order.shape, -1, jnp.int32)
    return by_machine(
        tree,
        rays,
        order,
        nothing,
        cpu=_by_packets if together else one_kernel(_in_turn),
        elsewhere=_side_by_side,
    )


def _in_turn(
    tree: Tree, rays: Ray, order: Int[Array, "N"], met: Int[Array, "N"]
) -> Int[Array, "N"]:
    def one(state):
        k, met = state
        first = _first_met(tree, jax.tree.map(lambda x: x[k], rays))
        return k + 1, jax.lax.dynamic_update_slice(met, first[None], (order[k],))

    N = order.shape[0]
    more = lambda state: (state[0] < N) & (order[jnp.minimum(state[0], N - 1)] >= 0)
    return jax.lax.while_loop(more, one, (jnp.int32(0), met))[1]


def _by_packets(
    tree: Tree, rays: Ray, order: Int[Array, "N"], met: Int[Array, "N"]
) -> Int[Array, "N"]:
    return one_kernel(_packets_in_turn)(tree, rays, beams(rays), order, met)


def _packets_in_turn(
    tree: Tree, rays: Ray, beam: Beam, order: Int[Array, "N"], met: Int[Array, "N"]
) -> Int[Array, "N"]:
    """Search for packets together where they have bounds; and for their rays one by one where they
    have none, or come to no end, and then for those of some packets that follow."""
    N = order.shape[0]

    def packet(k, state):
        alone, met = state
        first = jnp.minimum(RAYS * k, N - RAYS)  # the last may hold some of the one before
        here = jax.tree.map(lambda x: jax.lax.dynamic_slice(x, (first,), (RAYS,)), rays)
        bounds = jax.tree.map(lambda x: x[k], beam)
        tried = bounds.whole & (alone <= 0)
        none = jnp.full(RAYS, -1, jnp.int32)
        together = lambda: first_met_of_packet(tree, here, bounds)
        found, done = jax.lax.cond(tried, together, lambda: (none, False))
        one_by_one = lambda: jax.lax.fori_loop(0, RAYS, partial(ray, first), none)
        found = jax.lax.cond(done, lambda: found, one_by_one)
        alone = jnp.where(done, 0, jnp.where(tried, ALONE, alone - 1))
        return alone, jax.lax.fori_loop(0, RAYS, partial(put, first, found), met)

    def ray(first, i, found):
        which = _first_met(tree, jax.tree.map(lambda x: x[first + i], rays))
        return jax.lax.dynamic_update_slice(found, which[None], (i,))

    def put(first, found, i, met):
        return jax.lax.dynamic_update_slice(met, found[i][None], (order[first + i],))

    return jax.lax.fori_loop(0, -(-N // RAYS), packet, (jnp.int32(0), met))[1]


def _side_by_side(
    tree: Tree, rays: Ray, order: Int[Array, "N"], met: Int[Array, "N"]
) -> Int[Array, "N"]:
    N = order.shape[0]
    found = jax.lax.map(partial(_first_met, tree), rays, batch_size=min(BESIDE, N))
    return met.at[jnp.where(order < 0, N, order)].set(found, mode="drop")


def _first_met(tree: Tree, ray: Ray) -> Int[Array, ""]:
    """Return the index of the primitive that a ray meets first, -1 for none."""
    best, met = jnp.array(jnp.inf, ray.line[0].dtype), jnp.int32(-1)
    look, test = partial(children, tree, beam_of(ray)), partial(_met_in_leaf, tree, ray)
    return search(tree, look, test, best, met, ray.real).met


def _met_in_leaf(tree: Tree, ray: Ray, leaf: Int[Array, ""], best: Array, met: Array):
    """Return how deep the nearest of what was met and of what is in a leaf is, and its index."""
    depth = depths_of(tree, ray.line, ray.axes, ray.scale[2], leaf)
    here = jnp.min(depth)

    def nearer(met):
        index = jax.lax.dynamic_index_in_dim(tree.primitive, leaf, keepdims=False)
        first = jnp.min(jnp.where(depth == here, index, jnp.iinfo(jnp.int32).max))
        return jnp.where((here < best) | (first < met), first, met)

    some = (here <= best) & (here < jnp.inf)
    met = jax.lax.cond(some, nearer, lambda met: met, met)  # their indices are rarely read
    return jnp.minimum(here, best), met
