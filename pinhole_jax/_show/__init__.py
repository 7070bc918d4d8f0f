"""The outline on the film and the object in space, as lines to draw."""
