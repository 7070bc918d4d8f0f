"""What a camera looks at: `Mesh`, `Spheres`, `Scene`, and what is worked out once per mesh."""

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from .._camera.camera import Camera, check_camera
from .._numerics.arrays import (
    MISSING,
    ArrayLike,
    Input,
    at_hand,
    float_array,
    float_dtype,
    is_concrete,
)
from .._numerics.jitted import is_within_another, jitted, stands_alone
from .._numerics.pointwise import filled_up
from .._numerics.safe import binary_scale, norm, safe_divide
from .topology import edge_records, without_copies


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


#: Edges of a cluster: as many as bits in a word of `Selection`.
CLUSTER = 32
#: Of a mesh with more than this share of its edges at a border it is asked whether its vertices
#: stand at fewer places than this share of their number.
MOSTLY_BORDER, LOOSE = 0.5, 0.6
#: Faces (and vertices) that a small mesh's arrays are filled up to.
FILLED_UP = (1 << 14, 1 << 16)
#: The same of arrays that planes are made from: that takes a time that follows their size.
MADE_FROM = (1 << 11, *FILLED_UP)


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


class Triangles(Protocol):
    """What other libraries hold a mesh in, as trimesh does."""

    @property
    def vertices(self) -> ArrayLike: ...

    @property
    def faces(self) -> ArrayLike: ...


class Mesh(eqx.Module):
    """Triangles: `vertices` (V, 3) in world units, `faces` (F, 3) indices of vertices; or one
    object that has both, as trimesh's.

    A face whose corners are those of another adds nothing to what is seen (a mesh that has every
    face twice, or once more turned over): the later one's three indices are made equal, so that the
    others keep their numbers. Walls between parts, which two closed bodies share, stay.

    Worked out once, on the host: the edges with the faces on either side. An edge record (a, b)
    runs as in its first face; the second face, if any, runs through it from b to a, and is -1 at a
    border. Edges that more than two faces, or two of opposite winding, share have several records.
    `closed` says that there is no border: closed and consistently wound (per shared vertex index;
    `load_mesh` merges equal vertices). `order` lists the faces along a space-filling curve, for the
    tracer; the edges follow their first faces along it.

    `vertices` may be traced and differentiated, also by way of `eqx.tree_at`; `faces` may not.
    Raises ValueError for wrong shapes or dtypes, non-finite vertices and indices out of range.

    ```python
    corners = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    mesh = pj.Mesh(corners, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    mesh.closed
    ```
    """

    vertices: Float[Array, "V 3"]
    faces: Int[Array, "F 3"]
    edge_vertices: Int[Array, "E 2"]
    edge_faces: Int[Array, "E 2"]
    planes: Planes
    order: Int[Array, "F"]
    closed: bool | None = eqx.field(static=True)

    def __init__(
        self,
        vertices: Input[ArrayLike | Triangles, "V 3"],
        faces: Input[ArrayLike, "F 3"] = MISSING,
    ):
        if faces is MISSING and hasattr(vertices, "vertices") and hasattr(vertices, "faces"):
            whole: Any = vertices
            vertices, faces = whole.vertices, whole.faces
        if faces is MISSING:
            raise TypeError("Mesh() missing 1 required argument: 'faces'")
        self.vertices = float_array("vertices", vertices, (None, 3), float_dtype(vertices))
        triangles = _face_indices(faces, self.vertices.shape[0])
        points = np.asarray(self.vertices) if is_concrete(self.vertices) else None
        if points is not None:
            triangles = without_copies(points, triangles)
        edge_vertices, edge_faces = edge_records(triangles, points, self.vertices.shape[0])
        # (With no type named, JAX compiles a copy of an array of each size.)
        self.faces = jnp.asarray(triangles, np.int32)
        self.order = _face_order(self.vertices, self.faces)
        if is_concrete(self.order) and edge_faces.size:
            rank = np.empty(len(triangles), np.int32)
            rank[np.asarray(self.order)] = np.arange(len(triangles), dtype=np.int32)
            along = np.argsort(rank[edge_faces[:, 0]], kind="stable")
            edge_vertices, edge_faces = edge_vertices[along], edge_faces[along]
        self.edge_vertices = jnp.asarray(edge_vertices, np.int32)
        self.edge_faces = jnp.asarray(edge_faces, np.int32)
        self.planes = _planes_and_clusters(self.vertices, self.faces, self.edge_faces)
        self.closed = bool(np.all(edge_faces >= 0))
        borders = np.count_nonzero(edge_faces < 0)
        if points is not None and borders > MOSTLY_BORDER * len(edge_faces):
            _say_if_loose(points, triangles)


