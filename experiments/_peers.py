"""The systems that the benchmark compares with, each set up as its own documentation advises.

A peer is made once from a mesh. Its methods give jobs: a callable without arguments, which is what
is timed, and how to read an image or a gradient from what that returns. Making rays, scenes and
buffers ahead of the call is no part of its time.
"""

import importlib
import time
from collections.abc import Callable, Iterator
from typing import Any, ClassVar, NamedTuple

import numpy as np

import pinhole_jax as pj


class Job(NamedTuple):
    """What is timed, and how to read a NumPy array from its result."""

    call: Callable[[], Any]
    read: Callable[[Any], np.ndarray] = np.asarray


class Trail(NamedTuple):
    """A fit's way: seconds since its start and moves, after each step."""

    seconds: list[float]
    moves: list[np.ndarray]


class Pose(NamedTuple):
    """A camera in float64: the eye, the axes (rows right, up, forward), the field of view."""

    e: np.ndarray
    axes: np.ndarray
    phi: float


def pose_of(camera: pj.Camera) -> Pose:
    e, p, u = (np.asarray(x, float) for x in (camera.e, camera.p, camera.u))
    forward = (p - e) / np.linalg.norm(p - e)
    right = np.cross(forward, u) / np.linalg.norm(np.cross(forward, u))
    return Pose(e, np.stack([right, np.cross(right, forward), forward]), float(camera.phi))


def film_matrix(pose: Pose, W: int, H: int) -> np.ndarray:
    """Return the (3, 4) matrix from world points to film coordinates times depth, and depth."""
    focal = H / (2 * np.tan(pose.phi / 2))
    inner = np.array([[focal, 0, W / 2], [0, focal, H / 2], [0, 0, 1]])
    return inner @ pose.axes @ np.column_stack([np.eye(3), -pose.e])


class Moves:
    """Seven moves of a camera about the origin, where the object is; one unit is about a pixel.

    Turns about the camera's axes, shifts right and up, log distance, log focal length: what our own
    fit moves too, in float64, for peers that bring no camera to fit.
    """

    def __init__(self, camera: pj.Camera, radius: float = 1.0):
        self.start, self.W, self.H = pose_of(camera), camera.W, camera.H
        distance = np.linalg.norm(self.start.e)
        one_px = 2 * np.tan(self.start.phi / 2) / camera.H
        wide = one_px * distance / radius
        self.unit = np.array([wide, wide, wide, one_px * distance, one_px * distance, wide, wide])

    def pose(self, y: np.ndarray) -> Pose:
        from scipy.spatial.transform import Rotation

        step, axes = self.unit * y, self.start.axes
        turn = Rotation.from_rotvec(step[:3] @ axes).as_matrix()
        e = turn @ (self.start.e * np.exp(step[5]) + step[3:5] @ axes[:2])
        return Pose(e, axes @ turn.T, 2 * np.arctan(np.tan(self.start.phi / 2) * np.exp(-step[6])))

    def camera(self, y: np.ndarray) -> pj.Camera:
        """Return the moved camera, in float32."""
        e, axes, phi = self.pose(y)
        e, p, u = (x.astype(np.float32) for x in (e, e + axes[2], axes[1]))
        return pj.Camera(e, p, u, np.float32(phi), 1.0, self.W, self.H)

    def parameters(self, y: np.ndarray) -> np.ndarray:
        """Return e, p, u and phi of the moved camera as one vector."""
        e, axes, phi = self.pose(y)
        return np.array([*e, *(e + axes[2]), *axes[1], phi])

    def film(self, y: np.ndarray) -> np.ndarray:
        return film_matrix(self.pose(y), self.W, self.H)


def central_difference(function: Callable, y: np.ndarray, step: float = 1e-4) -> np.ndarray:
    """Return the derivative of an array by each entry of y, on a new last axis."""
    ends = [(function(y + h), function(y - h)) for h in step * np.eye(len(y))]
    return np.stack([(up - down) / (2 * step) for up, down in ends], axis=-1)


