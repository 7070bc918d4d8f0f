"""How long does a newcomer wait, and for what?

    python experiments/startup.py first-calls | first-use | hotspots [OUT]

- `first-calls`: each first call in a process of its own with nothing kept: traced and lowered,
  compiled, and run. Imports are not counted. `--against FOLDER`, another checkout, takes turns.
- `first-use` (`--all`: the slow steps, too): builds the source distribution and from that the
  wheel, installs both into a fresh environment (`--borrow`: what they depend on is this one's, with
  nothing downloaded), and plays what newcomers do with files of their own: help, typos, masks as
  data sets have them, a known K, a crop, an interrupt, a report, files of other programs. Each
  step's time and words are in the table.
- `hotspots`: where a fit's time goes by Python's profiler; `import pinhole_jax`, and the command
  `fit` on a mesh of 5k faces with an empty and a filled cache of compiled programs.
"""

import cProfile
import json
import os
import pstats
import re
import signal
import subprocess
import sys
import sysconfig
import tempfile
import time
import venv
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from _common import Options, apart, camera_at, main, mask_of, show, start_from

import pinhole_jax as pj

ROOT = Path(__file__).parents[1]
#: What names a mask's file.
MASK = "PINHOLE_JAX_FIRST_MASK"


# First calls


def camera() -> pj.Camera:
    return camera_at(np.eye(3), np.array([0.1, 0.05]), 5.0, 0.6)


def scene(**more) -> pj.Scene:
    return pj.Scene(mesh=pj.shapes.bumpy(4), **more)


def loss(camera: pj.Camera, scene: pj.Scene):
    return jnp.sum(pj.silhouette(camera, scene) ** 2)


def distorted() -> tuple[pj.Camera, pj.Scene]:
    c, lens = camera(), pj.Lens([128.0, 128.0], 1.0, pj.BrownConrady(0.1, 0.0, 0.0, 0.0, 0.0))
    centers = np.array([[0.9, 0, 0], [0, 1.0, 0.2]], np.float32)
    spheres = pj.Spheres(centers, np.float32([0.3, 0.2]))
    return pj.Camera(c.e, c.p, c.u, c.phi, c.d, c.W, c.H, lens), scene(spheres=spheres)


def by_vertices(camera: pj.Camera, vertices):
    with jax.ensure_compile_time_eval():
        faces = np.asarray(scene().mesh.faces)
    return loss(camera, pj.Scene(mesh=pj.Mesh(vertices, faces)))


def to_fit() -> tuple[pj.Scene, np.ndarray, pj.Camera]:
    start = start_from(camera(), 5, 0.02, np.random.default_rng(0))
    return scene(), np.load(os.environ[MASK]), start


jitted = jax.jit
#: Functions and what makes their arguments; those that `jit` makes tell what compiling takes.
CALLS: dict[str, tuple[Callable, Callable[[], tuple]]] = {
    "mask": (jitted(pj.silhouette), lambda: (camera(), scene())),
    "mask_without_overlaps": (
        jitted(lambda c, s: pj.silhouette(c, s, overlaps=False)),
        lambda: (camera(), scene()),
    ),
    "depth": (jitted(pj.depth), lambda: (camera(), scene())),
    "gradient_of_camera": (jitted(jax.grad(loss)), lambda: (camera(), scene())),
    "gradient_of_vertices": (
        jitted(jax.grad(by_vertices, (0, 1))),
        lambda: (camera(), scene().mesh.vertices),
    ),
    "gradient_with_spheres_and_distortion": (jitted(jax.grad(loss)), distorted),
    "fit": (lambda *given: pj.fit_camera(*given).camera, to_fit),
}


def first(name: str) -> dict:
    """Return the seconds of a first call in this process, by the clock and of the processor."""
    function, arguments = CALLS[name]
    given, clock, used = arguments(), [time.perf_counter()], time.process_time()
    if name != "fit":
        lowered = function.lower(*given)
        clock.append(time.perf_counter())
        function = lowered.compile()
        clock.append(time.perf_counter())
    jax.block_until_ready(jax.tree.leaves(function(*given)))
    parts = np.diff([*clock, time.perf_counter()]).tolist()
    names = ("traced", "compiled", "run") if len(parts) > 1 else ("run",)
    whole = {"s": sum(parts), "processor s": time.process_time() - used}
    return {**whole, **dict(zip(names, parts, strict=True))}


