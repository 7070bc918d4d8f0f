"""A camera from a mask or from points: residuals, least squares, the search, and what is known."""
