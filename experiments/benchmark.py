"""How fast, and how exact, beside the systems that others would use?

    python experiments/benchmark.py OUT [question ...]

Questions: masks, jacobian, gradient, fits, rays, faces, resolution, skip; all by default. Each peer
that is installed (`_peers.py` has their install lines and settings) is measured in this process, on
the same float32 inputs, against the same oracle: the union of the projected triangles, pixel by
pixel, in float64. All systems take turns; times are medians after warm-up, in seconds. First
calls, which compile, are reported apart. The targets are ratios of times on two cores: on a larger
machine, `taskset -c 0,1 python experiments/benchmark.py OUT`.
"""

import json
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _common import camera_at, degrees, folder, noisy, orbited, random_camera
from _peers import PEERS, Job, Moves, Peer, Trail, central_difference, film_matrix, pose_of, usable

import pinhole_jax as pj
from pinhole_jax._fit.full_image import At, image_and_jacobian
from pinhole_jax._solver.moves import Move, canonical
from pinhole_jax._solver.solver import Solver

OURS = "pinhole_jax"
TURNS, TURN_S, BUDGET_S = 9, 0.05, 4.0
NEAR = 0.5  # degrees: a fit has arrived
FIT_S = 60.0  # a peer's fit is stopped after that
ROUNDED = 1e-6  # coverage nearer to 0 or 1 than this is no boundary

FIT = f"{OURS}, fit"
WINDOW = "fit of an object 64 px across, in 2048 px over in 256 px"

#: What each figure (a ratio, or a time where it says so) is asked to stay below; None: nothing is.
ASKED: dict[str, float | None] = {
    "mask, sphere of 328k faces, 512 px: over Open3D's cast_rays, 1 sample": 1 / 20,
    "mask, sphere of 328k faces, 512 px: over Open3D's test_occlusions, 1 sample": None,
    "mask, sphere of 328k faces, 512 px: error over the most exact peer's": 1e-3,
    "mask, bumpy 9.5k faces, 256 px: ms": 2.0,
    "mask, bumpy 9.5k faces, 256 px: over Open3D's cast_rays, 1 sample": 1 / 5,
    "mask, bumpy 9.5k faces, 256 px: over Open3D's test_occlusions, 1 sample": None,
    "mask, bumpy 9.5k faces, 256 px: error over the most exact peer's": 1e-3,
    "mask, scan of 82k faces, 256 px: ms": None,
    "mask, scan of 82k faces, 256 px: over Open3D's cast_rays, 1 sample": None,
    "mask, scan of 82k faces, 256 px: error over the most exact peer's": 1e-3,
    "image and 7-column Jacobian over image, bumpy 9.5k faces, 256 px": 2.5,
    "image and 7-column Jacobian over image, sphere of 328k faces, 512 px": 2.5,
    "gradient of a loss over image, bumpy 9.5k faces, 256 px": 2.0,
    "gradient of a loss over image, sphere of 328k faces, 512 px": 2.0,
    "fit, 5k faces, 256 px: ms": 60.0,
    "fit, 5k faces, 256 px: over DEODR's time to 0.5 degrees": 0.1,
    "fit, 328k faces, 512 px: ms": 300.0,
    "fit, 328k faces, 512 px: over DEODR's time to 0.5 degrees": None,
    "rays, 1920 x 1080: over writing the same bytes": 1.5,
    "rays, 1920 x 1080: over jaxcam's": None,
    "rays, 1920 x 1080: over Mitsuba's": None,
    "mask, faces times 1024: time times": 1024.0,
    "fit, faces times 1024: time times": 32.0,
    "fit, 1.3M faces: ms": 1000.0,
    "load_mesh, 1.3M faces: ms": 5000.0,
    "mask, pixels times 1024: time times": None,
    "fit, pixels times 1024: time times": None,
    WINDOW: 1.3,
}


# Timing


def seconds(call: Callable[[], Any]) -> float:
    """Return the time until a call's result is there; peers wait for theirs themselves."""
    begin = time.perf_counter()
    jax.block_until_ready([x for x in jax.tree.leaves(call()) if isinstance(x, jax.Array)])
    return time.perf_counter() - begin


def let_go() -> None:
    """Let go of compiled programs: each takes memory maps, and a process may have 65530."""
    jax.clear_caches()