def first_calls(asked: Options) -> dict:
    drawn, rows = asked.out.resolve() / "first_mask.npy", []
    np.save(drawn, mask_of(camera(), scene()))
    for name in asked.names(CALLS):
        turns = [
            apart(__file__, "--call", name, **{MASK: str(drawn)}) for _ in range(asked.number(3))
        ]
        rows.append(
            {"call": name, **{k: float(np.median([t[k] for t in turns])) for k in turns[0]}}
        )
        print(rows[-1], flush=True)
    drawn.unlink()
    show(rows)
    said = ", ".join(f"{row['call'].replace('_', ' ')} {row['s']:.1f}" for row in rows)
    return {"verdict": f"Seconds: {said}", "table": rows}


# A newcomer's first hour

#: Help and words about a typo are to come within this many seconds of the processor.
AT_ONCE = 0.3

WHERE = "import sysconfig; print(sysconfig.get_path('purelib'))"

#: Makes the files that a newcomer has: a mesh, masks, a camera to start from, an OpenCV file.
FILES = """
import numpy as np
import trimesh
from PIL import Image
from skimage.draw import polygon
import pinhole_jax as pj

mesh = pj.shapes.bumpy(3)
with open("part.obj", "w") as file:
    for x, y, z in np.asarray(mesh.vertices).tolist():
        file.write(f"v {x} {y} {z}\\n")
    for a, b, c in (np.asarray(mesh.faces) + 1).tolist():
        file.write(f"f {a} {b} {c}\\n")
camera = pj.Camera([0.3, 1, 5], [0.1, 0, 0], [0.2, 1, 0.1], 0.6, W=96, H=80)
film = np.asarray(pj.project(camera, mesh.vertices))
mask = np.zeros((80, 96), bool)
for face in film[np.asarray(mesh.faces)]:
    mask[polygon(79.5 - face[:, 1], face[:, 0] - 0.5, mask.shape)] = True
Image.fromarray(mask).save("mask.png")
Image.fromarray(np.uint8(mask)).save("ones.png")
Image.fromarray(np.uint8(7 * mask)).save("sevens.png")
Image.fromarray(~mask).save("negative.png")
Image.fromarray(np.uint8(255 * mask)).save("mask.jpg", quality=85)
Image.fromarray(mask[8:72, 16:80]).save("cropped.png")
cut = mask.copy()
cut[:, : np.flatnonzero(mask.any(axis=0))[0] + 6] = False
Image.fromarray(cut).save("cut.png")
start = camera.replace(e=[0.5, 1.2, 5])
pj.io.save_camera("start.json", start)
pj.formats.write("start.yaml", {"camera": start})
data = pj.io.camera_to_dict(start)
data["phi_degrees"] = 40
import json
json.dump(data, open("edited.json", "w"))
dirty = mask.copy()
dirty[4, 4:6] = dirty[70, 90] = dirty[75, 5] = True
dirty[40, 48] = dirty[41, 50] = False
Image.fromarray(dirty).save("network.png")
open("ros.yaml", "w").write(
    "image_width: 96\\nimage_height: 80\\ndistortion_model: plumb_bob\\n"
    "camera_matrix: {rows: 3, cols: 3, data: [129.3, 0, 47.5, 0, 129.3, 39.5, 0, 0, 1]}\\n"
    "distortion_coefficients: {rows: 1, cols: 5, data: [0.0, 0, 0, 0, 0]}\\n"
)
json.dump({"intrinsics": [[129.3, 0, 47.5], [0, 129.3, 39.5], [0, 0, 1]]}, open("net.json", "w"))
open("cameras.txt", "w").write("1 PINHOLE 96 80 129.3 129.3 48 40\\n")
open("part.step", "w").write("ISO-10303-21;")
open("arm.urdf", "w").write(
    '<robot name="arm"><link name="base"/><link name="arm"><visual><geometry>'
    '<box size="1 1 1"/></geometry></visual></link><joint name="turn" type="revolute">'
    '<parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>'
    '<limit lower="-3" upper="3" effort="1" velocity="1"/></joint></robot>'
)
open("joints.csv", "w").write("turn\\n69\\n")
open("set.csv", "w").write(
    "id,mesh,mask,fov\\n" + "".join(f"frame {k},part.obj,mask.png,34.4\\n" for k in range(2))
)
"""

