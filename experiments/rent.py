"""What does each rule that a fit decides by buy?

    python experiments/rent.py rules [OUT] [--only NAME,...] [--trials N] [--resume]

`pinhole_jax/_rules.py` holds the numbers that choose cameras, statuses and intervals, with what
each decides. Each is halved and doubled (all numbers of a tuple at once), and the trials of
`honesty.py` that it is for are run again: near-symmetric shapes for proposals and places, wrong
masks for the likelihood, occluders for what looks behind them.
"""

import ast
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import honesty
from _common import Options, main, show

import pinhole_jax as pj
from pinhole_jax._rules import RULES


class Rule(NamedTuple):
    """A rule's name, what its comment says that it decides, and the trials that it is for."""

    name: str
    decides: str
    trials: str

    def times(self, factor: float) -> Any:
        """The value times a factor: whole numbers stay whole, and at least 1."""
        return _times(getattr(RULES, self.name), factor)


def _times(value: Any, factor: float) -> Any:
    if isinstance(value, tuple):
        return tuple(_times(x, factor) for x in value)
    if isinstance(value, int):
        return max(round(value * factor), 1)
    return value * factor


def rules() -> list[Rule]:
    """All rules, in their order."""
    text = Path(pj.__file__).with_name("_rules.py").read_text(encoding="utf-8")
    lines, found = text.splitlines(), []
    body = next(node for node in ast.parse(text).body if isinstance(node, ast.ClassDef)).body
    for node in body:
        if isinstance(node, ast.AnnAssign):
            before = lines[: node.lineno - 1]
            heading = [line.strip() for line in before if line.startswith("    # ")][-1]
            kind = "occluded" if "in front" in heading else "exact"
            kind = "wrong" if "errs" in heading else kind
            comment = comment_above(lines, node.lineno - 1) or found[-1].decides
            found.append(Rule(ast.unparse(node.target), comment, kind))
    return found


def comment_above(lines: list[str], number: int) -> str:
    """The `#:` comment that ends above a line."""
    words: list[str] = []
    while number and lines[number - 1].strip().startswith("#:"):
        number -= 1
        words.insert(0, lines[number].strip().removeprefix("#:").strip())
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
    moved = [abs(a["degrees"] - b["degrees"]) > 1e-3 for a, b in zip(rows, base, strict=True)]
    seconds = [sum(r["seconds"] for r in each) for each in (rows, base)]
    return {
        "lies": sum(map(honesty.is_lie, rows)),
        "other status": sum(statuses),
        "other camera": sum(moved),
        "worse camera": sum(worse),
        "better camera": sum(better),
        "time": seconds[0] / seconds[1],
    }


def table(asked: Options) -> dict:
    number, path = asked.number(200, 2), asked.out / "rent.jsonl"
    if not asked.resume:
        path.unlink(missing_ok=True)
    done = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    known = {(row["rule"], row["times"]): row for row in done}
    base: dict[str, list[dict]] = {}
    every = rules()
    for rule in every:
        for factor in (0.5, 2.0):
            if (rule.name, factor) in known or rule.name not in asked.names([rule.name]):
                continue
            if rule.trials not in base:
                outcome(rule.trials, 1, asked.seed)  # (compiles)
                base[rule.trials] = outcome(rule.trials, number, asked.seed)
            value = getattr(RULES, rule.name)
            object.__setattr__(RULES, rule.name, rule.times(factor))
            try:
                found = compared(outcome(rule.trials, number, asked.seed), base[rule.trials])
            except Exception as error:  # (a value that the code cannot work with)
                found = {"fails": type(error).__name__}
            finally:
                object.__setattr__(RULES, rule.name, value)
            row = {"rule": rule.name, "times": factor, "trials": number, **found}
            known[rule.name, factor] = {**row, "value": str(value), "decides": rule.decides}
            with path.open("a") as file:
                file.write(json.dumps(known[rule.name, factor]) + "\n")
            print(json.dumps(row), flush=True)
    rows = list(known.values())
    changes = ("lies", "other status", "other camera", "fails")
    paying = {r["rule"] for r in rows if any(r.get(k) for k in changes)}
    show({k: v for k, v in r.items() if k not in ("decides", "value")} for r in rows)
    words = f"{len(every)} rules, {len({r['rule'] for r in rows})} tried;"
    words += f" {len(paying)} change an answer when halved or doubled"
    return {"verdict": words, "table": rows}


if __name__ == "__main__":
    main(__doc__, {"rules": table})
