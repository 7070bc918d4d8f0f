"""Central differences of functions whose slopes are known by hand, kinks among them."""

import numpy as np
import pytest

from pinhole_jax.testing.differences import STEPS, outside, slopes

STEP = 1e-5


def slopes_of(function, allowed=1e-6):
    """Return the slopes of a one-pixel image at 0."""
    image = lambda x: np.array([[function(x)]])
    up, down = (np.stack([image(sign * STEP * k) for k in STEPS]) for sign in (1, -1))
    return slopes(image(0.0), up, down, STEP, allowed)


def test_smooth_pixel_has_one_slope():
    found = slopes_of(lambda x: 3 * np.sin(x) + x * x)
    assert not found.kink[0, 0]
    np.testing.assert_allclose([found.central, found.low, found.high], 3, rtol=1e-9)


@pytest.mark.parametrize("jump", [3.0, -3.0])
def test_kink_at_the_point_has_two_slopes(jump):
    """All its central differences agree, on the mean of two slopes: the gap gives it away."""
    found = slopes_of(lambda x: x + jump * max(x, 0))
    assert found.kink[0, 0]
    np.testing.assert_allclose(
        np.array([found.low[0, 0], found.high[0, 0]]), sorted([1, 1 + jump]), rtol=1e-9
    )


@pytest.mark.parametrize("at", [0.9, 0.6, 0.3, 0.2, -0.2])
def test_kink_away_from_the_point_is_ignored(at):
    """A smaller step does not meet it, and the slope at the point itself is found."""
    found = slopes_of(lambda x: 2 * x + 5 * max(x - at * STEP, 0) * (at > 0) + min(x, 0) * 0)
    assert not found.kink[0, 0]
    np.testing.assert_allclose(found.central, 2, rtol=1e-9)


def test_jump_of_the_second_derivative_is_no_kink():
    """An outline that passes a pixel's corner: the second derivative jumps."""
    found = slopes_of(lambda x: x + 0.5 * max(x - 0.3 * STEP, 0) ** 2)
    assert not found.kink[0, 0]
    np.testing.assert_allclose(found.central, 1, atol=1e-6)


def test_distance_outside_the_two_slopes():
    kink = slopes_of(lambda x: max(x, 0.0))
    far = [outside(np.array([[d]]), kink)[0, 0] for d in (-0.5, 0.0, 0.4, 1.0, 1.5)]
    np.testing.assert_allclose(far, [0.5, 0, 0, 0, 0.5], atol=1e-9)
    smooth = slopes_of(lambda x: x)
    far = [outside(np.array([[d]]), smooth)[0, 0] for d in (0.0, 1.0, 3.0)]
    np.testing.assert_allclose(far, [1, 0, 2], atol=1e-9)
    assert np.isnan(outside(np.array([[np.nan]]), smooth)[0, 0])