class Spheres(eqx.Module):
    """Spheres: `centers` (S, 3) and `radii` (S,), world units, both differentiable.

    Raises ValueError for wrong shapes or dtypes, non-finite values and radii that are not positive.

    ```python
    spheres = pj.Spheres(centers=[[0.0, 0, 0], [2, 0, 0]], radii=[1.0, 0.5])
    ```
    """

    centers: Float[Array, "S 3"]
    radii: Float[Array, "S"]

    def __init__(self, centers: Input[ArrayLike, "S 3"], radii: Input[ArrayLike, "S"]):
        dtype = float_dtype(centers, radii)
        self.centers = float_array("centers", centers, (None, 3), dtype)
        self.radii = float_array("radii", radii, (self.centers.shape[0],), dtype)
        if is_concrete(self.radii) and not np.all(np.asarray(self.radii) > 0):
            raise ValueError(f"`radii`: expected positive radii, got {np.min(self.radii)}")


class Scene(eqx.Module):
    """A mesh, spheres, or both; what is left out costs nothing. An empty scene covers nothing.

    ```python
    scene = pj.Scene(mesh=mesh, spheres=spheres)  # either may be left out
    ```
    """

    mesh: Mesh | None
    spheres: Spheres | None

    def __init__(
        self,
        mesh: Input[Mesh | None, "triangles"] = None,
        spheres: Input[Spheres | None, "spheres"] = None,
    ):
        if not (mesh is None or isinstance(mesh, Mesh)):
            hint = "; give `Mesh(mesh)`" if hasattr(mesh, "vertices") else ""
            raise ValueError(f"`mesh`: expected a Mesh or None, got {type(mesh).__name__}{hint}")
        if not (spheres is None or isinstance(spheres, Spheres)):
            raise ValueError(f"`spheres`: expected Spheres or None, got {type(spheres).__name__}")
        self.mesh, self.spheres = mesh, spheres


def check_view(camera: Any, scene: Any) -> None:
    """Raise ValueError unless these are one camera and a scene, in this order."""
    if not (isinstance(camera, Camera) and isinstance(scene, Scene)):
        kinds = f"{type(camera).__name__}, {type(scene).__name__}"
        raise ValueError(f"`camera`, `scene`: expected a Camera and a Scene, got {kinds}")
    check_camera(camera)


def check_scene(scene: Any) -> None:
    """Raise ValueError unless there is something to look at."""
    if not isinstance(scene, Scene):
        hint = "; give `Scene(mesh=...)`" if isinstance(scene, Mesh) else ""
        raise ValueError(f"`scene`: expected a Scene, got {type(scene).__name__}{hint}")
    faces = scene.mesh is not None and scene.mesh.edge_faces.shape[0]
    if not faces and (scene.spheres is None or not scene.spheres.radii.shape[0]):
        raise ValueError("`scene`: expected a Scene with a mesh or spheres, got an empty one")


def astype(scene: Scene, dtype: Any) -> Scene:
    """Return the scene in a float type; planes are made anew where the vertices change."""
    mesh, spheres = scene.mesh, scene.spheres
    if mesh is not None and mesh.vertices.dtype != dtype:
        mesh = with_vertices(mesh, mesh.vertices.astype(dtype))
    if spheres is not None and spheres.radii.dtype != dtype:
        spheres = jax.tree.map(lambda x: x.astype(dtype), spheres)
    return Scene(mesh=mesh, spheres=spheres)


def with_vertices(mesh: Mesh, vertices: Float[Array, "V 3"]) -> Mesh:
    """Return the mesh with its vertices elsewhere, and planes made of these."""
    planes = _planes_and_clusters(vertices, mesh.faces, mesh.edge_faces)
    return eqx.tree_at(lambda m: (m.vertices, m.planes), mesh, (vertices, planes))


