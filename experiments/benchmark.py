"""How fast, and how exact, beside the systems that others would use, and what a machine can do?

    python experiments/benchmark.py loop | drawn | peers | memory | tracer | device [OUT]

- `loop`: a mask, its Jacobian and a fit over a plain compiled loop that does the least work
  (`_plain_loop.py`): spheres of more and more faces at 512 px, and of 328k faces at more and more
  pixels; on one thread, ms of the processor.
- `drawn`: fits to masks (640 x 480) that waver, of an object of 90 px and 20k faces, from a start
  10 degrees off (focal length free) and from none: seconds, and degrees off.
- `peers`: masks, gradients and fits beside Embree and DEODR, as far as these are
  installed (`_peers.py` has their settings), against a union of the projected triangles in float64.
- `memory`: what is resident while a mask is made, over scene and mask. (Linux alone tells.)
- `tracer`: rays of an image and rays from anywhere, beside Embree's.
- `device`: is what an accelerator makes right, and how fast is it there? Each place in a process
  of its own; errors are the largest entry's distance from what the CPU makes in float64.

Float32; medians of calls that are compiled already, all systems in turn, so that a busy machine
slows all.
"""

import ctypes
import json
import os
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from _common import (
    Options,
    apart,
    camera_at,
    curves,
    degrees,
    in_turn,
    main,
    mask_of,
    noisy,
    random_camera,
    resized,
    scene_of,
    show,
    start_from,
)
from _peers import Job, Moves, central_difference, film_matrix, pose_of, usable
from honesty import signed_distance, start_off, waves
from scipy.spatial.transform import Rotation

import pinhole_jax as pj

sys.path.insert(0, str(Path(__file__).parent / "reference"))
from _oracle import union_per_pixel

FREE = ("pose", "phi")


# The least work

FACES, PIXELS = (1e2, 1e3, 1e4, 1e5, 3.28e5, 1e6), (64, 128, 256, 512, 1024, 2048)
QUICK = ((1e4,), (256,))
AT_PX, AT_FACES = 512, 3.28e5
PARAMETERS = (0.4, 1.1, 4.8, 0.05, -0.02, 0.03, 0.55)  # e, p, phi
UP = (0.1, 1.0, 0.05)
MOST_PX = 1024  # of a Jacobian: at 4096 px it is 470 MB


def sphere(faces: float) -> pj.Mesh:
    """Return a sphere of about this many faces, in rings of twice as many as there are rings."""
    rings = max(4, round((faces / 4) ** 0.5))
    angle = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)
    profile = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    profile[[0, -1], 0] = 0
    mesh = pj.shapes.revolved(profile, 2 * rings)
    return pj.Mesh(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces))


def seen(x: Any, px: int) -> pj.Camera:
    """Return the camera of the seven parameters."""
    return pj.Camera(x[:3], x[3:6], jnp.asarray(UP, x.dtype), x[6], 1.0, px, px)


def library(scene: pj.Scene, px: int) -> dict[str, Callable]:
    """Return our mask, and our mask with its Jacobian, compiled, as functions without arguments."""
    mask = lambda x, scene: pj.silhouette(seen(x, px), scene)

    def both(x, scene):
        twice = lambda x: (lambda image: (image, image))(mask(x, scene))
        jacobian, image = jax.jacfwd(twice, has_aux=True)(x)
        return image, jacobian

    x = jnp.asarray(PARAMETERS, jnp.float32)
    ways = {"mask": jax.jit(mask), "jacobian": jax.jit(both)}
    return {name: lambda f=f: f(x, scene) for name, f in ways.items()}


