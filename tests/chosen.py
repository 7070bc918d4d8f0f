"""Which cases of a test every run has."""

import jax
import pytest

#: Of a test of how a CPU does it: other machines do it another way.
on_cpu = pytest.mark.skipif(jax.default_backend() != "cpu", reason="it is about a CPU's programs")


def long(*case):
    """Return a case of a test that runs with the long ones."""
    return pytest.param(*case, marks=pytest.mark.long)


def full(*case):
    """Return a case of a test that runs where all tests do: others take the same way."""
    return pytest.param(*case, marks=pytest.mark.full)


def first(number, cases, of=1):
    """Return the cases, all but the first few marked long: each is compiled.

    Of the long ones only each `of`-th runs with these, the others where all tests do.
    """
    marked = lambda k: pytest.param if k < number else full if k % of else long
    rows = [case if isinstance(case, tuple) else (case,) for case in cases]
    return [marked(k)(*row) for k, row in enumerate(rows)]
