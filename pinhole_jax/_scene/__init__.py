"""What a camera looks at: a triangle mesh, spheres, and what is worked out once for each."""
