"""The curves that bound a scene's image, and their motion.

A closed mesh is seen as its front-facing triangles; they end where a front-facing one meets a
back-facing one. An open mesh shows both sides of each triangle, and its borders end it too. A
sphere is seen as a conic. Every curve is monotone in x and in y, with its covered side on the left.

All edges and all arcs of all conics go side by side; invisible ones have no parts. Through a lens
with distortion, a curve has enough straight parts to follow its image.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._camera.film import Bend, FilmMap, film_points
from .._native.rasteriser import sphere_frames
from .._numerics.safe import binary_inverse, norm, safe_divide
from .._scene.scene import Mesh, Scene, Spheres, front_facing
from .clip import Curve, cut_off
from .conics import arc_end, film_at
from .pieces import Arcs, Monotone
from .spheres import ARCS_PER_SPHERE, Arc, arc_within, shown_arcs

#: Numbers of curves, or of parts.
Ids = Int[Array, "K"]
#: The largest distance of straight parts from a bent curve (px), and the largest number of parts.
STRAY_PX, MOST_PARTS = 2e-4, 1 << 14
#: The allowance for second derivatives between the points where they are measured.
MARGIN = 1.3
#: Stretches in which a curve's bending is measured; two for edges shorter than this on the film.
STRETCHES, SHORT = 16, 1 / 16


class Contour(NamedTuple):
    """A view's curves, cut into parts: `upto` is the running sum of their numbers of parts.

    Edges come first, then their parts left of the film, then those of bent arcs, then arcs. `tail`
    and `head` are a curve's ends before a lens bends it (px); `weight` is the number of layers on
    its left less those on its right. `frames` are spheres' outlines as conics, `arcs` stretches of
    them through a lens. What moves is tails, heads, frames and the lens (`bend`).
    """

    tail: Float[Array, "G 2"]
    head: Float[Array, "G 2"]
    weight: Float[Array, "G"]
    upto: Int[Array, "G"]
    frames: Float[Array, "S 3 3"] | None
    arcs: Arc | None
    bend: Bend | None

    @classmethod
    def from_scene(cls, film: FilmMap, scene: Scene) -> "Contour":
        """The curves of a scene."""
        kinds, frames, arcs = [], None, None
        if scene.mesh is not None:
            kinds.extend(edge_curves(film, scene.mesh))
        if scene.spheres is not None:
            frames = sphere_frames(film, scene.spheres).reshape(-1, 3, 3)
            more, arcs = _arcs(*jax.lax.stop_gradient((frames, film, scene.spheres)))
            kinds.extend(more)
        tail, head, weight = (jnp.concatenate(x) for x in zip(*kinds, strict=True))
        seen = (weight != 0).astype(jnp.int32)
        curves = cls(tail, head, weight, seen, frames, arcs, film.bend)
        parts = seen if film.bend is None else jax.lax.stop_gradient(curves)._parts(film)
        return curves._replace(upto=jax.lax.cumsum(parts))

    @property
    def number(self) -> int:
        """The number of curves, visible or not."""
        return self.weight.shape[0]

    def monotone(self, ids: Ids) -> Monotone:
        """Parts from their lower to their upper end; without weight past the last one."""
        curve, *shares = self._find(ids)
        tail, head = (self._image(curve, share) for share in shares)
        weight = jnp.where(ids < self.upto[-1], self.weight[curve], 0)
        if self.frames is None or self.bend is not None:  # (a lens makes straight parts of arcs)
            return Monotone.from_ends(tail, head, weight, None)
        arc = self._arc(curve)
        arcs = Arcs(self.frames[self._sphere(arc)], arc >= 0)
        return Monotone.from_ends(tail, head, weight, arcs)

    def sphere(self, ids: Ids) -> Ids:
        """The sphere of each part; any for edges."""
        return self._sphere(self._arc(self._find(ids)[0]))

    def speeds(self, moved: "Contour", ids: Ids) -> Float[Array, "K 2"]:
        """Numbers with the derivatives of straight parts' motion at tail and head, where curves
        are `moved`: upwards for flat parts, to the right for steep ones."""
        curve, *shares = self._find(ids)
        tail, head = (self._image(curve, share) for share in shares)
        way = head - tail
        steep = jnp.abs(way[:, 1]) > jnp.abs(way[:, 0])
        slope = jnp.where(steep, *(safe_divide(way[:, k], way[:, 1 - k]) for k in (0, 1)))

        def speed(share):
            x, y = moved._image(curve, share).T
            return jnp.where(steep, x - slope * y, y - slope * x)

        return jnp.stack([speed(share) for share in shares], axis=1)

    # --- parts and their points ---

    def _find(self, ids: Ids) -> tuple[Array, Array, Array]:
        """The curve of each part, and the shares of it at which the part begins and ends."""
        curve = jnp.searchsorted(self.upto, ids, side="right").astype(jnp.int32)
        curve = jnp.minimum(curve, self.number - 1)
        before = jnp.where(curve > 0, self.upto[curve - 1], 0)
        part, real = ids - before, self.weight.dtype
        parts = jnp.maximum(self.upto[curve] - before, 1).astype(real)
        return curve, part.astype(real) / parts, (part + 1).astype(real) / parts

    def _arc(self, curve: Ids) -> Ids:
        """Numbers of arcs; below 0 for other curves."""
        spheres = 0 if self.frames is None else self.frames.shape[0]
        return curve - (self.number - ARCS_PER_SPHERE * spheres)

    def _sphere(self, arc: Ids) -> Ids:
        return jnp.maximum(arc, 0) // ARCS_PER_SPHERE

    def _image(self, curve: Ids, share: Float[Array, "K"]) -> Float[Array, "K 2"]:
        """Points of curves, which go with them."""
        (tail, head), t = (x[curve] for x in (self.tail, self.head)), share[:, None]
        point = jnp.where(t >= 1, head, tail + t * (head - tail))
        if self.bend is None:
            return point
        if self.arcs is not None and self.frames is not None:
            arc = self._arc(curve)
            own = jax.tree.map(lambda x: x[jnp.maximum(arc, 0)], self.arcs)
            bent = film_at(self.frames[self._sphere(arc)], own.turned(share))
            point = jnp.where(arc[:, None] >= 0, bent, point)
        return self.bend(point)

    def _parts(self, film: FilmMap) -> Int[Array, "G"]:
        """The number of straight parts of each curve through the lens."""
        curve = jnp.arange(self.number, dtype=jnp.int32)
        shorter = norm(self.head - self.tail) < SHORT * min(film.W, film.H)
        stretches = jnp.where(shorter & (self._arc(curve) < 0), 2, STRETCHES)
        point = lambda k: self._image(curve, k / stretches.astype(self.tail.dtype))

        def further(k, state):
            before, last, second = state
            here = point(k)
            bent = jnp.where((k > 1) & (k <= stretches), norm(before - 2 * last + here), 0)
            return last, here, jnp.maximum(second, bent)

        start = point(0)
        second = jax.lax.fori_loop(1, STRETCHES + 1, further, (start, start, start[:, 0] * 0))[2]
        needed = jnp.ceil(jnp.sqrt(MARGIN * second * stretches**2 / (8 * STRAY_PX)))
        parts = jnp.clip(needed, 1, MOST_PARTS).astype(jnp.int32)
        # (Parts left of the film are invisible: they stay whole.)
        left = film.bounds[0]
        whole = (self.tail[:, 0] == left) & (self.head[:, 0] == left)
        return jnp.where(self.weight == 0, 0, jnp.where(whole, 1, parts))


def edge_curves(film: FilmMap, mesh: Mesh) -> list[Curve]:
    """The parts of edges near the film, and those left of it."""
    weight = contour_weights(mesh, film.eye)
    edges = film_points(film, mesh.vertices)[mesh.edge_vertices]
    edges = edges * binary_inverse(jnp.max(jnp.abs(edges), axis=-1))[..., None]
    return cut_off(edges, weight.astype(edges.dtype), film.bounds)


def contour_weights(mesh: Mesh, e: Float[Array, "3"]) -> Int[Array, "E"]:
    """The number of layers on each edge's left less those on its right; 0 off the contour.

    A closed mesh counts front-facing triangles only; any other mesh counts every triangle, from
    whichever side it is seen.
    """
    front, (first, second) = front_facing(mesh, e), mesh.edge_faces.T
    border, positive = second < 0, front[first]
    inner = jnp.where(border | mesh.closed, 1, 2)
    seen = border | (front[jnp.maximum(second, 0)] != positive)
    return jnp.where(seen, jnp.where(positive, inner, -inner), 0)


def _arcs(
    frames: Float[Array, "S 3 3"], film: FilmMap, spheres: Spheres
) -> tuple[list[Curve], Arc | None]:
    """The monotone arcs of spheres' outlines.

    Through a lens also the parts left of the film, and the arcs' stretches within its bounds.
    """
    apart = norm(spheres.centers - film.eye[None])
    start, end, weight = shown_arcs(frames, apart > spheres.radii)
    frame = jnp.repeat(frames, ARCS_PER_SPHERE, axis=0)
    if film.bend is None:
        return [(arc_end(frame, start, 1), arc_end(frame, end, -1), weight)], None
    arc, heights, beside = arc_within(film.bounds, frame, start, end)
    tail, head = (jnp.stack([jnp.full_like(y, film.bounds[0]), y], -1) for y in heights.T)
    nowhere = jnp.zeros_like(tail)
    left = tail, head, jnp.where(beside, weight, 0)
    return [left, (nowhere, nowhere, jnp.where(arc.begin < arc.finish, weight, 0))], arc
