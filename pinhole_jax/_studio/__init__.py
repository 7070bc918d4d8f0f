"""A bench in the browser: a person gets a camera from a photo, by turning, painting and fitting."""
