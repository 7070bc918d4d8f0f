"""Example shapes: closed meshes for trying things out."""

import numpy as np

from ._scene.scene import Mesh


def bumpy(subdivisions: int = 4, seed: int = 0, bumps: float = 0.12) -> Mesh:
    """Return a bumpy ellipsoid with no symmetry: 20 * 4**subdivisions faces, radius about 1.

    A sphere whose radius is modulated by eight sine waves of relative amplitude `bumps`.

    ```python
    mesh = pj.shapes.bumpy(2)
    ```
    """
    import trimesh

    random = np.random.default_rng(seed)
    sphere = trimesh.creation.icosphere(subdivisions)
    points = np.asarray(sphere.vertices)
    height = np.zeros(len(points))
    for _ in range(8):
        wave = 2.5 * random.normal(size=3)
        height += bumps * np.sin(points @ wave + random.uniform(0, 2 * np.pi))
    return Mesh(points * (1 + height)[:, None] * [1, 0.8, 1.2], np.asarray(sphere.faces))


def revolved(profile: np.ndarray, sections: int = 64) -> Mesh:
    """Return the closed surface that a profile [(radius, height), ...] sweeps about the z axis.

    The profile runs from the axis to the axis (radius 0 at both ends), counter-clockwise as seen
    with the radius to the right and the height up.

    ```python
    cone = pj.shapes.revolved(np.array([(0, 0), (1, 0), (0, 2)]))
    ```
    """
    import trimesh

    radii = np.asarray(profile, float)[:, 0]
    if len(radii) < 3 or radii[0] != 0 or radii[-1] != 0 or np.any(radii[1:-1] <= 0):
        raise ValueError("`profile`: expected radii 0, then positive ones, then 0")
    surface = trimesh.creation.revolve(profile, sections=sections)
    return Mesh(np.asarray(surface.vertices), np.asarray(surface.faces))