def timed(calls: dict[str, Callable[[], Any]]) -> dict[str, dict[str, float]]:
    """Return seconds of the first call, and the median of later ones, all systems taking turns.

    A turn is a burst whose first call does not count: it finds the caches and the threads as
    another system has left them. Slow calls have shorter bursts and fewer turns.
    """
    first = {name: seconds(call) for name, call in calls.items()}
    later: dict[str, list[float]] = {name: [seconds(call)] for name, call in calls.items()}
    spent = {name: times[0] for name, times in later.items()}
    for _ in range(TURNS):
        for name, call in calls.items():
            if spent[name] > BUDGET_S:
                continue
            again = max(1, min(20, int(TURN_S / later[name][-1])))
            burst = [seconds(call) for _ in range(again + 1 if again > 1 else 1)]
            later[name] += burst[again > 1 :]
            spent[name] += sum(burst)
    # The second call still warms up, unless it is all there is.
    counted = {name: times[1:] or times for name, times in later.items()}
    return {
        name: {"first_s": first[name], "median_s": float(np.median(t)), "calls": len(t)}
        for name, t in counted.items()
    }


def once(call: Callable[[], Any]) -> float:
    """Return the median seconds of one call that has nothing to take turns with."""
    return timed({"": call})[""]["median_s"]


def say(case: str, system: str, entry: dict, more: str = "") -> None:
    times = f"{1e3 * entry['median_s']:.3g} ms (first call {entry['first_s']:.2g} s)"
    print(f"  {case}: {system}: {times}{more and ', ' + more}", flush=True)


# Shapes and cameras, all of radius 1 about the origin


class Shape(NamedTuple):
    """Triangles, float32; `convex` shapes have a simple oracle."""

    vertices: np.ndarray
    faces: np.ndarray
    convex: bool = False

    def mesh(self) -> pj.Mesh:
        return pj.Mesh(self.vertices, self.faces)

    def scene(self) -> pj.Scene:
        return pj.Scene(mesh=self.mesh())


@cache
def bumpy(subdivisions: int) -> Shape:
    mesh = pj.shapes.bumpy(subdivisions)
    vertices = np.asarray(mesh.vertices, float)
    vertices = vertices / np.linalg.norm(vertices, axis=1).max()
    return Shape(vertices.astype(np.float32), np.asarray(mesh.faces))


@cache
def scan(subdivisions: int = 6, noise: float = 0.12) -> Shape:
    """Return the bumpy sphere with what a scanner adds: noise, as a share of the mean edge."""
    smooth = bumpy(subdivisions)
    vertices = noisy(smooth.vertices, smooth.faces, noise)
    return smooth._replace(vertices=vertices.astype(np.float32))


@cache
def sphere(subdivisions: int = 7) -> Shape:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions)
    return Shape(np.asarray(ball.vertices, np.float32), np.asarray(ball.faces), convex=True)


@cache
def marched(cells: int = 44) -> Shape:
    """Return a bumpy ellipsoid by marching cubes, of about 9.5k faces as different as its are."""
    from skimage.measure import marching_cubes

    grid = np.stack(np.meshgrid(*[np.linspace(-1.4, 1.4, cells)] * 3, indexing="ij"), axis=-1)
    bumps = 0.12 * np.sin(grid @ [3.1, -1.7, 2.3] + 0.5) + 0.1 * np.sin(grid @ [-2.2, 3.7, 1.9])
    inside = 1 + bumps - np.linalg.norm(grid / [1, 0.8, 1.2], axis=-1)
    vertices, faces, _, _ = marching_cubes(inside, 0.0)
    vertices = vertices * (2.8 / (cells - 1)) - 1.4
    vertices = vertices / np.linalg.norm(vertices, axis=1).max()
    return Shape(vertices.astype(np.float32), faces[:, ::-1])  # counter-clockwise from outside


def view(size: int, distance: float = 4.6) -> pj.Camera:
    """Return a camera in general position, in whose picture the unit sphere takes 3/4."""
    from scipy.spatial.transform import Rotation

    axes = Rotation.from_euler("xyz", [0.4, -0.7, 0.2]).as_matrix()
    return camera_at(axes, np.array([0.031, -0.017]), distance, 0.6, size)


def off(truth: pj.Camera, angle: float, share: float, random: np.random.Generator) -> pj.Camera:
    """Return the camera turned about the origin (degrees), distance and focal length off."""
    from scipy.spatial.transform import Rotation

    axis, sign = random.normal(size=3), random.choice([-1, 1])
    turn = Rotation.from_rotvec(np.deg2rad(angle) * axis / np.linalg.norm(axis)).as_matrix()
    near = orbited(truth, turn, 1 + share * sign)
    phi = 2 * np.arctan(np.tan(float(truth.phi) / 2) / (1 - share * sign))
    return pj.Camera(near.e, near.p, near.u, np.float32(phi), 1.0, truth.W, truth.H)


# The oracle


