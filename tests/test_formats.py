import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import refusal

import pinhole_jax as pj
from pinhole_jax import formats

# A turn about y by the angle with cosine 0.8, then 3 units forward.
R = np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
T = np.array([0.1, -0.2, 3.0])


@pytest.mark.parametrize(("centres", "half"), [("integer", 0.5), ("half", 0.0)])
@pytest.mark.parametrize(("W", "H"), [(64, 48), (65, 33)])
def test_opencv_by_hand(centres, half, W, H):
    K = np.array([[70.0, 0, 30.0], [0, 72.0, 20.0], [0, 0, 1]])
    camera = formats.from_opencv(K, R, T, W, H, pixel_centres=centres)
    points = np.array([[0.2, 0.3, 0.4], [-1, 0.5, 0]])
    x, y, z = (points @ R.T + T).T
    u, v = 70 * x / z + 30, 72 * y / z + 20  # OpenCV's pixel coordinates, y down
    film = np.stack([u + half, H - (v + half)], axis=1)
    assert_allclose(pj.project(camera, jnp.asarray(points)), film, atol=1e-12)


def test_centred_camera_needs_no_lens():
    K = np.array([[70.0, 0, 31.5], [0, 70.0, 23.5], [0, 0, 1]])
    assert formats.from_opencv(K, R, T, 64, 48, pixel_centres="integer").lens is None
    assert formats.from_opencv(K, R, T, 64, 48, pixel_centres="half").lens is not None


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
