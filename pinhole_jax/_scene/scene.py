"""The scene before a camera: `Mesh`, `Spheres`, `Scene`; edges are found once per mesh."""

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
    as_numpy,
    check_above_zero,
    float_array,
    float_dtype,
    is_concrete,
    stands_alone,
)
from .._numerics.components import inner, outer
from .._numerics.pointwise import padded as filled_up, room
from .._numerics.safe import binary_scale
from .topology import edge_records, without_copies

#: A mesh with more than this share of its edges at a border is checked for vertices that stand at
#: fewer places than this share of their number.
MOSTLY_BORDER, LOOSE = 0.5, 0.6
#: Steps between float32 numbers that are more than this share of the object are worth a warning: a
#: fit's own rounding is far smaller.
COARSE = 1 / 2000
#: Faces (and vertices) that a small mesh's arrays are filled up to.
FILLED_UP = (1 << 14, 1 << 16)


class Triangles(Protocol):
    """A mesh of another library, as trimesh's."""

    @property
    def vertices(self) -> ArrayLike: ...

    @property
    def faces(self) -> ArrayLike: ...


class Mesh(eqx.Module):
    """Triangles: `vertices` (V, 3) in world units, `faces` (F, 3) indices of vertices; or one
    object that has both, as trimesh's.

    A face with the corners of another adds nothing to the image (a mesh that has every face twice,
    or once more turned over): the later one's three indices are made equal, so that the others keep
    their numbers. Walls between parts, which two closed bodies share, stay.

    Computed once, on the host: the edges with the faces on either side. An edge record (a, b)
    runs as in its first face; the second face, if any, runs through it from b to a, and is -1 at a
    border. Edges that more than two faces, or two of opposite winding, share have several records.
    They follow their first faces along a space-filling curve.

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
        known = is_concrete(self.vertices)
        points = as_numpy(self.vertices)
        if known:
            triangles = without_copies(points, triangles)
            _warn_if_coarse(points)
        edge_vertices, edge_faces = edge_records(triangles, points if known else None, len(points))
        if known and edge_faces.size:
            with np.errstate(all="ignore"):
                a, b, c = (np.take(points, corner, axis=0) for corner in triangles.T)
                codes = morton_codes((a + b + c) / 3)
            along = np.argsort(codes[edge_faces[:, 0]], kind="stable")
            edge_vertices, edge_faces = edge_vertices[along], edge_faces[along]
        # (With no type named, JAX compiles a copy of an array of each size.)
        self.faces, self.edge_vertices, self.edge_faces = (
            jnp.asarray(x, np.int32) for x in (triangles, edge_vertices, edge_faces)
        )
        borders = np.count_nonzero(edge_faces < 0)
        if known and borders > MOSTLY_BORDER * len(edge_faces):
            _warn_if_loose(points, triangles)

    @property
    def closed(self) -> Bool[Array, ""] | bool:
        """True without a border: the mesh is closed and consistently wound.

        Per shared vertex index; `load_mesh` merges equal vertices. Traced as the mesh is.
        """
        without_border = (as_numpy(self.edge_faces) >= 0).all()
        return bool(without_border) if is_concrete(without_border) else without_border


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
        check_above_zero("radii", self.radii, "positive radii")
        if is_concrete(self.centers, self.radii):
            middles, radii = np.asarray(self.centers), np.asarray(self.radii)[:, None]
            _warn_if_coarse(np.concatenate([middles - radii, middles + radii]), "centers")


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


def check_view(camera: object, scene: object) -> None:
    """Raise ValueError for anything but a single camera and a scene, in this order."""
    if not (isinstance(camera, Camera) and isinstance(scene, Scene)):
        kinds = f"{type(camera).__name__}, {type(scene).__name__}"
        raise ValueError(f"`camera`, `scene`: expected a Camera and a Scene, got {kinds}")
    check_camera(camera)


def check_scene(scene: object) -> None:
    """Raise ValueError for anything but a scene with a face or a sphere."""
    if not isinstance(scene, Scene):
        hint = "; give `Scene(mesh=...)`" if isinstance(scene, Mesh) else ""
        raise ValueError(f"`scene`: expected a Scene, got {type(scene).__name__}{hint}")
    faces = scene.mesh is not None and scene.mesh.edge_faces.shape[0]
    if not faces and (scene.spheres is None or not scene.spheres.radii.shape[0]):
        raise ValueError("`scene`: expected a Scene with a mesh or spheres, got an empty one")


def astype(scene: Scene, dtype: np.dtype) -> Scene:
    """Return the scene in a float type."""
    cast = lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x
    return jax.tree.map(cast, scene)


def with_arrays(mesh: Mesh, arrays: Sequence[Array | np.ndarray]) -> Mesh:
    """Return the mesh with other vertices, faces, edges' vertices and edges' faces, unchecked."""
    return jax.tree.unflatten(jax.tree.structure(mesh), arrays)


def padded(scene: Scene) -> Scene:
    """Return the scene with its mesh's arrays filled up to one of a few sizes.

    Added faces have vertices -1; added edges have the last face on both sides. They are no
    contour's, so the silhouette is the same. Meshes of similar size share compiled programs.
    """
    mesh = scene.mesh
    if mesh is None or not mesh.edge_faces.shape[0]:
        return scene
    V, F, E = _filled_sizes(len(mesh.vertices), len(mesh.faces), len(mesh.edge_faces))
    # (By NumPy: JAX would compile that for each size; within `grad` its `asarray` is traced.)
    added = zip(jax.tree.leaves(mesh), (V, F, E, E), (0, -1, 0, F - 1), strict=True)
    filled = jax.device_put([filled_up(np.asarray(x), size, value) for x, size, value in added])
    return Scene(mesh=with_arrays(mesh, filled), spheres=scene.spheres)


def _filled_sizes(vertices: int, faces: int, edges: int) -> tuple[int, int, int]:
    """Return the numbers of vertices, faces and edges that a mesh is filled up to.

    Few sizes, as each is compiled for; in steps of an eighth for large meshes, whose memory counts.
    """
    for most in FILLED_UP:
        if max(vertices, faces) <= most and 2 * edges <= 3 * most:
            return most, most, 3 * most // 2
    return room(vertices), room(faces), room(edges)


def front_facing(mesh: Mesh, e: Float[Array, "3"]) -> Bool[Array, "F"]:
    """Return the faces that show their front (counter-clockwise) side to the eye; edge-on: False.

    The eye is taken from a face's own corner: in a scene much larger than the object nothing is
    lost. Normals have a unit of the mesh's own, so that they neither overflow nor vanish.
    """
    points, e = jax.lax.stop_gradient((mesh.vertices, e))
    a, b, c = (points[corner].T for corner in mesh.faces.T)
    unit = binary_scale(points) / 4
    normal = outer([*((b - a) * unit)], [*((c - a) * unit)])
    return inner(normal, [*(e[:, None] - a)]) > 0


class Ball(NamedTuple):
    """A sphere, in world units: `centre` (3,) and `radius`; of NumPy or JAX."""

    centre: Any
    radius: Any


def bounding_box(scene: Scene) -> Float[Array, "2 3"]:
    """Return the least and largest coordinates of the scene."""
    if stands_alone(scene):
        scene = jax.tree.map(np.asarray, scene)  # (JAX would compile that for each size)
    points: list[Array | np.ndarray] = []
    if scene.mesh is not None:
        points.append(scene.mesh.vertices)
    if scene.spheres is not None:
        centers, radii = scene.spheres.centers, scene.spheres.radii[:, None]
        points += [centers - radii, centers + radii]
    xp = np if isinstance(points[0], np.ndarray) else jnp
    every = xp.concatenate(points)
    box = xp.stack([every.min(axis=0), every.max(axis=0)])
    return jnp.asarray(box, box.dtype)


def ball_about(box: Float[Array | np.ndarray, "2 3"]) -> Ball:
    """Return the sphere through a box's corners, of NumPy or JAX as the box is."""
    low, high = box
    half = (high - low) / 2
    size = abs(half).max()
    unit = half / (size + (size == 0).astype(half.dtype))  # squares do not overflow
    return Ball(low + half, size * (unit**2).sum() ** 0.5)


