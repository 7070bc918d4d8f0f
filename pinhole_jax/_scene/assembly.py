"""Several rigid bodies that move against one another, as one mesh."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from .scene import Mesh, Scene, with_vertices


class Assembly:
    """Rigid bodies, each a `Mesh`: `at` puts them in their places.

    Which faces share which edges is worked out once, so that a posture costs no more than to move
    the vertices; scenes of all postures share their faces, and compiled programs.

    Raises ValueError for what are no meshes.
    """

    def __init__(self, bodies: Sequence[Mesh]):
        bodies = list(bodies)
        if not bodies or not all(isinstance(body, Mesh) for body in bodies):
            kinds = ", ".join(type(body).__name__ for body in bodies) or "none"
            raise ValueError(f"`bodies`: expected at least one Mesh, got {kinds}")
        counts = [len(body.vertices) for body in bodies]
        begin = np.cumsum([0, *counts[:-1]])
        faces = [np.asarray(b.faces) + n for b, n in zip(bodies, begin, strict=True)]
        self._dtype = bodies[0].vertices.dtype
        self._points = np.concatenate([np.asarray(body.vertices, float) for body in bodies])
        self._body = np.repeat(np.arange(len(bodies)), counts)
        self._mesh = Mesh(self._points.astype(self._dtype), np.concatenate(faces))

    def __len__(self) -> int:
        """Return the number of bodies."""
        return int(self._body[-1]) + 1

    def at(self, poses: Any) -> Scene:
        """Return the scene with each body at its pose: rigid transforms (B, 4, 4), body to world.

        Raises ValueError for another shape, and for numbers that are not finite.
        """
        matrices = np.asarray(poses, float)
        if matrices.shape != (len(self), 4, 4) or not np.all(np.isfinite(matrices)):
            got = "numbers that are not finite"
            got = got if matrices.shape == (len(self), 4, 4) else f"shape {matrices.shape}"
            raise ValueError(f"`poses`: expected finite numbers ({len(self)}, 4, 4), got {got}")
        rotation, shift = matrices[:, :3, :3][self._body], matrices[:, :3, 3][self._body]
        points = np.einsum("nij,nj->ni", rotation, self._points) + shift
        return Scene(mesh=with_vertices(self._mesh, jnp.asarray(points, self._dtype)))