class Peer:
    """A system that may be installed. What it cannot do, it has no jobs for.

    `side` is the number of samples along each side of a pixel. Gradients are of the mean square
    difference from a target, by `Moves`.
    """

    name: ClassVar[str]
    package: ClassVar[str]
    install: ClassVar[str]
    settings: ClassVar[str]

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        self.vertices = np.asarray(vertices, np.float32)
        self.faces = np.asarray(faces, np.uint32)

    @classmethod
    def missing(cls) -> str | None:
        """Return why the peer cannot be used here, or None where it can."""
        try:
            importlib.import_module(cls.package)
        except Exception as error:  # a broken installation must not stop the others
            return f"{type(error).__name__}: {error}"
        return None

    def masks(self, camera: pj.Camera, side: int) -> dict[str, Job]:
        return {}

    def gradients(self, moves: Moves, y: np.ndarray, target: np.ndarray) -> dict[str, Job]:
        return {}

    def fits(self, moves: Moves, target: np.ndarray, budget_s: float) -> dict[str, Trail]:
        return {}


def sample_rays(camera: pj.Camera, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return origins and directions (N, 3) of the rays through a regular grid in each pixel."""
    direction = np.asarray(pj.camera_rays(camera, samples=side).direction).reshape(-1, 3)
    return np.tile(np.asarray(camera.e), (len(direction), 1)), direction


def mean_of(camera: pj.Camera, hit: np.ndarray) -> np.ndarray:
    """Return the share of each pixel's rays that hit."""
    return np.reshape(hit, (camera.H, camera.W, -1)).mean(axis=-1)


class Embreex(Peer):
    name, package, install = "embreex", "embreex", "pip install embreex"
    settings = (
        "Embree 4 ray by ray on one core, query OCCLUDED; rays made ahead and not timed, on a"
        " regular grid in each pixel"
    )

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        super().__init__(vertices, faces)
        self.scene = rtcore_scene.EmbreeScene()
        self.mesh = TriangleMesh(self.scene, self.vertices[self.faces])
        self.scene.run(*np.ones((2, 1, 3), np.float32))  # the first query builds the tree

    def masks(self, camera: pj.Camera, side: int) -> dict[str, Job]:
        rays = sample_rays(camera, side)
        blocked = lambda answer: mean_of(camera, answer == 0)
        return {"embreex": Job(lambda: self.scene.run(*rays, query="OCCLUDED"), blocked)}


class Deodr(Peer):
    name, package, install = "DEODR", "deodr", "pip install deodr"
    settings = (
        "Scene2D (C++, one core), backface culling: its own anti-aliasing (sigma=1, its"
        " default, and 0.5, which is less biased) for one sample and for gradients"
        " (render_compare_and_backward), hard edges (sigma=0) averaged over n x n for more; fits by"
        " scipy's L-BFGS-B"
    )
    sigmas = (1.0, 0.5)

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        from deodr.differentiable_renderer import Scene2D
        from deodr.triangulated_mesh import TriMeshAdjacencies

        super().__init__(vertices, faces)
        self.points, self.scene = self.vertices.astype(float), Scene2D
        self.adjacencies = TriMeshAdjacencies(self.faces)
        F, V = len(self.faces), len(self.points)
        self.still = {
            "faces": self.faces,
            "faces_uv": self.faces,
            "textured": np.zeros(F, bool),
            "shaded": np.zeros(F, bool),
            "uv": np.zeros((V, 2)),
            "shade": np.zeros(V),
            "colors": np.ones((V, 1)),
            "nb_colors": 1,
            "texture": np.zeros((0, 0)),
            "background_color": np.zeros(1),
            "backface_culling": True,
            "integer_pixel_centers": False,
        }
        self.no_edges = np.zeros((F, 3), bool)

    def view(self, film: np.ndarray, W: int, H: int, side: int = 1, edges: bool = False) -> Any:
        """Return the projected scene, y down; `edges` for its own anti-aliasing."""
        x, y, depth = film[:, :3] @ self.points.T + film[:, 3:]
        ij = np.stack([side * x / depth, side * (H - y / depth)], axis=1)
        flags = self.adjacencies.edge_on_silhouette(ij) if edges else self.no_edges
        size = {"width": side * W, "height": side * H}
        return self.scene(ij=ij, depths=depth, edgeflags=flags, **size, **self.still)

    def masks(self, camera: pj.Camera, side: int) -> dict[str, Job]:
        film, W, H = film_matrix(pose_of(camera), camera.W, camera.H), camera.W, camera.H

        def sampled() -> np.ndarray:
            image, _ = self.view(film, W, H, side).render(sigma=0)
            return image.reshape(H, side, W, side).mean(axis=(1, 3))

        smooth = lambda sigma: self.view(film, W, H, edges=True).render(sigma)[0][..., 0]
        sigmas = self.sigmas if side == 1 else ()
        own = {f"DEODR sigma={s:g}": Job(lambda s=s: smooth(s)) for s in sigmas}
        return {"DEODR sigma=0": Job(sampled), **own}

    def loss_and_gradient(
        self, moves: Moves, y: np.ndarray, target: np.ndarray, sigma: float
    ) -> tuple[float, np.ndarray]:
        film = moves.film(y)
        view = self.view(film, moves.W, moves.H, edges=True)
        compare = view.render_compare_and_backward
        loss = compare(target[..., None], sigma=sigma, make_copies=False)[3]
        by_x, by_y = view.ij_b.T * [[1], [-1]]
        x, up, depth = film[:, :3] @ self.points.T + film[:, 3:]
        by_depth = -(by_x * x + by_y * up) / depth
        by_point = np.stack([by_x, by_y, by_depth]) / depth
        by_film = np.column_stack([by_point @ self.points, by_point.sum(axis=1)])
        gradient = np.tensordot(by_film, central_difference(moves.film, y), 2)
        return loss / target.size, gradient / target.size

    def gradients(self, moves: Moves, y: np.ndarray, target: np.ndarray) -> dict[str, Job]:
        call = lambda sigma: self.loss_and_gradient(moves, y, target, sigma)
        job = lambda sigma: Job(lambda: call(sigma), lambda answer: answer[1])
        return {f"DEODR sigma={s:g}": job(s) for s in self.sigmas}

    def fits(self, moves: Moves, target: np.ndarray, budget_s: float) -> dict[str, Trail]:
        return {f"DEODR sigma={s:g}": self.fit(moves, target, budget_s, s) for s in self.sigmas}

    def fit(self, moves: Moves, target: np.ndarray, budget_s: float, sigma: float) -> Trail:
        from scipy.optimize import minimize

        trail, begin = Trail([0.0], [np.zeros(7)]), time.perf_counter()

        def step(y: np.ndarray) -> None:
            trail.seconds.append(time.perf_counter() - begin)
            trail.moves.append(y.copy())
            if trail.seconds[-1] > budget_s:
                raise StopIteration

        # Per pixel of outline: SciPy's stopping rule means something for losses of about 1.
        scale = float(max(moves.W, moves.H))
        both = lambda y: tuple(scale * x for x in self.loss_and_gradient(moves, y, target, sigma))
        options = {"maxiter": 200, "ftol": 1e-12, "gtol": 1e-10}
        minimize(both, np.zeros(7), jac=True, method="L-BFGS-B", callback=step, options=options)
        return trail


PEERS: tuple[type[Peer], ...] = (Embreex, Deodr)


def usable() -> Iterator[type[Peer]]:
    """Yield the peers that work here; say aloud which do not, and how they are installed."""
    for peer in PEERS:
        reason = peer.missing()
        if reason is None:
            yield peer
        else:
            print(f"{peer.name}: SKIPPED ({reason}); {peer.install}", flush=True)
