"""The curves that bound a scene's image, and their motion.

A closed mesh is seen as its front-facing triangles; they end where a front-facing one meets a
back-facing one. An open mesh shows both sides of each triangle, and its borders end it too. A
sphere is seen as a conic. Every curve is monotone in x and in y, with its covered side on the left.

All edges and all arcs of all conics go side by side; invisible ones have no parts. Through a lens
with distortion, a curve has enough straight parts to follow its image.
"""

from typing import NamedTuple

import equinox as eqx
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

#: The largest distance of straight parts from a bent curve (px), and the largest number of parts.
STRAY_PX, MOST_PARTS = 2e-4, 1 << 14
#: The allowance for second derivatives between the points where they are measured.
MARGIN = 1.3
#: Stretches in which a curve's bending is measured; two for edges shorter than this on the film.
STRETCHES, SHORT = 16, 1 / 16


class Moving(NamedTuple):
    """The variables of curves: homogeneous film points of a mesh's vertices, spheres' outlines as
    conics, and a lens; None where a scene has none."""

    points: Float[Array, "V 3"] | None
    frames: Float[Array, "S 3 3"] | None
    bend: Bend | None

    @classmethod
    def from_scene(cls, film: FilmMap, scene: Scene) -> "Moving":
        """The variables of a scene's curves."""
        mesh, spheres = scene.mesh, scene.spheres
        points = None if mesh is None else film_points(film, mesh.vertices)
        frames = None if spheres is None else sphere_frames(film, spheres).reshape(-1, 3, 3)
        return cls(points, frames, film.bend)