def padded(scene: Scene) -> Scene:
    """Return the scene with its mesh's arrays filled up to one of a few sizes.

    What is added is on no contour, so the silhouette is the same, and meshes of similar size share
    compiled programs. Not for tracing: the faces' order is left out.
    """
    if scene.mesh is None or not scene.mesh.edge_faces.shape[0]:
        return scene
    mesh, planes = scene.mesh, None
    made_from = mesh.planes.fingerprint
    current = made_from is None or int(made_from) == _fingerprint_of(np.asarray(mesh.vertices))
    if current and mesh.planes.clusters is not None:
        planes = mesh.planes
    parts = (mesh.vertices, mesh.faces, mesh.edge_vertices, mesh.edge_faces)
    *parts, planes = _filled_up(*parts, planes)
    if planes is None:
        planes = _planes_and_clusters(parts[0], parts[1], parts[3])
    order = jnp.asarray(np.zeros(0, np.int32), jnp.int32)
    mesh = eqx.tree_at(
        lambda m: (m.vertices, m.faces, m.edge_vertices, m.edge_faces, m.order, m.planes),
        mesh,
        (*parts, order, planes),
    )
    return Scene(mesh=mesh, spheres=scene.spheres)


def filled_alike(scenes: Sequence[Scene]) -> list[Scene]:
    """Return scenes with their meshes' arrays filled up to the largest one's, so that one program
    serves them side by side: small meshes, whose edges are all looked at.

    Raises ValueError where some have a mesh, or as many spheres, and others do not.
    """
    made = {(s.mesh is None, 0 if s.spheres is None else len(s.spheres.radii)) for s in scenes}
    if len(made) > 1:
        raise ValueError(
            "`scene`: expected scenes that all have a mesh or none, and as many spheres"
        )
    if scenes[0].mesh is None:
        return [*scenes]
    meshes: list[Any] = [scene.mesh for scene in scenes]
    arrays = ("vertices", "faces", "edge_vertices", "edge_faces")
    sizes = [max(len(getattr(mesh, name)) for mesh in meshes) for name in arrays]
    result = []
    for scene, mesh in zip(scenes, meshes, strict=True):
        own = (getattr(mesh, name) for name in arrays)
        vertices, faces, *edges = (_with_room(x, n, 0) for x, n in zip(own, sizes, strict=True))
        parts = vertices, faces, *edges, jnp.zeros(0, jnp.int32), planes_of(vertices, faces)
        of = lambda m: (m.vertices, m.faces, m.edge_vertices, m.edge_faces, m.order, m.planes)
        mesh = eqx.tree_at(of, mesh, parts)
        object.__setattr__(mesh, "closed", None)  # (`tree_at` changes no static field)
        result.append(Scene(mesh=mesh, spheres=scene.spheres))
    return result


def with_or_without_border(scene: Scene) -> Scene:
    """Return the scene with a small mesh that does not tell a compiler if it is closed: open ones
    share programs with closed ones."""
    mesh = scene.mesh
    if mesh is None or len(mesh.vertices) not in FILLED_UP:
        return scene
    mesh = jax.tree.map(lambda x: x, mesh)  # (equinox never lets go of what `copy` makes)
    object.__setattr__(mesh, "closed", None)  # (`tree_at` changes no static field)
    return Scene(mesh=mesh, spheres=scene.spheres)


def at_rest(scene: Scene) -> Scene:
    """Return a scene whose mesh's planes are current, and whose vertices nobody will move: no view
    of it asks again, which takes as long as to find the contour of millions of faces."""
    if scene.mesh is None:
        return scene
    of = lambda s: s.mesh.planes.fingerprint
    return eqx.tree_at(of, scene, None, is_leaf=lambda x: x is None)


def is_closed(mesh: Mesh) -> Any:
    """Return whether a mesh is closed: a bool, or a traced one where a compiler is not told."""
    return jnp.all(mesh.edge_faces >= 0) if mesh.closed is None else mesh.closed


