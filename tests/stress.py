"""Hard cases, and what is right there: projections in extended precision.

Each case draws scenes and cameras at some extreme, rounds them to float32 and to float64, and takes
what is rounded as exact: the oracle projects triangles in 60 digits, clips them in 80 bits and
unites polygons with shapely. The error is the worst pixel's, in machine epsilons (1.2e-7 px^2 in
float32, 2.2e-16 in float64). A case holds where it is below `LIMIT` of them.
"""

import decimal
from collections import namedtuple
from decimal import Decimal

import numpy as np
import trimesh
from oracles import _oracle, balls, filled, union_per_pixel

import pinhole_jax as pj

W, H = 24, 18
LIMIT = 256.0
TYPES = {"float32": np.float32, "float64": np.float64}
Exact = np.longdouble
decimal.getcontext().prec = 60


#: A scene of triangles, and a camera; epsilons that rounding a film point is worth, beside one of
#: W x H; the film's size; the radius of a sphere about the first vertex, in place of the faces.
View = namedtuple(
    "View", "vertices faces e p u phi d unit size radius", defaults=(1.0, (W, H), 0.0)
)
SHAPES = [
    (np.asarray(shape.vertices), np.asarray(shape.faces))
    for shape in (
        trimesh.creation.icosphere(1),
        trimesh.creation.box(),
        trimesh.Trimesh([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]],
                        [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]),
    )
]  # fmt: skip


def unit(x):
    return x / np.linalg.norm(x)


def direction(random):
    return unit(random.normal(size=3))


def usual(random):
    """Return a view of a shape of size about 1 from some 3 to 6 sizes away."""
    vertices, faces = SHAPES[random.integers(len(SHAPES))]
    turned = vertices @ np.linalg.qr(random.normal(size=(3, 3)))[0]
    eye = direction(random) * random.uniform(3, 6)
    phi = 2 * np.arctan(random.uniform(0.9, 2) / np.linalg.norm(eye))
    return View(turned, faces, eye, 0.2 * random.normal(size=3), direction(random), phi, 1.0)


def log_uniform(random, low, high):
    return float(10 ** random.uniform(np.log10(low), np.log10(high)))


def extreme(low, high, change):
    """Return a case: a usual view, changed by a number of any size between two."""
    return lambda random: change(usual(random), log_uniform(random, low, high), random)


def distant(v, s, random):
    """With the field of view to match."""
    return v._replace(e=s * unit(v.e), phi=2 * np.arctan(random.uniform(0.9, 2) / s))


def offset(v, s, random):
    """The world's origin far off, the camera near the object."""
    away = s * direction(random)
    return v._replace(vertices=v.vertices + away, e=v.e + away, p=v.p + away)


def in_a_large_scene(v, s, random):
    """A triangle behind the eye, whose corners come first."""
    ahead = unit(v.p - v.e)
    side = np.cross(ahead, direction(random))
    behind = v.e - s * (ahead + np.array([-side, side, np.cross(ahead, side)]))
    vertices = np.concatenate([behind, v.vertices])
    return v._replace(vertices=vertices, faces=np.concatenate([[[0, 1, 2]], v.faces + 3]))


def close(v, s, random):
    """The eye above the surface of the icosphere's inscribed ball, or within."""
    vertices, faces = SHAPES[0]
    middle = vertices[faces].mean(axis=1)[random.integers(len(faces))]
    eye = middle * (1 + s * random.choice([-1, 1]))
    aim, phi = eye + direction(random), random.uniform(0.5, 2)
    return v._replace(vertices=vertices, faces=faces, e=eye, p=aim, phi=phi)


def pole(v, s, random):
    ahead = unit(v.p - v.e)
    return v._replace(u=ahead + s * unit(np.cross(ahead, v.u)))


def short_view(v, s, random):
    return v._replace(p=v.e + s * unit(v.p - v.e))


def narrow(v, s, random):
    return v._replace(e=unit(v.e) / np.tan(s / 2) * random.uniform(1, 2), phi=s)


def huge_edges(v, s, random):
    """A triangle across the film."""
    ahead = unit(v.p - v.e)
    side = np.cross(ahead, direction(random))
    middle = v.p + 0.3 * random.normal(size=3)
    corners = [middle + side, middle - s * side, middle + s * np.cross(ahead, side)]
    return v._replace(vertices=np.array(corners), faces=np.array([[0, 1, 2]]))


def slivers(v, s, random):
    """Triangles on their own."""
    a, b = random.uniform(-1, 1, (2, 10, 3))
    c = a + random.random((10, 1)) * (b - a) + s * random.normal(size=(10, 3))
    return v._replace(
        vertices=np.stack([a, b, c], 1).reshape(-1, 3), faces=np.arange(30).reshape(-1, 3)
    )