def exact(film: np.ndarray, W: int, H: int, shape: Shape) -> np.ndarray:
    """Return the exact coverage (H, W) that a (3, 4) film matrix shows, by polygons in float64.

    One union of everything says where the outline is, to far better than 0.01 px. Within that of it
    pixels are resolved one by one: so no area is lost where edges nearly agree.
    """
    import shapely

    x, y, depth = film[:, :3] @ shape.vertices.astype(float).T + film[:, 3:]
    points = np.stack([x / depth, y / depth], axis=1)
    if shape.convex:
        triangles = np.array([shapely.convex_hull(shapely.multipoints(points))])
    else:
        triangles = shapely.polygons(points[shape.faces])
        # A closed mesh's front covers what its back covers.
        triangles = triangles[shapely.is_ccw(shapely.get_exterior_ring(triangles))]
    rough = shapely.union_all(triangles)
    i, j = np.meshgrid(np.arange(W), np.arange(H)[::-1])
    squares = shapely.box(i, j, i + 1, j + 1).ravel()
    border = rough.boundary.buffer(0.01)
    shapely.prepare([rough, border])
    area = shapely.intersects(rough, squares).astype(float)
    tree = shapely.STRtree(triangles)
    for k in np.flatnonzero(shapely.intersects(border, squares)):
        near = triangles[tree.query(squares[k], predicate="intersects")]
        area[k] = shapely.area(shapely.union_all(shapely.intersection(near, squares[k])))
    return area.reshape(H, W)


def boundary_error(image: np.ndarray, coverage: np.ndarray) -> float:
    """Return the RMS error over the pixels that the outline crosses."""
    boundary = (coverage > ROUNDED) & (coverage < 1 - ROUNDED)
    return float(np.sqrt(np.mean((np.asarray(image, float) - coverage)[boundary] ** 2)))


# Our own jobs


def moving(moves: Moves, scene: pj.Scene, free: tuple[str, ...]) -> tuple[jax.Array, At]:
    """Return no move, and where `moves` start, as our Jacobian is told."""
    reach = np.linalg.norm(moves.start.e)
    unit = moves.scale / [1, 1, 1, reach, reach, 1, 1]  # our shifts are shares of the distance
    of = {"pose": unit[:6], "phi": unit[6:]}
    unit = jnp.asarray(np.concatenate([of[name] for name in free]), jnp.float32)
    camera = moves.camera(np.zeros(7))
    move = Move(camera, jnp.zeros(3, jnp.float32), unit)
    return jnp.zeros_like(unit), At(move, camera, scene, free, True)


def our_jacobian(moves: Moves, scene: pj.Scene, free: tuple[str, ...] = ("pose", "phi")) -> Job:
    y, at = moving(moves, scene, free)
    return Job(lambda: image_and_jacobian(y, at), lambda answer: np.asarray(answer[1]))


@jax.jit
def loss_and_gradient(parameters: jax.Array, film: pj.Camera, scene: pj.Scene, target: jax.Array):
    """Return the mean square difference, and its derivative by e, p, u and phi as one vector."""

    def loss(x: jax.Array) -> jax.Array:
        camera = pj.Camera(x[:3], x[3:6], x[6:9], x[9], film.d, film.W, film.H)
        return jnp.mean((pj.silhouette(camera, scene) - target) ** 2)

    return jax.value_and_grad(loss)(parameters)


def our_gradient(moves: Moves, scene: pj.Scene, target: np.ndarray) -> Job:
    y = np.zeros(7)
    parameters = jnp.asarray(moves.parameters(y), jnp.float32)
    inputs = (parameters, moves.camera(y), scene, jnp.asarray(target, jnp.float32))
    chain = central_difference(moves.parameters, y)
    read = lambda answer: np.asarray(answer[1], float) @ chain
    return Job(lambda: loss_and_gradient(*inputs), read)


def our_mask(camera: pj.Camera, scene: pj.Scene, overlaps: bool = True) -> Callable:
    return lambda: pj.silhouette(camera, scene, overlaps)


def our_fit(
    scene: pj.Scene, target: np.ndarray, start: pj.Camera, free: tuple[str, ...] = ("pose", "phi")
) -> Callable:
    # A fit's camera is on the device: waiting for it is waiting for the fit.
    return lambda: pj.fit_camera(scene, target, start, free).camera


# Questions: each returns its answer, with the ratios that `ASKED` names under "ratios"


Peers = list[type[Peer]]

CASES: dict[str, tuple[Callable[[], Shape], int, tuple[int, ...]]] = {
    "bumpy 9.5k faces, 256 px": (marched, 256, (1, 2, 4, 8)),
    "sphere of 328k faces, 512 px": (sphere, 512, (1, 2, 4)),
}
SCAN = "scan of 82k faces, 256 px"
MASKS = CASES | {SCAN: (scan, 256, (1, 2, 4, 8))}


