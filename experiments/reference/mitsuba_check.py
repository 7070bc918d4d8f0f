"""Do Mitsuba's and PyTorch3D's images agree with exact coverage and its derivative?

    python experiments/reference/mitsuba_check.py OUT [--data MITSUBA_DATA] [--pytorch3d CHECKOUT]

1. Mitsuba's own derivatives (`prb_projective`) of an emitter on black, a pure silhouette: the
   scenes of its tests `test_ad_integrators`, a rectangle and a sphere that move or grow. Here the
   camera moves instead, so what is held against them are the derivatives by `e` and `p`.
2. Its test of a camera that moves: differences as its generator of references takes them.
3. With `--data` (a checkout of the repository mitsuba-data): the derivative images stored there, of
   the same scenes with a Gaussian filter (files in its folder of integrators' tests).
4. PyTorch3D's stored render of a cow, of which its tests say the camera: which pixels it covers
   (`--cow`; a folder with cow.obj, cow.png, camera.json).
5. With `--pytorch3d`: the soft silhouette of a sphere that its tests store.

Asked: correlation 0.999, sums within 1 %. What is not there is skipped aloud. Needs `mitsuba`, and
LLVM for it (of LLVM 15 Mitsuba 3.7 makes use, 3.9 cannot).
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from compare import CORRELATION, SHARE, Comparison, compared

import pinhole_jax as pj

#: The cow, beside this repository.
COW = Path(__file__).parents[3] / "shared" / "data" / "renders" / "pytorch3d_cow"
#: Pixels a side, samples a pixel, and in how many rounds.
SIZE, SAMPLES, ROUNDS = 128, 1024, 4
#: Mitsuba's Gaussian filter: standard deviation and radius, px; and how fine it is sampled here.
SIGMA, RADIUS, FINE = 0.5, 2, 16
EYE, FAR = [0.0, 0.0, 4.0], 4.0


class Test(NamedTuple):
    """One of Mitsuba's tests: an emitter on black.

    - `file`: its mesh in mitsuba-data. `shift`: where the mesh is put, after a turn about y.
    - `grows`: vertices times (1 + theta) about the origin, else they move along x.
    """

    file: str
    shift: tuple[float, float, float]
    turn: bool
    grows: bool


TESTS = {
    "translate_rectangle_emitter_on_black": Test("rectangle.obj", (1.25, 0, 0), False, False),
    "translate_sphere_emitter_on_black": Test("sphere.obj", (1.25, 0, 0), True, False),
    "scale_sphere_emitter_on_black": Test("sphere.obj", (0, 0, 0), False, True),
}


def own_mesh(file: str) -> pj.Mesh:
    """Return a mesh like Mitsuba's of this name: the square from -1 to 1, or a unit sphere."""
    if file == "rectangle.obj":
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
        return pj.Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    import trimesh

    sphere = trimesh.creation.icosphere(4)
    return pj.Mesh(np.asarray(sphere.vertices), np.asarray(sphere.faces))


def placed(mesh: pj.Mesh, test: Test) -> pj.Mesh:
    vertices = np.asarray(mesh.vertices, float)
    if test.turn:  # 180 degrees about y
        vertices = vertices * [-1, 1, -1]
    return pj.Mesh(vertices + np.array(test.shift, float), mesh.faces)


def camera_of(fov: float, size: int) -> pj.Camera:
    return pj.Camera(EYE, [0.0, 0, 0], [0.0, 1, 0], np.deg2rad(fov), 1.0, size, size)


@eqx.filter_jit
def pushed(camera: pj.Camera, scene: pj.Scene, e: Any, p: Any) -> tuple[Any, Any]:
    """Return coverage, and its derivative as eye and view point move."""
    view = lambda e, p: eqx.tree_at(lambda c: (c.e, c.p), camera, (e, p))
    return jax.jvp(lambda e, p: pj.silhouette(view(e, p), scene), (camera.e, camera.p), (e, p))