def one_row(v, s, random):
    """The object across some of the pixels."""
    wide = random.random() < 0.5
    angle = 2 * np.arctan(np.tan(v.phi / 2) / s) if wide else v.phi
    return v._replace(phi=angle, size=(1000, 1) if wide else (1, 1000), unit=1000 / min(W, H))


wide = extreme(1e-6, 1, lambda v, s, _: v._replace(phi=np.pi - s))


def inside(random):
    eye, aim, phi = 0.1 * random.normal(size=3), direction(random), random.uniform(0.5, 2)
    return usual(random)._replace(e=eye, p=aim, phi=phi)


def beside_a_box(eye, aim, phi):
    vertices, faces = SHAPES[1]
    return View(vertices, faces, eye, aim, np.array([0.3, 1, 0.2]), phi, 1.0)


def on_vertex_plane(random):
    """Vertices in the plane of the eye, others behind it."""
    eye = np.array([random.uniform(-2, 2), random.uniform(-2, 2), 0.5])
    return beside_a_box(eye, eye - [0, 0, 1], random.uniform(0.5, 2.5))


def in_face_plane(random):
    eye = np.array([random.uniform(2, 4), random.uniform(-0.4, 0.4), 0.5])
    return beside_a_box(eye, np.zeros(3), 0.7)


def on_the_grid(random):
    """A box whose outline runs along pixel rows and columns and through their corners."""
    v = beside_a_box(np.array([0, 0, 9.0]), np.zeros(3), np.pi / 2)
    size, place = [*random.integers(1, 12, 2), 1.0], [*random.integers(-3, 4, 2), -0.5]
    return v._replace(vertices=v.vertices * size + place, u=np.array([0, 1.0, 0]))