def masks(peers: Peers) -> dict:
    answer: dict[str, Any] = {"ratios": {}}
    for case, (make, size, sides) in MASKS.items():
        shape, camera = make(), view(size)
        systems = [peer(shape.vertices, shape.faces) for peer in peers]
        found = masks_of(case, shape, camera, systems, sides)
        answer[case] = {"faces": len(shape.faces), "systems": found}
        ours = found[OURS]["1"]
        answer["ratios"][f"mask, {case}: ms"] = 1e3 * ours["median_s"]
        errors = [e["error"] for k, each in found.items() if k != OURS for e in each.values()]
        if errors:
            name = f"mask, {case}: error over the most exact peer's"
            answer["ratios"][name] = ours["error"] / min(errors)
        for how in ("cast_rays", "test_occlusions"):
            if peer := found.get(f"Open3D {how}"):
                ratio = ours["median_s"] / peer["1"]["median_s"]
                answer["ratios"][f"mask, {case}: over Open3D's {how}, 1 sample"] = ratio
    return answer


def masks_of(
    case: str, shape: Shape, camera: pj.Camera, systems: list[Peer], sides: Iterable[int]
) -> dict[str, dict]:
    """Return time and error of every system by its samples a pixel; we have no samples: once."""
    coverage = exact(film_matrix(pose_of(camera), camera.W, camera.H), camera.W, camera.H, shape)
    found: dict[str, dict] = {}
    for side in sides:
        jobs = {OURS: Job(our_mask(camera, shape.scene()))} if side == 1 else {}
        for system in systems:
            jobs |= system.masks(camera, side)
        times = timed({name: job.call for name, job in jobs.items()})
        for name, job in jobs.items():
            error = boundary_error(job.read(job.call()), coverage)
            found.setdefault(name, {})[str(side * side)] = {**times[name], "error": error}
            say(case, f"{name}, {side * side} samples", times[name], f"error {error:.1e}")
    return found


def jacobian(peers: Peers) -> dict:
    name = "image and 7-column Jacobian over image"
    ours = lambda moves, scene, target: our_jacobian(moves, scene)
    theirs = lambda system, moves, target: system.jacobians(moves, np.zeros(7))
    truth = lambda image, target: central_difference(image, np.zeros(7))
    return derivative(peers, name, ours, theirs, truth)


def gradient(peers: Peers) -> dict:
    name = "gradient of a loss over image"
    theirs = lambda system, moves, target: system.gradients(moves, np.zeros(7), target)
    loss = lambda image, target: lambda y: np.mean((image(y) - target) ** 2)
    truth = lambda image, target: central_difference(loss(image, target), np.zeros(7))
    return derivative(peers, name, our_gradient, theirs, truth)


def derivative(
    peers: Peers, name: str, ours: Callable, theirs: Callable, truth: Callable
) -> dict[str, Any]:
    """Return times of a derivative and of the image alone, and relative errors against differences
    of the oracle; peers and errors on the smaller shape only.
    """
    answer: dict[str, Any] = {"ratios": {}}
    for case, (make, size, _) in CASES.items():
        shape, there = make(), view(size)
        scene, moves = shape.scene(), Moves(off(there, 3, 0.02, np.random.default_rng(0)))
        target = np.asarray(pj.silhouette(there, scene), float)
        jobs = {OURS: ours(moves, scene, target)}
        for peer in [] if shape.convex else peers:
            jobs |= theirs(peer(shape.vertices, shape.faces), moves, target)
        image = our_mask(moves.camera(np.zeros(7)), scene)
        times = timed({"image alone": image, **{k: job.call for k, job in jobs.items()}})
        if not shape.convex:
            shown = lambda y, m=moves, s=shape: exact(m.film(y), m.W, m.H, s)
            right = truth(shown, target)
            for system, job in jobs.items():
                wrong = np.linalg.norm(job.read(job.call()) - right) / np.linalg.norm(right)
                times[system]["error"] = float(wrong)
        for system, entry in times.items():
            say(case, system, entry, f"error {entry['error']:.1e}" if "error" in entry else "")
        answer[case] = times
        ratio = times[OURS]["median_s"] / times["image alone"]["median_s"]
        answer["ratios"][f"{name}, {case}"] = ratio
    return answer


def fits(peers: Peers) -> dict:
    small = fits_of("5k faces, 256 px", bumpy(4), 256, peers, trials=5)
    quick = [peer for peer in peers if peer.quick]
    large = fits_of("328k faces, 512 px", bumpy(7), 512, quick, trials=2)
    return {**small, **large, "ratios": {**small["ratios"], **large["ratios"]}}


