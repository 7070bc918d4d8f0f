"""How a refusal is tried."""

from contextlib import contextmanager

import pytest


@contextmanager
def refusal(words):
    """Assert that a ValueError itself, and no subclass of it, is raised with these words."""
    with pytest.raises(ValueError, match=words) as caught:
        yield caught
    assert type(caught.value) is ValueError, caught.value
