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

#: What `Fit.status` may be: what to do, and why.
STATUSES = {
    "converged": "trust it: at rest, the masks overlap, every direction is determined",
    "ambiguous": "pick one of its views: others explain the mask as well",
    "rank_deficient": "use what the notes do not name: the mask does not determine all",
    "uncertain": "use it for a start: the mask's errors leave a turn of several degrees open",
    "misfit": "do not use it: outline and mask disagree by more than such a mask may err",
    "max_steps": "go on from it (`camera`): it stopped while still moving",
    "no_overlap": "do not use it: IoU below a half. Another mesh, unit, or focal length?",
    "saturated": "take another mask: the object covers the film, there is no outline to follow",
    "non_finite": "do not use it: NaN or infinity turned up",
}
