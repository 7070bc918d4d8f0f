"""The 20 scenes of the set: shapes made by code, one camera each, plain NumPy numbers.

A view knows nothing of the renderer: what checks it (`_oracle.py`) reads the same numbers.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from pinhole_jax import shapes

#: The least side of an image; `--scale` makes all of them larger.
W, H = 64, 48

POINTS = ("e", "p", "u")
#: What images are differentiated by. `d` moves with phi held, `d_film` with the film's height held.
PARAMETERS = (
    *(f"{name}_{axis}" for name in POINTS for axis in "xyz"),
    *("phi", "d", "d_film", "principal_point_x", "principal_point_y", "k1"),
)


def none(*shape: int) -> Callable[[], np.ndarray]:
    return lambda: np.zeros(shape)


@dataclass(frozen=True)
class View:
    """A camera and what it sees; film coordinates in px, origin bottom left, y up.

    - `model`: "none", "brown" (coefficients k1, k2, p1, p2, k3) or "fisheye" (k1, k2, k3, k4), as
      OpenCV has them.
    """

    about: str
    e: np.ndarray
    p: np.ndarray
    u: np.ndarray
    phi: float
    vertices: np.ndarray = field(default_factory=none(0, 3))
    faces: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), int))
    centers: np.ndarray = field(default_factory=none(0, 3))
    radii: np.ndarray = field(default_factory=none(0))
    d: float = 1.3
    W: int = W
    H: int = H
    principal_point: np.ndarray = field(default_factory=lambda: np.array([W / 2, H / 2]))
    aspect: float = 1.0
    model: str = "none"
    coefficients: np.ndarray = field(default_factory=none(0))

    @property
    def focal_px(self) -> tuple[float, float]:
        fy = self.H / (2 * np.tan(self.phi / 2))
        return fy * self.aspect, fy

    @property
    def axes(self) -> np.ndarray:
        """Return the rows right, up, forward."""
        forward = (self.p - self.e) / np.linalg.norm(self.p - self.e)
        right = np.cross(forward, self.u)
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(right, forward), forward])

    @property
    def parameters(self) -> tuple[str, ...]:
        """Return what this view's image is differentiated by."""
        return PARAMETERS if self.model != "none" else PARAMETERS[:-1]

    def moved(self, name: str, amount: float) -> "View":
        """Return the view with one of its parameters larger by an amount."""
        if name == "phi":
            return replace(self, phi=self.phi + amount)
        if name == "d":
            return replace(self, d=self.d + amount)
        if name == "d_film":
            height = 2 * self.d * np.tan(self.phi / 2)
            d = self.d + amount
            return replace(self, d=d, phi=2 * np.arctan(height / (2 * d)))
        if name == "k1":
            return replace(self, coefficients=self.coefficients + amount * first(self.coefficients))
        whole, _, axis = name.rpartition("_")
        point = np.array(getattr(self, whole), float)
        point["xyz".index(axis)] += amount
        return replace(self, **{whole: point})

    def scaled(self, times: int) -> "View":
        """Return the same picture in so many times as many pixels each way."""
        centre = self.principal_point * times
        return replace(self, W=self.W * times, H=self.H * times, principal_point=centre)

    def step(self, name: str) -> float:
        """Return how much of a parameter moves the picture by about a pixel."""
        half, focal = max(self.W, self.H) / 2, self.focal_px[1]
        points = np.concatenate([self.vertices, self.centers])
        far = np.linalg.norm(points.mean(axis=0) - self.e)
        view = np.linalg.norm(self.p - self.e)
        steps = {"e": min(far, view) / focal, "p": view / focal, "u": np.linalg.norm(self.u) / half}
        steps |= {"phi": np.sin(self.phi) / half, "d": self.d / half, "d_film": self.d / half}
        steps |= {"principal_point": 1.0, "k1": (focal / half) ** 3 / focal}
        return float(steps.get(name) or steps[name.rpartition("_")[0]])


def first(values: np.ndarray) -> np.ndarray:
    return np.eye(len(values))[0]


