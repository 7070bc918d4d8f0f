"""How a refusal is tried."""

from contextlib import contextmanager

import pytest


@contextmanager
def refusal(words):
    """Assert that a ValueError itself, and no subclass of it, is raised with these words."""
    with pytest.raises(ValueError, match=words) as caught:
        yield caught
    assert type(caught.value) is ValueError, caught.value


def pairs(names, cases):
    """Run a test for each key of a dict, with its value, or the parts of a tuple: so they are
    named, and the key is the case's name."""
    parts = lambda value: value if isinstance(value, tuple) else (value,)
    rows = [(key, *parts(value)) for key, value in cases.items()]
    return pytest.mark.parametrize(names, rows, ids=[*cases])


def refuses(function, good, cases):
    """A test that a function takes good arguments with no such change, by the words of its error.

    Assign it to a name that pytest finds.
    """

    @pairs("words, change", cases)
    def refused(words, change):
        with refusal(words):
            function(**{**good, **change})

    return refused
