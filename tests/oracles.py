"""Independent answers: polygon union by shapely, central differences. Nothing of pinhole_jax but
`project`, which `test_rays` checks by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import shapely
from scipy.spatial.transform import Rotation

import pinhole_jax as pj


def pixel_squares(W: int, H: int) -> np.ndarray:
    """Return the pixels' squares as boxes, shape (H, W), row 0 on top."""
    i, j = np.meshgrid(np.arange(W), np.arange(H)[::-1])
    return shapely.box(i, j, i + 1, j + 1)


def area_per_pixel(shape, W: int, H: int) -> np.ndarray:
    """Return the area of a shape (film coordinates) within each pixel's square."""
    squares = pixel_squares(W, H)
    shapely.prepare(shape)
    inside = shapely.contains_properly(shape, squares)
    crossed = shapely.intersects(shape, squares) & ~inside
    area = inside.astype(float)
    area[crossed] = shapely.area(shapely.intersection(squares[crossed], shape))
    return area


def union_per_pixel(shapes, W: int, H: int, only=None) -> np.ndarray:
    """Return the area of a union of polygons within each pixel's square, 0 where it is not asked
    for: `only` says in which pixels it is (H, W).

    Shape by shape and pixel by pixel: a union of many at once loses area where edges nearly agree.
    """
    shapes = np.asarray(shapes, dtype=object)
    shapes = shapes[shapely.area(shapes) > 0]
    squares = pixel_squares(W, H).ravel()
    area = np.zeros(W * H)
    asked = np.arange(W * H) if only is None else np.flatnonzero(only)
    square, of = shapely.STRtree(shapes).query(squares[asked], predicate="intersects")
    square = asked[square]
    area[square[shapely.covers(shapes[of], squares[square])]] = 1
    left = area[square] == 0
    square, of = square[left], of[left]
    parts = shapely.intersection(shapes[of], squares[square])
    order = np.argsort(square, kind="stable")
    first = np.flatnonzero(np.diff(square[order], prepend=-1))
    for group in np.split(order, first[1:]) if len(order) else []:
        area[square[group[0]]] = shapely.area(shapely.union_all(parts[group]))
    return area.reshape(H, W)


def homogeneous(camera: pj.Camera, points) -> np.ndarray:
    """Return (x z, y z, z) of world points, from the film coordinates of their directions' sums
    with the view axis: `project` alone, also for points behind the eye."""
    e, p = (np.asarray(x, float) for x in (camera.e, camera.p))
    view = (p - e) / np.linalg.norm(p - e)
    offset = np.asarray(points, float) - e
    z = offset @ view
    # Any point of the plane at depth 1 projects safely; film coordinates are affine there, so that
    # three of them tell all.
    across = np.linalg.svd(view[None])[2][1:]
    plane = e + view + np.concatenate([np.zeros((1, 3)), across])
    centre, *ends = np.asarray(pj.project(camera, jnp.asarray(plane)), float)
    film = offset @ across.T @ (np.array(ends) - centre)
    return np.concatenate([film + z[..., None] * centre, z[..., None]], axis=-1)


def clipped(corners: np.ndarray, planes) -> np.ndarray:
    """Return the part of a convex polygon of homogeneous points before some planes."""
    for plane in planes:
        if not len(corners):
            break
        side, ahead = corners @ plane, np.roll(corners, -1, axis=0)
        after = np.roll(side, -1)
        crosses = (side > 0) != (after > 0)
        t = (side / np.where(crosses, side - after, 1))[:, None]
        both = np.stack([corners, corners + t * (ahead - corners)], axis=1)
        corners = both.reshape(-1, corners.shape[1])[np.stack([side > 0, crosses], axis=1).ravel()]
    return corners


def sides_of_frame(W: int, H: int) -> np.ndarray:
    """Return the planes through the eye and the sides of a frame that is a pixel larger."""
    return np.array([[1, 0, 1], [0, 1, 1], [-1, 0, W + 1], [0, -1, H + 1]])


def clipped_polygon(corners: np.ndarray, W: int, H: int):
    """Return a convex polygon of homogeneous points within the frame (a pixel larger)."""
    corners = clipped(corners, sides_of_frame(W, H))
    corners = corners[corners[:, 2] > 1e-13] if len(corners) else corners
    if len(corners) < 3:
        return None
    hull = shapely.convex_hull(shapely.multipoints(corners[:, :2] / corners[:, 2:]))
    return hull if hull.geom_type == "Polygon" else None


def mesh_polygons(camera: pj.Camera, vertices, faces) -> list:
    """Return the projected triangles, clipped at the frame: no facing, no contour, no winding.

    In float64, whatever the camera's type.
    """
    camera = jax.tree.map(lambda x: jnp.asarray(x, float), camera)
    triangles = homogeneous(camera, vertices)[np.asarray(faces)]
    inside = np.ones(len(triangles), bool)
    for plane in (*sides_of_frame(camera.W, camera.H), [0, 0, 1]):
        side = triangles @ plane > 0
        keep = np.any(side, axis=1)
        triangles, inside = triangles[keep], inside[keep] & np.all(side, axis=1)[keep]
    whole = triangles[inside]
    found = [clipped_polygon(t, camera.W, camera.H) for t in triangles[~inside]]
    return [
        *shapely.polygons(whole[..., :2] / whole[..., 2:]),
        *(p for p in found if p is not None),
    ]


def mesh_coverage(camera: pj.Camera, vertices, faces, only=None) -> np.ndarray:
    return union_per_pixel(mesh_polygons(camera, vertices, faces), camera.W, camera.H, only)