def joined(*parts: tuple[np.ndarray, np.ndarray]) -> dict[str, np.ndarray]:
    """Return several meshes as the vertices and faces of one."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    faces = [faces + start for (_, faces), start in zip(parts, starts, strict=False)]
    return {"vertices": np.concatenate([v for v, _ in parts]), "faces": np.concatenate(faces)}


def turned(about: np.ndarray, radians: float) -> np.ndarray:
    """Return a rotation about an axis (Rodrigues)."""
    x, y, z = about / np.linalg.norm(about)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(radians) * cross + (1 - np.cos(radians)) * cross @ cross


def bumpy(subdivisions: int = 2, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    mesh = shapes.bumpy(subdivisions, seed)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def box(x: float, y: float, z: float) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], float)
    sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = [[a, *pair] for a, b, c, d in sides for pair in ((b, c), (c, d))]
    return corners * [x, y, z], np.array(faces)


def grid(surface: Callable, n: int, m: int, closed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return a mesh of `surface(s, t)` over n x m cells of [0, 1]^2; closed: both ways round."""
    rows, columns = (n, m) if closed else (n + 1, m + 1)
    s, t = np.meshgrid(np.arange(rows) / n, np.arange(columns) / m, indexing="ij")
    vertices = np.stack(np.broadcast_arrays(*surface(s, t)), axis=-1).reshape(-1, 3)
    i, j = (x.ravel() for x in np.meshgrid(np.arange(n), np.arange(m), indexing="ij"))
    at = lambda i, j: (i % rows) * columns + j % columns
    corners = at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)
    a, b, c, d = corners
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return vertices, faces


def torus() -> tuple[np.ndarray, np.ndarray]:
    def surface(s, t):
        around, across = 2 * np.pi * s, 2 * np.pi * t
        r = 1 + 0.38 * np.cos(across)
        return r * np.cos(around), r * np.sin(around), 0.38 * np.sin(across)

    return grid(surface, 24, 12, closed=True)


def sheet() -> tuple[np.ndarray, np.ndarray]:
    """Return a wavy open sheet: seen from the side it hides parts of itself."""

    def surface(s, t):
        x, y = 2.4 * s - 1.2, 2 * t - 1
        return x, y, 0.35 * np.sin(3.1 * x + 0.4) * np.cos(2.3 * y - 0.2)

    return grid(surface, 12, 10, closed=False)


def bowl() -> tuple[np.ndarray, np.ndarray]:
    """Return the lower half of a sphere, open above and below: its inside shows."""

    def surface(s, t):
        around, down = 2 * np.pi * s, np.pi / 2 * (0.12 + 0.88 * t)
        r = np.sin(down)
        return r * np.cos(around), r * np.sin(around), -np.cos(down)

    return grid(surface, 20, 6, closed=False)


def bottle() -> tuple[np.ndarray, np.ndarray]:
    profile = [(0, -1), (0.42, -1), (0.46, -0.9), (0.46, 0.3), (0.17, 0.62), (0.16, 0.95), (0, 1)]
    mesh = shapes.revolved(np.array(profile), 24)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def soup() -> tuple[np.ndarray, np.ndarray]:
    """Return 12 triangles at random that pierce one another."""
    random = np.random.default_rng(7)
    middles = random.uniform(-0.7, 0.7, (12, 1, 3))
    corners = middles + random.normal(size=(12, 3, 3)) * 0.55
    return corners.reshape(-1, 3), np.arange(36).reshape(12, 3)


def at(e, p=(0.05, -0.03, 0.02), u=(0.11, 1.0, 0.06), phi: float = 0.62) -> dict:
    """Return the pose and the field of view; u is neither a unit vector nor across the view."""
    return {"e": np.array(e, float), "p": np.array(p, float), "u": np.array(u, float), "phi": phi}


def placed(mesh: tuple, shift, about=(1.0, 2.0, 3.0), radians: float = 0.0, size: float = 1.0):
    vertices, faces = mesh
    return size * vertices @ turned(np.array(about), radians).T + np.array(shift), faces


