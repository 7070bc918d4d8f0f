import numpy as np
import pytest

import pinhole_jax as pj
from pinhole_jax._fit.words import in_digits


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (1e5 + 2.12345678, 2.9e-6, "100002.1234568"),
        (1.23456, 0.1, "1.23"),
        (1234.5, 100.0, "1234"),
        (0.5, 1e-30, "0.500000000000"),
        (1234567.8, np.inf, "1.23457e+06"),
        (2.0, 0.0, "2"),
    ],
)
def test_a_number_has_the_digits_that_its_error_leaves(value, std, text):
    assert in_digits(value, std) == text


def test_a_fit_is_printed_as_a_table():
    camera = pj.Camera([1, 2, 5], [0, 0, 0], [0, 1, 0], 0.6, 1.0, 64, 48)
    names = ("rotation_b1", "e_x", "phi")
    std = np.array([1e-3, 1e-4, 1e-5])
    other = pj.Fit(camera, "converged", names, np.diag(std**2), std, 0.01, 0.99, (3,), ())
    fit = other._replace(status="ambiguous", weak=("the distance",), modes=(other,))
    lines = str(fit).splitlines()
    assert [line.split() for line in lines[1:4]] == [
        ["pitch", "(about", "b1,", "right)", "-", "0.057", "deg"],
        ["e_x", "1.00000", "0.0001", "world"],
        ["phi,", "vertical", "field", "of", "view", "34.37747", "0.00057", "deg"],
    ]
    assert lines[4].startswith("status     ambiguous   (at rest, but other views")
    assert lines[-2:] == [
        "note       the distance",
        "note       another view explains the mask as well",
    ]
