"""Which cases of a test every run has."""

from collections.abc import Iterable
from typing import Any

import pytest


def first(number: int, cases: Iterable[Any]) -> list[Any]:
    """Return the cases, all but the first so many marked long: each is compiled."""
    rows = [case if isinstance(case, tuple) else (case,) for case in cases]
    return [pytest.param(*row, marks=[pytest.mark.long] if k >= number else [])
            for k, row in enumerate(rows)]  # fmt: skip
