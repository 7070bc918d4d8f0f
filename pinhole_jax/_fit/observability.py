"""`observability`: what a mask of this scene could tell of a camera, before any mask is taken."""

from collections.abc import Iterable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .._camera.axes import axes_of
from .._camera.camera import Camera
from .._mask.mask import Mask
from .._mask.target import check_weight
from .._numerics.arrays import ArrayLike, Input
from .._scene.scene import Scene, check_scene, check_view
from .._solver.moves import canonical
from .._solver.parameters import check_free, components, labels_of, with_lens
from .._solver.problem import UNIT_PX
from .._solver.solver import Solver
from .._solver.subject import Subject
from .._solver.uncertainty import BLIND, covariance, moves_in_words, weak_directions
from .result import to_units


class Observability(NamedTuple):
    """What `observability` returns.

    - `names`: the parameters, as in a `Fit`; `std` (n,) and `covariance` (n, n) are what a fit to a
      mask with the given noise would report: infinite where the mask says nothing.
    - `rank`: how many directions of the `free` parameters change the mask at all, `of` how many.
    - `values` (n,): the Jacobian's singular values, largest first: root sum of squares of the
      change of coverage for a move of the outline by about one pixel.
    - `weak`: sentences on the directions that change it little or not at all.

    ```python
    told.rank, told.std, told.weak
    ```
    """

    names: tuple[str, ...]
    rank: int
    of: int
    values: Float[np.ndarray, "n"]
    std: Float[np.ndarray, "n"]
    covariance: Float[np.ndarray, "n n"]
    weak: tuple[str, ...]

    def __str__(self) -> str:
        """Return it as a short table."""
        lines = [f"{self.rank} of {self.of} directions are visible"]
        lines += [f"{n:<14} {s:.3g}" for n, s in zip(self.names, self.std, strict=True)]
        return "\n".join([*lines, *self.weak])


def observability(
    camera: Camera,
    scene: Scene,
    free: str | Sequence[str] = ("pose", "phi"),
    *,
    weight: Input[ArrayLike | None, "H W"] = None,
    noise: float = 0.1,
) -> Observability:
    """Directions of the free parameters that a mask can determine, and how well.

    `noise` is the standard deviation of coverage in a pixel that the outline touches (a hard edge
    has 0.29), `weight` (H, W) as in `fit_camera`. Singular directions have infinite `std` and are
    named in sentences. A sphere shows 4 of the 7 directions of pose and focal length, two 6, three
    7.

    Raises ValueError for arguments that make no fit.

    ```python
    told = pj.observability(truth, scene)
    print(told)
    ```
    """
    check_view(camera, scene)
    check_scene(scene)
    freed = check_free(free, camera)
    camera = with_lens(camera, freed)
    weights = check_weight(weight, camera.W, camera.H)
    mask = Mask(np.full(weights.shape, 0.25), weights, camera)  # (any mask)
    solver = Solver.on(Subject.from_scene(scene, camera.e.dtype), mask, freed, 1)
    view, blind = solver.look(canonical(camera)), BLIND[solver.dtype]
    triangle = view.triangle
    by_px = triangle / UNIT_PX, to_units(view.to_reported, freed, camera) / UNIT_PX
    words = partial(moves_in_words, components(freed), axes_of(camera))
    _, weak = weak_directions(triangle, words, blind)
    return observability_of(labels_of(freed), *by_px, noise, blind, weak)


def observability_of(
    names: tuple[str, ...],
    triangle: np.ndarray,
    reported: np.ndarray,
    noise: float,
    blind: float,
    weak: Iterable[str],
) -> Observability:
    """The observability of parameters that are `reported` (p, n), by moves of about a pixel; R (n,
    n) of J = QR is by these.

    Raises ValueError for a `noise` that is not positive.
    """
    if not noise > 0:
        raise ValueError(f"`noise`: expected a positive standard deviation, got {noise}")
    values = np.linalg.svd(triangle, compute_uv=False)
    cov = covariance(triangle, reported, noise**2 * triangle.T @ triangle, blind)
    rank = int(np.sum(values > blind * max(values[0], np.finfo(float).tiny)))
    std = np.sqrt(np.diag(cov))
    return Observability(names, rank, len(values), values, std, cov, tuple(weak))
