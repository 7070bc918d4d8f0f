"""Many views, or views of points, as one problem: unknowns that they share, and the front doors."""
