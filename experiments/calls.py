"""What does each call of a user take the first time, and again with other numbers of everything?

    python experiments/calls.py OUT

Each kind of call in a process of its own with nothing kept: seconds, and how much is compiled,
of the first call and of three further ones, with another camera, another mask or another number of
points. What a further call compiles is paid for again and again.
"""

import time
from collections.abc import Callable
from functools import cache

import jax
import numpy as np
from _common import one_by_one

import pinhole_jax as pj

W, H = 256, 200
LENS = pj.Lens([128.0, 100.0], 1.0, pj.BrownConrady(0.1, 0.0, 0.0, 0.0, 0.0))
FURTHER = 3


@cache
def _scene() -> pj.Scene:
    return pj.Scene(mesh=pj.shapes.bumpy(3))


def _camera(number: int, lens: pj.Lens | None = None) -> pj.Camera:
    random = np.random.default_rng(number)
    eye = np.array([0.3, 1.0, 5.0]) + 0.3 * random.standard_normal(3)
    return pj.Camera(eye, 0.1 * random.standard_normal(3), [0, 1, 0], 0.6, 1.0, W, H, lens)


def _start(number: int, lens: pj.Lens | None = None) -> pj.Camera:
    camera = _camera(number, lens)
    return camera.replace(e=np.asarray(camera.e) + np.float32([0.05, -0.03, 0.1]))


@cache
def _mask(number: int) -> np.ndarray:
    hit = pj.trace(_scene(), _camera(number))
    return np.isfinite(np.asarray(hit.t))


@cache
def _fit(number: int) -> pj.Fit:
    return pj.fit_camera(_scene(), _mask(number), _start(number))


def _points(number: int) -> np.ndarray:
    return np.random.default_rng(number).standard_normal((12 + number, 3)).astype(np.float32)


def camera_rays(number: int):
    return pj.camera_rays(_camera(number))


def project(number: int):
    return pj.project(_camera(number), _points(number))


def project_through_a_lens(number: int):
    return pj.project(_camera(number, LENS), _points(number))


def trace_rays_in_a_row(number: int):
    return pj.trace(_scene(), pj.Rays(np.float32([0, 0, 5]), _points(number)))


def depth(number: int):
    return pj.depth(_camera(number), _scene())


def silhouette(number: int):
    return pj.silhouette(_camera(number), _scene())


def fit_camera(number: int):
    return _fit(number).camera


def fit_cameras(number: int):
    masks, starts = ([of(n) for n in (number, number + 1)] for of in (_mask, _start))
    return pj.fit_cameras(_scene(), masks, starts)


def derivative_of_a_fit(number: int):
    fit = lambda target: pj.fit_camera(_scene(), target, _start(number)).camera.e[0]
    return jax.grad(fit)(1.0 * _mask(number))


def fit_points(number: int):
    points, truth = _points(number), _camera(number)
    return pj.fit_points(points, pj.project(truth, points), _start(number)).camera


def fit_points_through_a_lens(number: int):
    points, truth = _points(number), _camera(number, LENS)
    seen = np.array(pj.project(truth, points))
    seen[0] += 30
    return pj.fit_points(points, seen, _start(number, LENS), outlier_px=1.0).camera


def overlay(number: int):
    return pj.plot.overlay(np.uint8(_mask(number)), _camera(number), _scene())


def overlay_through_a_lens(number: int):
    return pj.plot.overlay(np.uint8(_mask(number)), _camera(number, LENS), _scene())


def report(number: int):
    return pj.report.page(_fit(number), _scene(), _mask(number))


#: What is called, and what is made before it for each of its numbers: masks, or fits to them.
CALLS: dict[str, tuple[Callable, Callable | None]] = {
    "camera_rays": (camera_rays, None),
    "project": (project, None),
    "project_through_a_lens": (project_through_a_lens, None),
    "trace_rays_in_a_row": (trace_rays_in_a_row, None),
    "depth": (depth, None),
    "silhouette": (silhouette, None),
    "fit_camera": (fit_camera, _mask),
    "fit_cameras": (fit_cameras, _mask),
    "derivative_of_a_fit": (derivative_of_a_fit, _fit),
    "fit_points": (fit_points, None),
    "fit_points_through_a_lens": (fit_points_through_a_lens, None),
    "overlay": (overlay, _mask),
    "overlay_through_a_lens": (overlay_through_a_lens, _mask),
    "report": (report, _fit),
}


def measured(name: str) -> dict:
    """Return seconds and programs of a first call, and the most of the further ones."""
    call, before = CALLS[name]
    compiled: list[float] = []

    def listen(event: str, duration: float, **_) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(duration)

    if before is not None:
        for number in range(FURTHER + 2):
            before(number)
    _scene()
    jax.monitoring.register_event_duration_secs_listener(listen)
    rows = []
    for number in range(FURTHER + 1):
        compiled.clear()
        begin = time.perf_counter()
        jax.block_until_ready(jax.tree.leaves(call(number)))
        rows.append((time.perf_counter() - begin, len(compiled)))
    (seconds, programs), *further = rows
    return {
        "first s": round(seconds, 2),
        "first programs": programs,
        "further ms": round(1e3 * float(np.median([s for s, _ in further])), 2),
        "further programs": max(n for _, n in further),
    }


if __name__ == "__main__":
    one_by_one(CALLS, measured)