def ratios(mesh: pj.Mesh, px: int, fits: bool) -> dict:
    """Return ms of the library and of the loop, their ratios, and the distance of their answers. A
    fit is held against one step of the loop's."""
    import _plain_loop as loop

    scene = pj.Scene(mesh=mesh)
    shape = loop.shape_of(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    film = loop.film_of(np.array(PARAMETERS), np.array(UP), px, px)
    ours = library(scene, px)
    theirs = {"mask": lambda: loop.mask(shape, film)}
    theirs["jacobian"] = lambda: loop.mask_and_jacobian(shape, film)
    if px > MOST_PX:
        del theirs["jacobian"]
    if fits:  # of a shape that its outline tells, with about as many faces
        solid, there = bumpy(round(np.log(len(mesh.faces) / 20) / np.log(4))), general(px)
        target, start = mask_of(there, solid), start_from(there, 8, 0.05, np.random.default_rng(0))
        theirs["fit"] = lambda: loop.step(shape, film, target)
        ours["fit"] = lambda: pj.fit_camera(solid, target, start, FREE).camera
    off = np.abs(np.asarray(ours["mask"]()) - theirs["mask"]()).max()
    if off > 1e-3:
        raise SystemExit(f"loop and library differ by {off}")
    jobs = {f: job for k, x in theirs.items() for f, job in ((k, ours[k]), (f"{k}, loop", x))}
    ms = {name: 1e3 * s for name, s in in_turn(jobs, time.process_time).items()}
    ms |= {f"{k} ratio": ms[k] / ms[f"{k}, loop"] for k in theirs}
    return {"faces": len(mesh.faces), "px": px, "apart": float(off), **ms}


def on_one_core() -> None:
    """Keep this process, where JAX has not begun, and the loop's threads to one core."""
    import numba

    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
    numba.set_num_threads(1)


def loop(asked: Options) -> dict:
    on_one_core()
    faces, pixels = QUICK if asked.quick else (FACES, PIXELS)
    mesh, table = sphere(AT_FACES), []
    sizes = [(sphere(n), AT_PX) for n in faces] + [(mesh, px) for px in pixels if px != AT_PX]
    for shape, px in sizes:
        table.append(ratios(shape, px, fits=px <= MOST_PX))
        print(table[-1], flush=True)
    show(table)
    large = [row for row in table if row["faces"] > 9e4]
    worst = {k: max(row.get(f"{k} ratio", 0) for row in large) for k in ("mask", "jacobian", "fit")}
    words = [f"a {k} takes at most {x:.1f} times the loop's" for k, x in worst.items()]
    return {"verdict": f"From 100k faces on {', '.join(words)} (a fit: one step)", "table": table}


def draw_loop(found: dict, path: Path) -> None:
    panels = []
    for by, rows in (
        ("faces", [r for r in found["table"] if r["px"] == AT_PX]),
        ("px", [r for r in found["table"] if 1 / 1.1 < r["faces"] / AT_FACES < 1.1]),
    ):
        names = [k for k in rows[0] if k in ("mask", "jacobian", "fit") or k.endswith("loop")]
        lines = {}
        for name in names:
            some = sorted((r[by], r[name]) for r in rows if name in r)
            lines[name] = tuple(zip(*some, strict=True))
        panels.append(("ms", by, "loglog", lines))
    curves(path, *panels)


# Peers

NEAR, FIT_S = 0.5, 60.0  # degrees: a fit has arrived; a peer's fit is stopped after seconds
ROUNDED = 1e-6  # coverage nearer to 0 or 1 than this is no boundary


@cache
def bumpy(subdivisions: int) -> pj.Scene:
    mesh = pj.shapes.bumpy(subdivisions)
    return scene_of(np.asarray(mesh.vertices, float), np.asarray(mesh.faces))


def ball() -> pj.Scene:
    shape = trimesh.creation.icosphere(7)
    return scene_of(np.asarray(shape.vertices), np.asarray(shape.faces))


def scan() -> pj.Scene:
    mesh = bumpy(6).mesh
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    return scene_of(noisy(vertices, faces, 0.12), faces)


CASES: dict[str, tuple[Callable[[], pj.Scene], int]] = {
    "bumpy, 5k faces, 256 px": (lambda: bumpy(4), 256),
    "scan, 82k faces, 256 px": (scan, 256),
    "sphere, 328k faces, 512 px": (ball, 512),
}


def general(size: int) -> pj.Camera:
    """Return a camera in general position, in whose picture the unit sphere takes 3/4."""
    axes = Rotation.from_euler("xyz", [0.4, -0.7, 0.2]).as_matrix()
    return camera_at(axes, np.array([0.031, -0.017]), 4.6, 0.6, size)


def exact(film: np.ndarray, W: int, H: int, mesh: pj.Mesh) -> np.ndarray:
    """Return the exact coverage (H, W) that a (3, 4) film matrix shows of a closed mesh: its front
    covers what its back covers."""
    import shapely

    points = np.asarray(mesh.vertices, float)
    x, y, depth = film[:, :3] @ points.T + film[:, 3:]
    triangles = shapely.polygons(np.stack([x / depth, y / depth], axis=1)[np.asarray(mesh.faces)])
    front = triangles[shapely.is_ccw(shapely.get_exterior_ring(triangles))]
    return union_per_pixel(front, np.ones((H, W), bool))


def boundary_error(image: np.ndarray, coverage: np.ndarray) -> float:
    """Return the RMS error over the pixels that the outline crosses."""
    boundary = (coverage > ROUNDED) & (coverage < 1 - ROUNDED)
    return float(np.sqrt(np.mean((np.asarray(image, float) - coverage)[boundary] ** 2)))


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


def masks(scene: pj.Scene, size: int, systems: list, sides: tuple[int, ...]) -> list[dict]:
    """Return ms and error of every system by its samples a pixel; we have no samples: once."""
    camera, rows = general(size), []
    coverage = exact(film_matrix(pose_of(camera), size, size), size, size, scene.mesh)
    for side in sides:
        jobs = {"here": Job(lambda: pj.silhouette(camera, scene))} if side == 1 else {}
        for system in systems:
            jobs |= system.masks(camera, side)
        times = in_turn({name: job.call for name, job in jobs.items()})
        for name, job in jobs.items():
            error = boundary_error(job.read(job.call()), coverage)
            rows.append({"system": name, "samples": side**2, "ms": 1e3 * times[name]})
            rows[-1]["error"] = error
    return rows


def gradients(scene: pj.Scene, size: int, systems: list) -> list[dict]:
    """Return ms of a loss's gradient, and its error against differences of the polygons."""
    there = general(size)
    start = start_from(there, 3, 0.02, np.random.default_rng(0))
    moves, target = Moves(start), mask_of(there, scene).astype(float)
    jobs = {"here": our_gradient(moves, scene, target)}
    for system in systems:
        jobs |= system.gradients(moves, np.zeros(7), target)
    times = in_turn({name: job.call for name, job in jobs.items()})
    loss = lambda y: np.mean((exact(moves.film(y), size, size, scene.mesh) - target) ** 2)
    right, rows = central_difference(loss, np.zeros(7)), []
    for name, job in jobs.items():
        wrong = np.linalg.norm(job.read(job.call()) - right) / np.linalg.norm(right)
        rows.append({"gradient": name, "ms": 1e3 * times[name], "error": float(wrong)})
    return rows


def fits(scene: pj.Scene, size: int, systems: list) -> list[dict]:
    """Return fits of pose and focal length from 10 degrees and 5 % off."""
    random = np.random.default_rng(0)
    truth = random_camera(random, size=size)
    start, target = start_from(truth, 10, 0.05, random), mask_of(truth, scene).astype(float)
    fit = lambda: pj.fit_camera(scene, target, start, FREE).camera
    seconds = in_turn({"": fit})[""]
    rows = [{"fit": "here", "s": seconds, "degrees": degrees(fit(), truth), "near s": seconds}]
    moves = Moves(start)
    for system in systems:
        for name, trail in system.fits(moves, target, FIT_S).items():
            errors = [degrees(moves.camera(y), truth) for y in trail.moves]
            near = [s for s, error in zip(trail.seconds, errors, strict=True) if error < NEAR]
            row = {"fit": name, "s": trail.seconds[-1], "degrees": errors[-1]}
            rows.append({**row, "near s": near[0] if near else None})
    return rows


def peers(asked: Options) -> dict:
    found, known = {}, [*usable()]
    for case in asked.names([*CASES][:1] if asked.quick else CASES):
        make, size = CASES[case]
        scene = make()
        mesh = np.asarray(scene.mesh.vertices), np.asarray(scene.mesh.faces)
        systems = [peer(*mesh) for peer in known]
        rows = masks(scene, size, systems, (1, 2) if asked.quick else (1, 2, 4, 8))
        found[case] = {"masks": rows, "fits": fits(scene, size, systems)}
        if case == next(iter(CASES)):
            found[case]["gradients"] = gradients(scene, size, systems)
        print(case)
        for table in found[case].values():
            show(table)
    said = []
    for case, tables in found.items():
        ours, *others = tables["masks"]
        least = min((r["error"] for r in others), default=np.nan)
        said.append(f"{case}: {ours['ms']:.2f} ms, error {ours['error'] / least:.1e} of the least")
    settings = {peer.name: peer.settings for peer in known}
    return {"verdict": "; ".join(said), "settings": settings, "table": found}


def draw_peers(found: dict, path: Path) -> None:
    panels = []
    for case, tables in found["table"].items():
        lines: dict[str, tuple] = {}
        for row in tables["masks"]:
            error, ms = lines.setdefault(row["system"], ([], []))
            error.append(row["error"])
            ms.append(row["ms"])
        panels.append((f"ms: {case}", "RMS error of boundary pixels", "loglog", lines))
    curves(path, *panels)


# Masks as people and networks draw them


def drawn(asked: Options) -> dict:
    scene, table = bumpy(4 if asked.quick else 5), []
    for seed in range(asked.seed, asked.seed + asked.number(12, 2)):
        random = np.random.default_rng(seed)
        axes, aside = Rotation.random(random_state=random).as_matrix(), random.uniform(-0.1, 0.1, 2)
        truth = resized(camera_at(axes, aside, 480 / np.tan(0.3) / 90, 0.6, 480), 640, 480)
        image = mask_of(truth, scene)
        mask = signed_distance(image) > waves(image.shape, random)
        start = start_off(truth, 10, *random.normal(size=(2, 3)))
        for camera, phi in ((start, None), (None, 0.6)):
            pj.fit_camera(scene, mask, camera, phi=phi)
            begin, used = time.perf_counter(), time.process_time()
            found = pj.fit_camera(scene, mask, camera, phi=phi)
            seconds = time.perf_counter() - begin, time.process_time() - used
            off, sigma = degrees(found.camera, truth), np.linalg.norm(found.std[:3])
            row = {"start": camera is not None, "status": found.status, "degrees": off}
            row |= {"sigma": float(np.rad2deg(sigma)), "s": seconds[0], "processor s": seconds[1]}
            table.append(row)
    show(table)
    median = lambda key, start: float(np.median([r[key] for r in table if r["start"] == start]))
    with_start, without = (median("s", start) for start in (True, False))
    words = (
        f"A drawn mask takes {with_start:.2f} s from a start, {without:.2f} s from none (median)"
    )
    return {"verdict": words, "s": with_start, "without": without, "table": table}


# Memory


def resident(field: str) -> int:
    """Return bytes of a field of the process's memory: `VmRSS`, now, `VmHWM`, at most."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(x for x in lines if x.startswith(field)).split()[1])


def held(faces: float, px: int, views: int) -> dict:
    """Return MB of the scene, of the result and of the resident process while masks are made:
    of one view, or of many under `vmap`."""
    scene, x = pj.Scene(mesh=sphere(faces)), jnp.asarray(PARAMETERS, jnp.float32)
    mask = lambda x, scene: pj.silhouette(seen(x, px), scene)
    if views > 1:
        mask, x = jax.vmap(mask, (0, None)), jnp.broadcast_to(x, (views, 7))
    compiled = jax.jit(mask).lower(x, scene).compile()
    jax.block_until_ready(jax.tree.leaves(scene))
    ctypes.CDLL(None).malloc_trim(0)  # what compiling took is given back
    Path("/proc/self/clear_refs").write_text("5")  # at most, from now on
    before = resident("VmRSS")
    image = jax.block_until_ready(compiled(x, scene))
    beyond = resident("VmHWM") - before
    size = sum(x.nbytes for x in jax.tree.leaves(scene) if isinstance(x, jax.Array))
    row = {"scene MB": size / 1e6, "masks MB": image.nbytes / 1e6, "beyond MB": beyond / 1e6}
    return {**row, "times both": (size + beyond) / (size + image.nbytes)}


def memory(asked: Options) -> dict:
    if not Path("/proc/self/clear_refs").exists():
        return {"verdict": "skipped: this system does not tell what a process holds"}
    sizes = [(1e5, 512, 1)] if asked.quick else [(n, 512, 1) for n in (1e5, 1e6, 4e6)]
    table = []
    for case in (*sizes, (1e5, 64, 100 if asked.quick else 1000)):
        names = dict(zip(("faces", "px", "views"), case, strict=True))
        table.append({**names, **apart(__file__, "--held", *map(str, case))})
    show(table)
    worst = max(row["times both"] for row in table)
    return {"verdict": f"At most {worst:.1f} times scene and masks are resident", "table": table}


# Rays


def random_rays(number: int) -> pj.Rays:
    random = np.random.default_rng(0)
    origin = random.normal(size=(number, 3))
    origin *= 3 / np.linalg.norm(origin, axis=1, keepdims=True)
    direction = random.uniform(-1, 1, size=origin.shape) - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return pj.Rays(jnp.asarray(origin, jnp.float32), jnp.asarray(direction, jnp.float32))


def embree(mesh: pj.Mesh) -> Callable | None:
    """Return Embree's first hits of rays as a function, or None where embreex is not installed."""
    try:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh
    except ImportError:
        return None
    scene = rtcore_scene.EmbreeScene()
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.faces)].astype(np.float32)
    keep = TriangleMesh(scene, corners)
    return lambda origin, direction, keep=keep: scene.run(origin, direction)


