"""One view's least squares: what may move, residuals, steps."""
