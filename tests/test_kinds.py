"""What a mask tells of how it was made, and so of the residual that a right camera leaves."""

import numpy as np
from honesty import jpeg
from numpy.random import default_rng
from oracles import drawn, lump, normal, usual_camera
from refusals import pairs
from scipy.ndimage import gaussian_filter

from pinhole_jax._mask.kinds import kind_of

CAMERA = usual_camera(128, 128)


MASK = drawn(CAMERA, lump(3))


def sampled(mask, number):
    return default_rng(0).binomial(number, np.clip(mask, 0, 1)) / number


def bytes_of(mask):
    return np.round(255 * mask).astype(np.uint8)


def noisy(mask):
    return mask + 0.02 * normal(mask.shape)


def rounded(mask):
    """A mask computed in float32, two of whose pixels within the object are not quite 1."""
    mask = mask.astype(np.float32)
    rows, columns = np.nonzero(gaussian_filter(mask, 3.0) > 0.9999)
    mask[rows[:2], columns[:2]] = 1 - np.float32([6e-8, 1.6e-5])
    return mask


def few_greys(mask):
    """A picture without soft edges, matted: a tenth of its edge's pixels is grey."""
    some = default_rng(0).random(mask.shape) < 0.1
    return bytes_of(np.where(some, mask, mask > 0.5))


KINDS = {
    "exact": (lambda m: m, "soft", True),
    "exact but for rounding": (rounded, "soft", True),
    "16 bits of floats": (lambda m: m.astype(np.float16), "soft", True),
    "8 bits": (bytes_of, "soft", True),
    "8 bits as floats": (lambda m: np.round(255 * m) / 255, "soft", True),
    "16 samples": (lambda m: sampled(m, 16), "soft", False),
    "64 samples, 8 bits": (lambda m: bytes_of(sampled(m, 64)), "soft", False),
    "256 samples": (lambda m: sampled(m, 256), "soft", True),
    "256 samples, 8 bits": (lambda m: bytes_of(sampled(m, 256)), "soft", True),
    "exact, and 1 to rounding": (lambda m: np.where(m == 1, 1 - 4e-15, m), "soft", True),
    "noisy": (noisy, "noisy", True),
    "noisy and clipped": (lambda m: np.clip(noisy(m), 0, 1), "noisy", True),
    "one bit": (lambda m: m > 0.5, "one bit", False),
    "one bit, a few greys": (few_greys, "one bit", False),
    "a little blurred": (lambda m: gaussian_filter(m, 0.5), "wide edges", False),
    "blurred": (lambda m: gaussian_filter(m, 1.5), "wide edges", False),
    "JPEG": (lambda m: jpeg(m, 30), "noisy", False),
}


@pairs("name, make, kind, exact", KINDS)
def test_residual_of_the_right_camera_matches_the_kind(name, make, kind, exact):
    target = make(MASK)
    found = kind_of(target, np.ones(MASK.shape), np.float64)
    assert (found.name, found.exact) == (kind, exact)
    shown = target / 255 if target.dtype == np.uint8 else target.astype(float)
    outline = (MASK > 1e-4) & (MASK < 1 - 1e-4)
    left = np.mean((shown - MASK)[outline] ** 2)
    assert left <= found.most
    assert found.least <= 1.2 * max(left, found.variance)
    rounded_only = name.startswith("exact") or name in ("16 bits of floats", "256 samples, 8 bits")
    if exact and not rounded_only:
        assert 0.3 < left / found.variance < 3
    if exact:  # half a pixel off is not explained
        moved = 0.5 * (MASK + np.roll(MASK, 1, axis=1))
        assert np.mean((moved - MASK)[outline] ** 2) > found.most
