"""`check_gradients`: a certificate that an image's derivatives agree with its differences.

A derivative that is nearly right still descends, so its faults go unnoticed. The check moves each
parameter a little to either side and compares the change of every pixel with the forward-mode
derivative; then it compares reverse mode with forward mode. Neither the step nor the scale of an
error comes from the derivative under test: a fault cannot excuse itself.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from .._camera.camera import Camera
from .._numerics.arrays import as_count, check_positive, is_concrete
from .._scene.scene import Scene, check_view
from .._silhouette.silhouette import silhouette
from .differences import STEPS, Scales, compared
from .directions import Probe, camera_and_scene, floats

#: A row is undecided if more than this share of its moving pixels are at a kink.
KINKS_ALLOWED = 0.25
#: A pixel moves if it changes by more than this share of the largest change.
MOVING = 0.02
RIGHT = ("ok", "moves nothing")
#: The head of the printed table.
HEAD = (
    "parameter           derivative   difference     pixel   step  error  reverse  kinks  verdict"
)


class Row(NamedTuple):
    """The check of one parameter, or of one random direction in an array.

    - `derivative`, `difference`: of one pixel, per unit of the parameter: the pixel that fails
      worst or, if none fails, the one that changes most.
    - `pixel`: its (row, column).
    - `step`: of the first central difference, in units of the direction.
    - `error`: the worst pixel's, relative to the image's largest difference.
    - `reverse`: relative distance of reverse mode from forward mode.
    - `kinks`: pixels with two slopes; their derivative must lie between these.
    - `verdict`: "ok"; "moves nothing" (derivative and difference are both 0); or the fault: "not
      finite", "wrong derivative", "reverse differs", "undecided" (too many kinks).
    """

    parameter: str
    derivative: float
    difference: float
    pixel: tuple[int, int]
    step: float
    error: float
    reverse: float
    kinks: int
    verdict: str


class Certificate(NamedTuple):
    """The rows of `check_gradients`; `passed`: all are right, and at least one moves the image.

    ```python
    certificate.passed, {row.parameter: row.verdict for row in certificate.rows}
    ```
    """

    rows: tuple[Row, ...]
    passed: bool

    def __str__(self) -> str:
        """Return the verdict, and below it the table."""
        return "\n".join([_summary(self), HEAD, *map(_line, self.rows)])


def check_gradients(
    camera: Camera,
    scene: Scene,
    image: Callable[[Camera, Scene], Array] = silhouette,
    *,
    tolerance: float | None = None,
    directions: int = 2,
    seed: int = 0,
    verbose: bool = True,
) -> Certificate:
    """Return a certificate of an image's derivatives at this camera and scene, and print it.

    `image(camera, scene)`, (H, W) and finite, is `silhouette` or a differentiable renderer of your
    own. It checks e, p, u, phi, d, a lens, and `directions` random directions each in vertices,
    centers and radii. Values must be finite; forward mode must agree with central differences in
    each pixel, and reverse mode with forward mode.

    A step moves the picture by some 1e-5 px. If a pixel's differences over h and h/2 disagree, it
    takes smaller steps. If these disagree too, the pixel is at a kink (an edge along its border, a
    face edge-on), and its derivative must lie between the slopes to either side.

    The default `tolerance` of `Row.error` is 1e-6 in float64. A float32 camera's derivatives are
    compared with float64 differences, to 1e-3, if `jax_enable_x64` is on. If it is off, differences
    are in float32, over some 0.02 px, and the tolerance is 0.1: wrong signs and lost pieces show,
    small errors do not.

    Raises ValueError if camera or scene are traced, `tolerance` is not positive, `directions` is
    below 1, or the image is not (H, W) floats.

    ```python
    small = pj.Scene(mesh=pj.shapes.bumpy(2))
    certificate = pj.check_gradients(camera.replace(W=64, H=64), small)
    print(certificate)
    ```
    """
    _check(camera, scene, tolerance, directions)
    point = camera, scene
    x = np.concatenate([np.ravel(leaf) for leaf in floats(point)]).astype(camera.e.dtype)
    fine = x.astype(jnp.zeros(()).dtype)  # for differences: the very same camera and scene
    rendered = _render(image, point, fine)
    _check_image(rendered, camera)
    scales = Scales.for_precision(
        camera.e.dtype, rendered.dtype, max(camera.H, camera.W), tolerance
    )
    random, middle = np.random.default_rng(seed), np.asarray(rendered, float)
    # Weights are exact in either precision; none is small, so that every pixel counts.
    weight = random.uniform(0.5, 1.5, middle.shape) * random.choice([-1, 1], middle.shape)
    weight = weight.astype(np.float32)
    gradient = np.asarray(_gradient(image, point, x, weight), float)
    rows = []
    for probe in camera_and_scene(point, scales, directions, seed):
        derivative = np.asarray(_forward(image, point, x, probe.direction), float)
        gap = _mode_gap(gradient, probe, weight * derivative)
        to = lambda h, way=probe.direction: _render(image, point, fine + fine.dtype.type(h) * way)
        up, down = (
            np.stack([np.asarray(to(side * h), float) for h in STEPS])
            for side in (probe.step, -probe.step)
        )
        rows.append(_row(probe, derivative, middle, up, down, gap, scales))
    verdicts = {row.verdict for row in rows}
    certificate = Certificate(tuple(rows), "ok" in verdicts and verdicts <= {*RIGHT})
    if verbose:
        print(certificate)
    return certificate


@eqx.filter_jit
def _render(image: Callable, point: Any, x: Any) -> Any:
    """Return the image where the float arrays of camera and scene have these numbers (n,)."""
    moving, still = eqx.partition(point, eqx.is_inexact_array)
    _, put = ravel_pytree(jax.tree.map(lambda leaf: leaf.astype(x.dtype), moving))
    return image(*eqx.combine(put(x), still))


@eqx.filter_jit
def _forward(image: Callable, point: Any, x: Any, direction: Any) -> Float[Array, "H W"]:
    return jax.jvp(partial(_render, image, point), (x,), (direction,))[1]


@eqx.filter_jit
def _gradient(image: Callable, point: Any, x: Any, weight: Any) -> Float[Array, "n"]:
    def loss(x):
        value = _render(image, point, x)
        return jnp.sum(weight.astype(value.dtype) * value)

    return jax.grad(loss)(x)


def _row(
    probe: Probe,
    derivative: np.ndarray,
    middle: np.ndarray,
    up: np.ndarray,
    down: np.ndarray,
    gap: float,
    scales: Scales,
) -> Row:
    tolerance = scales.tolerance
    with np.errstate(invalid="ignore"):  # the verdict reports it, no warning
        largest = np.max(np.abs(up[0] - down[0])) / (2 * probe.step)
        scale = max(largest, probe.least)
        allowed = tolerance / 2 * scale
        central, kink, off = compared(derivative, middle, up, down, probe.step, allowed)
        errors, moving = off / scale, np.abs(central) > MOVING * scale
    worst, kinks = np.max(errors), np.sum(kink)
    faults = {
        "not finite": not np.isfinite(worst + gap),
        "wrong derivative": worst > tolerance,
        "reverse differs": gap > scales.reverse,
        "undecided": kinks > KINKS_ALLOWED * np.sum(moving),
        "moves nothing": largest <= tolerance * probe.least,
    }
    verdict = next((fault for fault, is_so in faults.items() if is_so), "ok")
    shown = np.abs(central) if worst <= tolerance else errors
    at = np.unravel_index(np.argmax(shown), shown.shape)  # the first NaN, if any
    row, column = map(int, at)
    values = float(derivative[at]), float(central[at])
    counts = float(worst), gap, int(kinks)
    return Row(probe.name, *values, (row, column), probe.step, *counts, verdict)


def _mode_gap(gradient: np.ndarray, probe: Probe, pushed: np.ndarray) -> float:
    """Return the relative distance of <gradient, direction> from the sum of the weighted
    derivative."""
    moving = probe.direction != 0  # (a NaN elsewhere belongs to another row)
    pulled = gradient[moving] @ probe.direction[moving].astype(float)
    scale = max(np.sum(np.abs(pushed)), probe.least * sum(pushed.shape))
    with np.errstate(invalid="ignore"):
        return float(np.abs(pulled - np.sum(pushed)) / scale)


def _check_image(image: Any, camera: Camera) -> None:
    shape, dtype = getattr(image, "shape", None), getattr(image, "dtype", np.dtype(object))
    if shape != (camera.H, camera.W) or not jnp.issubdtype(dtype, jnp.floating):
        got = type(image).__name__ if shape is None else f"{dtype} of shape {shape}"
        raise ValueError(
            "`image`: expected a function of (camera, scene) that returns floats of shape (H, W) ="
            f" ({camera.H}, {camera.W}), got {got}"
        )


def _check(camera: Camera, scene: Scene, tolerance: float | None, directions: int) -> None:
    check_view(camera, scene)
    for name, value in (("camera", camera), ("scene", scene)):
        if not is_concrete(value):
            raise ValueError(f"`{name}`: expected values, got traced ones; call it outside of jit")
    if tolerance is not None:
        check_positive("tolerance", tolerance)
    as_count("directions", directions)


def _line(row: Row) -> str:
    pixel = "{},{}".format(*row.pixel)
    values = f"{row.parameter:17} {row.derivative:12.6g} {row.difference:12.6g} {pixel:>9}"
    errors = f"{row.step:6.0e} {row.error:6.0e} {row.reverse:8.0e} {row.kinks:6}"
    return f"{values} {errors}  {row.verdict}"


def _summary(certificate: Certificate) -> str:
    rows = certificate.rows
    wrong = [row.parameter for row in rows if row.verdict not in RIGHT]
    if wrong and all(row.verdict in ("undecided", *RIGHT) for row in rows):
        return f"UNDECIDED: at a kink in {', '.join(wrong)}; move the camera a little"
    if wrong:
        return f"FAILED: {len(wrong)} of {len(rows)} derivatives ({', '.join(wrong)})"
    if not certificate.passed:
        return "FAILED: nothing moves the image (out of the frame, or fills it)"
    return f"passed: {len(rows)} derivatives, forward and reverse"