def fits_of(case: str, shape: Shape, size: int, peers: Peers, trials: int) -> dict[str, Any]:
    """Return fits of pose and focal length from 10 degrees and 5 % off; slow peers get one."""
    scene = shape.scene()
    systems = [peer(shape.vertices, shape.faces) for peer in peers]
    found: dict[str, list[dict]] = {OURS: []}
    for trial in range(trials):
        random = np.random.default_rng(trial)
        truth = random_camera(random, size=size)
        start = off(truth, 10, 0.05, random)
        target = np.asarray(pj.silhouette(truth, scene), float)
        found[OURS].append(ours_to(truth, scene, target, start))
        for system in systems:
            if trial and not system.quick:
                continue
            moves = Moves(start)
            for name, trail in system.fits(moves, target, FIT_S).items():
                found.setdefault(name, []).append(arrival(trail, moves, truth))
    summaries = {name: summary(each) for name, each in found.items()}
    for name, one in summaries.items():
        near = "never" if one["near_s"] is None else f"{one['near_s']:.3g} s"
        print(
            f"  fit, {case}: {name}: {one['seconds']:.3g} s, within {NEAR} degrees after {near}"
            f" ({one['arrived']:.0%}), off by {one['degrees']:.1e} degrees at the end",
            flush=True,
        )
    name = f"fit, {case}: over DEODR's time to {NEAR} degrees"
    best = [one["near_s"] for k, one in summaries.items() if "DEODR" in k and one["near_s"]]
    ratios = {f"fit, {case}: ms": 1e3 * summaries[OURS]["seconds"]}
    if best:
        ratios[name] = summaries[OURS]["seconds"] / min(best)
    return {case: {"fits": found, "medians": summaries}, "ratios": ratios}


def ours_to(truth: pj.Camera, scene: pj.Scene, target: np.ndarray, start: pj.Camera) -> dict:
    """Return our fit's median time and final error; it counts as near when it is done."""
    fit = our_fit(scene, target, start)
    time_, error = timed({OURS: fit})[OURS], degrees(fit(), truth)
    near = time_["median_s"] if error < NEAR else None
    return {**time_, "seconds": time_["median_s"], "degrees": error, "near_s": near}


def arrival(trail: Trail, moves: Moves, truth: pj.Camera) -> dict[str, float | None]:
    """Return when a fit ended and came near, and its final error."""
    errors = [degrees(moves.camera(y), truth) for y in trail.moves]
    near = [s for s, error in zip(trail.seconds, errors, strict=True) if error < NEAR]
    return {
        "seconds": trail.seconds[-1],
        "steps": len(errors) - 1,
        "degrees": errors[-1],
        "near_s": near[0] if near else None,
    }


def summary(each: list[dict]) -> dict[str, float | None]:
    """Return medians over trials; of the times to come near, over those that did."""
    near = [one["near_s"] for one in each if one["near_s"] is not None]
    return {
        "seconds": float(np.median([one["seconds"] for one in each])),
        "degrees": float(np.median([one["degrees"] for one in each])),
        "near_s": float(np.median(near)) if near else None,
        "arrived": len(near) / len(each),
    }


def rays(peers: Peers) -> dict:
    """Return times of 1920 x 1080 normalised directions, and of writing as many bytes."""
    W, H = 1920, 1080
    small = view(H)
    camera = pj.Camera(small.e, small.p, small.u, small.phi, 1.0, W, H)
    cube = np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint32)
    ours = jax.jit(pj.camera_rays)
    jobs = {OURS: Job(lambda: ours(camera), lambda rays: np.asarray(rays.direction))}
    for peer in [p for p in peers if p.makes_rays]:
        jobs |= peer(*cube).rays(camera)
    touched = np.ones((H, W, 3), np.float32)
    writes = {
        "writing the same bytes": lambda: touched.fill(0.5),
        "writing them to new memory": lambda: np.full((H, W, 3), 0.5, np.float32),
    }
    times = timed({**{name: job.call for name, job in jobs.items()}, **writes})
    right = exact_rays(camera)
    for name, job in jobs.items():
        times[name]["error"] = float(np.max(np.abs(job.read(job.call()) - right)))
    for name, entry in times.items():
        error = f"error {entry['error']:.1e}" if "error" in entry else ""
        say("rays", name, entry, error)
    over = {"writing the same bytes": "writing the same bytes", "jaxcam": "jaxcam's"}
    over["Mitsuba"] = "Mitsuba's"
    ratios = {
        f"rays, {W} x {H}: over {words}": times[OURS]["median_s"] / times[name]["median_s"]
        for name, words in over.items()
        if name in times
    }
    return {"systems": times, "ratios": ratios}


