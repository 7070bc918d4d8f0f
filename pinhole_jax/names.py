"""What users may name, and what each word means: plain data, which the help shows without JAX."""

#: The models of a lens's distortion, each with its coefficients in OpenCV's order.
DISTORTIONS: dict[str, tuple[str, ...]] = {
    "BrownConrady": ("k1", "k2", "p1", "p2", "k3"),
    "Rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "Fisheye": ("k1", "k2", "k3", "k4"),
}

#: All that `free` may name.
FREE: tuple[str, ...] = (
    "pose",
    "position",
    "orientation",
    "phi",
    "d",
    "principal_point",
    "aspect",
    *DISTORTIONS["Rational"],
    "distortion",
)

#: What `Fit.status` may be, and what each means.
STATUSES = {
    "converged": "the gradient vanishes, the masks overlap, every direction is determined",
    "ambiguous": "at rest, but other views explain the mask as well",
    "rank_deficient": "at rest, but the mask does not determine some direction",
    "uncertain": "at rest, but the mask's errors leave a turn of several degrees open",
    "misfit": "at rest, but the mask is not explained as its kind (exact, hard, noisy) allows",
    "max_steps": "stopped while still moving",
    "no_overlap": "object and mask hardly overlap: their IoU is below a half",
    "saturated": "the object covers the whole film: there is no outline to follow",
    "non_finite": "NaN or infinity turned up",
}
