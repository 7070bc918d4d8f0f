"""Where a camera may be that sees a mask, with no start: views compared by their signatures.

A signature is a mask in polar coordinates about its own centroid, on a film turned to face it and
scaled to its own size: what is left of a mask when shift, distance and (up to a rotation of the
columns) roll are taken away. The scene is rendered from directions all over the sphere; a circular
correlation finds the roll at which each view comes closest to the mask.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._camera.camera import Camera, bend, camera_basis, film_map, focal_px, principal_point
from .._scene.scene import Ball, Scene
from .._silhouette.silhouette import silhouette
from .target import shares

#: Directions looked from (some 11 degrees apart), and px of their images.
VIEWS, VIEW_PX = 400, 48
#: A signature's rings, out to `REACH` radii of the disc of the mask's own area, and angles.
RINGS, ANGLES, REACH = 16, 72, 2.4
#: The nearest that a view is taken from, in radii of the scene.
NEAREST = 1.2


class Signature(NamedTuple):
    """Masks about their own centroids: samples (N, RINGS, ANGLES), whether each was in the picture,
    solid angles (N,) and axes (N, 3, 3): rows x, y and the centroid's direction, in camera axes.
    """

    samples: np.ndarray
    valid: np.ndarray
    solid_angle: np.ndarray
    axes: np.ndarray


def signatures(
    images: np.ndarray, weight: np.ndarray, focal: np.ndarray, centre: np.ndarray
) -> Signature:
    """Return the signatures of images (N, H, W); focal lengths and principal point in px.

    Where `weight` (H, W) is 0 nothing is known of the image.
    """
    images, weight = images[:, ::-1], weight[::-1]  # rows from the film's bottom
    N, H, W = images.shape
    x, y = (np.arange(W) + 0.5 - centre[0]) / focal[0], (np.arange(H) + 0.5 - centre[1]) / focal[1]
    cosine = (1 + x**2 + y[:, None] ** 2) ** -0.5
    share = images * (weight > 0) * cosine**3 / (focal[0] * focal[1])
    total = np.maximum(share.sum(axis=(1, 2)), 1e-12)
    middle = np.stack(
        [(share.sum(axis=1) @ x) / total, (share.sum(axis=2) @ y) / total, np.ones(N)], axis=-1
    )
    axes = facing(middle)
    radius = np.tan(np.minimum(np.sqrt(total / np.pi), 1.2))
    ring = (np.arange(RINGS) + 0.5) / RINGS * REACH
    angle = 2 * np.pi * np.arange(ANGLES) / ANGLES
    r = (radius[:, None] * ring)[:, :, None]
    flat = np.stack([r * np.cos(angle), r * np.sin(angle), np.ones((N, RINGS, ANGLES))], axis=-1)
    ray = np.einsum("nrti,nij->nrtj", flat, axes)
    ahead = ray[..., 2] > 1e-3
    depth = np.where(ahead, ray[..., 2], 1)
    column = ray[..., 0] / depth * focal[0] + centre[0] - 0.5
    row = ray[..., 1] / depth * focal[1] + centre[1] - 0.5
    inside = ahead & (column > -1) & (column < W) & (row > -1) & (row < H)
    i, j = np.floor(column), np.floor(row)
    a, b = column - i, row - j
    n = np.arange(N)[:, None, None]
    samples, known = np.zeros(column.shape), np.zeros(column.shape)
    for di, dj in ((0, 0), (1, 0), (0, 1), (1, 1)):
        part = np.where(di, a, 1 - a) * np.where(dj, b, 1 - b)
        there = [np.clip(k, 0, size - 1).astype(int) for k, size in ((j + dj, H), (i + di, W))]
        samples += part * images[n, there[0], there[1]]
        known += part * weight[there[0], there[1]]
    return Signature(np.where(inside, samples, 0), inside & (known > 0.5), total, axes)


def facing(direction: np.ndarray) -> np.ndarray:
    """Return axes (N, 3, 3) whose third row is along a direction, turned there the shortest way."""
    d = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    x, y, z = d.T
    k = 1 / (1 + np.maximum(z, -1 + 1e-9))
    rows = [[1 - k * x * x, -k * x * y, -x], [-k * x * y, 1 - k * y * y, -y], [x, y, z]]
    return np.moveaxis(np.array(rows), -1, 0)


def distances(mask: Signature, views: Signature) -> np.ndarray:
    """Return (N, ANGLES): mean squared difference of one mask and N views turned by each angle."""
    area = np.arange(RINGS)[:, None] + 0.5
    known, seen = (s.valid * 1.0 for s in (mask, views))
    target, samples = mask.samples * known, views.samples * seen

    def correlate(a, b):
        spectrum = np.fft.rfft(a * area, axis=-1) * np.conj(np.fft.rfft(b, axis=-1))
        return np.fft.irfft(spectrum, n=ANGLES, axis=-1).sum(axis=1)

    both = np.maximum(correlate(known, seen), 1)
    total = correlate(target**2, seen) + correlate(known, samples**2)
    return (total - 2 * correlate(target, samples)) / both


@jax.jit
def _views(
    scene: Scene,
    eyes: Float[Array, "N 3"],
    number: Int[Array, ""],
    pivot: Float[Array, "3"],
    phi: Float[Array, ""],
) -> tuple[Float[Array, "N h w"], Float[Array, "N 3 3"]]:
    """Return images and camera axes from the first `number` of the eyes: one program for any."""

    def one(n, seen):
        eye = eyes[n]
        # An up direction that is never along the view.
        back = eye - pivot
        up = jnp.where(jnp.abs(back[2]) < 0.9 * jnp.sqrt(jnp.sum(back**2)), 1, 0)
        up = jnp.stack([1 - up, 0 * up, up]).astype(eye.dtype)
        camera = Camera(eye, pivot, up, phi, 1.0, VIEW_PX, VIEW_PX)
        image, axes = silhouette(camera, scene, overlaps=False), jnp.stack(camera_basis(camera))
        return seen[0].at[n].set(image), seen[1].at[n].set(axes)

    shapes = (VIEW_PX, VIEW_PX), (3, 3)
    nothing = tuple(jnp.zeros((len(eyes), *shape), eyes.dtype) for shape in shapes)
    return jax.lax.fori_loop(0, number, one, nothing)


class Mask(NamedTuple):
    """A target (H, W), its weights, and a camera of which film, phi and lens are used."""

    target: np.ndarray
    weight: np.ndarray
    camera: Camera

    @property
    def image(self) -> np.ndarray:
        """Return the target as floats."""
        return shares(self.target)

    def longer(self, factor: float) -> "Mask":
        """Return the mask as seen with a focal length times a factor."""
        phi = 2 * jnp.arctan(jnp.tan(self.camera.phi / 2) / factor)
        return self._replace(camera=eqx.tree_at(lambda c: c.phi, self.camera, phi))

    def signature(self) -> Signature:
        """Return the mask's signature."""
        focal = np.array([float(f) for f in focal_px(self.camera)])
        centre = np.asarray(principal_point(self.camera), float)
        if self.camera.lens is None or self.camera.lens.distortion is None:
            return signatures(self.image[None], self.weight, focal, centre)
        image, weight, corner, scale = self._straightened()
        return signatures(image[None], weight, focal * scale, (centre - corner) * scale)

    def _straightened(self) -> tuple[np.ndarray, ...]:
        """Return mask and weight without distortion; their lower left corner (px), and their pixels
        for one of now."""
        from scipy.ndimage import map_coordinates

        H, W = self.image.shape
        corner, size = _ideal_rectangle(self.camera)
        x, y = (
            c + (np.arange(n) + 0.5) / n * s for c, n, s in zip(corner, (W, H), size, strict=True)
        )
        column, row = np.moveaxis(_bent(self.camera, np.stack(np.meshgrid(x, y[::-1]), -1)), -1, 0)
        at = np.stack([H - row - 0.5, column - 0.5])
        image, weight = (
            map_coordinates(z, at, order=1, cval=0.0) for z in (self.image, self.weight + 0.0)
        )
        return image, weight, corner, np.array([W, H]) / size

    def seen_by(self, eye: np.ndarray, axes: np.ndarray) -> Camera:
        """Return the camera at an eye with these axes (rows b1, b2, v)."""
        c, dtype = self.camera, self.camera.e.dtype
        far = float(np.linalg.norm(np.asarray(c.p - c.e)))
        pose = [jnp.asarray(x, dtype) for x in (eye, eye + far * axes[2], axes[1])]
        return eqx.tree_at(lambda c: [c.e, c.p, c.u], c, pose)


