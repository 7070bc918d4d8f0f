"""The gate of frozen figures ends with 1 where one is worse, and says what it cannot compare."""

import json
import sys

import _common
import frozen
import pytest

LOWER = {"value": 2.0, "unit": "px", "direction": "lower", "tolerance": 0.1, "how": "-"}
FIGURES = {
    "error": LOWER,
    "found": {**LOWER, "value": 100, "direction": "higher", "tolerance": 3},
    "share": {**LOWER, "value": 0.95, "direction": "equal", "tolerance": 0.02},
}


def with_values(**values):
    return {name: {**row, "value": values.get(name, row["value"])} for name, row in FIGURES.items()}


@pytest.fixture
def gate(monkeypatch, tmp_path):
    """The command with what it measures given, and the JSON that it keeps in a folder."""
    monkeypatch.setattr(frozen, "KEPT", tmp_path / "frozen.json")
    frozen.update({}, "full", {"errors": FIGURES}, "as it is")

    def run(fresh, *words):
        monkeypatch.setattr(frozen, "measured", lambda group, quick, cache: fresh)
        monkeypatch.setattr(sys, "argv", ["frozen.py", "--only", "errors", *words])
        return frozen.main()

    return run


NOT_WORSE = {}, {"error": 2.1}, {"error": 1.0}, {"found": 97}, {"share": 0.97}, {"share": 0.93}
WORSE = ("error", 2.2), ("found", 96), ("share", 0.98), ("share", 0.92)


@pytest.mark.parametrize(
    "fresh, words, ended, told",
    [
        *((with_values(**values), "--gate", 0, "Nothing is worse") for values in NOT_WORSE),
        *(
            (with_values(**{name: x}), "--gate", 1, f"{name}: {FIGURES[name]['value']} -> {x}")
            for name, x in WORSE
        ),
        (with_values(error=2.2), "", 0, "worse           error: 2.0 -> 2.2"),
        (with_values(error=5.9), "--gate --times 3", 0, ""),
        (with_values(error=6.1), "--gate --times 3", 1, "worse           error"),
        (with_values(error=None), "--gate", 1, "cannot compare  error"),
        ({"found": FIGURES["found"]}, "--gate", 1, "cannot compare  error"),
        ({}, "--gate", 0, "cannot compare: errors was skipped"),
        (FIGURES, "--gate --quick", 1, "nothing is frozen at the quick size"),
    ],
)
def test_gate_ends_with_one_where_a_figure_is_worse_or_missing(
    gate, fresh, words, ended, told, capsys
):
    assert gate(fresh, *words.split()) == ended
    assert told in capsys.readouterr().out


def test_group_that_was_never_frozen_ends_with_one(capsys):
    assert frozen.gate({"full": {}}, "full", {"errors": FIGURES}) == 1
    assert "errors is not frozen" in capsys.readouterr().out


def test_update_wants_a_reason_and_keeps_it(gate, capsys):
    with pytest.raises(SystemExit) as ended:
        gate(with_values(error=5.0), "--update", "--reason", " ")
    assert ended.value.code == 2
    assert "expected `--reason`" in capsys.readouterr().err
    assert gate(with_values(error=5.0), "--update", "--reason", "exact overlaps") == 0
    kept = json.loads(frozen.KEPT.read_text())
    said = {"groups": ["errors"], "size": "full", "reason": "exact overlaps"}
    assert kept["reasons"][-1] == said
    assert gate(with_values(error=5.0), "--gate") == 0


def test_trials_go_on_where_they_stopped(tmp_path):
    done = []

    def trial(number, shape):
        done.append((number, shape))
        return {"shape": shape, "number": number}

    asked = _common.Options(tmp_path, seed=5, resume=True)
    given = asked, "some", 4, [("ball",), ("cube",)], trial
    rows = _common.trials(*given)
    assert done == [(5, "ball"), (6, "ball"), (7, "cube"), (8, "cube")]
    path = tmp_path / "some.jsonl"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:3]))  # stopped before one
    assert _common.trials(*given)[:3] == rows[:3]
    assert done[4:] == [(8, "cube")]