def drawn(camera: pj.Camera, scene: pj.Scene) -> np.ndarray:
    """Return a mask for a fit: of a mesh, to some 1e-13, by no program that a size or a mesh needs
    of its own; of spheres and under distortion what the package draws."""
    lens = camera.lens
    if scene.mesh is None or scene.spheres is not None or (lens and lens.distortion is not None):
        return np.asarray(pj.silhouette(camera, scene))
    polygons = mesh_polygons(camera, scene.mesh.vertices, scene.mesh.faces)
    try:
        return area_per_pixel(shapely.union_all(polygons), camera.W, camera.H)
    except shapely.GEOSException:  # where edges nearly agree
        return union_per_pixel(polygons, camera.W, camera.H)


def rim(eye, center, radius, corners: int) -> np.ndarray:
    """Return points (n, 3) of the circle in space where rays from the eye touch a sphere."""
    axis = center - eye
    distance = np.linalg.norm(axis)
    axis = axis / distance
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    angle = np.linspace(0, 2 * np.pi, corners, endpoint=False)[:, None]
    ring = np.cos(angle) * side + np.sin(angle) * np.cross(axis, side)
    touch = np.sqrt(distance**2 - radius**2)
    return eye + touch / distance * (touch * axis + radius * ring)


def rims(camera: pj.Camera, centers, radii, corners: int) -> list[np.ndarray]:
    """Return the `rim` of each sphere."""
    eye, given = np.asarray(camera.e, float), (np.asarray(x, float) for x in (centers, radii))
    return [rim(eye, *sphere, corners) for sphere in zip(*given, strict=True)]


def sphere_polygons(camera: pj.Camera, centers, radii, corners: int = 20_000) -> list:
    """Return the spheres' outlines, clipped at the frame: polygons of their images' areas to 1e-7
    relative."""
    points = (homogeneous(camera, points) for points in rims(camera, centers, radii, corners))
    outlines = [clipped_polygon(corners, camera.W, camera.H) for corners in points]
    return [outline for outline in outlines if outline is not None]


def scene_polygons(camera: pj.Camera, scene: pj.Scene, corners: int = 20_000) -> list:
    """Return the projected triangles, and the outlines of spheres."""
    mesh, spheres = scene.mesh, scene.spheres
    found = mesh_polygons(camera, mesh.vertices, mesh.faces) if mesh else []
    rounds = sphere_polygons(camera, spheres.centers, spheres.radii, corners) if spheres else []
    return [*found, *rounds]


def coverage(camera: pj.Camera, scene: pj.Scene, corners: int = 20_000) -> np.ndarray:
    return union_per_pixel(scene_polygons(camera, scene, corners), camera.W, camera.H)


def central_difference(function, x: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """Return d function / d x, entry by entry; function returns a number or an array."""
    x = np.asarray(x, float)
    columns = []
    for index in np.ndindex(x.shape):
        h = np.zeros_like(x)
        h[index] = step
        up, down = np.asarray(function(x + h)), np.asarray(function(x - h))
        columns.append((up - down) / (2 * step))
    return np.stack(columns, axis=-1).reshape((*np.shape(columns[0]), *x.shape))


def single(tree):
    """Return cameras or scenes in float32."""
    return jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype == float else x, tree)


def turned(camera: pj.Camera, axis, degrees: float, distance: float = 1.0, focal: float = 1.0):
    """Return the camera orbited about the origin; distance and focal length are multiples."""
    turn = np.deg2rad(degrees) * np.asarray(axis) / np.linalg.norm(axis)
    R = Rotation.from_rotvec(turn).as_matrix()
    e, p, u = (np.asarray(x, float) for x in (camera.e, camera.p, camera.u))
    eye = R @ e * distance
    phi = 2 * np.arctan(np.tan(float(camera.phi) / 2) / focal)
    dtype = np.asarray(camera.e).dtype
    arrays = (x.astype(dtype) for x in (eye, eye + R @ (p - e), R @ u))
    return pj.Camera(*arrays, dtype.type(phi), camera.d, camera.W, camera.H, camera.lens)


def usual_camera(W: int = 96, H: int = 80) -> pj.Camera:
    """Return the camera that most tests look through: askew, 5 from a shape of size 1."""
    return pj.Camera([0.3, 1.0, 5.0], [0.1, 0, 0], [0.2, 1, 0.1], 0.6, 1.0, W, H)


def filled(vertices, faces, room: int) -> pj.Mesh:
    """Return the mesh with arrays of one size, so that all meshes share one program; what is added
    shows nowhere."""
    pad = lambda x, row: np.concatenate([x, np.repeat(row, room - len(x), 0)])
    mesh = pj.Mesh(pad(vertices, vertices[:1]), pad(faces, np.zeros((1, 3), int)))
    edges = lambda m: (m.edge_vertices, m.edge_faces)
    fill = lambda x: jnp.pad(x, ((0, 2 * room - x.shape[0]), (0, 0)))
    return eqx.tree_at(edges, mesh, tuple(map(fill, edges(mesh))))


def random_camera(random: np.random.Generator, W: int, H: int, distance: float = 5.0):
    eye = random.normal(size=3)
    eye *= distance / np.linalg.norm(eye)
    return pj.Camera(eye, 0.1 * random.normal(size=3), random.normal(size=3), 0.6, 1.0, W, H)


def random_rays(number: int, dtype=float):
    """Return origins (n, 3), 3 from the middle, and unit directions past it."""
    random = np.random.default_rng(0)
    origin = random.normal(size=(number, 3))
    origin *= 3 / np.linalg.norm(origin, axis=1, keepdims=True)
    direction = 0.6 * random.normal(size=(number, 3)) - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return jnp.asarray(origin, dtype), jnp.asarray(direction, dtype)
