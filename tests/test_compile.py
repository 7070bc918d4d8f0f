"""What is compiled stays small: instructions are counted, not seconds."""

import json
import os
import sys

import pytest
from processes import printed

#: At most this many instructions of the optimised program.
MOST = {
    "mask_without_overlaps": 495,
    "mask": 495,
    "depth": 1323,
    "gradient_of_camera": 1628,
    "gradient_with_spheres_and_distortion": 3428,
    "fit": 3753,
}
#: Counted with all tests: what the others have in them, and one that takes as long as these.
WITH_ALL = {"mask_without_overlaps", "depth", "gradient_with_spheres_and_distortion"}
COUNT = """
import json, sys
import numpy as np
import startup
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

found = {}
for name in sys.argv[1:]:
    function, arguments = startup.CALLS[name]
    function, given = fit() if name == "fit" else (function, arguments())
    compiled = function.lower(*given).compile()
    found[name] = getattr(compiled, "compiled", compiled).as_text().count(" = ")
print(json.dumps(found))
"""


@pytest.mark.long
def test_programs_have_few_instructions(exhaustive):
    """How many there are depends on the compiler's version: by a twentieth at most."""
    # In a process of its own, as users have it: the tests' settings are not there.
    given = {**os.environ, "JAX_ENABLE_X64": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    asked = [name for name in MOST if exhaustive or name not in WITH_ALL]
    found = json.loads(printed("-c", COUNT, *asked, env=given))
    assert {name: count for name, count in found.items() if count > 1.05 * MOST[name]} == {}
