"""The gate of frozen figures ends with 1 where one is worse, and says what it cannot compare."""

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "experiments"))
import frozen

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


@pytest.mark.parametrize(
    "values", [{}, {"error": 2.1}, {"error": 1.0}, {"found": 97}, {"share": 0.97}, {"share": 0.93}]
)
def test_figures_within_tolerance_pass(gate, values, capsys):
    assert gate(with_values(**values), "--gate") == 0
    assert "Nothing is worse" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "value"), [("error", 2.2), ("found", 96), ("share", 0.98), ("share", 0.92)]
)
def test_worsened_figure_ends_with_one_and_is_listed(gate, name, value, capsys):
    assert gate(with_values(**{name: value}), "--gate") == 1
    told = capsys.readouterr().out
    assert f"worse           {name}: {FIGURES[name]['value']} -> {value}" in told
    assert gate(with_values(**{name: value})) == 0  # without --gate it is only shown


def test_cliffs_alone_are_worse_where_times_are_allowed(gate):
    assert gate(with_values(error=5.9), "--gate", "--times", "3") == 0
    assert gate(with_values(error=6.1), "--gate", "--times", "3") == 1


@pytest.mark.parametrize("fresh", [with_values(error=None), {"found": FIGURES["found"]}])
def test_figure_without_a_number_cannot_be_compared(gate, fresh, capsys):
    assert gate(fresh, "--gate") == 1
    assert "cannot compare  error" in capsys.readouterr().out


def test_skipped_group_is_named_and_passes(gate, capsys):
    assert gate({}, "--gate") == 0
    assert "cannot compare: errors was skipped" in capsys.readouterr().out


def test_size_that_was_never_frozen_ends_with_one(gate, capsys):
    assert gate(FIGURES, "--gate", "--quick") == 1
    assert "nothing is frozen at the quick size" in capsys.readouterr().out


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
    assert kept["full"]["errors"]["error"]["value"] == 5.0
    assert kept["reasons"][-1] == {
        "groups": ["errors"],
        "size": "full",
        "reason": "exact overlaps",
    }
    assert gate(with_values(error=5.0), "--gate") == 0


def test_figures_are_written_with_value_unit_direction_tolerance_and_command(monkeypatch, tmp_path):
    given = [frozen.Figure("a", 2.0, "px", "lower", 0.1, 0.5), frozen.Figure("b", float("nan"), "")]
    monkeypatch.setitem(frozen.GROUPS, "errors", lambda asked: iter(given))
    monkeypatch.setattr("pinhole_jax.cache", lambda: None)
    frozen.child("errors", tmp_path / "errors.json", "full")
    found = json.loads((tmp_path / "errors.json").read_text())
    how = "python experiments/frozen.py --only errors"
    row = {"value": 2.0, "unit": "px", "direction": "lower", "tolerance": 1.0, "how": how}
    assert found["a"] == row
    assert found["b"]["value"] is None


def test_trials_go_on_where_they_stopped(tmp_path):
    import _common

    done = []

    def trial(number, shape):
        done.append((number, shape))
        return {"shape": shape, "number": number}

    asked = _common.Asked(tmp_path, seed=5, resume=True)
    rows = _common.trials(asked, "some", 4, [("ball",), ("cube",)], trial)
    assert done == [(5, "ball"), (6, "ball"), (7, "cube"), (8, "cube")]
    path = tmp_path / "some.jsonl"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:3]))  # stopped before one
    assert _common.trials(asked, "some", 4, [("ball",), ("cube",)], trial)[:3] == rows[:3]
    assert done[4:] == [(8, "cube")]
    again = _common.Asked(tmp_path, seed=5)
    _common.trials(again, "some", 1, [("ball",)], trial)
    assert done[5:] == [(5, "ball")]