def exact_rays(camera: pj.Camera) -> np.ndarray:
    """Return unit directions (H, W, 3) in float64."""
    _, axes, phi = pose_of(camera)
    x, y = np.meshgrid(np.arange(camera.W) + 0.5, camera.H - 0.5 - np.arange(camera.H))
    film = np.stack([x - camera.W / 2, y - camera.H / 2], axis=-1) * 2 * np.tan(phi / 2) / camera.H
    q = film @ axes[:2] + axes[2]
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def faces(peers: Peers) -> dict:
    """Return costs of a mask (1 sample), a fit, loading and building for 1k to 1.3M faces."""
    size, growth = 512, {}
    for subdivisions in range(3, 9):
        shape, camera = bumpy(subdivisions), view(size)
        scene, built, systems = shape.scene(), loading(shape), []
        for peer in peers:
            begin = time.perf_counter()
            systems.append(peer(shape.vertices, shape.faces))
            built[peer.name] = time.perf_counter() - begin
        start = off(camera, 10, 0.05, np.random.default_rng(0))
        target = np.asarray(pj.silhouette(camera, scene))
        costs = compared(camera, scene, systems) | fit_cost(scene, target, start, camera)
        growth[str(len(shape.faces))] = {**costs, "build_s": built}
        for name, entry in costs.items():
            say(f"{len(shape.faces)} faces", name, entry)
        listed = ", ".join(f"{name} {1e3 * s:.3g} ms" for name, s in built.items())
        print(f"  {len(shape.faces)} faces: to build: {listed}", flush=True)
        let_go()
    last = growth[max(growth, key=int)]
    ratios = {
        **grown(growth, "faces times 1024"),
        "fit, 1.3M faces: ms": 1e3 * last[FIT]["median_s"],
        "load_mesh, 1.3M faces: ms": 1e3 * last["build_s"][f"{OURS} load_mesh"],
    }
    return {"by": growth, "size": size, "ratios": ratios}


def resolution(peers: Peers) -> dict:
    """Return costs of a mask (1 sample), a Jacobian and a fit for 64 to 2048 pixels."""
    shape, growth = marched(), {}
    scene = shape.scene()
    systems = [peer(shape.vertices, shape.faces) for peer in peers]
    for size in (64, 128, 256, 512, 1024, 2048):
        camera = view(size)
        start = off(camera, 10, 0.05, np.random.default_rng(0))
        target = np.asarray(pj.silhouette(camera, scene))
        costs = compared(camera, scene, systems) | fit_cost(scene, target, start, camera)
        columns = our_jacobian(Moves(camera), scene).call
        costs[f"{OURS}, image and Jacobian"] = timed({"": columns})[""]
        growth[str(size)] = costs
        for name, entry in costs.items():
            say(f"{size} px", name, entry)
        let_go()
    return {"by": growth, "faces": len(shape.faces), "ratios": grown(growth, "pixels times 1024")}


def compared(camera: pj.Camera, scene: pj.Scene, systems: list[Peer]) -> dict[str, dict]:
    jobs = {OURS: Job(our_mask(camera, scene))}
    for system in systems:
        jobs |= system.masks(camera, 1)
    return timed({name: job.call for name, job in jobs.items()})


def fit_cost(
    scene: pj.Scene, target: np.ndarray, start: pj.Camera, truth: pj.Camera
) -> dict[str, dict]:
    fit = our_fit(scene, target, start)
    return {FIT: {**timed({FIT: fit})[FIT], "degrees": degrees(fit(), truth)}}


def grown(growth: dict[str, dict], words: str) -> dict[str, float]:
    """Return by how much the largest case takes longer than the smallest."""
    first, *_, last = growth.values()
    names = {"mask": OURS, "fit": FIT}
    ratio = lambda name: last[name]["median_s"] / first[name]["median_s"]
    return {f"{what}, {words}: time times": ratio(name) for what, name in names.items()}


def loading(shape: Shape) -> dict[str, float]:
    """Return seconds of reading a file, of reading it into a Mesh, and of making a Mesh."""
    import trimesh

    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "mesh.ply"
        trimesh.Trimesh(shape.vertices, shape.faces, process=False).export(path)
        return {
            "trimesh's load": once(lambda: trimesh.load(path)),
            f"{OURS} load_mesh": once(lambda: pj.load_mesh(path)),
            f"{OURS} Mesh": once(shape.mesh),
        }


def skip(peers: Peers) -> dict:
    """Return what a scene, a fit or a camera saves by not having a thing."""
    del peers
    pairs = {**skip_parts(), **skip_code(), **skip_parameters(), **skip_pixels()}
    pairs |= {**skip_edges(), **skip_steps()}
    answer: dict[str, Any] = {}
    for name, calls in pairs.items():
        times = answer[name] = timed(calls)
        for case, entry in times.items():
            say(name, case, entry)
    small, large = (x["median_s"] for x in answer[WINDOW].values())
    return {**answer, "ratios": {WINDOW: large / small}}


