"""`fit_cameras`: many views of one scene with shared intrinsics: `fit_joint`, a camera a view."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from .._camera.camera import Camera, check_camera
from .._camera.lens import Lens
from .._fit.fit_camera import anywhere, check_alone
from .._fit.result import Fit
from .._numerics.arrays import ArrayLike, Input
from .._scene.scene import Scene, check_scene
from .._solver.parameters import as_names, check_free
from .._solver.priors import Pair
from .fit_joint import joint_fit
from .lenses import SHARED
from .views import JointView


def fit_cameras(
    scene: Scene,
    targets: Input[Sequence[ArrayLike], "H W each"],
    cameras: Sequence[Camera] | None,
    shared: str | Sequence[str] = ("phi",),
    free: str | Sequence[str] = ("pose",),
    *,
    phi: Input[ArrayLike | None, "rad"] = None,
    lens: Lens | None = None,
    weights: Input[Sequence[ArrayLike | None] | None, "H W each"] = None,
    outlier_px: float | None = 2.0,
    prior: Input[Mapping[str, Pair] | None, "mean, sigma"] = None,
    bounds: Input[Mapping[str, Pair] | None, "low, high"] = None,
    max_steps: int = 64,
    progress: bool | Callable[[str], None] | None = None,
) -> tuple[Fit, ...]:
    """A `Fit` for each mask; what is `free` is each view's own, what is `shared` is one.

    - `targets`: masks, each as in `fit_camera`; their sizes may differ.
    - `cameras`: where to start, one for each mask; what is shared begins at their mean. None: each
      is searched for, with `phi` and `lens` as in `fit_camera`.
    - `weights`: for each mask, or None.
    - `outlier_px`: as in `fit_camera`: pixels farther from a mask's edge lose their weight at the
      end, where masks are not exact. Then views that err by more than most count less, too.
    - `prior`, `bounds`: as in `fit_camera`; once for shared parameters, else for each view.
    - `max_steps`: a limit for each level, and for each descent from another place.
    - `progress`: as in `fit_camera`; a function is called with words after each level.

    It is `fit_joint` of one scene before separate cameras. As `fit_camera` does, and with the
    others' knowledge of shared parameters, it looks for places of each view that fit as well (its
    `modes`, "ambiguous") or better (then all descend from there), and for moves that are free over
    an interval (`weak`, "rank_deficient", a larger covariance). A start rules out what is far from
    it; where a mask matches badly, the whole sphere of views is searched.

    The covariance of each fit is that of the joint problem: knowledge of all views is in it. The
    cost of a step grows linearly with the number of views.

    Runs outside `jit` and `vmap`. Cameras of the result are differentiable (once, forward and
    reverse) with respect to scene, targets and weights, by the implicit function theorem, as views
    and pixels count in the end; where nothing is known beforehand.

    Raises ValueError for arguments that make no fit; the solver's troubles are in each
    `Fit.status`.

    ```python
    other = truth.replace(e=[4.2, 1.5, 2.5])
    masks = [mask, pj.silhouette(other, scene)]
    fits = pj.fit_cameras(scene, masks, [start, other.replace(e=[4.2, 1.2, 2.8])], shared=("phi",))
    ```
    """
    check_scene(scene)
    count = _checked_count(targets, cameras, weights)
    if cameras is None:
        freed = check_free((*as_names(free), *as_names(shared, "shared")), None, lens)
        starts = [anywhere(scene, target, freed, phi, lens) for target in targets]
    else:
        check_alone("cameras", phi=phi, lens=lens)
        starts = cameras
    if not as_names(shared, "shared"):
        raise ValueError(f"`shared`: expected at least one of {', '.join(SHARED)}, got none")
    names = [str(k) for k in range(count)]
    each = zip(targets, names, [None] * count if weights is None else weights, strict=True)
    fit = joint_fit(
        [JointView(scene, target, name, weight) for target, name, weight in each],
        dict(zip(names, starts, strict=True)),
        free,
        shared=shared,
        search=cameras is None,
        outlier_px=outlier_px,
        prior=prior,
        bounds=bounds,
        max_steps=max_steps,
        progress=progress,
        widens=False,
    )
    return tuple(fit.cameras.values())


def _checked_count(targets: Any, cameras: Any, weights: Any) -> int:
    """The number of masks. Raises ValueError where other arguments have not as many."""
    if isinstance(cameras, Camera):
        raise ValueError("`cameras`: expected one Camera for each mask, in a list, got one Camera")
    if not isinstance(targets, Sequence | np.ndarray | jax.Array):
        kind = type(targets).__name__
        raise ValueError(f"`targets`: expected masks (H, W) in a list, got {kind}")
    if (count := len(targets)) == 0:
        raise ValueError("`targets`: expected at least one mask, got none")
    for name, given in (("cameras", cameras), ("weights", weights)):
        if given is not None and len(given) != count:
            raise ValueError(f"`{name}`: expected one for each of {count} masks, got {len(given)}")
    for camera in cameras if cameras is not None else ():
        check_camera(camera, "cameras")
    return count
