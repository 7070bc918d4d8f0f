"""Masks as people and networks draw them: an image's outline, off by stretches."""

from honesty import signed_distance
from scipy.ndimage import gaussian_filter


def wavy(image, random, px, length, bias=0.0):
    """Return a mask whose outline errs by this many px over a length, and a bias."""
    field = gaussian_filter(random.normal(size=image.shape), length / 2**0.5)
    return signed_distance(image) + px * field / field.std() + bias > 0
