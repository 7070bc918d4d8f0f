"""Rays against a scene: closest and any hit, depth and normals."""
