"""Where does the time of a mask and a fit go, and what does the first call take?

    python experiments/hotspots.py OUT

A profile of compiled programs (`jax.profiler`), each kernel put down to the innermost function of
`pinhole_jax` that it was traced from; a fit's time beside its kernels is Python and NumPy. Then new
processes: `import pinhole_jax`, and the command `fit` on a mesh of 5k faces with an empty and a
filled cache of compiled programs.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import trimesh
from _common import camera_at, folder, one_step, orbited
from PIL import Image
from scipy.spatial.transform import Rotation

import pinhole_jax as pj
from pinhole_jax._silhouette.silhouette import _silhouette
from pinhole_jax._solver.levenberg_marquardt import descended
from pinhole_jax._solver.moves import canonical
from pinhole_jax._solver.solver import Solver

PACKAGE = Path(pj.__file__).parent
CALLS, SHOWN, PROCESSES = 20, 12, 5
#: These hold others, which are counted themselves.
HOLDERS = ("while", "conditional", "call")


def sources(text: str) -> dict[str, str]:
    """Return file:function of the package for each instruction of a compiled program's text."""

    def table(name: str) -> dict[int, str]:
        found = re.search(rf"^{name}\n((?:\d+ .*\n)+)", text, re.MULTILINE)
        rows = found.group(1).splitlines() if found else []
        return {int(k): rest for k, rest in (row.split(" ", 1) for row in rows)}

    def field(row: str, name: str) -> int:
        return int(re.search(rf"{name}=(\d+)", row).group(1))  # type: ignore[union-attr]

    files, functions = table("FileNames"), table("FunctionNames")
    places, frames = table("FileLocations"), table("StackFrames")

    def innermost(number: int) -> str:
        while number:
            place = places[field(frames[number], "file_location_id")]
            file = Path(files[field(place, "file_name_id")].strip('"'))
            if PACKAGE in file.parents:
                name = functions[field(place, "function_name_id")].strip('"')
                return f"{file.name}: {name.split('.')[0]}"
            number = field(frames[number], "parent_frame_id") - 1
        return "(others')"

    of = re.compile(r"^\s+(?:ROOT )?%(\S+) = .*stack_frame_id=(\d+)", re.MULTILINE)
    return {name: innermost(int(number)) for name, number in of.findall(text)}


def profile(call: Callable[[], Any], program: Any, arguments: tuple) -> dict[str, Any]:
    """Return ms of a call, in all, in a program's kernels, and by function.

    The program is the one that the call runs for arguments like these.
    """
    jax.block_until_ready(call())
    text = program.lower(*arguments).compile().compiled.as_text()
    (module,) = re.findall(r"^HloModule (\w+)", text)
    where, spent = sources(text), Counter()
    with tempfile.TemporaryDirectory() as place:
        with jax.profiler.trace(place):
            begin = time.perf_counter()
            for _ in range(CALLS):
                jax.block_until_ready(call())
            wall = time.perf_counter() - begin
        (file,) = Path(place).glob("**/*.xplane.pb")
        for plane in jax.profiler.ProfileData.from_file(str(file)).planes:
            for line in plane.lines:
                for event in line.events:
                    facts = dict(event.stats)
                    if facts.get("hlo_module") == module and not event.name.startswith(HOLDERS):
                        spent[where.get(event.name, "(others')")] += event.duration_ns / 1e6
    by = {name: ms / CALLS for name, ms in spent.most_common()}
    return {"wall_ms": 1e3 * wall / CALLS, "kernels_ms": sum(by.values()), "by_ms": by}


def say(words: str, found: dict[str, Any]) -> None:
    kernels = found["kernels_ms"]
    print(f"{words}: {found['wall_ms']:.2f} ms, {kernels:.2f} of them in kernels (while profiled)")
    for name, ms in [*found["by_ms"].items()][:SHOWN]:
        print(f"  {ms / kernels:5.1%}  {name}")


def first_calls(mesh: pj.Mesh, mask: np.ndarray, start: pj.Camera) -> dict[str, Any]:
    """Return seconds of new processes: imports, the command with an empty and a filled cache."""

    def seconds(*command: str, **more: str) -> float:
        begin = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True, env=os.environ | more)
        return time.perf_counter() - begin

    python, found = sys.executable, {}
    for words, modules in (("without", "jax, equinox"), ("with", "jax, equinox, pinhole_jax")):
        times = [seconds(python, "-c", f"import {modules}") for _ in range(PROCESSES)]
        found[f"import {words} pinhole_jax"] = float(np.median(times))
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        trimesh.Trimesh(mesh.vertices, mesh.faces).export(place / "mesh.ply")
        Image.fromarray(np.round(255 * mask).astype(np.uint8)).save(place / "mask.png")
        pj.io.save_camera(place / "start.json", start)
        paths = [str(place / x) for x in ("mesh.ply", "mask.png")]
        options = ["--camera", str(place / "start.json"), "--free", "pose,phi", "-o", str(place)]
        command = [python, "-m", "pinhole_jax", "fit", *paths, *options]
        times = [seconds(*command, XDG_CACHE_HOME=str(place)) for _ in range(1 + PROCESSES)]
    found["fit, empty cache"], found["fit, filled cache"] = times[0], float(np.median(times[1:]))
    return found


def main() -> None:
    place = folder()
    mesh = pj.shapes.bumpy(4)
    scene, truth = pj.Scene(mesh=mesh), camera_at(np.eye(3), np.zeros(2), 4.6, 0.6)
    mask = np.asarray(pj.silhouette(truth, scene))
    start = orbited(truth, Rotation.from_rotvec(np.deg2rad([4, -9, 2])).as_matrix(), 1.05)
    free, weights = ("pose", "phi"), np.broadcast_to(1.0, mask.shape)

    solver = Solver.of(scene, mask, weights, np.float32, free, 64)
    solver.look(canonical(truth), solver.finest)
    calls = {
        "mask": (_silhouette, lambda: pj.silhouette(truth, scene), (truth, scene, True)),
        "fit": (
            descended,
            lambda: pj.fit_camera(scene, mask, start, free),
            one_step(solver, start),
        ),
    }
    answers = {"first_calls_s": first_calls(mesh, mask, start)}
    for words, s in answers["first_calls_s"].items():
        print(f"{words}: {s:.2f} s")
    for words, (program, call, arguments) in calls.items():
        answers[words] = profile(call, program, arguments)
        say(f"{words}, 5k faces, 256 px", answers[words])
    (place / "hotspots.json").write_text(json.dumps(answers, indent=1) + "\n")


if __name__ == "__main__":
    main()