class Contour(NamedTuple):
    """A view's curves, cut into parts: `upto` is the running sum of their numbers of parts.

    Edges come first, then their parts left of the film, then those of bent arcs, then arcs. `tail`
    and `head` are a curve's ends before a lens bends it (px); `weight` is the number of layers on
    its left less those on its right. `ends` are the vertices of edges, `arcs` stretches of `frames`
    through a lens.
    """

    tail: Float[Array, "G 2"]
    head: Float[Array, "G 2"]
    weight: Float[Array, "G"]
    upto: Int[Array, "G"]
    ends: Int[Array, "E 2"] | None
    points: Float[Array, "V 3"] | None
    frames: Float[Array, "S 3 3"] | None
    arcs: Arc | None
    bend: Bend | None

    @classmethod
    def from_scene(cls, moving: Moving, film: FilmMap, scene: Scene) -> "Contour":
        """The curves of a scene."""
        mesh, spheres, kinds, arcs = scene.mesh, scene.spheres, [], None
        if mesh is not None and moving.points is not None:
            kinds.extend(edge_curves(moving.points, film, mesh))
        if spheres is not None and moving.frames is not None:
            more, arcs = _arcs(moving.frames, film, spheres)
            kinds.extend(more)
        tail, head, weight = (jnp.concatenate(x) for x in zip(*kinds, strict=True))
        ends = None if mesh is None else mesh.edge_vertices
        seen = (weight != 0).astype(jnp.int32)
        curves = cls(tail, head, weight, seen, ends, *moving[:2], arcs, moving.bend)
        parts = seen if film.bend is None else curves._parts(film)
        return curves._replace(upto=jax.lax.cumsum(parts))

    @property
    def number(self) -> int:
        """The number of curves, visible or not."""
        return self.weight.shape[0]

    def monotone(self, ids: Int[Array, "K"]) -> Monotone:
        """Parts from their lower to their upper end; without weight past the last one."""
        curve, *shares = self._find(ids)
        tail, head = (self._image(curve, share) for share in shares)
        weight = jnp.where(ids < self.upto[-1], self.weight[curve], 0)
        if self.frames is None or self.bend is not None:  # (a lens makes straight parts of arcs)
            return Monotone.from_ends(tail, head, weight, None)
        arc = self._arc(curve)
        arcs = Arcs(self.frames[self._sphere(arc)], arc >= 0)
        return Monotone.from_ends(tail, head, weight, arcs)

    def sphere(self, ids: Int[Array, "K"]) -> Int[Array, "K"]:
        """The sphere of each part; any for edges."""
        return self._sphere(self._arc(self._find(ids)[0]))

    def carried(self, moving: Moving, ids: Int[Array, "K"]) -> list[Float[Array, "K 2"]]:
        """The ends of parts, tail and head, as functions of the variables."""
        curve, *shares = self._find(ids)
        return [self._carried(moving, curve, share) for share in shares]

    # --- parts and their points ---

    def _find(self, ids: Int[Array, "K"]) -> tuple[Array, Array, Array]:
        """The curve of each part, and the shares of it at which the part begins and ends."""
        curve = jnp.searchsorted(self.upto, ids, side="right").astype(jnp.int32)
        curve = jnp.minimum(curve, self.number - 1)
        before = jnp.where(curve > 0, self.upto[curve - 1], 0)
        part, real = ids - before, self.weight.dtype
        parts = jnp.maximum(self.upto[curve] - before, 1).astype(real)
        return curve, part.astype(real) / parts, (part + 1).astype(real) / parts

    def _arc(self, curve: Int[Array, "K"]) -> Int[Array, "K"]:
        """Numbers of arcs; below 0 for other curves."""
        spheres = 0 if self.frames is None else self.frames.shape[0]
        return curve - (self.number - ARCS_PER_SPHERE * spheres)

    def _sphere(self, arc: Int[Array, "K"]) -> Int[Array, "K"]:
        return jnp.maximum(arc, 0) // ARCS_PER_SPHERE

    def _ideal(self, curve: Int[Array, "K"], share: Float[Array, "K"]) -> Float[Array, "K 2"]:
        """Points of curves before a lens bends them."""
        (tail, head), t = (x[curve] for x in (self.tail, self.head)), share[:, None]
        point = jnp.where(t >= 1, head, tail + t * (head - tail))
        if self.arcs is None or self.frames is None:
            return point
        arc = self._arc(curve)
        bent = film_at(self.frames[self._sphere(arc)], self._turned(arc, share))
        return jnp.where(arc[:, None] >= 0, bent, point)

    def _turned(self, arc: Int[Array, "K"], share: Float[Array, "K"]) -> Float[Array, "K 2"]:
        """Points of the unit circle at a share of arcs."""
        assert self.arcs is not None
        return jax.tree.map(lambda x: x[jnp.maximum(arc, 0)], self.arcs).turned(share)

    def _image(self, curve: Array, share: Array) -> Float[Array, "K 2"]:
        point = self._ideal(curve, share)
        return point if self.bend is None else self.bend(point)

    def _carried(self, moving: Moving, curve: Array, share: Array) -> Float[Array, "K 2"]:
        """Points fixed on the curves, as functions of the variables."""
        at = self._ideal(curve, share)
        if self.ends is not None and self.points is not None and moving.points is not None:
            E = self.ends.shape[0]
            own = self.ends[jnp.minimum(curve, E - 1)]
            shares = jax.lax.stop_gradient(_shares(self.points[own], at))
            total = jnp.sum(shares[..., None] * moving.points[own], axis=1)
            place = safe_divide(total[:, :2], total[:, 2:])
            at = jnp.where(curve[:, None] < E, place, at)
        if self.arcs is not None and moving.frames is not None:
            arc = self._arc(curve)
            place = film_at(moving.frames[self._sphere(arc)], self._turned(arc, share))
            at = jnp.where(arc[:, None] >= 0, place, at)
        if moving.bend is None:
            return at
        held = jax.lax.stop_gradient(moving.bend.trusted)
        return eqx.tree_at(lambda b: b.trusted, moving.bend, held)(at)

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
        edges = 0 if self.ends is None else self.ends.shape[0]
        whole = (curve >= edges) & (self._arc(curve) < 0)
        return jnp.where(self.weight == 0, 0, jnp.where(whole, 1, parts))


def edge_curves(points: Float[Array, "V 3"], film: FilmMap, mesh: Mesh) -> list[Curve]:
    """The parts of edges near the film, and those left of it."""
    weight = contour_weights(mesh, film.eye)
    both = points[mesh.edge_vertices]
    both = both * binary_inverse(jnp.max(jnp.abs(both), axis=-1))[..., None]
    return cut_off(both.T, weight, film.bounds)


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
    tail, head = (jnp.stack([jnp.full_like(y, film.bounds[0]), y], -1) for y in heights)
    nowhere = jnp.zeros_like(tail)
    left = tail, head, jnp.where(beside, weight, 0)
    return [left, (nowhere, nowhere, jnp.where(arc.turn > 0, weight, 0))], arc


def _shares(ends: Float[Array, "K 2 3"], at: Float[Array, "K 2"]) -> Float[Array, "K 2"]:
    """The shares of edges' ends, as homogeneous points, that points between them are."""
    scale = binary_inverse(jnp.max(jnp.abs(ends), axis=-1))
    ends = ends * scale[..., None]
    line = jnp.cross(ends[:, 0], ends[:, 1])
    steep = jnp.abs(line[:, 0]) > jnp.abs(line[:, 1])
    past = ends[..., :2] - at[:, None] * ends[..., 2:]
    past = jnp.where(steep[:, None], past[..., 1], past[..., 0])
    t = jnp.clip(safe_divide(past[:, 0], past[:, 0] - past[:, 1]), 0, 1)
    return jnp.stack([1 - t, t], axis=-1) * scale