def derivative(mesh: pj.Mesh, fov: float, size: int, test: Test) -> np.ndarray:
    """Return the derivative by theta: the camera does what the mesh does, the other way."""
    camera = camera_of(fov, size)
    along = jnp.array([1.0, 0, 0])
    e, p = (-camera.e, -camera.p) if test.grows else (-along, -along)
    return np.asarray(pushed(camera, pj.Scene(mesh=mesh), e, p)[1])


def filtered(fine: np.ndarray) -> np.ndarray:
    """Return what Mitsuba's Gaussian filter makes of an image FINE times as large each way.

    `exp(-x^2 / 2 sigma^2)` less its value at the radius, each way; weights sum to 1 (samples are
    drawn beyond the border too, so the image has RADIUS px more on each side).
    """
    n = RADIUS * FINE
    x = (np.arange(2 * n) + 0.5 - n) / FINE
    weight = np.exp(-(x**2) / (2 * SIGMA**2)) - np.exp(-(RADIUS**2) / (2 * SIGMA**2))
    weight /= weight.sum()
    shown = fine.shape[0] // FINE - 2 * RADIUS
    # Pixel i is centred at (i + RADIUS + 1/2) FINE, counted from the border's end.
    table = np.zeros((shown, fine.shape[0]))
    for i in range(shown):
        start = (2 * i + 2 * RADIUS + 1) * FINE // 2 - n
        table[i, start : start + 2 * n] = weight
    return table @ fine @ table.T


def with_border(fov: float) -> tuple[float, int]:
    """Return field of view and size (fine px) of the picture with RADIUS px more on each side."""
    wide = SIZE + 2 * RADIUS
    return float(np.rad2deg(2 * np.arctan(np.tan(np.deg2rad(fov) / 2) * wide / SIZE))), wide * FINE


def through_gaussian(mesh: pj.Mesh, fov: float, test: Test) -> np.ndarray:
    """Return the derivative as the stored images have it: through a Gaussian filter."""
    wide, size = with_border(fov)
    return filtered(derivative(mesh, wide, size, test))


def mitsuba_scene(mi: Any, mesh: pj.Mesh, size: int, **more: Any) -> Any:
    """Return Mitsuba's scene: a mesh that shines (or `shape`, `light`) before its test's camera."""
    with tempfile.NamedTemporaryFile("w", suffix=".obj", delete=False) as file:
        lines = [f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in np.asarray(mesh.vertices)]
        lines += [f"f {a} {b} {c}\n" for a, b, c in np.asarray(mesh.faces) + 1]
        file.writelines(lines)
    radiance = {"type": "rgb", "value": [1.0, 1.0, 1.0]}
    shape = {"type": "obj", "filename": file.name, "face_normals": True}
    film = {
        "type": "hdrfilm",
        "width": size,
        "height": size,
        "rfilter": more.pop("rfilter", {"type": "box"}),
        "sample_border": True,
        "component_format": "float32",
    }
    look = mi.ScalarTransform4f().look_at(origin=EYE, target=[0, 0, 0], up=[0, 1, 0])
    emitter = {} if more else {"emitter": {"type": "area", "radiance": radiance}}
    scene = {
        "type": "scene",
        "shape": {**shape, **emitter},
        "sensor": {"type": "perspective", "to_world": look, "film": film},
        **more,
    }
    loaded = mi.load_dict(scene)
    Path(file.name).unlink()
    return loaded


def fov_of(mi: Any, scene: Any) -> float:
    return float(np.array(mi.traverse(scene)["sensor.x_fov"]).ravel()[0])