def skip_parts() -> dict[str, dict[str, Callable]]:
    centers = np.random.default_rng(0).uniform(-0.6, 0.6, (20, 3)).astype(np.float32)
    balls = pj.Spheres(centers, np.full(20, 0.15, np.float32))
    mesh, camera = bumpy(4).mesh(), view(256)
    scenes = {
        "5k triangles": pj.Scene(mesh=mesh),
        "20 spheres": pj.Scene(spheres=balls),
        "both": pj.Scene(mesh=mesh, spheres=balls),
    }
    return {"mask, parts of a scene": {k: our_mask(camera, s) for k, s in scenes.items()}}


def skip_code() -> dict[str, dict[str, Callable]]:
    scene, camera, ours = sphere().scene(), view(512), jax.jit(pj.camera_rays)
    lens = pj.Lens(np.float32([256, 256]))
    c = camera
    seen_through = pj.Camera(c.e, c.p, c.u, c.phi, c.d, c.W, c.H, lens)
    overlaps = {f"overlaps={o}": our_mask(camera, scene, o) for o in (False, True)}
    cameras = {"without a lens": camera, "with a lens": seen_through}
    return {
        "mask of a convex shape": overlaps,
        "mask": {name: our_mask(c, scene) for name, c in cameras.items()},
        "rays": {name: lambda c=c: ours(c) for name, c in cameras.items()},
    }


def skip_parameters() -> dict[str, dict[str, Callable]]:
    scene, truth = bumpy(4).scene(), view(256)
    target = np.asarray(pj.silhouette(truth, scene))
    start = off(truth, 10, 0.0, np.random.default_rng(0))
    moves = Moves(start)
    columns = {"1 column": ("phi",), "6 columns": ("pose",), "7 columns": ("pose", "phi")}
    fitted = {"pose": ("pose",), "pose and phi": ("pose", "phi")}
    jacobians = {name: our_jacobian(moves, scene, free).call for name, free in columns.items()}
    return {
        "image and Jacobian": jacobians,
        "fit": {name: our_fit(scene, target, start, free) for name, free in fitted.items()},
    }


def skip_pixels() -> dict[str, dict[str, Callable]]:
    """Return fits of an object 64 px across, in a picture of 256 px and in one of 2048."""
    scene, calls, camera = bumpy(4).scene(), {}, view(256)
    for size in (256, 2048):
        # About 64 px across: the camera's window is a part of the larger one's.
        phi = 2 * np.arctan(size / 256 * np.tan(0.3) * 184 / 64)
        wide = lambda c, size=size, phi=phi: pj.Camera(
            c.e, c.p, c.u, np.float32(phi), 1.0, size, size
        )
        target = np.asarray(pj.silhouette(wide(camera), scene))
        start = wide(off(camera, 10, 0.05, np.random.default_rng(0)))
        calls[f"in {size} px"] = our_fit(scene, target, start, ("pose",))
    return {WINDOW: calls}


def skip_edges() -> dict[str, dict[str, Callable]]:
    """Return masks of a mesh whose clusters of edges are passed over, and of one that has none."""
    scene, camera = sphere().scene(), view(512)
    clusters = lambda s: s.mesh.planes.clusters
    each = eqx.tree_at(clusters, scene, None)
    scenes = {"by clusters": scene, "edge by edge": each}
    return {"mask, 328k faces": {name: our_mask(camera, s) for name, s in scenes.items()}}


def skip_steps() -> dict[str, dict[str, Callable]]:
    """Return a fit's look at the contour's pixels beside the whole image with its derivative; fits
    from the camera itself and from one that is off."""
    scene, truth = bumpy(4).scene(), view(256)
    target, free = np.asarray(pj.silhouette(truth, scene)), ("pose", "phi")
    weights, start = (
        np.broadcast_to(1.0, target.shape),
        off(truth, 10, 0.05, np.random.default_rng(0)),
    )
    solver, unit = Solver.of(scene, target, weights, np.float32, free, 64), canonical(truth)
    pixels = {
        "the contour's": lambda: solver.look(unit, solver.finest).triangle,
        "all": our_jacobian(Moves(truth), scene).call,
    }
    starts = {"converged": truth, "10 degrees off": start}
    return {
        "derivative, pixels": pixels,
        "fit, levels": {name: our_fit(scene, target, c) for name, c in starts.items()},
    }


QUESTIONS: dict[str, Callable[[Peers], dict]] = {
    q.__name__: q for q in (masks, jacobian, gradient, fits, rays, faces, resolution, skip)
}


# The report


