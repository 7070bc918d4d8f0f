"""Are the derivatives of exact coverage right, pixel by pixel? A set of images to hold others to.

    python experiments/reference/make.py OUT [--scale N] [scene ...]

Writes OUT/NAME.npz for each of 20 scenes: camera, scene, coverage, and its derivative by each
parameter, in float64; each was held against central differences of polygon unions (`_oracle.py`).
`reference.json` has the worst differences, `reference.jpg` all of it as pictures; README.md says
how to compare a renderer of your own. `--scale` makes images this many times as large.
"""

import argparse
import json
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from _oracle import coverage
from _scenes import PARAMETERS, View, views

import pinhole_jax as pj
from pinhole_jax.testing.differences import STEPS, Scales, compared

SCHEMA = "pinhole_jax.reference/1"
#: How far coverage (px^2) and a derivative (in parts of its image's largest) may be off.
#: Where a sphere or a lens bends, polygons are no curves; under a lens neither is the library's.
ALLOWED = {"straight": (1e-12, 1e-6), "spheres": (1e-9, 2e-6), "bent": (1e-6, 2e-5)}
#: A renderer's straight parts stray from what the lens shows by no more than this, px.
BENT_PX = 1e-6


class Made(NamedTuple):
    """One scene's images and how far they are from the oracle's.

    - `derivatives`: (K, H, W), in the order of the view's parameters.
    - `coverage_error`: the worst pixel's, px^2. `errors`: by parameter, the worst pixel's in parts
      of the derivative image's largest. `kinks`: pixels where differences do not settle.
    """

    coverage: np.ndarray
    derivatives: np.ndarray
    coverage_error: float
    errors: dict[str, float]
    kinks: int


def camera_of(view: View) -> pj.Camera:
    """Return the view's camera; its lens is never None, so that the principal point can move."""
    models = {"none": lambda: None, "brown": pj.BrownConrady, "fisheye": pj.Fisheye}
    distortion = models[view.model](*view.coefficients)
    lens = pj.Lens(view.principal_point, view.aspect, distortion)
    return pj.Camera(view.e, view.p, view.u, view.phi, view.d, view.W, view.H, lens)


def scene_of(view: View) -> pj.Scene:
    return pj.Scene(
        mesh=pj.Mesh(view.vertices, view.faces) if len(view.faces) else None,
        spheres=pj.Spheres(view.centers, view.radii) if len(view.radii) else None,
    )


def velocity(view: View, camera: pj.Camera, name: str) -> Any:
    """Return the camera's velocity by a parameter, leaf by leaf."""
    still = jax.tree.map(jnp.zeros_like, eqx.filter(camera, eqx.is_inexact_array))
    if name == "d_film":  # phi = 2 atan(h / 2d)
        turn = jnp.asarray(-np.sin(view.phi) / view.d)
        return eqx.tree_at(lambda c: (c.d, c.phi), still, (jnp.ones(()), turn))
    if name in ("phi", "d"):
        return eqx.tree_at(lambda c: getattr(c, name), still, jnp.ones(()))
    if name == "k1":
        return eqx.tree_at(lambda c: c.lens.distortion.k1, still, jnp.ones(()))
    whole, _, axis = name.rpartition("_")
    lens = whole == "principal_point"
    where: Callable = lambda c: getattr(c.lens if lens else c, whole)
    unit = np.eye(2 if lens else 3)["xyz".index(axis)]
    return eqx.tree_at(where, still, jnp.asarray(unit))


@eqx.filter_jit
def pushed(camera: pj.Camera, scene: pj.Scene, moves: Any) -> tuple[Any, Any]:
    """Return coverage, and how it changes as the camera moves."""
    moving, still = eqx.partition(camera, eqx.is_inexact_array)
    image = lambda m: pj.silhouette(eqx.combine(m, still), scene)
    return jax.jvp(image, (moving,), (moves,))


def images(view: View) -> tuple[np.ndarray, np.ndarray]:
    """Return coverage (H, W) and its derivatives (K, H, W), as the library has them."""
    camera, scene = camera_of(view), scene_of(view)
    found = [pushed(camera, scene, velocity(view, camera, name)) for name in view.parameters]
    return np.asarray(found[0][0]), np.stack([np.asarray(push) for _, push in found])


def differences(view: View, name: str, scales: Scales, edge: np.ndarray) -> tuple:
    """Return the polygons' images on either side, for steps of some 1e-5 px, and the first step."""
    step = 2.0 ** np.round(np.log2(scales.step_px * view.step(name)))
    up, down = (
        np.stack([coverage(view.moved(name, sign * step * k), edge) for k in STEPS])
        for sign in (1, -1)
    )
    return up, down, step