def mitsuba_derivative(mi: Any, scene: Any, test: Test) -> np.ndarray:
    """Return Mitsuba's forward derivative, as its test takes it."""
    import drjit as dr

    key = "shape.vertex_positions"
    params = mi.traverse(scene)
    params.keep([key])
    start = mi.Vector3f(dr.detach(dr.unravel(mi.Vector3f, params[key])))
    integrator = mi.load_dict({"type": "prb_projective", "max_depth": 1, "sppc": 0, "sppi": 0})
    integrator.proj_seed_spp = 4096
    total = np.zeros(())
    for seed in range(ROUNDS):  # a forward pass uses up the graph: it is built anew for each
        theta = mi.Float(0.0)
        dr.enable_grad(theta)
        moved = start * (1 + theta) if test.grows else start + mi.Vector3f(theta, 0, 0)
        params[key] = dr.ravel(moved)
        params.update()
        dr.eval()
        dr.forward(theta, dr.ADFlag.ClearEdges)
        image = integrator.render_forward(scene, params=theta, seed=seed, spp=SAMPLES // ROUNDS)
        total = total + np.array(image)[..., 0].astype(float)
    return total / ROUNDS


def by_mitsuba(mi: Any) -> dict[str, Comparison]:
    """Compare derivatives that Mitsuba takes here, with a box filter."""
    found = {}
    for name, test in TESTS.items():
        mesh = placed(own_mesh(test.file), test)
        scene = mitsuba_scene(mi, mesh, SIZE)
        ours = derivative(mesh, fov_of(mi, scene), SIZE, test)
        found[name] = compared(mitsuba_derivative(mi, scene, test), ours)
    return found


def moving_camera(mi: Any, samples: int = 16384, step: float = 0.02) -> dict[str, Comparison]:
    """Compare Mitsuba's test of a camera that moves to its left: its generator's differences.

    A grey sphere in white light: the picture is 1 - coverage / 2. The generator sets theta to
    -h/2, then to h/2, and the test's `update` composes each with where the camera is: it comes back
    to where it began, and the difference over h is one over h/2. "as meant" puts it back first.
    """
    size, found = 16, {}
    blur = {"type": "gaussian", "stddev": SIGMA}
    mesh, light = own_mesh("sphere.obj"), {"type": "constant"}
    scene = mitsuba_scene(mi, mesh, size, rfilter=blur, light=light)
    fov = fov_of(mi, scene)
    wide = float(np.rad2deg(2 * np.arctan(np.tan(np.deg2rad(fov) / 2) * (size + 4) / size)))
    left = -jnp.array([1.0, 0, 0])
    view = camera_of(wide, (size + 2 * RADIUS) * FINE)
    ours = -0.5 * filtered(np.asarray(pushed(view, pj.Scene(mesh=mesh), left, left)[1]))
    integrator = mi.load_dict({"type": "path", "max_depth": 2})
    for name, back in (("camera, as the generator does it", 0.0), ("camera, as meant", step / 2)):
        params, images = mi.traverse(scene), []
        start = mi.Transform4f(params["sensor.to_world"])
        for theta in (-step / 2, step / 2 + back):
            moved = params["sensor.to_world"] @ mi.Transform4f().translate([theta, 0, 0])
            params["sensor.to_world"] = moved
            params.update()
            images.append(np.array(integrator.render(scene, seed=0, spp=samples))[..., 0])
        found[name] = compared((images[1] - images[0]).astype(float) / step, ours)
        params["sensor.to_world"] = start
        params.update()
    return found


def stored(mi: Any, data: Path) -> dict[str, Comparison]:
    """Compare the derivative images that mitsuba-data holds; say which are not there."""
    found = {}
    for name, test in TESTS.items():
        path = data / "tests" / "integrators" / f"test_{name}_image_fwd_ref.exr"
        mesh = data / "common" / "meshes" / test.file
        missing = [str(p) for p in (path, mesh) if not p.exists()]
        if missing:
            print(f"{name}: skipped, there is no {' and no '.join(missing)}")
            continue
        placed_mesh = placed(pj.load_mesh(mesh), test)
        fov = fov_of(mi, mitsuba_scene(mi, placed_mesh, SIZE))
        theirs = np.array(mi.Bitmap(str(path)))[..., 0]
        found[f"{name}, stored"] = compared(theirs, through_gaussian(placed_mesh, fov, test))
    return found


def hard_silhouette(folder: Path) -> dict[str, Comparison]:
    """Compare PyTorch3D's stored render of a cow: the pixels that are not white.

    It asks one place in a pixel, its centre; here a pixel is covered by more than half or not.
    """
    if not folder.exists():
        print(f"PyTorch3D's cow: skipped, there is no {folder}")
        return {}
    given = json.loads((folder / "camera.json").read_text())
    theirs = pj.io.load_image(folder / "cow.png")[..., :3].min(axis=2) < 255
    H, W = theirs.shape
    camera = pj.formats.from_opencv(
        given["K"], given["R"], given["t"], W, H, pixel_centres="integer"
    )
    scene = pj.Scene(mesh=pj.load_mesh(folder / "cow.obj"))
    coverage = np.asarray(pj.silhouette(camera, scene))
    share = theirs.sum() / coverage.sum() - 1
    print(
        f"PyTorch3D's cow: {np.sum(theirs != (coverage > 0.5))} of {theirs.size} pixels differ;"
        f" its area is {share:+.2%} of the exact one off"
    )
    halves = (coverage > 0.5).astype(float)
    return {"PyTorch3D, a cow": compared(theirs.astype(float), halves)}


def soft_silhouette(checkout: Path) -> dict[str, Comparison]:
    """Compare PyTorch3D's stored silhouette of a unit sphere, 2.7 units away, 60 degrees.

    It is blurred by some pixels by design: a correlation says how like it is, sums do not agree.
    """
    path = checkout / "tests" / "data" / "test_FoVPerspectiveCameras_silhouette.png"
    if not path.exists():
        print(f"PyTorch3D: skipped, there is no {path}")
        return {}
    theirs = np.asarray(pj.io.load_image(path), float) / 255
    scene = pj.Scene(spheres=pj.Spheres([[0.0, 0, 0]], [1.0]))
    H, W = theirs.shape[:2]
    camera = pj.Camera([0.0, 0, 2.7], [0.0, 0, 0], [0.0, 1, 0], np.deg2rad(60), 1.0, W, H)
    ours = np.asarray(pj.silhouette(camera, scene))
    return {"PyTorch3D, a soft sphere": compared(theirs.reshape(H, W, -1)[..., 0], ours)}


def mitsuba() -> Any:
    """Return Mitsuba with derivatives on the CPU, None (said aloud) where it is not there."""
    try:
        import mitsuba as mi
    except ImportError:
        print("Mitsuba: skipped, `pip install mitsuba` (3.7 with LLVM 15)")
        return None
    if "llvm_ad_rgb" not in mi.variants():
        print("Mitsuba: skipped, this build has no variant llvm_ad_rgb")
        return None
    mi.set_variant("llvm_ad_rgb")
    return mi


def line(name: str, c: Comparison) -> str:
    numbers = f"correlation {c.correlation:.5f}  factor {c.factor:.4f}"
    sums = f"sums {c.sums[0]:.5g}, here {c.sums[1]:.5g} ({c.apart:.2%} of all)"
    return f"{name:<46}{numbers}  {sums}  {'agrees' if c.agrees else 'DIFFERS ' + c.suspicion}"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("out", nargs="?", default="out", type=Path)
    parser.add_argument("--data", type=Path, help="a checkout of mitsuba-renderer/mitsuba-data")
    parser.add_argument("--pytorch3d", type=Path, help="a checkout of facebookresearch/pytorch3d")
    parser.add_argument("--cow", type=Path, default=COW, help="PyTorch3D's cow and its camera")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    found = {}
    mi = mitsuba()
    if mi is not None:
        found |= by_mitsuba(mi) | moving_camera(mi)
        if given.data is not None:
            found |= stored(mi, given.data)
        else:
            print("stored images: skipped, no --data FOLDER with tests/integrators/*_fwd_ref.exr")
    found |= hard_silhouette(given.cow)
    if given.pytorch3d is not None:
        found |= soft_silhouette(given.pytorch3d)
    else:
        print("PyTorch3D: skipped, no --pytorch3d FOLDER with tests/data/*_silhouette.png")
    if not found:
        sys.exit("nothing was compared")
    print(f"asked: correlation {CORRELATION}, sums within {SHARE:.0%}")
    for name, comparison in found.items():
        print(line(name, comparison))
    answer = {name: {**c._asdict(), "agrees": c.agrees} for name, c in found.items()}
    if mi is not None:
        answer["versions"] = {"mitsuba": mi.__version__, "samples a pixel": SAMPLES}
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "mitsuba_check.json").write_text(json.dumps(answer, indent=1) + "\n")


if __name__ == "__main__":
    main()
