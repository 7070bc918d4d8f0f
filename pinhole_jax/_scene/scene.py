"""What a camera looks at: `Mesh`, `Spheres`, `Scene`, and what is worked out once per mesh."""

import warnings
from typing import Any, NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._camera.camera import Camera, check_camera
from .._numerics.arrays import (
    MISSING,
    ArrayLike,
    Input,
    at_hand,
    float_array,
    float_dtype,
    is_concrete,
    stands_alone,
)
from .planes import (
    Planes,
    box_of,
    fingerprint,
    fingerprint_of,
    in_front,
    planes_at_hand,
    planes_of,
)
from .topology import edge_records, without_copies

#: Of a mesh with more than this share of its edges at a border it is asked whether its vertices
#: stand at fewer places than this share of their number.
MOSTLY_BORDER, LOOSE = 0.5, 0.6
#: Steps between float32 numbers that are more than this share of the object are worth a warning: a
#: fit's own rounding is far smaller.
COARSE = 1 / 2000
#: Faces (and vertices) that a small mesh's arrays are filled up to.
FILLED_UP = (1 << 14, 1 << 16)


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
            _say_if_coarse(points)
        edge_vertices, edge_faces = edge_records(triangles, points, self.vertices.shape[0])
        # (With no type named, JAX compiles a copy of an array of each size.)
        self.faces = jnp.asarray(triangles, np.int32)
        corners = self.vertices if points is None else points
        order = _face_order(corners, triangles)
        self.order = jnp.asarray(order, np.int32)
        if points is not None and edge_faces.size:
            rank = np.empty(len(triangles), np.int32)
            rank[order] = np.arange(len(triangles), dtype=np.int32)
            along = np.argsort(rank[edge_faces[:, 0]], kind="stable")
            edge_vertices, edge_faces = edge_vertices[along], edge_faces[along]
        self.edge_vertices = jnp.asarray(edge_vertices, np.int32)
        self.edge_faces = jnp.asarray(edge_faces, np.int32)
        self.planes = _planes(corners, triangles)
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
        if is_concrete(self.centers) and is_concrete(self.radii):
            middles, radii = np.asarray(self.centers), np.asarray(self.radii)[:, None]
            _say_if_coarse(np.concatenate([middles - radii, middles + radii]), "centers")


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
    planes = _planes(vertices, mesh.faces)
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
    current = made_from is None or int(made_from) == fingerprint_of(np.asarray(mesh.vertices))
    if current:
        planes = mesh.planes
    parts = (mesh.vertices, mesh.faces, mesh.edge_vertices, mesh.edge_faces)
    *parts, planes = _filled_up(*parts, planes)
    if planes is None:
        planes = _planes(parts[0], parts[1])
    order = jnp.asarray(np.zeros(0, np.int32), jnp.int32)
    mesh = eqx.tree_at(
        lambda m: (m.vertices, m.faces, m.edge_vertices, m.edge_faces, m.order, m.planes),
        mesh,
        (*parts, order, planes),
    )
    return Scene(mesh=mesh, spheres=scene.spheres)


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
    if planes is None:
        return *arrays, None
    # What is filled up is before nothing: no contour.
    faces_of = _with_room(planes.normal, F, 1), _with_room(planes.corner, F, 1)
    # (Zeros add nothing to a fingerprint.)
    return *arrays, Planes(*faces_of, planes.box, planes.fingerprint)


def _with_room(x: Array, size: int, axis: int) -> Array:
    """Return an array, filled up by NumPy: JAX would compile that for each size."""
    widths = [(0, 0)] * x.ndim
    widths[axis] = (0, size - x.shape[axis])
    return jnp.asarray(np.pad(np.asarray(x), widths), x.dtype)


def _filled_sizes(vertices: int, faces: int, edges: int) -> tuple[int, int, int]:
    """Return how many vertices, faces and edges a mesh is filled up to: few sizes, as each is
    compiled for; in steps of an eighth where the mesh is large and memory counts."""
    for most in FILLED_UP:
        if max(vertices, faces) <= most and 2 * edges <= 3 * most:
            return most, most, 3 * most // 2
    up = lambda size: size + -size % (1 << max(size.bit_length() - 3, 6))
    return up(vertices), up(faces), up(edges)


@eqx.filter_jit
def planes_are_current(mesh: Mesh) -> Bool[Array, ""]:
    """Return whether the planes were made from the vertices as they are now."""
    if mesh.planes.fingerprint is None:
        return jnp.array(True)
    return mesh.planes.fingerprint == fingerprint(mesh.vertices)


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
    return box_of(jnp.concatenate(points))


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


def vertex_box(mesh: Mesh) -> Float[Array, "2 3"]:
    """Return the least and largest coordinates of the vertices, as far as known already."""
    mesh = jax.lax.stop_gradient(mesh)
    return jax.lax.cond(
        planes_are_current(mesh), lambda: mesh.planes.box, lambda: box_of(mesh.vertices)
    )


def _planes(vertices: Any, faces: Any) -> Planes:
    make = planes_at_hand if is_concrete(vertices, faces) else planes_of
    return make(vertices, faces)


def _face_order(vertices: Any, faces: np.ndarray) -> Any:
    if not (faces.shape[0] and vertices.shape[0]):
        return np.zeros(faces.shape[0], np.int32)
    if not isinstance(vertices, np.ndarray):
        return morton_order(jnp.mean(jax.lax.stop_gradient(vertices)[faces], axis=1))
    with np.errstate(all="ignore"):
        middles = sum(np.take(vertices, corner, axis=0) for corner in faces.T) / 3
        return np.argsort(morton_codes(middles), kind="stable").astype(np.int32)


@jax.jit
def morton_order(points: Float[Array, "N 3"]) -> Int[Array, "N"]:
    """Return the order of at least one point by Morton code."""
    return jnp.argsort(morton_codes(points)).astype(jnp.int32)


def morton_codes(points: Any) -> Any:
    """Return the Morton codes of at least one point, 10 bits an axis; of NumPy or JAX, as points
    are."""
    low, high = points.min(axis=0), points.max(axis=0)
    extent = (high - low).max(initial=np.finfo(points.dtype).tiny)
    cell = ((points - low[None]) / extent * 1024).clip(0, 1023).astype(np.uint32)
    spread = cell & 1
    for bit in range(1, 10):
        spread |= ((cell >> bit) & 1) << (3 * bit)
    return spread[:, 0] | spread[:, 1] << 1 | spread[:, 2] << 2


def coarse(points: np.ndarray, name: str = "vertices") -> str:
    """Return a warning that float32 rounds points to a good part of the object, if it does."""
    if not points.size:
        return ""
    low, high = points.min(axis=0), points.max(axis=0)
    size, far = float(np.max(high - low)), float(np.max(np.abs([low, high])))
    step = float(np.spacing(np.float32(far)))
    if step <= COARSE * size:
        return ""
    return (
        f"float32 rounds {name} to steps of {step:.2g}, 1/{size / step:.0f} of the object, which"
        f" lies {far:.3g} from the origin; move it there"
    )


def _say_if_coarse(points: np.ndarray, name: str = "vertices") -> None:
    if points.dtype == np.float32 and (words := coarse(points, name)):
        warnings.warn(f"`{name}`: {words}, or set jax_enable_x64", stacklevel=3)


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
