"""Many views as one problem: unknowns that they share, and the front doors."""
