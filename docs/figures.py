"""Write the tables of figures in the pages from the experiments' JSON: `python docs/figures.py`.

A page marks a table's place with `<!-- figures: NAME -->`; figures.toml has the tables.
"""

import json
import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
FIGURE = re.compile(r"\{([^{}]+?)(?: \* (\d+))?(?: : (\d))?\}")
PLACE = re.compile(r"(<!-- figures: (\w+) -->\n)(?:\n\|.*(?:\n\|.*)*\n)?")
SOURCES = tomllib.loads((ROOT / "docs/figures.toml").read_text("utf-8"))


def figure(match: re.Match[str]) -> str:
    """A number of the JSON, rounded to the digits asked for, or a word of it."""
    place, *keys = match[1].split(" > ")
    file, *outer = SOURCES["places"][place].split(" > ")
    value = json.loads((ROOT / f"experiments/results/{file}.json").read_bytes())
    for key in outer + keys:
        value = value[int(key) if isinstance(value, list) else key]
    if not match[3]:
        return value
    return f"{value * int(match[2] or 1):.{match[3]}g}".replace("e-0", "e-")


def filled(page: str) -> str:
    """A page with its tables, their numbers from the JSON."""
    table = lambda place: f"{place[1]}\n{FIGURE.sub(figure, SOURCES['tables'][place[2]])}"
    return PLACE.sub(table, page)


if __name__ == "__main__":
    for path in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]:
        path.write_text(filled(path.read_text("utf-8")), "utf-8")
