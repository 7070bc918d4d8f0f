"""What is compiled for stays small: kernels are counted, not seconds."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from kernels import Kernels, kernels

#: At most this many kernels in all, that differ, and loops.
MOST = {
    "mask_without_overlaps": Kernels(23, 17, 0),
    "mask": Kernels(23, 17, 0),
    "depth": Kernels(30, 24, 0),
    "gradient_of_camera": Kernels(47, 39, 0),
    "gradient_with_spheres_and_distortion": Kernels(115, 96, 0),
    "fit": Kernels(162, 121, 1),
}
#: Counted with all tests: what the others have in them, and one that takes as long as these.
WITH_ALL = {"mask_without_overlaps", "depth", "gradient_with_spheres_and_distortion"}
COUNT = """
import json, sys
import numpy as np
import startup
from kernels import kernels
from pinhole_jax._mask.mask import Mask
from pinhole_jax._solver.levenberg_marquardt import descended
from pinhole_jax._solver.looks import size_of_looks
from pinhole_jax._solver.moves import canonical
from pinhole_jax._solver.solver import Solver
from pinhole_jax._solver.subject import Subject

def fit():
    camera, scene = startup.camera(), startup.scene()
    disc = np.hypot(*np.mgrid[-128:128, -128:128]) < 70
    mask = Mask(disc, np.ones((camera.H, camera.W)), camera)
    solver = Solver.on(Subject.from_scene(scene, np.float32), mask, ("pose", "phi"), 64)
    ends = np.float32(1e-3), np.float32(0), np.int32(1)
    level = solver.levels[solver.finest], *ends, solver.freed, size_of_looks(solver.levels)
    return descended, (canonical(camera), solver.problem, *level)

for name in sys.argv[1:]:
    function, arguments = startup.CALLS[name]
    function, given = fit() if name == "fit" else (function, arguments())
    compiled = function.lower(*given).compile()
    print(json.dumps([name, kernels(getattr(compiled, "compiled", compiled).as_text())]))
"""


@pytest.mark.long
def test_programs_have_few_kernels(exhaustive):
    """How many there are depends on the compiler's version: by a twentieth at most."""
    # In a process of its own, as users have it: the tests' settings are not there.
    given = {**os.environ, "JAX_ENABLE_X64": "1"}
    scripts = Path(__file__).parents[1] / "experiments"
    given["PYTHONPATH"] = os.pathsep.join([*sys.path, str(scripts)])
    asked = [name for name in MOST if exhaustive or name not in WITH_ALL]
    words = [sys.executable, "-c", COUNT, *asked]
    done = subprocess.run(words, env=given, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = dict(json.loads(line) for line in done.stdout.splitlines())
    assert [*found] == asked
    for name in asked:
        counts = zip(found[name], MOST[name], strict=True)
        assert all(a <= 1.05 * b for a, b in counts), (name, found)


def test_equal_kernels_count_once():
    """Two loops with equal bodies, as the compiler writes them."""
    text = """
HloModule m

%body (a: (s32[], f32[8])) -> (s32[], f32[8]) {
  %a = (s32[], f32[8]{0}) parameter(0)
  %n = s32[] get-tuple-element(%a), index=0
  %v = f32[8]{0} get-tuple-element(%a), index=1
  %w = f32[8]{0} multiply(%v, %v), metadata={op_name="x"}
  ROOT %t = (s32[], f32[8]{0}) tuple(%n, %w)
}

%condition (c: (s32[], f32[8])) -> pred[] {
  %c = (s32[], f32[8]{0}) parameter(0)
  %m = s32[] get-tuple-element(%c), index=0
  ROOT %l = pred[] compare(%m, %m), direction=LT
}

ENTRY %main (x: (s32[], f32[8])) -> (s32[], f32[8]) {
  %x = (s32[], f32[8]{0}) parameter(0)
  %y = (s32[], f32[8]{0}) while(%x), condition=%condition, body=%body
  %z = (s32[], f32[8]{0}) while(%y), condition=%condition.1, body=%body.1
  ROOT %r = (s32[], f32[8]{0}) tuple(%y, %z)
}
"""
    more = text[text.index("%body") : text.index("ENTRY")]
    more = more.replace("%body", "%body.1").replace("%condition", "%condition.1")
    more = more.replace("%w", "%other")
    text = text.replace("ENTRY", more + "ENTRY")
    assert kernels(text) == Kernels(all=4, distinct=2, loops=2)
