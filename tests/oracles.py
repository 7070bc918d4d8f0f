"""Independent answers: unions of polygons (`_oracle`), central differences."""

import sys
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import shapely
from numpy.random import default_rng
from scipy.spatial.transform import Rotation

import pinhole_jax as pj

sys.path.append(str(Path(__file__).parents[1] / "experiments" / "reference"))
import _oracle
from _scenes import View

#: The corners of a square in z = 0, and its triangles.
CORNERS = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
QUAD = [[0, 1, 2], [0, 2, 3]]


def view_of(camera, scene):
    """Return the plain numbers of a camera and what it sees, in float64, whatever their type."""
    numbers = lambda thing, *names: {x: np.asarray(getattr(thing, x), float) for x in names}
    lens = camera.lens or pj.Lens([camera.W / 2, camera.H / 2])
    none, bent = np.zeros((0, 3)), lens.distortion
    mesh = scene.mesh or SimpleNamespace(vertices=none, faces=none)
    spheres = scene.spheres or SimpleNamespace(centers=none, radii=none[:, 0])
    return View(
        about="",
        **numbers(camera, "e", "p", "u", "phi", "d"),
        **numbers(mesh, "vertices"),
        faces=np.asarray(mesh.faces, int),
        **numbers(spheres, "centers", "radii"),
        W=camera.W,
        H=camera.H,
        **numbers(lens, "principal_point", "aspect"),
        model={pj.BrownConrady: "brown", pj.Fisheye: "fisheye"}.get(type(bent), "none"),
        coefficients=np.array([*bent.coefficients().values()] if bent else []),
    )


def scene_polygons(camera, scene):
    """Return the projected triangles, and the outlines of spheres."""
    view = view_of(camera, scene)
    return [*_oracle.triangles(view), *_oracle.rims(view)]


def union_per_pixel(polygons, W, H):
    """Return the area of a union of polygons within each pixel's square, row 0 on top."""
    return _oracle.union_per_pixel(np.array(polygons, dtype=object), np.ones((H, W), bool))


def coverage(camera, scene):
    return union_per_pixel(scene_polygons(camera, scene), camera.W, camera.H)


def mesh_coverage(camera, vertices, faces):
    return coverage(camera, body(vertices, faces))


def drawn(camera, scene):
    """Return a mask for a fit: of a mesh, to some 1e-13, by no program that a size or a mesh needs
    of its own; of spheres and under distortion what the package draws."""
    lens = camera.lens
    if scene.mesh is None or scene.spheres is not None or (lens and lens.distortion is not None):
        return np.asarray(pj.silhouette(camera, scene))
    polygons = scene_polygons(camera, scene)
    with suppress(shapely.GEOSException):  # where edges nearly agree
        polygons = [shapely.union_all(polygons)]
    return union_per_pixel(polygons, camera.W, camera.H)


def central_difference(function, x, step=1e-5):
    """Return d function / d x, entry by entry; function returns a number or an array."""
    x = np.asarray(x, float)
    columns = []
    for index in np.ndindex(x.shape):
        h = np.zeros_like(x)
        h[index] = step
        up, down = np.asarray(function(x + h)), np.asarray(function(x - h))
        columns.append((up - down) / (2 * step))
    return np.stack(columns, axis=-1).reshape((*np.shape(columns[0]), *x.shape))


def cast(tree, kind):
    """Return cameras or scenes in a float type."""
    return jax.tree.map(lambda x: x.astype(kind) if x.dtype.kind == "f" else x, tree)


def single(tree):
    return cast(tree, np.float32)


def turned(camera, degrees, distance=1.0, focal=1.0, axis=(1, 2, 3)):
    """Return the camera orbited about the origin; distance and focal length are multiples."""
    turn = np.deg2rad(degrees) * np.asarray(axis) / np.linalg.norm(axis)
    R, eye = Rotation.from_rotvec(turn).as_matrix(), np.asarray(camera.e, float)
    there = camera.with_pose(distance * R @ eye, np.stack(pj.camera_basis(camera)) @ R.T)
    phi = 2 * np.arctan(np.tan(float(camera.phi) / 2) / focal)
    return there.replace(phi=camera.phi.dtype.type(phi))


def usual_camera(W=96, H=80):
    """Return the camera that most tests look through: askew, 5 from a shape of size 1."""
    return pj.Camera([0.3, 1.0, 5.0], [0.1, 0, 0], [0.2, 1, 0.1], 0.6, 1.0, W, H)


def skew_camera(W, H, d=1.0):
    """Return a camera none of whose axes is one of the world's."""
    return pj.Camera([1.0, 2, 5], [0.1, 0, 0], [0.3, 1, 0.2], 0.7, d, W, H)


def camera_ahead(W=96, H=80):
    """Return a camera 5 before the origin that looks along -z, y up."""
    return pj.Camera([0.0, 0, 5], [0, 0, 0], [0, 1, 0], 0.6, 1.0, W, H)


def body(*mesh):
    """Return the scene of a mesh: of vertices and faces, or of a mesh of trimesh's."""
    return pj.Scene(pj.Mesh(*mesh))


def balls(centers, radii, mesh=None):
    """Return the scene of spheres, and of a mesh."""
    return pj.Scene(mesh, pj.Spheres(centers, radii))


def lump(*given, **more):
    """Return the scene of `shapes.bumpy` alone."""
    return pj.Scene(pj.shapes.bumpy(*given, **more))


def normal(shape, seed=0):
    """Return independent normal numbers, the same for a seed."""
    return default_rng(seed).normal(size=shape)


def filled(vertices, faces, room):
    """Return the mesh with arrays of one size, so that all meshes share one program; what is added
    shows nowhere."""
    pad = lambda x, row: np.concatenate([x, np.repeat(row, room - len(x), 0)])
    mesh = pj.Mesh(pad(vertices, vertices[:1]), pad(faces, np.zeros((1, 3), int)))
    edges = lambda m: (m.edge_vertices, m.edge_faces)
    fill = lambda x: jnp.pad(x, ((0, 2 * room - x.shape[0]), (0, 0)))
    return eqx.tree_at(edges, mesh, tuple(map(fill, edges(mesh))))


def camera_anywhere(seed, W=96, H=80):
    """Return a camera 5 from the origin, which it looks at, turned at random."""
    axes = Rotation.random(random_state=seed).as_matrix()
    return pj.Camera(-5 * axes[2], np.zeros(3), axes[1], 0.6, 1.0, W, H)


def off(camera, other):
    """Return the angle (rad) or the shift between two cameras, whichever is the larger number."""
    return max(map(float, pj.pose_error(camera, other)))


def random_camera(random, W, H):
    eye = random.normal(size=3)
    eye *= 5 / np.linalg.norm(eye)
    return pj.Camera(eye, 0.1 * random.normal(size=3), random.normal(size=3), 0.6, 1.0, W, H)


def random_rays(number, dtype=float):
    """Return origins (n, 3), 3 from the middle, and unit directions past it."""
    random = default_rng(0)
    origin = random.normal(size=(number, 3))
    origin *= 3 / np.linalg.norm(origin, axis=1, keepdims=True)
    direction = 0.6 * random.normal(size=(number, 3)) - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return jnp.asarray(origin, dtype), jnp.asarray(direction, dtype)
