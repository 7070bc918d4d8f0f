"""The record that a command line describes: the same fields as a row of `batch`."""

import argparse
from typing import Any

from ..batch.records import FIELDS


def record_of(options: argparse.Namespace, **more: Any) -> dict[str, Any]:
    """Return the fields of a record that the options give, and `more` of them."""
    given = {**vars(options), "start": None}
    given.setdefault("photo", given.get("image"))
    record = {n: x for n in FIELDS if (x := given.get(n)) is not None and x is not False}
    if given.get("no_tidy"):
        record["tidy"] = False
    return record | more