#: A reader that has enough.
PIPE = """
import os, subprocess, sys
reader, writer = os.pipe()
os.close(reader)
command = [sys.executable, "-m", "pinhole_jax", "fit", "--help"]
done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE)
assert not done.stderr, done.stderr
"""

#: Wrong arguments of the library: refused at the door, with an error that names them.
DOOR = """
import numpy as np
import trimesh
import pinhole_jax as pj
scene = pj.Scene(mesh=pj.load_mesh("part.obj"))
camera = pj.io.load_camera("start.json")
for call, words in (
    (lambda: pj.silhouette(scene, camera), "expected a Camera and a Scene"),
    (lambda: pj.silhouette(camera, scene.mesh), "expected a Camera and a Scene"),
    (lambda: pj.fit_camera(scene, np.full((80, 96), 7, np.int64), camera), "`target`: expected"),
    (lambda: pj.fit_camera(scene, np.ones((80, 96)) - np.eye(80, 96), camera), "inverted"),
    (lambda: pj.project(scene, np.zeros(3)), "`camera`: expected a Camera"),
    (lambda: pj.fit_cameras(scene, [np.eye(80, 96)], camera), "in a list, got one Camera"),
    (lambda: pj.Camera([0, 0, 5], [0, 0, 0], [0, 1, 0], 0.6, 640, 480), "missing W or H"),
):
    try:
        call()
    except (TypeError, ValueError) as error:
        assert words in str(error), (words, str(error))
    else:
        raise AssertionError(f"no error with {words}")
"""

#: What a library's user does with a fit.
RESULT = """
import json
import numpy as np
import trimesh
import pinhole_jax as pj
fit = pj.io.load_fit("out/camera.json")
print(fit)
assert fit.status == "converged"
assert {row.unit for row in fit.parameters.rows} == {"deg", "world"}
pose = pj.formats.object_pose(fit, pixel_centres="integer")
assert np.all(np.isfinite(pose.std)) and pose.covariance.shape == (6, 6)
told = json.load(open("out/camera.json"))["fit"]["object_in_camera"]
np.testing.assert_allclose(told["R"], pose.R, atol=1e-5)  # read as float32
json.dumps(pj.io.fit_to_dict(fit))
"""


#: What a student of rendering does with the parts.
PARTS = """
import jax
import jax.numpy as jnp
import numpy as np
import pinhole_jax as pj
scene = pj.Scene(mesh=pj.load_mesh("part.obj"))
fit = pj.io.load_fit("out/camera.json")
mask = pj.io.load_mask("mask.png") > 127
loss = lambda camera: jnp.sum(pj.residuals(camera, scene, mask) ** 2)
rms = np.sqrt(loss(fit.camera) / mask.size)
np.testing.assert_allclose(rms, fit.rms, rtol=1e-3)
assert str(jax.grad(loss)(fit.camera)).startswith("Gradient")
K, R, t = pj.formats.to_opencv(fit.camera, pixel_centres="integer")
np.testing.assert_allclose(fit.camera.K, K, rtol=1e-5)
np.testing.assert_allclose(fit.camera.R, R, atol=1e-5)
pj.fit_camera(scene, mask, fit.camera, progress=True)
"""

#: What a batch and a report leave.
PAGES = """
import csv
rows = [*csv.DictReader(open("table.csv"))]
assert [row["status"] for row in rows] == ["converged"] * 2
assert all(float(row["sigma_rotation_b1_rad"]) > 0 and row["tx"] for row in rows)
page = open("page.html").read()
assert "one-sigma band (yellow): one sigma is" in page
"""

#: A photo that says nothing of its field of view, on the studio's bench.
BENCH = """
from pathlib import Path
import pinhole_jax as pj
from pinhole_jax._studio.bench import Bench
from pinhole_jax._studio.session import new_session
from pinhole_jax._studio.workpiece import workpiece_of
from pinhole_jax.batch.inputs import Start
workpiece = workpiece_of("part.obj", "mask.png")
bench = Bench(new_session(workpiece, Start()), Path("bench"))
bench.take_mask(pj.io.load_mask("mask.png"))
assert bench.hello()["free"] == ["pose", "phi"]
fit = bench.act("fit", {"free": ["pose"], "search": True}, print)["fit"]
assert fit["status"] != "converged", fit["status"]
print(fit["notes"][0])
"""