def _ideal_rectangle(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return lower left corner and size (px) of a part of the ideal film that shows all."""
    left, right, bottom, top = (float(x) for x in film_map(camera).bounds)
    return np.array([left, bottom]), np.array([right - left, top - bottom])


def _bent(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return where ideal film points (px) are seen."""
    bent = bend(camera)
    assert bent is not None
    return np.asarray(bent(jnp.asarray(points, camera.e.dtype)), float)


def _seen(
    scene: Scene, ball: Ball, directions: np.ndarray, reach: float, dtype: Any
) -> tuple[Signature, np.ndarray]:
    """Return signatures of the scene, and camera axes, from directions at `reach` radii."""
    phi = 2 * np.arcsin(min(1 / reach, 0.95))
    eyes = ball.centre + reach * ball.radius * directions
    number = len(eyes)
    room = np.pad(eyes, ((0, VIEWS - number), (0, 0)))
    room, pivot, fov = (np.asarray(x, dtype) for x in (room, ball.centre, phi))
    seen = _views(scene, room, np.int32(number), pivot, fov)
    images, axes = (np.asarray(x[:number], float) for x in seen)
    film = np.full(2, VIEW_PX / (2 * np.tan(phi / 2))), np.full(2, VIEW_PX / 2)
    known = np.ones((VIEW_PX, VIEW_PX))
    return signatures(images, known, *film), axes


def guesses(mask: Mask, scene: Scene, ball: Ball) -> Iterator[Camera]:
    """Yield cameras that may see the mask, the likeliest first; the camera's pose is not used."""
    goal, dtype = mask.signature(), mask.camera.e.dtype
    # How far away the scene is, from its mean solid angle; then what it looks like from there.
    few, _ = _seen(scene, ball, sphere_points(VIEWS // 10), 5.0, dtype)
    reach = 5.0 * np.sqrt(np.median(few.solid_angle) / goal.solid_angle[0])
    reach, directions = float(np.clip(reach, NEAREST, 50)), sphere_points(VIEWS)
    views, axes = _seen(scene, ball, directions, reach, dtype)
    score = distances(goal, views)
    dips = (score <= np.roll(score, 1, axis=1)) & (score < np.roll(score, -1, axis=1))
    order = np.argsort(np.where(dips, score, np.inf), axis=None)[: int(dips.sum())]
    for n, k in zip(*np.unravel_index(order, score.shape), strict=True):
        c, s = np.cos(2 * np.pi * k / ANGLES), np.sin(2 * np.pi * k / ANGLES)
        roll = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        far = reach * np.sqrt(views.solid_angle[n] / goal.solid_angle[0])
        eye = ball.centre + max(far, NEAREST) * ball.radius * directions[n]
        yield mask.seen_by(eye, goal.axes[0].T @ roll @ views.axes[n] @ axes[n])


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
        view, _ = _seen(scene, ball, away[None], reach, mask.camera.e.dtype)
        reach = max(reach * np.sqrt(view.solid_angle[0] / goal.solid_angle[0]), NEAREST)
    toward = facing((axes @ -away)[None])[0] @ axes
    return mask.seen_by(ball.centre + reach * ball.radius * away, goal.axes[0].T @ toward)


def axes_of(camera: Camera) -> np.ndarray:
    """Return the camera's axes as rows (3, 3) in float64, without a compiled program."""
    e, p, u = (np.asarray(x, float) for x in (camera.e, camera.p, camera.u))
    v = (p - e) / np.linalg.norm(p - e)
    b1 = np.cross(v, u)
    b1 /= np.linalg.norm(b1)
    return np.stack([b1, np.cross(b1, v), v])


def angle(a: Camera, b: Camera) -> float:
    """Return the angle between two cameras' orientations (rad)."""
    chord = np.linalg.norm(axes_of(a) - axes_of(b)) / 8**0.5
    return float(2 * np.arcsin(min(chord, 1)))


def sphere_points(number: int) -> np.ndarray:
    """Return unit vectors (number, 3), spread evenly over the sphere (Fibonacci's spiral)."""
    k = np.arange(number) + 0.5
    z = 1 - 2 * k / number
    angle = np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=-1)
