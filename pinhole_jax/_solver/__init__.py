"""One view's least squares: what may move, residuals, steps, what a mask's errors leave."""
