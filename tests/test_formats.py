"""What `from_opencv`, and so `Camera.from_K`, refuses."""

import numpy as np
import pytest
from refusals import refusal

from pinhole_jax import formats

# A turn about y by the angle with cosine 0.8, then 3 units forward.
R = np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
T = np.array([0.1, -0.2, 3.0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"R": 2 * R}, "`R`: expected a rotation matrix"),
        ({"R": -R}, "`R`: expected a rotation matrix"),
        ({"t": [0, 0, np.nan]}, "`t`: expected finite values, got nan at index .2"),
        (
            {"pixel_centres": "corner"},
            "`pixel_centres`: expected 'integer' or 'half', got 'corner'",
        ),
        ({"K": np.array([[70.0, 1, 30], [0, 70, 20], [0, 0, 1]])}, "`K`: expected no skew, got 1"),
        ({"K": np.zeros((3, 3))}, r"`K`: expected \[\[fx, 0, cx\]"),
        ({"K": np.diag([70.0, -70, 1])}, "`K`: expected positive focal lengths .*fy = -70"),
        ({"K": np.diag([70.0, 1e200, 1])}, "`K`: expected positive focal lengths .*fy = 1e.200"),
        ({"K": [[70, 0], [0, 70, 1]]}, r"`K`: expected a real array of shape \(3, 3\), got"),
        ({"K": "K"}, r"`K`: expected a real array of shape \(3, 3\), got 'K'"),
        ({"R": [[1], [2, 3]]}, "`R`: expected a real array of shape"),
        ({"t": None}, "`t`: expected a real array of shape .* got None"),
        ({"W": None}, "`W`: expected an integer of at least 1, got None"),
        ({"H": "48"}, "`H`: expected an integer of at least 1, got '48'"),
        ({"pixel_centres": np.array(["half"] * 2)}, "`pixel_centres`: expected 'integer' or"),
    ],
)
def test_bad_input_is_refused(change, message):
    good = {"K": np.diag([70.0, 70, 1]), "R": R, "t": T, "W": 64, "H": 48, "pixel_centres": "half"}
    with refusal(message):
        formats.from_opencv(**{**good, **change})