class Step:
    """Runs commands of an environment in a folder, checks them, and prints what each took."""

    def __init__(self, python: Path, folder: Path):
        self.python, self.folder, self.rows = python, folder, []
        self.environment = {**os.environ, "XDG_CACHE_HOME": str(folder / "cache")}
        for name in ("PYTHONPATH", "JAX_COMPILATION_CACHE_DIR"):
            self.environment.pop(name, None)

    def command(self, title: str, words: Sequence[str], status: int | None, *told: str) -> float:
        """Run `pinhole-jax`; its exit status (None: 0 or 1) and what it says are to be these."""
        return self._run(title, ["-m", "pinhole_jax", *words], status, told)

    def script(self, title: str, code: str, *told: str) -> float:
        return self._run(title, ["-c", code], 0, told)

    def _run(
        self, title: str, words: Sequence[str], status: int | None, told: Sequence[str]
    ) -> float:
        before, begin = os.times(), time.perf_counter()
        done = subprocess.run(
            [str(self.python), *words],
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
            check=False,
        )
        said, after = done.stdout + done.stderr, os.times()
        expected = (0, 1) if status is None else (status,)
        assert done.returncode in expected, f"{title}: exit status {done.returncode}\n{said}"
        assert "Traceback" not in said, f"{title}:\n{said}"
        for text in told:
            assert text in said, f"{title}: expected {text!r} in\n{said}"
        used = after.children_user + after.children_system
        used -= before.children_user + before.children_system
        lines = [line for line in said.splitlines() if (told or ("",))[0] in line and line]
        self.note(title, time.perf_counter() - begin, used, lines[-1] if lines else "")
        return used

    def note(self, title: str, seconds: float, used: float, words: str = "") -> None:
        times = {"seconds": round(seconds, 2), "CPU": round(used, 2)}
        self.rows.append({"step": title, **times, "words": words.strip()})
        print(f"{seconds:7.2f} s, {used:6.2f} s CPU  {title}: {words.strip()}", flush=True)


