"""Where a camera may be that sees a mask, with no start: views compared by their signatures.

The scene is rendered from directions all over the sphere; a circular
correlation finds the roll at which each view comes closest to the mask.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from .._camera.axes import axes_of
from .._camera.camera import Camera
from .._scene.scene import Ball, Scene
from .mask import Mask
from .signatures import ANGLES, Signature, distances, facing, signatures
from .thumbnails import SIZE, axes_inward, thumbnails

#: Directions looked from (some 11 degrees apart).
VIEWS = 400
#: The nearest that a view is taken from, in radii of the scene.
NEAREST = 1.2


def _seen(
    scene: Scene, ball: Ball, directions: np.ndarray, reach: float
) -> tuple[Signature, np.ndarray]:
    """Return signatures of the scene, and camera axes, from directions at `reach` radii."""
    phi = 2 * np.arcsin(min(1 / reach, 0.95))
    axes = axes_inward(directions)
    images = thumbnails(scene, ball, reach * directions, axes, phi)
    film = np.full(2, SIZE / (2 * np.tan(phi / 2))), np.full(2, SIZE / 2)
    return signatures(images, np.ones((SIZE, SIZE)), *film), axes


def guesses(mask: Mask, scene: Scene, ball: Ball) -> Iterator[Camera]:
    """Yield cameras that may see the mask, the likeliest first; the camera's pose is not used."""
    goal = mask.signature()
    reach = _reach(scene, ball, goal)
    views, axes = _seen(scene, ball, sphere_points(VIEWS), reach)
    yield from _likely(mask, ball, goal, views, axes, reach)


def partly_hidden(
    mask: Mask, scene: Scene, ball: Ball, directions: Sequence[float | None]
) -> list[Iterator[Camera]]:
    """Return for each direction (rad, from the film's right to its top) cameras that may see the
    mask, the likeliest first, if something hides what lies there; for None, if nothing does."""
    goals = [mask.signature(), *(mask.signature(d) for d in directions if d is not None)]
    reach = _reach(scene, ball, goals[0])
    views, axes = _seen(scene, ball, sphere_points(VIEWS), reach)
    hidden = iter(goals[1:])
    asked = [goals[0] if d is None else next(hidden) for d in directions]
    return [_likely(mask, ball, goal, views, axes, reach) for goal in asked]


def _reach(scene: Scene, ball: Ball, goal: Signature) -> float:
    """The mean distance (radii) from which the scene has a mask's size."""
    few, _ = _seen(scene, ball, sphere_points(VIEWS // 10), 5.0)
    reach = 5.0 * np.sqrt(np.median(few.solid_angle) / goal.solid_angle[0])
    return float(np.clip(reach, NEAREST, 50))


def _likely(
    mask: Mask, ball: Ball, goal: Signature, views: Signature, axes: np.ndarray, reach: float
) -> Iterator[Camera]:
    """Yield cameras whose views are like a signature, the likeliest first."""
    directions = sphere_points(VIEWS)
    score = distances(goal, views)
    dips = (score <= np.roll(score, 1, axis=1)) & (score < np.roll(score, -1, axis=1))
    # (A round mask looks the same at every roll: none of them is less than the next.)
    flat = ~np.any(dips, axis=1)
    dips[flat, np.argmin(score[flat], axis=1)] = True
    order = np.argsort(np.where(dips, score, np.inf), axis=None)[: int(dips.sum())]
    for n, k in zip(*np.unravel_index(order, score.shape), strict=True):
        c, s = np.cos(2 * np.pi * k / ANGLES), np.sin(2 * np.pi * k / ANGLES)
        roll = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        far = reach * np.sqrt(views.solid_angle[n] / goal.solid_angle[0])
        eye = ball.centre + max(far, NEAREST) * ball.radius * directions[n]
        yield mask.camera.with_pose(eye, goal.axes[0].T @ roll @ views.axes[n] @ axes[n])


def aimed(mask: Mask, scene: Scene, ball: Ball) -> Camera:
    """Return the mask's camera with the scene brought to where the mask is, and to its size.

    The eye stays on its line to the scene's middle; the camera turns the shortest way.
    """
    goal, axes = mask.signature(), axes_of(mask.camera)
    away = np.asarray(mask.camera.e, float) - ball.centre
    if not np.linalg.norm(away) > 1e-6 * ball.radius:
        away = -axes[2]
    away = away / np.linalg.norm(away)
    reach = 5.0
    for _ in range(2):  # nearer, it looks a little different
        view, _ = _seen(scene, ball, away[None], reach)
        reach = max(reach * np.sqrt(view.solid_angle[0] / goal.solid_angle[0]), NEAREST)
    toward = facing((axes @ -away)[None])[0] @ axes
    return mask.camera.with_pose(ball.centre + reach * ball.radius * away, goal.axes[0].T @ toward)


def sphere_points(number: int) -> np.ndarray:
    """Return unit vectors (number, 3), spread evenly over the sphere (Fibonacci's spiral)."""
    k = np.arange(number) + 0.5
    z = 1 - 2 * k / number
    angle = np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=-1)
