"""Of what does a compilation consist? XLA's passes, MLIR, and LLVM for each kind of kernel.

    python experiments/compiling.py OUT [program of compile.py] ...

What XLA logs of a program's compilation, in a process of its own, on one core: seconds between a
line of its log and the next, by what the line says was just done or begun.
"""

import json
import os
import re
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator

from _common import folder
from compile import PROGRAMS

#: What logs that it begins or ends: passes over the program, kernels in MLIR, and in LLVM.
LOGGED = "hlo_pass_pipeline=1,fusion_compiler=1,ir_compiler=1"
BEGIN = "-- from here on --"
CHILD = f"""
import sys, jax, compile
from pinhole_jax._numerics.jitted import options
function, arguments = compile.PROGRAMS[sys.argv[-1]]()
lowered = function.lower(*arguments)
print("{BEGIN}", file=sys.stderr, flush=True)
getattr(lowered, "lowered", lowered).compile(compiler_options=options())
"""
#: What a line says of a step that ended, and how long it took.
ENDED = re.compile(
    r"(HLO pass|Compiled MLIR module|Compiled LLVM module): (?:__compute_module_)*(\S+)"
    r" time: ([\d.]+) (us|ms|s)\b"
)
SECONDS = {"us": 1e-6, "ms": 1e-3, "s": 1.0}
SHOWN = 12


def steps(log: str) -> Iterator[tuple[str, str, float]]:
    """Yield of each step its kind, its name without numbers, and its seconds."""
    for kind, name, number, unit in ENDED.findall(log.split(BEGIN)[-1]):
        name = re.sub(r"_kernel_module|_computation|wrapped_", "", name)
        name = re.sub(r"[._]\d+$", "", name)
        name = "loops in one kernel" if "jaxpr_as_fun" in name or name == "call" else name
        yield kind, name, float(number) * SECONDS[unit]


def logged(name: str) -> str:
    """Return what XLA logs while it compiles a program."""
    environment = {
        **os.environ,
        "JAX_PLATFORMS": "cpu",
        "TF_CPP_MIN_LOG_LEVEL": "0",
        "TF_CPP_VMODULE": LOGGED,
    }
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    words = [sys.executable, "-c", CHILD, str(folder()), name]
    here = os.path.dirname(os.path.abspath(__file__))
    out = subprocess.run(words, env=environment, cwd=here, capture_output=True, text=True)
    if out.returncode:
        raise RuntimeError(out.stderr[-2000:])
    return out.stderr


def main() -> None:
    answer = {}
    for name in sys.argv[2:] or ("mask", "gradient_of_camera", "fit"):
        if name not in PROGRAMS:
            raise SystemExit(f"no program {name!r}: one of {', '.join(PROGRAMS)}")
        table: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
        for kind, what, seconds in steps(logged(name)):
            table[kind][what].append(seconds)
        answer[name] = {}
        for kind, rows in table.items():
            total = {what: (sum(x), len(x)) for what, x in rows.items()}
            longest = sorted(total.items(), key=lambda row: -row[1][0])[:SHOWN]
            every = sum(s for s, _ in total.values()), sum(n for _, n in total.values())
            answer[name][kind] = {"all": every, **dict(longest)}
            print(f"{name}, {kind}: {every[0]:.2f} s of {every[1]}")
            for what, (seconds, number) in longest:
                print(f"  {seconds:6.3f} {number:4d} {what}", flush=True)
    (folder() / "compiling.json").write_text(json.dumps(answer, indent=1) + "\n")


if __name__ == "__main__":
    main()
