"""The planes of a mesh's faces: which the eye is before, and of which edges that need not be asked.

Of vertices that are there planes are made by NumPy, for which nothing is compiled; of traced ones
within their program.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from .._numerics.safe import binary_scale


class Clusters(NamedTuple):
    """The edges in groups of `CLUSTER`, as they come: what their faces' planes have in common.

    Unit normals within a cone (`axis`, cosine and sine of its half angle), a point of each plane in
    a ball (`middle`; `radius`, infinite where nothing can be said), as seen from `centre` and in a
    unit of length of the mesh's own (world lengths times `scale`, a power of 2): no square of a
    length overflows. `planes` holds the faces' normals and corners once more, face by face, to be
    looked up fast.
    """

    axis: Float[Array, "3 N"]
    cosine: Float[Array, "N"]
    sine: Float[Array, "N"]
    middle: Float[Array, "3 N"]
    radius: Float[Array, "N"]
    planes: Float[Array, "F 6"]
    centre: Float[Array, "3"]
    scale: Float[Array, ""]


class Planes(NamedTuple):
    """A mesh's face planes: x is before face f where `normal[:, f].(x - corner[:, f]) > 0`.

    A normal's length is the face's area in a unit of the mesh's own, so that it neither overflows
    nor vanishes. `box` holds the vertices' least and largest coordinates, `fingerprint`
    names the vertices that all this was made from; None where these are known to stay. `clusters`
    is None for a mesh made of traced vertices, whose planes would not be used often enough.
    """

    normal: Float[Array, "3 F"]
    corner: Float[Array, "3 F"]
    box: Float[Array, "2 3"]
    fingerprint: UInt32[Array, ""] | None
    clusters: Clusters | None = None


#: Edges of a cluster: as many as bits in a word of `Selection`.
CLUSTER = 32
#: Clusters that are made at a time: what is between stays in a processor's cache.
AT_A_TIME = 1 << 11


@jax.jit
def planes_of(vertices: Float[Array, "V 3"], faces: Int[Array, "F 3"]) -> Planes:
    """Return the faces' planes, without clusters of edges."""
    vertices = jax.lax.stop_gradient(vertices)
    a, b, c = jnp.moveaxis(vertices[faces], 1, 0)
    unit = binary_scale(vertices) / 4
    normal = jnp.cross((b - a) * unit, (c - a) * unit)
    return Planes(normal.T, a.T, box_of(vertices), fingerprint(vertices))


def box_of(vertices: Float[Array, "V 3"]) -> Float[Array, "2 3"]:
    """Return the least and largest coordinates; zeros where there are no vertices."""
    if not vertices.shape[0]:
        return jnp.zeros((2, 3), vertices.dtype)
    return jnp.stack([jnp.min(vertices, axis=0), jnp.max(vertices, axis=0)])


@jax.jit
def fingerprint(vertices: Float[Array, "V 3"]) -> UInt32[Array, ""]:
    """Return a checksum of the bits; integer sums do not depend on the order of summation."""
    return _checksum(jax.lax.bitcast_convert_type(vertices, jnp.uint32).reshape(-1), jnp)


def fingerprint_of(points: np.ndarray) -> np.uint32:
    """Return `fingerprint` of vertices that are there."""
    return _checksum(np.ascontiguousarray(points).view(np.uint32).reshape(-1), np)


def _checksum(bits: Any, of: Any) -> Any:
    weight = of.arange(bits.shape[0], dtype=np.uint32) * of.uint32(2654435761) | of.uint32(1)
    mixed = (bits ^ (bits >> 16)) * weight  # round numbers have nothing but zeros in their low bits
    return of.sum(mixed ^ (mixed >> 15), dtype=np.uint32)


def planes_and_clusters(
    vertices: Float[Array | np.ndarray, "V 3"],
    faces: Int[Array | np.ndarray, "F 3"],
    edge_faces: Int[Array | np.ndarray, "E 2"],
) -> Planes:
    """Return the planes of vertices that are there, with clusters of the edges where there are."""
    points, triangles, edges = (np.asarray(x) for x in (vertices, faces, edge_faces))
    with np.errstate(all="ignore"):  # (what overflows is infinite, as in a program)
        a, b, c = (np.take(points, corner, axis=0).T for corner in triangles.T)
        unit = _binary_scale(points) / 4
        (bx, by, bz), (cx, cy, cz) = (b - a) * unit, (c - a) * unit
        normal: Any = np.stack([by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx])
        clusters = _clusters(normal, a, points, edges) if len(edges) else None
    box = np.stack([points.min(axis=0), points.max(axis=0)]) if len(points) else np.zeros((2, 3))
    rest: Any = a, box.astype(points.dtype), fingerprint_of(points), clusters
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x), x.dtype), Planes(normal, *rest))