def morton_codes(points: Float[Array | np.ndarray, "N 3"]) -> UInt32[Array | np.ndarray, "N"]:
    """Return the Morton codes of at least one point, 10 bits an axis."""
    cell = grid_cells(points, 1024)
    spread = cell & 1
    for bit in range(1, 10):
        spread |= ((cell >> bit) & 1) << (3 * bit)
    return spread[:, 0] | spread[:, 1] << 1 | spread[:, 2] << 2


def grid_cells(
    points: Float[Array | np.ndarray, "N 3"], number: int
) -> UInt32[Array | np.ndarray, "N 3"]:
    """Return the cells of at least one point, this many along the longest side of a box."""
    low, high = points.min(axis=0), points.max(axis=0)
    extent = (high - low).max(initial=np.finfo(points.dtype).tiny)
    return ((points - low[None]) / extent * number).clip(0, number - 1).astype(np.uint32)


def rounding_warning(points: np.ndarray, name: str = "vertices") -> str:
    """Return a warning if float32 rounds points to a good part of the object, else nothing."""
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


def _warn_if_coarse(points: np.ndarray, name: str = "vertices") -> None:
    if points.dtype == np.float32 and (words := rounding_warning(points, name)):
        warnings.warn(f"`{name}`: {words}, or set jax_enable_x64", stacklevel=3)


def _warn_if_loose(points: np.ndarray, triangles: np.ndarray) -> None:
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