def made(view: View) -> Made:
    """Return the view's images, held against the oracle's."""
    image, derivatives = images(view)
    expected = coverage(view)
    edge = (expected > 0) & (expected < 1) | (image > 0) & (image < 1)
    edge = scipy.ndimage.binary_dilation(edge, np.ones((3, 3)))
    scales = Scales.for_precision(np.dtype(float), np.dtype(float), max(image.shape), None)
    errors, kinks = {}, np.zeros(image.shape, bool)
    for name, derivative in zip(view.parameters, derivatives, strict=True):
        up, down, step = differences(view, name, scales, edge)
        largest = np.max(np.abs(up[0] - down[0])) / (2 * step)
        scale = max(largest, 1e-3 / view.step(name))  # what moves nothing has rounding alone
        middle = np.where(edge, expected, 0)
        _, kink, off = compared(derivative, middle, up, down, step, 5e-7 * scale)
        errors[name] = float(np.max(off) / scale)
        kinks |= kink
    worst = float(np.max(np.abs(image - expected)))
    return Made(image, derivatives, worst, errors, int(np.sum(kinks)))


def save(path: Path, name: str, view: View, found: Made) -> None:
    """Write a scene's file: all that another renderer needs, in its own words."""
    fx, fy = view.focal_px
    right, up, forward = view.axes
    R = np.stack([right, -up, forward])
    cx, cy = view.principal_point
    np.savez_compressed(
        path,
        schema=SCHEMA,
        name=name,
        about=view.about,
        **{key: getattr(view, key) for key in ("e", "p", "u", "phi", "d", "W", "H", "aspect")},
        principal_point=view.principal_point,
        distortion=view.model,
        coefficients=view.coefficients,
        K=np.array([[fx, 0, cx], [0, fy, view.H - cy], [0, 0, 1]]),
        R=R,
        t=-R @ view.e,
        vertices=view.vertices,
        faces=view.faces.astype(np.int32),
        centers=view.centers,
        radii=view.radii,
        coverage=found.coverage,
        parameters=np.array(view.parameters),
        derivatives=found.derivatives,
        coverage_error=found.coverage_error,
        derivative_errors=np.array([found.errors[name] for name in view.parameters]),
    )


def sheet(made: dict[str, tuple[View, Made]], path: Path) -> None:
    """Draw two scenes to a row: coverage, then derivatives, red where it grows."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    shown = ("e_x", "e_z", "p_x", "u_x", "phi", "principal_point_y")
    rows, wide = -(-len(made) // 2), len(shown) + 1
    figure, panels = plt.subplots(
        rows, 2 * wide, figsize=(2 * wide * 1.1, rows * 0.98), dpi=105, squeeze=False
    )
    for panel in panels.ravel():
        panel.axis("off")
    for number, (name, (view, found)) in enumerate(made.items()):
        row, half = number % rows, number // rows * wide
        first, *others = panels[row, half : half + wide]
        first.imshow(found.coverage, cmap="gray", vmin=0, vmax=1)
        first.set_title(name, fontsize=7, pad=2)
        for panel, parameter in zip(others, shown, strict=True):
            image = found.derivatives[view.parameters.index(parameter)]
            most = np.max(np.abs(image)) or 1.0
            panel.imshow(image, cmap="RdBu_r", vmin=-most, vmax=most)
            panel.set_title(parameter.replace("principal_point", "centre"), fontsize=6, pad=2)
    figure.subplots_adjust(0.005, 0.005, 0.995, 0.975, 0.06, 0.16)
    figure.savefig(path, pil_kwargs={"quality": 84})


def row_of(view: View, found: Made) -> dict:
    coverage_allowed, allowed = limits(view)
    worst = max(found.errors, key=lambda name: found.errors[name])
    good = found.coverage_error <= coverage_allowed and found.errors[worst] <= allowed
    return {
        "holds": good,
        "coverage, px^2": found.coverage_error,
        "derivative, of its largest": found.errors[worst],
        "worst parameter": worst,
        "kinks": found.kinks,
        "boundary pixels": int(np.sum((found.coverage > 0) & (found.coverage < 1))),
    }


def limits(view: View) -> tuple[float, float]:
    """Return the errors allowed of coverage and of a derivative."""
    if view.model != "none":
        return ALLOWED["bent"]
    return ALLOWED["spheres" if len(view.radii) else "straight"]


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("out", nargs="?", default="out", type=Path)
    parser.add_argument("scenes", nargs="*", metavar="scene", help=", ".join(views()))
    parser.add_argument("--scale", type=int, default=1)
    given = parser.parse_args()
    from pinhole_jax._silhouette import contour

    pj.cache()
    contour.STRAY_PX = BENT_PX
    given.out.mkdir(parents=True, exist_ok=True)
    done, table = {}, {}
    for name in given.scenes or views():
        view = views()[name].scaled(given.scale)
        found = made(view)
        done[name] = view, found
        table[name] = row_of(view, found)
        save(given.out / f"{name}.npz", name, view, found)
        print(name, json.dumps(table[name]), flush=True)
    report(given.out, table)
    sheet(done, given.out / "reference.jpg")


def report(out: Path, table: dict) -> None:
    good = sum(row["holds"] for row in table.values())
    worst = max(row["derivative, of its largest"] for row in table.values())
    print(f"{good} of {len(table)} scenes hold; the worst derivative is {worst:.1e} off.")
    answer = {
        "scenes": table,
        "parameters": PARAMETERS,
        "versions": {"jax": jax.__version__, "python": platform.python_version()},
    }
    (out / "reference.json").write_text(json.dumps(answer, indent=1) + "\n")


if __name__ == "__main__":
    main()
