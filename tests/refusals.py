"""How a refusal is tried."""

from contextlib import contextmanager

import pytest


@contextmanager
def refusal(words):
    """Assert that a ValueError itself, and no subclass of it, is raised with these words."""
    with pytest.raises(ValueError, match=words) as caught:
        yield caught
    assert type(caught.value) is ValueError, caught.value


def refuses(function, good, cases):
    """A test that a function takes good arguments with no such change, by the words of its error.

    Assign it to a name that pytest finds.
    """

    @pytest.mark.parametrize("words", cases)
    def refused(words):
        with refusal(words):
            function(**{**good, **cases[words]})

    return refused