def traced(scene: pj.Scene, rays: pj.Rays, film: pj.Camera | None) -> dict:
    """Return ms of the ways to find hits, and the share of equal ones."""
    jobs: dict[str, Callable] = {"trace": lambda: pj.trace(scene, rays)}
    if film is not None:
        jobs |= {"depth": lambda: pj.depth(film, scene), "drawn": lambda: pj.trace(scene, film)}
    direction = np.asarray(rays.direction).reshape(-1, 3)
    origin = np.ascontiguousarray(np.broadcast_to(rays.origin, rays.direction.shape).reshape(-1, 3))
    peer = embree(scene.mesh)
    if peer is not None:
        jobs["embree"] = lambda: peer(origin, direction)
    row: dict = {"faces": len(scene.mesh.faces), "rays": len(direction), "image": film is not None}
    row |= {f"{name} ms": 1e3 * s for name, s in in_turn(jobs).items()}
    if peer is not None:
        ours = np.asarray(pj.trace(scene, rays).primitive).reshape(-1)
        row |= {f"{name} times": row[f"{name} ms"] / row["embree ms"] for name in jobs}
        row["same hit"] = float(np.mean((ours >= 0) == (peer(origin, direction) >= 0)))
    return row


def tracer(asked: Options) -> dict:
    table = []
    for level in (5,) if asked.quick else (3, 5, 7):
        shape = trimesh.creation.icosphere(level)
        mesh = pj.Mesh(np.asarray(shape.vertices, np.float32), np.asarray(shape.faces))
        for px in (128,) if asked.quick else (128, 512, 1024):
            film = general(px)
            for rays, camera in ((pj.camera_rays(film), film), (random_rays(px * px), None)):
                table.append(traced(pj.Scene(mesh=mesh), rays, camera))
    show(table)
    last = [row for row in table if row["image"]][-1]
    times = ", ".join(f"{k} {x:.1f}" for k, x in last.items() if k.endswith("times"))
    words = f"{last['rays']} rays of an image, {last['faces']} faces, times Embree's: {times}"
    return {"verdict": words, "table": table}