def installed(folder: Path, borrow: bool) -> Path:
    """Build both distributions, install them into a fresh environment; return that one's Python.

    The sdist comes first, and the wheel that was built replaces it: they have to hold the same.
    """
    built, place = folder / "built", folder / "environment"
    build = [sys.executable, "-m", "build", "--outdir", str(built), str(ROOT)]
    subprocess.run(build, check=True, cwd=folder, stdout=subprocess.DEVNULL)
    venv.create(place, with_pip=True, symlinks=os.name != "nt")
    python = place / ("Scripts" if os.name == "nt" else "bin") / "python"
    own = subprocess.run([str(python), "-c", WHERE], capture_output=True, text=True, check=True)
    packages, options = Path(own.stdout.strip()), []
    if borrow:  # what a .pth file adds comes last, and its own .pth files are not read
        (packages / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
        options = ["--no-deps"]
    pip = [str(python), "-m", "pip", "--disable-pip-version-check", "--quiet", "install", *options]
    extras = "" if borrow else "[robots,studio]"
    held = []
    for pattern, more in (("*.tar.gz", ()), ("*.whl", ("--force-reinstall", "--no-deps"))):
        files = [f"{path}{extras}" for path in built.glob(pattern)]
        subprocess.run([*pip, *more, *files], check=True, cwd=folder)
        (record,) = packages.glob("pinhole_jax-*/RECORD")
        held.append({line for line in record.open() if line.startswith("pinhole_jax/")})
    assert held[0] == held[1], f"the sdist and the wheel differ: {held[0] ^ held[1]}"
    shown = (record.parent / "METADATA").read_text(encoding="utf-8").partition("\n\n")[2]
    assert "](https://" in shown, "the README has no links"
    assert not re.search(r"\]\((?!https:)", shown), "the README has links that are no addresses"
    return python


def at_the_door(step: Step) -> None:
    """What needs no fit: help, typos, refusals."""
    used = [
        step.command("help", ["fit", "--help"], 0, "usage: pinhole-jax fit"),
        step.command("the version", ["--version"], 0, "pinhole-jax "),
        step.command(
            "a typo",
            ["fit", "part.obj", "mask.png", "--fvo", "3"],
            2,
            "--fvo 3 (did you mean --fov?)",
            "usage: pinhole-jax fit",
        ),
    ]
    assert max(used) < AT_ONCE, f"help took {max(used):.2f} s of the processor"
    fit = lambda *words: ["fit", "part.obj", *words]
    step.command(
        "an inverted mask", fit("negative.png", "--fov", "34"), 2, "`MASK`: expected", "`--invert`"
    )
    step.command("labels 0 and 7", fit("sevens.png", "--fov", "34"), 2, "`--mask-from label=7`")
    step.command("a field of view in other units", fit("mask.png", "--fov", "234"), 2, "degrees")
    step.command("no mesh", ["fit", "no.obj", "mask.png", "--fov", "34"], 2, "`MESH`: expected")
    step.command(
        "an edited camera", fit("mask.png", "--camera", "edited.json"), 2, "`phi_degrees`: expected"
    )
    step.command(
        "a cropped mask and the whole photo's camera",
        fit("cropped.png", "--camera", "start.json"),
        2,
        "size 64 x 64, got one of 96 x 80",
    )
    step.command("a solid", ["fit", "part.step", "mask.png", "--fov", "34"], 2, "export it as STL")
    step.command("exchanged", ["fit", "mask.png", "part.obj"], 2, "`MESH` and `MASK` exchanged?")
    K = "--K", "129.3,129.3,39.5,200", "--dist", "-0.2,0.1,0,0"
    step.command(
        "K of another picture", fit("mask.png", *K), 2, "point inside the picture", "cut or resized"
    )
    step.command("a field of view in rad", fit("mask.png", "--fov", "0.577"), 2, "degrees?")
    step.command(
        "an output that cannot be written",
        fit("mask.png", "--fov", "34", "-o", "part.obj"),
        2,
        "`--output`: expected",
    )
    step.script("a pipe that nobody reads", PIPE)
    step.script("wrong arguments of the library", DOOR)


def fits(step: Step) -> None:
    """What fits: the first one compiles, the others find its programs."""
    told = "status     converged   (trust it", "X_camera = R X_object + t", "where +y is up", "time"
    fit = lambda mask, *words: ["fit", "part.obj", mask, "-o", "out", *words]
    start = "--camera", "start.json"
    step.command("the first fit: it compiles", fit("mask.png", *start), 0, *told)
    step.command(
        "the second fit, a camera of OpenCV's",
        fit("mask.png", "--camera", "start.yaml"),
        0,
        "out/camera.json (replaced)",
    )
    step.script("a fit's file, its pose and covariance", RESULT)
    network = fit("network.png", "--K", "ros.yaml")
    step.command("a network's mask, ROS's calibration", network, None, "3 islands", "2 holes")
    check = ["check", "out/camera.json", "part.obj", "mask.png"]
    step.command("it has not moved", check, 0, "not moved: less than 1 sigma")
    moved = ["check", "start.json", "part.obj", "mask.png"]
    step.command("it has moved", moved, 1, "moved: ", "turned by")


def more(step: Step) -> None:
    """What takes longer: other masks, a search with K, a crop, a report."""
    fit = lambda mask, *words: ["fit", "part.obj", mask, "-o", "more", *words]
    start = "--camera", "start.json"
    step.command("a JPEG", fit("mask.jpg", *start), 0, "status     converged")
    step.command("an inverted mask, told", fit("negative.png", "--invert", *start), 0)
    step.command("labels 0 and 1", fit("ones.png", *start), 0, "mask: its values 0 and 1")
    step.command("labels, told", fit("sevens.png", "--mask-from", "label=7", *start), 0)
    window = "--crop", "16", "8", "64", "64"
    step.command("a crop", fit("cropped.png", *start, *window), 0, "status     converged")
    # Whether its camera is trusted hangs on how much is gone; the report says where.
    cut = ["fit", "part.obj", "cut.png", "-o", "more", *start]
    step.command("a mask that is cut off", cut, None, "is the mask cut off or covered there")
    K = "--K", "129.3", "129.3", "47.5", "39.5"
    step.command("K known, no pose", fit("mask.png", *K), 0, "status     converged")
    step.command("a report", fit("mask.png", *start, "--report", "page.html"), 0, "page.html")
    for name in ("net.json", "cameras.txt", "start.yaml"):
        step.command(f"K in {name}", fit("mask.png", "--K", name), 0, "status     converged")
    batch = ["batch", "set.csv", "-o", "rows", "--track", "--merge", "table.csv"]
    step.command("frames, one after another", batch, 0, "2   converged", "table.csv")
    step.script("a table of every row, a page with a band", PAGES)
    step.script("residuals, matrices, a gradient, progress", PARTS, "fitting: ")
    step.script("a bench whose field of view is a guess", BENCH, "field of view assumed: 40")
    arm = ["hand-eye", "arm.urdf", "joints.csv", "mask.png", "--camera", "start.json"]
    step.command("angles in degrees", arm, 2, "degrees? Then give JSON")
    step.command("a lens: pose and k1", fit("mask.png", *start, "--free", "pose,k1"), 0)


def interrupted(step: Step) -> None:
    """Ctrl-C: one line, status 130, nothing half-written."""
    begin = time.perf_counter()
    words = ["-m", "pinhole_jax", "fit", "part.obj", "mask.png", "--fov", "34", "-o", "never"]
    process = subprocess.Popen(
        [str(step.python), *words, "--no-cache"],
        cwd=step.folder,
        env=step.environment,
        stderr=subprocess.PIPE,
        text=True,
        # What a shell starts in the background ignores it.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    time.sleep(1.5)  # (A quick machine is through after 3.)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=120)
    assert (process.returncode, said) == (130, "pinhole-jax fit: interrupted\n"), said
    assert not (step.folder / "never").exists()
    step.note("Ctrl-C after 1.5 s", time.perf_counter() - begin, 0.0)


def first_use(asked: Options) -> dict:
    with tempfile.TemporaryDirectory() as name:
        folder, begin = Path(name), time.perf_counter()
        step = Step(installed(folder, "borrow" in asked.flags), folder)
        step.note("built and installed", time.perf_counter() - begin, 0.0)
        step.script("a mesh, masks and cameras, drawn", FILES)
        for part in (at_the_door, fits, interrupted, *[more] * ("all" in asked.flags)):
            part(step)
    seconds = sum(row["seconds"] for row in step.rows)
    words = f"All {len(step.rows)} steps did what they should, in {seconds:.0f} s."
    return {"verdict": words, "table": step.rows}


# Where the time goes


def profile(call: Callable[[], object]) -> dict[str, float]:
    """Return the share of a call's time that functions of the package take, the most first."""
    call()
    with cProfile.Profile() as profiler:
        for _ in range(5):
            call()
    times: dict[str, float] = {}
    for (file, _, name), (_, _, own, _, _) in pstats.Stats(profiler).stats.items():  # type: ignore[attr-defined]
        path = Path(file)
        key = f"{path.parent.name}/{path.stem}: {name}" if "pinhole_jax" in file else "JAX, NumPy"
        times[key] = times.get(key, 0) + own
    total = sum(times.values())
    shares = sorted(((t / total, name) for name, t in times.items()), reverse=True)
    return {name: share for share, name in shares[:12]}


def hotspots(asked: Options) -> dict:
    truth = camera()
    mask, start = mask_of(truth, scene()), start_from(truth, 10, 0.05, np.random.default_rng(0))

    def seconds(*command: str, **more: str) -> float:
        begin = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True, env=os.environ | more)
        return time.perf_counter() - begin

    python, found, turns = sys.executable, {}, asked.number(5)
    for modules in ("jax, equinox", "jax, equinox, pinhole_jax"):
        times = [seconds(python, "-c", f"import {modules}") for _ in range(turns)]
        found[f"import {modules}"] = float(np.median(times))
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        mesh = scene().mesh
        trimesh.Trimesh(mesh.vertices, mesh.faces).export(place / "mesh.ply")
        pj.io.save_image(place / "mask.png", mask > 0.5)
        pj.io.save_camera(place / "start.json", start)
        paths = [str(place / x) for x in ("mesh.ply", "mask.png")]
        options = ["--camera", str(place / "start.json"), "-o", str(place)]
        command = [python, "-m", "pinhole_jax", "fit", *paths, *options]
        first, *others = (seconds(*command, XDG_CACHE_HOME=name) for _ in range(1 + turns))
    found |= {"fit, empty cache": first, "fit, filled cache": float(np.median(others))}
    shares = profile(lambda: pj.fit_camera(scene(), mask, start))
    show([{"": name, "s": s} for name, s in found.items()])
    show([{"of a fit": name, "share": share} for name, share in shares.items()])
    words = ", ".join(f"{name} {s:.2f}" for name, s in found.items())
    return {"verdict": f"Seconds: {words}", "seconds": found, "shares": shares}


if __name__ == "__main__":
    if sys.argv[1] == "--call":
        print(json.dumps(first(sys.argv[2])))
    else:
        parts = {"first-calls": first_calls, "first-use": first_use, "hotspots": hotspots}
        main(__doc__, parts, x64=False, flags=("all", "borrow"))
