"""Independent answers: polygon union by shapely, central differences. Nothing of pinhole_jax but
`project`, which `test_rays` checks by hand."""

import jax.numpy as jnp
import numpy as np
import shapely

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


def mesh_union(camera: pj.Camera, vertices, faces):
    """Return the union of the projected triangles: no facing, no contour, no winding."""
    film = np.asarray(pj.project(camera, jnp.asarray(vertices)))
    triangles = shapely.polygons(film[np.asarray(faces)])
    return shapely.union_all(triangles[shapely.area(triangles) > 0])


def mesh_coverage(camera: pj.Camera, vertices, faces) -> np.ndarray:
    return area_per_pixel(mesh_union(camera, vertices, faces), camera.W, camera.H)


def sphere_union(camera: pj.Camera, centers, radii, corners: int = 20_000):
    """Return the union of the spheres' outlines: the circle in space where rays touch the sphere,
    projected point by point to a polygon of the ellipse's area to 1e-7 relative."""
    outlines = []
    eye = np.asarray(camera.e, float)
    for center, radius in zip(np.asarray(centers), np.asarray(radii), strict=True):
        axis = center - eye
        distance = np.linalg.norm(axis)
        axis = axis / distance
        side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
        side /= np.linalg.norm(side)
        angle = np.linspace(0, 2 * np.pi, corners, endpoint=False)[:, None]
        ring = np.cos(angle) * side + np.sin(angle) * np.cross(axis, side)
        touch = np.sqrt(distance**2 - radius**2)
        points = eye + touch / distance * (touch * axis + radius * ring)
        outlines.append(shapely.polygons(np.asarray(pj.project(camera, jnp.asarray(points)))))
    return shapely.union_all(outlines)


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


def turned(camera: pj.Camera, axis, degrees: float, distance: float = 1.0, focal: float = 1.0):
    """Return the camera orbited about the origin; distance and focal length are multiples."""
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    angle = np.deg2rad(degrees)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    R = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    e, p, u = (np.asarray(x, float) for x in (camera.e, camera.p, camera.u))
    eye = R @ e * distance
    phi = 2 * np.arctan(np.tan(float(camera.phi) / 2) / focal)
    dtype = np.asarray(camera.e).dtype
    arrays = (x.astype(dtype) for x in (eye, eye + R @ (p - e), R @ u))
    return pj.Camera(*arrays, dtype.type(phi), camera.d, camera.W, camera.H, camera.lens)


def random_camera(random: np.random.Generator, W: int, H: int, distance: float = 5.0):
    eye = random.normal(size=3)
    eye *= distance / np.linalg.norm(eye)
    return pj.Camera(eye, 0.1 * random.normal(size=3), random.normal(size=3), 0.6, 1.0, W, H)