# Devices

#: Where programs run, the truth first, and whether in float64.
PLACES = {"cpu64": ("cpu", "1"), "cpu32": ("cpu", "0"), "here64": ("", "1"), "here32": ("", "0")}


def programs() -> dict[str, tuple[Callable, tuple]]:
    """Return programs and their arguments, in this process's precision."""
    to = np.float64 if jax.config.read("jax_enable_x64") else np.float32
    real = lambda x: jax.tree.map(lambda y: y.astype(to) if y.dtype.kind == "f" else y, x)
    camera, smooth, rough = real(general(256)), real(bumpy(4)), real(scan())
    loss = lambda c, s: jnp.sum(pj.silhouette(c, s) ** 2)
    places = camera.e + 0.1 * np.random.default_rng(0).normal(size=(64, 3)).astype(to)
    return {
        "mask": (pj.silhouette, (camera, smooth)),
        "mask of a scan": (pj.silhouette, (camera, rough)),
        "64 masks": (
            jax.vmap(lambda e: pj.silhouette(camera.replace(e=e), smooth)),
            (places,),
        ),
        "gradient": (jax.grad(lambda e: loss(camera.replace(e=e), smooth)), (camera.e,)),
        "depth": (pj.depth, (camera, smooth)),
        "rays": (lambda c, s: pj.trace(s, pj.camera_rays(c)).t, (real(general(1024)), smooth)),
    }


