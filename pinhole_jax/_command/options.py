"""The record that a command line describes: the same fields as a row of `batch`."""

import argparse
from typing import Any

from ..batch.records import FIELDS


def record_of(options: argparse.Namespace, **more: Any) -> dict[str, Any]:
    """Return the fields of a record that the options give, and `more` of them."""
    given = {name: getattr(options, name, None) for name in FIELDS if name != "start"}
    record = {name: x for name, x in given.items() if x is not None and x is not False}
    if getattr(options, "image", None) is not None:
        record["photo"] = options.image
    if getattr(options, "no_tidy", False):
        record["tidy"] = False
    return record | more