def _filled_up(
    vertices: Array, faces: Array, edge_vertices: Array, edge_faces: Array, planes: Planes | None
) -> tuple:
    """Return a mesh's arrays filled up to one of a few sizes, and its planes, which are current."""
    V, F, E = _filled_sizes(vertices.shape[0], faces.shape[0], edge_faces.shape[0])
    parts = (vertices, V), (faces, F), (edge_vertices, E), (edge_faces, E)
    arrays = tuple(_with_room(x, size, 0) for x, size in parts)
    if planes is None or planes.clusters is None:
        return *arrays, None
    # What is filled up is behind everything: no contour.
    number = -(-arrays[2].shape[0] // CLUSTER)
    c = planes.clusters
    axis, cosine, sine, middle = (_with_room(x, number, x.ndim - 1) for x in c[:4])
    radius = _with_room(c.radius, number, 0, -np.inf)
    clusters = Clusters(axis, cosine, sine, middle, radius, _with_room(c.planes, F, 0), *c[6:])
    faces_of = _with_room(planes.normal, F, 1), _with_room(planes.corner, F, 1)
    # (Zeros add nothing to a fingerprint.)
    return *arrays, Planes(*faces_of, planes.box, planes.fingerprint, clusters)


def _with_room(x: Array, size: int, axis: int, value: float = 0.0) -> Array:
    """Return an array, filled up by NumPy: JAX would compile that for each size."""
    widths = [(0, 0)] * x.ndim
    widths[axis] = (0, size - x.shape[axis])
    return jnp.asarray(np.pad(np.asarray(x), widths, constant_values=value), x.dtype)


def _filled_sizes(
    vertices: int, faces: int, edges: int, sizes: tuple[int, ...] = FILLED_UP
) -> tuple[int, int, int]:
    """Return how many vertices, faces and edges a mesh is filled up to: few sizes, as each is
    compiled for; in steps of an eighth where the mesh is large and memory counts."""
    for most in sizes:
        if max(vertices, faces) <= most and 2 * edges <= 3 * most:
            return most, most, 3 * most // 2
    up = lambda size: size + -size % (1 << max(size.bit_length() - 3, 6))
    return up(vertices), up(faces), up(edges)


@jitted
def planes_are_current(mesh: Mesh) -> Bool[Array, ""]:
    """Return whether the planes were made from the vertices as they are now."""
    if mesh.planes.fingerprint is None:
        return jnp.array(True)
    return mesh.planes.fingerprint == _fingerprint(mesh.vertices)


def front_facing(
    mesh: Mesh, e: Float[Array, "3"], current: Bool[Array, ""] | None = None
) -> Bool[Array, "F"]:
    """Return which faces show their front (counter-clockwise) side to the eye; edge-on: False.

    Uses the stored planes; where the vertices are no longer those that the planes were made from
    (`eqx.tree_at`, an optimiser's update), the planes are made anew, so they are never stale.
    (Within a branch `current` is for those who asked `planes_are_current` before it: the compiler
    makes that anew for each branch.)
    """
    mesh, e = jax.lax.stop_gradient((mesh, e))
    return jax.lax.cond(
        planes_are_current(mesh) if current is None else current,
        lambda: in_front(mesh.planes, e),
        lambda: in_front(planes_of(mesh.vertices, mesh.faces), e),
    )


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
    across = jnp.sqrt(jnp.maximum(distance * distance - along * along, 0))
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


class Ball(NamedTuple):
    """A sphere: `centre` (3,) and `radius`, world units."""

    centre: Any
    radius: Any


def bounding_box(scene: Scene) -> Float[Array, "2 3"]:
    """Return the least and largest coordinates of the scene."""
    if stands_alone(scene):
        scene = jax.tree.map(np.asarray, scene)  # (JAX would compile that for each size)
    points: list[Any] = []
    if scene.mesh is not None:
        points.append(scene.mesh.vertices)
    if scene.spheres is not None:
        centers, radii = scene.spheres.centers, scene.spheres.radii[:, None]
        points += [centers - radii, centers + radii]
    if isinstance(points[0], np.ndarray):
        every = np.concatenate(points)
        return jnp.asarray(np.stack([every.min(axis=0), every.max(axis=0)]), every.dtype)
    return _box(jnp.concatenate(points))


def bounding_sphere(scene: Scene) -> Ball:
    """Return a sphere about the scene (the bounding box's, not the least)."""
    return ball_about(at_hand(bounding_box(scene)))


def ball_about(box: Any) -> Ball:
    """Return the sphere through a box's corners; of NumPy or JAX, as the box is."""
    low, high = box
    half = (high - low) / 2
    size = abs(half).max()
    unit = half / (size + (size == 0).astype(half.dtype))  # squares do not overflow
    return Ball(low + half, size * (unit**2).sum() ** 0.5)


@jax.jit
def planes_of(vertices: Float[Array, "V 3"], faces: Int[Array, "F 3"]) -> Planes:
    """Return the faces' planes, without clusters of edges."""
    vertices = jax.lax.stop_gradient(vertices)
    a, b, c = jnp.moveaxis(vertices[faces], 1, 0)
    unit = binary_scale(vertices) / 4
    normal = jnp.cross((b - a) * unit, (c - a) * unit)
    return Planes(normal.T, a.T, _box(vertices), _fingerprint(vertices))


def _box(vertices: Float[Array, "V 3"]) -> Float[Array, "2 3"]:
    if not vertices.shape[0]:
        return jnp.zeros((2, 3), vertices.dtype)
    return jnp.stack([jnp.min(vertices, axis=0), jnp.max(vertices, axis=0)])


def vertex_box(mesh: Mesh) -> Float[Array, "2 3"]:
    """Return the least and largest coordinates of the vertices, as far as known already."""
    mesh = jax.lax.stop_gradient(mesh)
    return jax.lax.cond(
        planes_are_current(mesh), lambda: mesh.planes.box, lambda: _box(mesh.vertices)
    )


def _planes_and_clusters(
    vertices: Float[Array, "V 3"], faces: Int[Array, "F 3"], edge_faces: Int[Array, "E 2"]
) -> Planes:
    if not (is_concrete(vertices) and edge_faces.shape[0]):
        return planes_of(vertices, faces)
    if is_within_another():
        planes = planes_of(vertices, faces)
        return planes._replace(clusters=_clusters(planes, vertices, edge_faces))
    # (By programs that meshes of similar size share; what is filled up with is the last again.)
    points, triangles, edges = (np.asarray(x) for x in (vertices, faces, edge_faces))
    V, F, E = _filled_sizes(len(points), len(triangles), len(edges), MADE_FROM)
    filled = _lasting(points, V)
    planes = planes_of(filled, _lasting(triangles, F))
    c = _clusters(planes, filled, _lasting(edges, E))
    F, N = len(triangles), -(-len(edges) // CLUSTER)
    cut = lambda x, n: jnp.asarray(np.ascontiguousarray(np.asarray(x)[..., :n]), x.dtype)
    table = jnp.asarray(np.asarray(c.planes)[:F], c.planes.dtype)
    axis, cosine, sine, middle, radius = (cut(x, N) for x in c[:5])
    clusters = Clusters(axis, cosine, sine, middle, radius, table, c.centre, c.scale)
    box = jnp.asarray(np.stack([points.min(axis=0), points.max(axis=0)]), points.dtype)
    fingerprint = jnp.asarray(_fingerprint_of(points), np.uint32)
    return Planes(cut(planes.normal, F), cut(planes.corner, F), box, fingerprint, clusters)


def _lasting(x: np.ndarray, size: int) -> np.ndarray:
    """Return rows, filled up with the last one."""
    return filled_up(x, size, x[-1:])


@jax.jit
def _clusters(
    planes: Planes, vertices: Float[Array, "V 3"], edge_faces: Int[Array, "E 2"]
) -> Clusters:
    first, second = edge_faces[:, 0], edge_faces[:, 1]
    both = jnp.stack([first, jnp.where(second < 0, first, second)], axis=1)
    both = jnp.pad(both, ((0, -len(both) % CLUSTER), (0, 0)), mode="edge")
    both = both.reshape(-1, 2 * CLUSTER)
    length = norm(planes.normal.T)
    unit = safe_divide(planes.normal, length[None])[:, both]
    centre = vertices[0]
    scale = binary_scale(vertices - centre[None])
    point = ((planes.corner - centre[:, None]) * scale)[:, both]  # (3, N, 64)
    axis = jnp.sum(unit, axis=2)
    size = jnp.sqrt(jnp.sum(axis**2, axis=0))
    axis = safe_divide(axis, size[None])
    cosine = jnp.min(jnp.sum(unit * axis[..., None], axis=0), axis=1)
    middle = jnp.mean(point, axis=2)
    radius = jnp.sqrt(jnp.max(jnp.sum((point - middle[..., None]) ** 2, axis=0), axis=1))
    # Border edges are always contour; a face without area has no normal.
    border = jnp.pad(second < 0, (0, -len(second) % CLUSTER)).reshape(-1, CLUSTER)
    unknown = jnp.any(border, axis=1) | jnp.any(length[both] == 0, axis=1) | (cosine <= 0)
    sine = jnp.sqrt(jnp.clip(1 - cosine**2, 0, 1))
    radius = jnp.where(unknown, jnp.inf, radius)
    table = jnp.concatenate([planes.normal, planes.corner]).T
    return Clusters(axis, cosine, sine, middle, radius, table, centre, scale)


def _face_order(vertices: Float[Array, "V 3"], faces: Int[Array, "F 3"]) -> Int[Array, "F"]:
    if not (faces.shape[0] and vertices.shape[0]):
        return jnp.zeros(faces.shape[0], jnp.int32)
    if not stands_alone(vertices, faces):
        codes = _middles_codes(jax.lax.stop_gradient(vertices), faces)
        return jnp.argsort(codes).astype(jnp.int32)
    points, triangles = np.asarray(vertices), np.asarray(faces)
    V, F, _ = _filled_sizes(len(points), len(triangles), 0, MADE_FROM)
    codes = np.asarray(_middles_codes(_lasting(points, V), _lasting(triangles, F)))
    order = np.argsort(codes[: len(triangles)], kind="stable")  # five times as fast as XLA's
    return jnp.asarray(order.astype(np.int32), np.int32)


@jax.jit
def _middles_codes(vertices: Float[Array, "V 3"], faces: Int[Array, "F 3"]) -> UInt32[Array, "F"]:
    return morton_codes(jnp.mean(vertices[faces], axis=1))


@jax.jit
def morton_order(points: Float[Array, "N 3"]) -> Int[Array, "N"]:
    """Return the order of at least one point by Morton code."""
    return jnp.argsort(morton_codes(points)).astype(jnp.int32)


def morton_codes(points: Float[Array, "N 3"]) -> UInt32[Array, "N"]:
    """Return the Morton codes of at least one point, 10 bits an axis."""
    low, high = jnp.min(points, axis=0), jnp.max(points, axis=0)
    extent = jnp.maximum(jnp.max(high - low), jnp.finfo(points.dtype).tiny)
    cell = jnp.clip((points - low[None]) / extent * 1024, 0, 1023).astype(jnp.uint32)
    spread = jnp.zeros_like(cell)
    for bit in range(10):
        spread |= ((cell >> bit) & 1) << (3 * bit)
    return spread[:, 0] | spread[:, 1] << 1 | spread[:, 2] << 2


@jax.jit
def _fingerprint(vertices: Float[Array, "V 3"]) -> UInt32[Array, ""]:
    """Return a checksum of the bits; integer sums do not depend on the order of summation."""
    bits = jax.lax.bitcast_convert_type(vertices, jnp.uint32).reshape(-1)
    weight = jnp.arange(bits.shape[0], dtype=jnp.uint32) * jnp.uint32(2654435761) | jnp.uint32(1)
    mixed = (bits ^ (bits >> 16)) * weight  # round numbers have nothing but zeros in their low bits
    return jnp.sum(mixed ^ (mixed >> 15), dtype=jnp.uint32)


def _fingerprint_of(points: np.ndarray) -> int:
    """Return `_fingerprint` of vertices that are there."""
    bits = np.ascontiguousarray(points).view(np.uint32).reshape(-1)
    weight = np.arange(len(bits), dtype=np.uint32) * np.uint32(2654435761) | np.uint32(1)
    mixed = (bits ^ (bits >> 16)) * weight
    return int(np.sum(mixed ^ (mixed >> 15), dtype=np.uint32))


def _say_if_loose(points: np.ndarray, triangles: np.ndarray) -> None:
    """Warn of faces that do not share their vertices, though these are at the same places."""
    used = np.unique(triangles)
    places = len(np.unique(points[used], axis=0))
    if places < LOOSE * len(used):
        warnings.warn(
            f"`vertices`: {len(used)} stand at {places} places, so that most edges are borders and"
            " count as outline; let faces share their vertices (`load_mesh` merges equal ones)",
            stacklevel=3,
        )


def _face_indices(faces: Any, V: int) -> np.ndarray:
    if not is_concrete(faces):
        raise ValueError("`faces`: expected a concrete array, got a traced one; close over it")
    try:
        array = np.asarray(faces)
    except ValueError as error:
        raise ValueError(f"`faces`: expected shape (F, 3), got {faces!r}") from error
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"`faces`: expected shape (F, 3), got {array.shape}")
    if not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"`faces`: expected integers, got dtype {array.dtype}")
    if array.size and not (array.min() >= 0 and array.max() < V):
        raise ValueError(
            f"`faces`: expected indices from 0 to {V - 1}, got {array.min()} to {array.max()}"
        )
    return array.astype(np.int32)
