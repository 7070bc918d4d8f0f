"""What does each constant that decides something buy?

    python experiments/rent.py constants [OUT] [--only NAME,...] [--trials N] [--resume]

The constants of the files that choose cameras, statuses and intervals are read from the code,
with the comments that say what they decide. Each is halved and doubled (all numbers of a tuple at
once), and the trials of `honesty.py` that it is for are run again: near-symmetric shapes for the
search, wrong masks for the likelihood, occluders for what looks behind them.
"""

import ast
import importlib
import json
import time
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import honesty
import numpy as np
from _common import Asked, main, show

#: The files whose constants decide, and the trials that they are for.
FILES = {
    "exact": (
        "_fit.places",
        "_fit.strategy",
        "_fit.result",
        "_fit.fit_camera",
        "_mask.kinds",
        "_outline.statistics",
        "_solver.solver",
        "_solver.uncertainty",
        "_mask.search",
    ),
    "wrong": ("_fit.likelihood", "_fit.refine", "_outline.outline_errors", "_outline.stretches"),
    "occluded": ("_fit.occluders",),
}


class Constant(NamedTuple):
    """A number or numbers at the top of a module, and what its comment says."""

    module: ModuleType
    name: str
    about: str
    trials: str

    @property
    def value(self) -> Any:
        return getattr(self.module, self.name)

    def times(self, factor: float) -> Any:
        """The value times a factor: whole numbers stay whole, and at least 1."""
        return _times(self.value, factor)


def _times(value: Any, factor: float) -> Any:
    if isinstance(value, tuple):
        return tuple(_times(x, factor) for x in value)
    if isinstance(value, int | np.integer):
        return max(round(value * factor), 1)
    return value * factor


def is_number(value: Any) -> bool:
    if isinstance(value, tuple):
        return all(map(is_number, value))
    numeric = isinstance(value, int | float | np.number) or (
        isinstance(value, np.ndarray) and value.size < 20
    )
    return numeric and not isinstance(value, bool)


def constants() -> list[Constant]:
    """All constants of `FILES`."""
    found = []
    for trials, names in FILES.items():
        for name in names:
            module = importlib.import_module(f"pinhole_jax.{name}")
            text = Path(str(module.__file__)).read_text(encoding="utf-8")
            lines = text.splitlines()
            for node in ast.parse(text).body:
                if not isinstance(node, ast.Assign):
                    continue
                about = comment_above(lines, node.lineno - 1)
                for target in (
                    node.targets[0].elts if isinstance(node.targets[0], ast.Tuple) else node.targets
                ):
                    key = ast.unparse(target)
                    if key.isupper() and is_number(getattr(module, key)):
                        found.append(Constant(module, key, about, trials))
    return found


def comment_above(lines: list[str], number: int) -> str:
    """The `#:` comment that ends above a line."""
    words: list[str] = []
    while number and lines[number - 1].startswith("#:"):
        number -= 1
        words.insert(0, lines[number].removeprefix("#:").strip())
    return " ".join(words)


def cases(trials: str) -> tuple[list[tuple[str, str]], Any]:
    """The cases of a kind of trials, and the trial."""
    if trials == "exact":
        return [(s, k) for s in honesty.SHAPES for k in honesty.KINDS], honesty.trial
    if trials == "wrong":
        return [(s, k) for s in honesty.DRAWN for k in honesty.WRONG], honesty.wrong_trial
    kinds = [f"{share} % {what}" for share in (10, 30) for what in ("plane", "ball")]
    return [(s, k) for s in honesty.DRAWN for k in kinds], honesty.hidden_trial


def outcome(trials: str, number: int, seed: int) -> list[dict]:
    each, trial = cases(trials)
    rows = []
    for k in range(number):
        begin = time.process_time()
        row = trial(seed + k, *each[k * len(each) // number])
        rows.append({**row, "seconds": time.process_time() - begin})
    return rows


def compared(rows: list[dict], base: list[dict]) -> dict[str, Any]:
    """What differs between two runs of the same trials."""
    off = [[max(r["degrees"], 1e-3) for r in each] for each in (rows, base)]
    worse = [a > 1.5 * b + 0.3 for a, b in zip(*off, strict=True)]
    better = [b > 1.5 * a + 0.3 for a, b in zip(*off, strict=True)]
    statuses = [a["status"] != b["status"] for a, b in zip(rows, base, strict=True)]
    seconds = [sum(r["seconds"] for r in each) for each in (rows, base)]
    return {
        "lies": sum(map(honesty.is_lie, rows)),
        "other status": sum(statuses),
        "worse camera": sum(worse),
        "better camera": sum(better),
        "time": seconds[0] / seconds[1],
    }


def table(asked: Asked) -> dict:
    number, path = asked.number(200, 2), asked.out / "rent.jsonl"
    if not asked.resume:
        path.unlink(missing_ok=True)
    done = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    known = {(row["constant"], row["times"]): row for row in done}
    base: dict[str, list[dict]] = {}
    for constant in constants():
        if constant.name not in asked.names([constant.name]):
            continue
        for factor in (0.5, 2.0):
            where = constant.module.__name__.removeprefix("pinhole_jax.")
            key = f"{where}.{constant.name}", factor
            if key in known:
                continue
            if constant.trials not in base:
                outcome(constant.trials, 1, asked.seed)  # (compiles)
                base[constant.trials] = outcome(constant.trials, number, asked.seed)
            value, moved = constant.value, constant.times(factor)
            setattr(constant.module, constant.name, moved)
            try:
                found = compared(
                    outcome(constant.trials, number, asked.seed), base[constant.trials]
                )
            except Exception as error:  # (a value that the code cannot work with)
                found = {"fails": type(error).__name__}
            finally:
                setattr(constant.module, constant.name, value)
            row = {"constant": key[0], "times": factor, "trials": number, **found}
            known[key] = {**row, "value": str(value), "decides": constant.about}
            with path.open("a") as file:
                file.write(json.dumps(known[key]) + "\n")
            print(json.dumps(row), flush=True)
    rows = list(known.values())
    changed = [r for r in rows if any(r.get(k) for k in ("lies", "other status", "worse camera"))]
    show({k: v for k, v in r.items() if k not in ("decides", "value")} for r in rows)
    words = f"{len({r['constant'] for r in rows})} constants; "
    words += f"{len({r['constant'] for r in changed})} change an answer when halved or doubled"
    return {"verdict": words, "table": rows}


if __name__ == "__main__":
    main(__doc__, {"constants": table})
