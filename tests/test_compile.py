"""What is compiled for stays small: kernels are counted, not seconds."""

import os
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "experiments"))
import compile as compile_table
from _kernels import Kernels, kernels

pytestmark = pytest.mark.optimised

#: At most so many kernels in all, that differ, and loops.
MOST = {
    "mask_without_overlaps": Kernels(220, 160, 8),
    "mask": Kernels(710, 460, 27),
    "depth": Kernels(200, 142, 2),
    "gradient_of_camera": Kernels(1520, 615, 58),
    "fit": Kernels(733, 481, 13),
}


@pytest.mark.long
@pytest.mark.parametrize("name", MOST)
def test_a_program_has_few_kernels(name):
    """How many there are depends on the compiler's version: by a twentieth at most."""
    function, arguments = compile_table.PROGRAMS[name]()
    # As users have the compiler, whatever `conftest` makes of it for the other tests.
    older = "fusion_emitters=false" in os.environ.get("XLA_FLAGS", "")
    options = {"xla_cpu_use_fusion_emitters": True} if older else None
    lowered = function.lower(*arguments)
    compiled = getattr(lowered, "lowered", lowered).compile(compiler_options=options)
    found = kernels(getattr(compiled, "compiled", compiled).as_text())
    assert all(a <= 1.05 * b for a, b in zip(found, MOST[name], strict=True)), found


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
