"""Masks as people and networks draw them: an image's outline, off by stretches."""

from scipy.ndimage import distance_transform_edt, gaussian_filter


def outward(image):
    """Return the distance to the outline (px), positive inside."""
    inside = image > 0.5
    return distance_transform_edt(inside) - distance_transform_edt(~inside) - inside + 0.5


def wavy(image, random, px, length, bias=0.0):
    """Return a mask whose outline errs by this many px over a length, and a bias."""
    field = gaussian_filter(random.normal(size=image.shape), length / 2**0.5)
    return outward(image) + px * field / field.std() + bias > 0