def degenerate(random):
    """Faces of no area, faces twice, vertices twice, a T-junction."""
    v = usual(random)
    n, f = len(v.vertices), v.faces
    middle = v.vertices[f[0, :2]].mean(axis=0, keepdims=True)
    more = [[0, 0, 1], [2, 2, 2], [0, 1, 0], [f[0, 0], n, f[0, 2]]]
    faces = np.concatenate([f, f[: len(f) // 2], f[:2] + n + 1, more])
    return v._replace(vertices=np.concatenate([v.vertices, middle, v.vertices]), faces=faces)


def sphere(random):
    """A sphere of radius 1e-8 to 1e8; its outline is an ellipse."""
    r, s = log_uniform(random, 1e-8, 1e8), log_uniform(random, 1e-2, 1e6)
    eye = r * (1 + s) * direction(random)
    seen = np.arcsin(1 / (1 + s))  # half the angle
    tilt = random.uniform(0, 0.5) * min(seen, np.pi / 2 - seen)
    aim = np.tan(tilt) * np.linalg.norm(eye) * unit(np.cross(eye, direction(random)))
    phi = 2 * np.arctan(np.tan(seen) * random.uniform(0.7, 2))
    faces = np.zeros((0, 3), int)
    return View(np.zeros((1, 3)), faces, eye, aim, direction(random), phi, r, radius=r)


CASES = {
    "size 1e-30 to 1e30": extreme(
        1e-30,
        1e30,
        lambda v, s, _: v._replace(vertices=v.vertices * s, e=v.e * s, p=v.p * s, d=s),
    ),
    "distance 1e1 to 1e8 sizes": extreme(10, 1e8, distant),
    "world offset to 1e6 sizes": extreme(1, 1e6, offset),
    "a scene of 1 to 1e6 sizes": extreme(1, 1e6, in_a_large_scene),
    "eye 1e-8 to 1 from a face": extreme(1e-8, 1, close),
    "up 1e-1 to 1e-12 rad off the view": extreme(1e-12, 1e-1, pole),
    "view point to 1e-12 from the eye": extreme(1e-12, 1, short_view),
    "phi 1e-6 to 1": extreme(1e-6, 1, narrow),
    "phi to pi - 1e-6": wide,
    "d 1e-12 to 1e12": extreme(1e-12, 1e12, lambda v, s, _: v._replace(d=s)),
    "eye inside": inside,
    "vertices in the eye's plane": on_vertex_plane,
    "eye in a face's plane": in_face_plane,
    "outline on the pixel grid": on_the_grid,
    "edges of 1e-7 to 1 px": extreme(
        1e-7, 1, lambda v, s, _: v._replace(vertices=v.p + v.vertices * s / 20)
    ),
    "edges of 1 to 1e7 px": extreme(1, 1e6, huge_edges),
    "slivers 1e-12 to 1e-1 wide": extreme(1e-12, 1e-1, slivers),
    "faces and vertices twice, no area": degenerate,
    "1000 px in a row or column": extreme(1, 1000, one_row),
    "sphere, eye 1e-2 to 1e6 radii off": sphere,
}


def rounded(view, dtype):
    """Return camera and vertices in a float type."""
    numbers = (np.asarray(x, dtype) for x in view[2:7])
    return pj.Camera(*numbers, *view.size), view.vertices.astype(dtype)


def scene_of(view, vertices):
    """Return the scene with arrays of one size, so that all share one program."""
    if view.radius:
        return balls(vertices, np.full(1, view.radius, vertices.dtype))
    return pj.Scene(filled(vertices, view.faces, 256))


def decimals(x):
    """Return the exact values of floats."""
    return np.vectorize(lambda v: Decimal(float(v)), otypes=[object])(np.asarray(x))


def film_matrix(camera):
    """Return the matrix from points about the eye to (x z, y z, z): Frisvad's equations in
    decimals of 60 digits."""
    e, p, u = (decimals(x) for x in (camera.e, camera.p, camera.u))
    unit = lambda x: x / (x @ x).sqrt()
    v = unit(p - e)
    b1 = unit(np.cross(v, u))
    tangent = np.tan(Exact(float(camera.phi)) / 2)
    high = float(tangent)
    focal = camera.H / (2 * (Decimal(high) + Decimal(float(tangent - high))))
    half = Decimal("0.5")
    return np.stack([focal * b1 + camera.W * half * v,
                     focal * np.cross(b1, v) + camera.H * half * v, v])  # fmt: skip


def film_points(camera, points):
    """Return points as (x z, y z, z), the largest of them about 1."""
    film = (decimals(points) - decimals(camera.e)) @ film_matrix(camera).T
    return film / np.abs(film).max(axis=1, keepdims=True)


def extended(x):
    """Return decimals as 80-bit numbers."""
    high = x.astype(float)
    return high.astype(Exact) + (x - decimals(high)).astype(float)


def sphere_oracle(camera, center, radius):
    """Return the coverage of a sphere before the eye, by Green's theorem along its outline.

    The outline is the image of the circle where rays touch the sphere. It is cut at every line of
    the pixel grid, and each part's area is integrated by Gauss's rule in 80 bits.
    """
    W, H = camera.W, camera.H
    axis = decimals(center) - decimals(camera.e)
    distance = (axis @ axis).sqrt()
    axis, sine = axis / distance, Decimal(float(radius)) / distance
    first = np.cross(axis, decimals(np.eye(3)[np.argmin(np.abs(axis))]))
    first = first / (first @ first).sqrt()
    rays = [(1 - sine * sine).sqrt() * axis, sine * first, sine * np.cross(axis, first)]
    frame = extended(np.stack(rays) @ film_matrix(camera).T)  # rows 1, cos, sin
    turn = 2 * np.arccos(Exact(-1))
    cuts = [np.linspace(Exact(0), turn, 65)]
    for k, size in enumerate((W, H)):
        c, a, b = frame[:, k, None] - np.arange(size + 1) * frame[:, 2, None]
        met = np.abs(c) < np.hypot(a, b)
        middle, aside = np.arctan2(b, a)[met], np.arccos((-c / np.hypot(a, b))[met])
        cuts += [(middle + aside) % turn, (middle - aside) % turn]
    cuts = np.unique(np.concatenate(cuts))
    nodes, weights = (x.astype(Exact) / 2 for x in np.polynomial.legendre.leggauss(12))
    width = np.diff(cuts)[:, None]
    angle = cuts[:-1, None] + width * (nodes + 0.5)
    cos, sin, one = np.cos(angle), np.sin(angle), np.ones_like(angle)
    x, y, z = np.moveaxis(np.stack([one, cos, sin], axis=-1) @ frame, -1, 0)
    _, dy, dz = np.moveaxis(np.stack([0 * one, -sin, cos], axis=-1) @ frame, -1, 0)
    x, y, dy = x / z, y / z, weights * width * (dy - y / z * dz) / z
    # Left of each line of the grid, part by part; then below each, and the squares between them.
    left = np.sum(np.clip(x[..., None], 0, np.arange(W + 1)) * dy[..., None], axis=1)
    corners = (y[:, :1] < np.arange(H + 1)).T @ left
    return np.abs(np.diff(np.diff(corners, axis=0))).astype(float)[::-1]


def oracle(camera, vertices, faces):
    """Return the coverage of the triangles' union, pixel by pixel (shapely)."""
    points = extended(film_points(camera, vertices))
    polygons = [polygon for face in faces for polygon in _oracle.clipped(points[face], camera)]
    return union_per_pixel(polygons, camera.W, camera.H)


def worst(view, dtype):
    """Return the worst pixel's error; infinite where it is no number."""
    camera, vertices = rounded(view, dtype)
    if view.radius:
        right = sphere_oracle(camera, vertices[0], np.asarray(view.radius, dtype))
    else:
        right = oracle(camera, vertices, view.faces)
    error = float(
        np.abs(np.asarray(pj.silhouette(camera, scene_of(view, vertices)), float) - right).max()
    )
    return error if np.isfinite(error) else np.inf