def _clusters(
    normal: Float[np.ndarray, "3 F"],
    corner: Float[np.ndarray, "3 F"],
    points: Float[np.ndarray, "V 3"],
    edges: Int[np.ndarray, "E 2"],
) -> Clusters:
    centre = points[0]
    scale = _binary_scale(points - centre)
    size = np.abs(normal).max(axis=0)
    unit = _divided(normal, size)
    unit = _divided(unit, np.sqrt((unit**2).sum(axis=0)))
    unknown = size == 0  # a face without area has no normal
    places = (corner - centre[:, None]) * scale
    table = np.ascontiguousarray(np.concatenate([normal, corner]).T)

    border: Any = edges[:, 1] < 0
    both = np.where(border[:, None], edges[:, :1], edges)
    both = np.pad(both, ((0, -len(both) % CLUSTER), (0, 0)), mode="edge").reshape(-1, 2 * CLUSTER).T
    border = np.pad(border, (0, -len(border) % CLUSTER)).reshape(-1, CLUSTER).any(axis=1)
    parts = []  # (of normals and points (3, 2 CLUSTER, N): NumPy adds up long rows fast)
    for k in range(0, len(border), AT_A_TIME):
        of = np.ascontiguousarray(both[:, k : k + AT_A_TIME])
        normals, at = (np.stack([np.take(x, of) for x in rows]) for rows in (unit, places))
        axis = normals.sum(axis=1)
        axis = _divided(axis, np.sqrt((axis**2).sum(axis=0)))
        # (Of the chord: from a cosine, which rounds to 1, flat clusters' angles could not be told.)
        chord = ((normals - axis[:, None]) ** 2).sum(axis=0).max(axis=0)
        cosine, sine = 1 - chord / 2, np.sqrt(np.clip(chord * (1 - chord / 4), 0, 1))
        middle = at.mean(axis=1)
        radius = np.sqrt(((at - middle[:, None]) ** 2).sum(axis=0).max(axis=0))
        # (Border edges are always contour.)
        nothing = border[k : k + AT_A_TIME] | unknown[of].any(axis=0) | ~(cosine > 0)
        parts.append((axis, cosine, sine, middle, np.where(nothing, np.inf, radius)))
    whole: Any = [np.concatenate(x, axis=-1).astype(points.dtype) for x in zip(*parts, strict=True)]
    rest: Any = table, centre, scale
    return Clusters(*whole, *rest)


def _divided(numerator: Any, denominator: Any) -> Any:
    """Return a ratio, 0 where the denominator is."""
    return numerator / np.where(denominator == 0, np.inf, denominator)


def _binary_scale(x: np.ndarray) -> Any:
    """Return `binary_scale` of numbers that are there."""
    most = 1 - np.finfo(x.dtype).minexp - 2  # both the power and its inverse are normal numbers
    _, exponent = np.frexp(np.abs(x).max(initial=0))
    return np.ldexp(np.ones((), x.dtype), -np.clip(exponent, -most, most))


def in_front(planes: Planes, e: Float[Array, "3"]) -> Bool[Array, "*F"]:
    """Return which planes the eye is before; taken from the planes' own corners, so that a scene
    that is much larger than the object and the eye beside it loses nothing."""
    return faces_eye(planes.normal, planes.corner, e)


def faces_eye(normal, corner, e: Float[Array, "3"]) -> Bool[Array, "*F"]:
    """Return whether an eye is before planes, given x, y and z of normals and corners."""
    x, y, z = (normal[k] * (e[k] - corner[k]) for k in range(3))
    return x + y + z > 0


def undecided(clusters: Clusters, e: Float[Array, "3"]) -> Bool[Array, "N"]:
    """Return in which clusters the eye may be in front of some planes and behind others."""
    eye = (e - clusters.centre) * clusters.scale
    to_eye = [eye[k] - clusters.middle[k] for k in range(3)]
    along = sum(clusters.axis[k] * to_eye[k] for k in range(3))
    distance = jnp.sqrt(sum(x * x for x in to_eye))
    # (Not of the other two: a small one would be lost in what they are rounded by.)
    across = jnp.sqrt(sum((to_eye[k] - along * clusters.axis[k]) ** 2 for k in range(3)))
    # |to_eye| cos(angle to the axis, plus and minus the cone's half angle)
    nearest = along * clusters.cosine - across * clusters.sine
    farthest = along * clusters.cosine + across * clusters.sine
    # Where the cone reaches the axis itself, or its opposite, that is the extreme.
    farthest = jnp.where(along >= distance * clusters.cosine, distance, farthest)
    nearest = jnp.where(-along >= distance * clusters.cosine, -distance, nearest)
    reach = jnp.sqrt(jnp.sum(eye * eye)) + distance
    info = jnp.finfo(e.dtype)
    radius = clusters.radius * (1 + 1e-3) + 256 * info.eps * reach + 16 * info.tiny**0.5
    return ~((nearest > radius) | (farthest < -radius))
