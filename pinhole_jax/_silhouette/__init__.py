"""Exact coverage: the occluding contour as curves on the film, and the area under them."""
