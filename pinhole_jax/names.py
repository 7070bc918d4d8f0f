"""The names that users may give and meet, as plain data: the help shows them without JAX."""

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

#: The values of `Fit.status`: what to do, and why.
STATUSES = {
    "converged": "trust it: it is at rest, the masks overlap, every direction is determined",
    "ambiguous": "pick one of its views: others fit the mask equally well",
    "rank_deficient": "the mask leaves open the directions in the notes: use the others",
    "uncertain": "use it as a start only: the notes say what is in doubt",
    "misfit": "do not use it: outline and mask disagree by more than such a mask should",
    "max_steps": "continue from its `camera`: it stopped while still moving",
    "no_overlap": "do not use it: IoU below 0.5. Wrong mesh, unit, or focal length?",
    "saturated": "use another mask: the object covers the whole picture and shows no outline",
    "non_finite": "do not use it: NaN or infinity turned up",
}