def machine() -> dict[str, Any]:
    cpu = platform.processor() or platform.machine()
    listed = Path("/proc/cpuinfo")
    if listed.exists():
        models = [x for x in listed.read_text().splitlines() if x.startswith("model name")]
        cpu = models[0].split(":")[1].strip() if models else cpu
    usable_cores = getattr(os, "sched_getaffinity", lambda _: range(os.cpu_count() or 1))(0)
    return {
        "cpu": cpu,
        "cores": len(usable_cores),
        "system": platform.platform(),
        "jax_backend": jax.default_backend(),
        "load_average": os.getloadavg() if hasattr(os, "getloadavg") else None,
    }


def versions(peers: Peers) -> dict[str, str]:
    names = ["pinhole-jax", "jax", "jaxlib", "numpy", "scipy", "shapely"]
    found = {"python": platform.python_version()}
    for name in [*names, *(peer.package for peer in peers)]:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed as a package"
    return found


def verdict(answers: dict[str, dict]) -> list[dict]:
    """Return every figure that was measured, what was asked of it, and whether that is reached."""
    ratios = {k: v for answer in answers.values() for k, v in answer["ratios"].items()}
    rows = []
    for name, measured in ratios.items():
        asked = ASKED.get(name)
        reached = None if asked is None else measured <= asked
        rows.append({"target": name, "measured": measured, "asked": asked, "reached": reached})
    return rows


def show(rows: list[dict]) -> None:
    width = max((len(row["target"]) for row in rows), default=0)
    print(f"\n{'ratio, or ms':{width}}  measured  asked  reached")
    for row in rows:
        asked = "–" if row["asked"] is None else f"{row['asked']:.3g}"
        reached = {None: "–", True: "yes", False: "NO"}[row["reached"]]
        print(f"{row['target']:{width}}  {row['measured']:8.3g}  {asked:>5}  {reached}")


def draw(answers: dict[str, dict], path: Path) -> None:
    """Draw time against error, one line per system over its samples; then costs as they grow."""
    try:
        import matplotlib
    except ImportError:
        print("no plot: matplotlib is not installed")
        return
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    panels = []
    for case in MASKS if "masks" in answers else ():
        panels.append(lambda axis, case=case: draw_errors(axis, case, answers["masks"][case]))
    for name, words in (("faces", "faces"), ("resolution", "pixels across")):
        if name in answers:
            by = answers[name]["by"]
            panels.append(lambda axis, by=by, words=words: draw_growth(axis, words, by))
    if not panels:
        return
    figure, axes = plt.subplots(1, len(panels), figsize=(5 * len(panels), 4.2), squeeze=False)
    for axis, panel in zip(axes[0], panels, strict=True):
        panel(axis)
        axis.set_ylabel("seconds")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=120)


def draw_errors(axis: Any, case: str, answer: dict) -> None:
    for name, entries in answer["systems"].items():
        errors, times = ([e[k] for e in entries.values()] for k in ("error", "median_s"))
        style = {"marker": "*", "ms": 16, "c": "k", "ls": ""} if name == OURS else {"marker": "o"}
        axis.loglog(errors, times, label=name, **style)
    axis.set(title=f"mask, {case}", xlabel="RMS error of boundary pixels")


def draw_growth(axis: Any, words: str, by: dict[str, dict]) -> None:
    names = [name for name in next(iter(by.values())) if name != "build_s"]
    for name in names:
        style = {"marker": "*", "c": "k", "lw": 2} if name == OURS else {"marker": "o", "ms": 3}
        style |= {"ls": "--"} if name.startswith(OURS) and name != OURS else {}
        times = [entry[name]["median_s"] for entry in by.values()]
        axis.loglog([int(x) for x in by], times, label=name, **style)
    axis.set(title="mask, one sample a pixel; our fit", xlabel=words)


def main() -> None:
    asked = sys.argv[2:] or [*QUESTIONS]
    if unknown := {*asked} - {*QUESTIONS}:
        sys.exit(f"expected questions among {', '.join(QUESTIONS)}, got {', '.join(unknown)}")
    # What was measured is written even if a later question breaks off.
    place, answers = folder(), {}
    peers = [*usable()]
    facts = {
        "machine": machine(),
        "versions": versions(peers),
        "settings": {peer.name: peer.settings for peer in peers},
        "skipped": {peer.name: peer.install for peer in PEERS if peer not in peers},
    }
    for name, words in facts["settings"].items():
        print(f"{name}: {words}")
    for name in asked:
        print(f"{name}:", flush=True)
        answers[name] = QUESTIONS[name](peers)
        let_go()
        written = {"verdict": verdict(answers), **facts, "answers": answers}
        (place / "benchmark.json").write_text(json.dumps(written, indent=1) + "\n")
    draw(answers, place / "benchmark.png")
    show(verdict(answers))


if __name__ == "__main__":
    main()