def made(place: str, out: str) -> dict:
    """Return the seconds of calls at one place; their results go to a file."""
    rows, kept = {}, {}
    for name, (function, arguments) in programs().items():
        compiled = jax.jit(function)
        call = lambda f=compiled, x=arguments: f(*x)
        begin = time.perf_counter()
        kept[name] = np.asarray(call(), float)
        rows[name] = {"first s": time.perf_counter() - begin, "ms": 1e3 * in_turn({"": call})[""]}
    np.savez_compressed(Path(out) / f"{place}.npz", **kept)
    return {"device": jax.devices()[0].device_kind, "rows": rows}


def device(asked: Options) -> dict:
    made, table = {}, []
    for place in asked.names(PLACES):
        platform, x64 = PLACES[place]
        given = {"JAX_ENABLE_X64": x64, "JAX_PLATFORMS": platform}
        made[place] = apart(__file__, "--place", place, str(asked.out), **given)
    truth = np.load(asked.out / "cpu64.npz")
    for place, of in made.items():
        found = np.load(asked.out / f"{place}.npz")
        for name, row in of["rows"].items():
            met = np.isfinite(truth[name])
            off = np.abs(found[name] - truth[name])[met].max() / np.abs(truth[name][met]).max()
            table.append({"program": name, "place": place, "device": of["device"], **row})
            table[-1]["apart"] = float(off)
    show(table)
    worst = max(row["apart"] for row in table)
    return {"verdict": f"The worst entry is {worst:.1e} of the largest off", "table": table}


if __name__ == "__main__":
    if sys.argv[1] == "--held":
        print(json.dumps(held(float(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))))
    elif sys.argv[1] == "--place":
        print(json.dumps(made(*sys.argv[2:])))
    else:
        parts = {"loop": (loop, draw_loop), "peers": (peers, draw_peers), "memory": memory}
        main(__doc__, {**parts, "drawn": drawn, "tracer": tracer, "device": device}, x64=False)
