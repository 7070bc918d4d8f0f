"""A perfect mask, one that the film cuts off and one that is cut off itself are told apart."""

import re

import numpy as np
import pytest
from oracles import drawn
from test_plot import AHEAD, SQUARE

from pinhole_jax.plot import disagreement


def square_mask():
    """SQUARE's hard mask as AHEAD sees it."""
    return drawn(AHEAD, SQUARE) > 0.5


def column_in(words):
    return int(re.search(r"\(near column (\d+)", words)[1])


def test_perfect_mask_gets_no_remark():
    assert disagreement(AHEAD, SQUARE, square_mask()) == ()
    assert disagreement(AHEAD, SQUARE, np.zeros((80, 96), bool)) == ()


def test_cut_mask_is_located():
    mask = square_mask()
    first = np.flatnonzero(mask.any(axis=0))[0]
    mask[:, : first + 10] = False
    lost, added = disagreement(AHEAD, SQUARE, mask)
    assert "of the model's outline (near column" in lost
    assert "is the mask cut off or covered there" in lost
    assert abs(column_in(lost) - first) < 10
    assert "of the mask's edge (near column" in added
    assert abs(column_in(added) - first - 10) <= 1


def test_object_cut_by_the_film_is_not_blamed_on_the_mask():
    camera = AHEAD.replace(p=[AHEAD.p[0] + 1.2, *AHEAD.p[1:]])
    mask = drawn(camera, SQUARE) > 0.5
    (words,) = disagreement(camera, SQUARE, mask)
    assert words.startswith("the picture's border cuts off ")


@pytest.mark.parametrize("extra", [True, False])
def test_extra_and_missing_parts_are_told_apart(extra):
    mask = square_mask()
    rows, columns = np.nonzero(mask)
    middle, last = round(np.mean(rows)), columns.max()
    begin = last if extra else last - 12
    mask[middle - 8 : middle + 8, begin : begin + 13] = extra
    _, added = disagreement(AHEAD, SQUARE, mask)
    assert (column_in(added) > last) == extra
