"""The curves that a scene is seen as: of its mesh's contour edges, and of its spheres' outlines.

Image, residuals and their derivatives read them from here. Which edges are contour, and where
curves are cut under distortion, is found once (`find`) and is not differentiated; the curves are.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._camera.film import FilmMap
from .._scene.scene import Scene, Spheres
from .contour import (
    MeshContour,
    edge_before,
    edge_segments,
    homogeneous_edges,
    mesh_contour,
    next_edge,
)
from .curves import Curves
from .distorted import Cuts
from .parts import InTurn, Together
from .spheres import (
    ARCS_PER_SPHERE,
    arc_cuts,
    arc_part_segments,
    arcs_of_sphere,
    homogeneous_arc_parts,
    sphere_arcs,
    sphere_frames,
)


class Found(NamedTuple):
    """What is not differentiated: which edges are contour, None without a mesh; where the spheres'
    outlines are cut, None without spheres or without distortion."""

    contour: MeshContour | None
    arcs: Cuts | None


class CurveSet(NamedTuple):
    """Curves of one kind.

    - `curves(ids)`: those with ids below `total`.
    - `homogeneous_of(ids)`: what they move with, differentiably.
    - `total`: how many there are.
    - `most`: how many there may be, None where that depends on the view.
    - `together`, `in_turn`: how a kernel finds them, so many at a time or one after the other (see
      `Part`); both None where it would compile longer than a kernel of each step.
    - `straight`: whether they are segments, not arcs.
    """

    curves: Callable[[Int[Array, "K"]], Curves]
    homogeneous_of: Callable[[Int[Array, "K"]], Float[Array, "K n 3"]]
    total: Int[Array, ""]
    most: int | None
    together: Together | None
    in_turn: InTurn | None
    straight: bool


def find(film: FilmMap, scene: Scene) -> Found:
    """Return which edges are contour, and where outlines are cut."""
    mesh, spheres = scene.mesh, scene.spheres
    contour = arcs = None
    if mesh is not None and mesh.edge_faces.shape[0]:
        contour = mesh_contour(film, mesh)
    if spheres is not None and spheres.radii.shape[0] and film.bend is not None:
        arcs = arc_cuts(film, spheres)
    return Found(contour, arcs)


def edge_curves(film: FilmMap, vertices: Float[Array, "V 3"], contour: MeshContour) -> CurveSet:
    """Return the mesh's contour edges, and once more for what of them lies left of the film."""
    in_turn = InTurn(
        lambda id: edge_before(contour, id),
        lambda id, before: next_edge(film, vertices, contour, id, before),
    )
    return CurveSet(
        lambda ids: edge_segments(film, vertices, contour, ids),
        lambda ids: homogeneous_edges(film, vertices, contour, ids),
        contour.segments,
        2 * contour.edge_vertices.shape[0] if contour.cuts is None else None,
        None,
        in_turn if contour.cuts is None else None,
        True,
    )


def outline_curves(film: FilmMap, spheres: Spheres, cuts: Cuts | None) -> CurveSet:
    """Return the spheres' outlines: arcs, or straight parts of them under distortion."""
    if cuts is not None:
        segments = lambda ids: arc_part_segments(film, cuts, ids)
        return CurveSet(
            segments,
            lambda ids: homogeneous_arc_parts(film, spheres, cuts, ids),
            cuts.total,
            None,
            None,
            None,
            True,
        )
    number = ARCS_PER_SPHERE * spheres.radii.shape[0]
    return CurveSet(
        lambda ids: sphere_arcs(film, spheres, ids),
        lambda ids: sphere_frames(film, spheres, ids),
        jnp.int32(number),
        number,
        Together(ARCS_PER_SPHERE, lambda ids: arcs_of_sphere(film, spheres, ids)),
        None,
        False,
    )


def joined(first: CurveSet, second: CurveSet) -> CurveSet:
    """Return two sets of straight curves as one: all that is done with curves is compiled once."""

    def either(a, b, ids):
        of_first = ids < first.total
        pairs = a(jnp.where(of_first, ids, 0)), b(jnp.where(of_first, 0, ids - first.total))
        shaped = lambda x: of_first.reshape(of_first.shape + (1,) * (x.ndim - 1))
        return jax.tree.map(lambda x, y: jnp.where(shaped(x), x, y), *pairs)

    curves = lambda ids: either(first.curves, second.curves, ids)
    return CurveSet(
        curves,
        lambda ids: either(first.homogeneous_of, second.homogeneous_of, ids),
        first.total + second.total,
        None if first.most is None or second.most is None else first.most + second.most,
        None,
        None,
        True,
    )