def meshes() -> dict[str, View]:
    """Return closed and open meshes before an ideal pinhole."""
    front = at([0.4, 0.7, 4.6])
    lone = np.array([[-1.1, -0.62, 0.2], [1.21, -0.35, -0.3], [-0.13, 0.94, 0.1]])
    triangle = View("one triangle, open", **front, vertices=lone, faces=np.array([[0, 1, 2]]))
    ground = np.array([[-3.0, -1, -9], [3.3, -1, -9.5], [2.2, -1.1, 6], [-2.5, -0.9, 6.4]])
    return {
        "triangle": triangle,
        "cube": View("a cube", **at([2.3, 1.9, 3.8]), **joined(box(0.9, 0.8, 0.75))),
        "bumpy": View("a bumpy shape of 320 faces", **front, **joined(bumpy())),
        "torus": View("a torus: a hole", **at([0.6, 3.1, 4.1]), **joined(torus())),
        "bottle": View(
            "a bottle of revolution", **at([3.3, -2.9, 1.7], u=(0.05, 0.1, 1.2)), **joined(bottle())
        ),
        "thin": View(
            "a rod thinner than a pixel",
            **at([0.9, 0.8, 4.4]),
            **joined(placed(box(1.3, 0.013, 0.011), [0, 0, 0], (1, 2, 9), 0.41)),
        ),
        "cut_off": View(
            "a shape that the film's edges cut off",
            **at([0.5, 0.6, 3.1], (0.62, 0.44, 0.1)),
            **joined(bumpy()),
        ),
        "sheet": View("an open wavy sheet", **at([2.9, -2.2, 1.9]), **joined(sheet())),
        "bowl": View(
            "an open bowl with a hole in its bottom",
            **at([2.6, -2.1, 2.4], (0, 0, -0.45)),
            **joined(bowl()),
        ),
        "ground": View(
            "a floor that reaches behind the eye",
            **at([0.2, 0.3, 3.2], (0.1, 0.05, 0)),
            vertices=ground,
            faces=np.array([[0, 1, 2], [0, 2, 3]]),
        ),
        "soup": View("12 triangles that pierce one another", **front, **joined(soup())),
        "two_bodies": View(
            "two bodies, one partly behind the other",
            **at([0.5, 0.9, 5.4]),
            **joined(
                placed(bumpy(), [-0.42, 0.1, -0.8]),
                placed(box(0.5, 0.62, 0.4), [0.55, -0.21, 0.7], radians=0.7),
            ),
        ),
        "crossing": View(
            "two bodies that cross",
            **at([0.3, 0.8, 5.0]),
            **joined(
                placed(bumpy(), [-0.3, 0.05, 0], size=0.85),
                placed(bumpy(2, 3), [0.4, -0.1, 0.15], radians=1.1, size=0.8),
            ),
        ),
    }


def spheres() -> dict[str, View]:
    """Return spheres, alone and with a mesh."""
    many = np.array(
        [[-0.9, 0.4, 0], [0.1, 0.5, -0.6], [0.7, -0.3, 0.3], [-0.3, -0.5, 0.8], [1.9, 0.6, -0.5]]
    )
    return {
        "sphere": View(
            "one sphere, off the axis",
            **at([0.3, 0.6, 4.1]),
            centers=np.array([[0.42, 0.21, 0.1]]),
            radii=np.array([0.83]),
        ),
        "spheres": View(
            "five spheres that overlap, one cut off by the film's edge",
            **at([0.2, 0.7, 5.1]),
            centers=many,
            radii=np.array([0.55, 0.6, 0.45, 0.35, 0.5]),
        ),
        "sphere_and_mesh": View(
            "a sphere that a box pierces",
            **at([1.1, 1.2, 4.7]),
            **joined(placed(box(1.2, 0.28, 0.33), [0.1, 0, 0], radians=0.5)),
            centers=np.array([[-0.15, 0.1, 0.05], [0.8, 0.75, 0.2]]),
            radii=np.array([0.72, 0.2]),
        ),
    }


def lenses() -> dict[str, View]:
    """Return lenses: a principal point off the centre, and distortion of three kinds."""
    centre = {"principal_point": np.array([34.7, 21.6]), "aspect": 1.07}
    brown = lambda *k: {"model": "brown", "coefficients": np.array(k), **centre}
    fisheye = {"model": "fisheye", "coefficients": np.array([-0.02, 0.006, -0.002, 3e-4]), **centre}
    ball = {"centers": np.array([[-0.55, 0.5, 0.1], [0.75, -0.35, 0.2]]), "radii": [0.45, 0.62]}
    ball["radii"] = np.array(ball["radii"])
    return {
        "off_centre": View(
            "principal point off the centre, pixels not square",
            **at([0.4, 0.7, 4.6]),
            **joined(bumpy()),
            **centre,
        ),
        "barrel": View(
            "barrel distortion (k1, k2, p1, p2, k3)",
            **at([1.0, 1.3, 2.3], phi=1.05),
            **joined(box(0.85, 0.7, 0.8)),
            **brown(-0.2, 0.05, 4e-3, -3e-3, 4e-3),
        ),
        "pincushion": View(
            "pincushion distortion, two spheres",
            **at([0.3, 0.4, 3.1], phi=0.9),
            **ball,
            **brown(0.22, 0.08, -3e-3, 2e-3, 0.0),
        ),
        "fisheye": View(
            "a fisheye, a bumpy shape",
            **at([0.4, 0.6, 2.6], phi=1.25),
            **joined(bumpy()),
            **fisheye,
        ),
    }


def views() -> dict[str, View]:
    """Return all 20 by name."""
    return {**meshes(), **spheres(), **lenses()}
