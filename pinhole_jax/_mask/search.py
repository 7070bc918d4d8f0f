"""Where a camera may be that sees a mask, with no start: views compared by their signatures.

The scene is rendered from directions all over the sphere; a circular
correlation finds the roll at which each view comes closest to the mask.
"""

from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.axes import axes_of, sphere_points
from .._camera.camera import Camera, camera_basis, film_map
from .._native.library import is_available
from .._numerics.memo import memoised
from .._rules import RULES
from .._scene.scene import Ball, Scene
from .._silhouette.silhouette import on_film
from .mask import Mask
from .signatures import ANGLES, Signature, distances, facing, signatures

#: Width and height of a scene's small pictures (px).
SIZE = 48
#: The nearest that a view is taken from, in radii of the scene.
NEAREST = 1.2
#: Views are drawn from distances that differ by this factor.
REACH_STEP = 1.15


class _Views(NamedTuple):
    """A scene from directions (N, 3), `reach` radii away: signatures, and the cameras' axes."""

    directions: np.ndarray
    reach: float
    signatures: Signature
    axes: np.ndarray

    def reaches(self, goal: Signature) -> np.ndarray:
        """How far away (N,), in radii, each view has a mask's size."""
        size = self.signatures.solid_angle / goal.solid_angle[0]
        return np.maximum(self.reach * np.sqrt(size), NEAREST)


def _seen_all_round(scene: Scene, ball: Ball, number: int, reach: float) -> _Views:
    """A scene as it looks from directions all over the sphere, from about `reach` radii away.

    Fits of one scene share these views: hence the steps of the distance.
    """
    reach = float(np.clip(REACH_STEP ** round(np.log(reach) / np.log(REACH_STEP)), NEAREST, 50))
    parts = map(np.asarray, jax.tree.leaves(scene))
    given = scene, ball, sphere_points(number), reach
    return memoised(_views, np.array([number, reach]), *parts, given=given)


def _views(scene: Scene, ball: Ball, directions: np.ndarray, reach: float) -> _Views:
    phi = 2 * np.arcsin(min(1 / reach, 0.95))
    images, axes = _thumbnails(scene, ball, directions, reach, phi)
    film = np.full(2, SIZE / (2 * np.tan(phi / 2))), np.full(2, SIZE / 2)
    found = signatures(images, np.ones((SIZE, SIZE)), *film)
    found = found._replace(samples=found.samples.astype(np.float32))
    return _Views(directions, reach, found, axes)


def _thumbnails(
    scene: Scene, ball: Ball, directions: np.ndarray, reach: float, phi: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return coverage (N, SIZE, SIZE), row 0 on top, and camera axes (N, 3, 3): the scene as it
    looks from unit directions (N, 3), its ball's radius times `reach` away from the middle."""
    up = np.where(np.abs(directions[:, 2:]) < 0.9, [0.0, 0, 1], [1.0, 0, 0])  # never along the view
    given = ball.centre, phi, ball.centre + reach * ball.radius * directions, up
    # (On the CPU where the library runs there.)
    cpu = jax.default_device(jax.devices("cpu")[0]) if is_available() else nullcontext()
    with cpu:
        real = jax.tree.leaves(scene)[0].dtype
        images, axes = _drawn(scene, *(jnp.asarray(x, real) for x in given))
        return np.asarray(images, float), np.asarray(axes, float)


@eqx.filter_jit
def _drawn(
    scene: Scene,
    centre: Float[Array, "3"],
    phi: Float[Array, ""],
    eyes: Float[Array, "N 3"],
    ups: Float[Array, "N 3"],
) -> tuple[Float[Array, "N H W"], Float[Array, "N 3 3"]]:
    def drawn(place: tuple[Array, Array]) -> tuple[Array, Array]:
        camera = Camera(place[0], centre, place[1], phi, 1.0, SIZE, SIZE)
        return on_film(film_map(camera), scene), jnp.stack(camera_basis(camera))

    return jax.lax.map(drawn, (eyes, ups))


def guesses(mask: Mask, scene: Scene, ball: Ball) -> Iterator[Camera]:
    """Yield cameras that may see the mask, the likeliest first; the camera's pose is not used."""
    return partly_hidden(mask, scene, ball, [None])[0]


def partly_hidden(
    mask: Mask, scene: Scene, ball: Ball, directions: Sequence[float | None]
) -> list[Iterator[Camera]]:
    """For each direction (rad, from the film's right to its top) the cameras that may see the
    mask, the likeliest first, if something hides what lies there; for None, if nothing does."""
    whole = mask.signature()
    few = _seen_all_round(scene, ball, RULES.views // 10, 5.0)
    views = _seen_all_round(scene, ball, RULES.views, float(np.median(few.reaches(whole))))
    goals = [whole if d is None else mask.signature(d) for d in directions]
    return [_likely(mask, ball, goal, views) for goal in goals]


def _likely(mask: Mask, ball: Ball, goal: Signature, views: _Views) -> Iterator[Camera]:
    """Yield cameras whose views are like a signature, the likeliest first."""
    from scipy.spatial.transform import Rotation

    seen, reaches = views.signatures, views.reaches(goal)
    score = distances(goal, seen)
    dips = (score <= np.roll(score, 1, axis=1)) & (score < np.roll(score, -1, axis=1))
    # (A round mask looks the same at every roll: none of them is less than the next.)
    flat = ~np.any(dips, axis=1)
    dips[flat, np.argmin(score[flat], axis=1)] = True
    order = np.argsort(np.where(dips, score, np.inf), axis=None)[: int(dips.sum())]
    for n, k in zip(*np.unravel_index(order, score.shape), strict=True):
        roll = Rotation.from_euler("z", 2 * np.pi * k / ANGLES).as_matrix()
        eye = ball.centre + reaches[n] * ball.radius * views.directions[n]
        yield mask.camera.with_pose(eye, goal.axes[0].T @ roll @ seen.axes[n] @ views.axes[n])


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
        reach = float(_views(scene, ball, away[None], reach).reaches(goal)[0])
    toward = facing((axes @ -away)[None])[0] @ axes
    return mask.camera.with_pose(ball.centre + reach * ball.radius * away, goal.axes[0].T @ toward)
