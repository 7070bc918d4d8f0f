"""Which cases of a test every run has."""

from collections.abc import Iterable
from typing import Any

import pytest


def first(number: int, cases: Iterable[Any], of: int = 1) -> list[Any]:
    """Return the cases, all but the first few marked long: each is compiled.

    Of the long ones only each `of`-th runs with these, the others where all tests do.
    """
    marks = lambda k: [] if k < number else [pytest.mark.full if k % of else pytest.mark.long]
    rows = [case if isinstance(case, tuple) else (case,) for case in cases]
    return [pytest.param(*row, marks=marks(k)) for k, row in enumerate(rows)]
