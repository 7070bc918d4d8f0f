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
    r, z = np.asarray(profile, float).T
    if r.shape[0] < 3 or r[0] != 0 or r[-1] != 0 or np.any(r[1:-1] <= 0):
        raise ValueError("`profile`: expected radii 0, then positive ones, then 0")
    angle = 2 * np.pi * np.arange(sections) / sections
    rings = np.stack([np.outer(r[1:-1], np.cos(angle)), np.outer(r[1:-1], np.sin(angle))], axis=-1)
    heights = np.broadcast_to(z[1:-1, None, None], (*rings.shape[:2], 1))
    points = np.concatenate([rings, heights], axis=-1).reshape(-1, 3)
    n = len(r) - 2
    first, last = n * sections, n * sections + 1
    vertices = np.concatenate([points, [[0, 0, z[0]], [0, 0, z[-1]]]])
    here = np.arange(sections)
    there = np.roll(here, -1)
    faces = [np.stack([np.full(sections, first), there, here], axis=1)]
    for k in range(n - 1):
        a, b = k * sections, (k + 1) * sections
        faces.append(np.stack([a + here, a + there, b + there], axis=1))
        faces.append(np.stack([a + here, b + there, b + here], axis=1))
    a = (n - 1) * sections
    faces.append(np.stack([a + here, a + there, np.full(sections, last)], axis=1))
    return Mesh(vertices, np.concatenate(faces))
