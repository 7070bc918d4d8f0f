"""The 20 scenes of the set as its files have them: plain NumPy numbers, one camera each.

A view knows nothing of the renderer: what checks it (`_oracle.py`) reads the same numbers.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

SET = Path(__file__).parent / "set"
POINTS = ("e", "p", "u")
#: What images are differentiated by. `d` moves with phi held, `d_film` with the film's height held.
PARAMETERS = (
    *(f"{name}_{axis}" for name in POINTS for axis in "xyz"),
    *("phi", "d", "d_film", "principal_point_x", "principal_point_y", "k1"),
)


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
    vertices: np.ndarray
    faces: np.ndarray
    centers: np.ndarray
    radii: np.ndarray
    d: float
    W: int
    H: int
    principal_point: np.ndarray
    aspect: float
    model: str
    coefficients: np.ndarray

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
        """Return the parameters that this view's image is differentiated by."""
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
            return replace(
                self, coefficients=self.coefficients + amount * np.eye(len(self.coefficients))[0]
            )
        whole, _, axis = name.rpartition("_")
        point = np.array(getattr(self, whole), float)
        point["xyz".index(axis)] += amount
        return replace(self, **{whole: point})

    def scaled(self, times: int) -> "View":
        """Return the same picture in this many times as many pixels each way."""
        centre = self.principal_point * times
        return replace(self, W=self.W * times, H=self.H * times, principal_point=centre)

    def step(self, name: str) -> float:
        """Return the change of a parameter that moves the picture by about a pixel."""
        half, focal = max(self.W, self.H) / 2, self.focal_px[1]
        points = np.concatenate([self.vertices, self.centers])
        far = np.linalg.norm(points.mean(axis=0) - self.e)
        view = np.linalg.norm(self.p - self.e)
        steps = {"e": min(far, view) / focal, "p": view / focal, "u": np.linalg.norm(self.u) / half}
        steps |= {"phi": np.sin(self.phi) / half, "d": self.d / half, "d_film": self.d / half}
        steps |= {"principal_point": 1.0, "k1": (focal / half) ** 3 / focal}
        return float(steps.get(name) or steps[name.rpartition("_")[0]])


def views() -> dict[str, View]:
    """Return all 20 by name."""
    return {path.stem: read(path) for path in sorted(SET.glob("*.npz"))}


def read(path: Path) -> View:
    with np.load(path) as file:
        given = {key: file[key] for key in View.__dataclass_fields__ if key in file}
        model = str(file["distortion"])
    numbers = {key: x.item() for key, x in given.items() if x.ndim == 0}
    return View(**(given | numbers), model=model)
