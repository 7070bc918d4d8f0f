"""The object and the camera in space, seen from the side."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .. import Camera, Rays, Scene, camera_basis, rays_through, trace
from .page import Svg

#: The viewer's angles above and behind the camera's line of sight (rad).
ABOVE, BEHIND = 0.44, 0.35
#: The number of rays through each side of the film. Rays farther from the axis than this cosine
#: (78 degrees) are drawn no longer than it: at 90 degrees they would be endless.
SIDE, LEAST_COSINE = 17, 0.2
#: Width, height and margin of a frustum's picture (px).
W, H, ROOM = 240, 170, 16.0
#: The world's axes with their colours.
WORLD = (("x", "#d9691e"), ("y", "#3a9a4b"), ("z", "#2f6fb0"))
TEAL, GREY = "#008573", "#8fa1ad"
#: The colours of `scene_view`: the object, the camera, the film, the ground.
FACE, LINE, FILM, GROUND = (214, 196, 168), (0, 107, 138), (0, 150, 190, 28), (250, 251, 253)

Points = Float[np.ndarray, "n 3"]


class Sheet(NamedTuple):
    """A parallel view on paper: px (x right, y down) from points of the world, and back.

    `axes` are the sheet's right and down and the way towards the viewer, `scale` is in px a unit.
    """

    axes: Float[np.ndarray, "3 3"]
    scale: float
    shift: Float[np.ndarray, "2"]

    @classmethod
    def from_aside(
        cls, camera: Camera, spread: Points, size: tuple[int, int], room: float
    ) -> "Sheet":
        """Return the view of a camera from behind and above it, with all of `spread` on paper of
        this size and margin (px)."""
        b1, b2, v = axes_of(camera)
        aside = np.cos(BEHIND) * b1 - np.sin(BEHIND) * v
        back = np.cos(ABOVE) * aside + np.sin(ABOVE) * b2
        right = np.cross(b2, aside)
        axes = np.stack([right, np.cross(right, back), back])
        low, high = (spread @ axes[:2].T).min(axis=0), (spread @ axes[:2].T).max(axis=0)
        scale = float(np.min((np.array(size) - 2 * room) / np.maximum(high - low, 1e-30)))
        return cls(axes, scale, np.array(size) / 2 - scale * (low + high) / 2)

    def place(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        """Return the places of points."""
        return self.scale * points @ self.axes[:2].T + self.shift


def scene_view(camera: Camera, scene: Scene, size: int = 800) -> np.ndarray:
    """Return a parallel view, RGB uint8 (3/4 size, size, 3), of the object and the camera.

    The frustum reaches to the film through the object's middle; its tick points up. Distortion
    bends it as it bends rays through the film's border. Faces are shaded by their angle to the
    view.

    ```python
    space = pj.plot.scene_view(fit.camera, scene, size=200)
    ```
    """
    from PIL import Image, ImageDraw

    eye, points = np.asarray(camera.e, float), points_of(scene)
    away = points.mean(axis=0) - eye
    depth = max(float(away @ axes_of(camera)[2]), 1e-6 * float(np.linalg.norm(away)), 1e-30)
    border, *_ = wires = _wires(camera, depth)
    wide, high = 2 * size, 2 * (3 * size // 4)  # drawn at twice the size and averaged down
    sheet = Sheet.from_aside(camera, np.concatenate([*wires, points]), (wide, high), 0.06 * high)

    canvas = Image.new("RGB", (wide, high), GROUND)
    draw = ImageDraw.Draw(canvas, "RGBA")
    flat = lambda points: sheet.place(points).ravel().tolist()
    draw.polygon(flat(border), FILM)
    lit = Image.fromarray(_lit(scene, sheet, size, high // 2)).resize(canvas.size)
    canvas.paste(lit, mask=lit)
    for wire in wires:
        draw.line(flat(wire), (*LINE, 230), 4)
    draw.ellipse([*(sheet.place(eye) - 9), *(sheet.place(eye) + 9)], LINE)
    return np.asarray(canvas.resize((size, high // 2), Image.Resampling.BOX))


def _lit(scene: Scene, sheet: Sheet, width: int, height: int) -> np.ndarray:
    """Return a picture (RGBA) of an object, half as large as its sheet."""
    back = sheet.axes[2]
    x, y = (2 * np.indices((width, height)).T + 1 - sheet.shift).T / sheet.scale
    far = np.max(points_of(scene) @ back) + 1 / sheet.scale
    origins = np.stack([x, y, np.full_like(x, far)]).T @ sheet.axes
    ways = np.broadcast_to(-back, origins.shape)
    hit = trace(scene, Rays(jnp.asarray(origins), jnp.asarray(ways)))
    light = np.abs(np.asarray(hit.normal, float) @ back)[..., None]
    there = 255 * np.isfinite(np.asarray(hit.t))[..., None]
    return np.concatenate([(0.35 + 0.65 * light) * FACE, there], axis=-1).astype(np.uint8)


def frustum(camera: Camera, way: Iterable[Camera] = (), others: Sequence[Camera] = ()) -> Svg:
    """Return a parallel view of a camera as SVG, empty if its numbers are not finite.

    It shows the frustum up to the view point, as `scene_view` does, and the world's axes there. The
    eyes of `way`, earlier cameras of a fit, are a dotted line; those of `others` rings.
    """
    eye, middle = np.asarray(camera.e, float), np.asarray(camera.p, float)
    border, tick, *_ = wires = _wires(camera, float(np.linalg.norm(middle - eye)))
    world = middle + np.linalg.norm(tick[1] - middle) / 2 * np.eye(3)
    eyes = lambda cameras: [np.asarray(c.e, float) for c in cameras]
    steps, rings = [*eyes(way), eye], eyes(others)
    spread = np.concatenate([*wires, world, [*steps, *rings, middle]])
    if not np.all(np.isfinite(spread)):
        return Svg()
    place = Sheet.from_aside(camera, spread, (W, H), ROOM).place
    at = lambda points: " ".join(f"{x:.1f},{y:.1f}" for x, y in place(np.array(points)))
    line = lambda points, style: f'<polyline points="{at(points)}" {style}/>'
    dot = lambda point, style: "<circle cx='{:.1f}' cy='{:.1f}' r='3.5' {}/>".format(
        *place(point), style
    )
    parts = [line(border, f'fill="{TEAL}" fill-opacity="0.13"')]
    parts += [line(wire, f'stroke="{TEAL}" stroke-width="1.6"') for wire in wires]
    for (name, colour), end in zip(WORLD, world, strict=True):
        x, y = place(end)
        parts.append(line([middle, end], f'stroke="{colour}" stroke-width="2"'))
        parts.append(f'<text x="{x:.1f}" y="{y:.1f}" fill="{colour}" font-size="11">{name}</text>')
    grey = f'stroke="{GREY}" stroke-width="1.5"'
    if len(steps) > 1:
        parts.append(line(steps, f'{grey} stroke-dasharray="2 3"'))
    parts += [dot(ring, grey) for ring in rings]
    parts.append(dot(eye, f'fill="{TEAL}"'))
    size = f'width="{W}" height="{H}" viewBox="0 0 {W} {H}"'
    words = 'role="img" aria-label="the camera in the world" font-family="sans-serif" fill="none"'
    return Svg(f'<svg xmlns="http://www.w3.org/2000/svg" {size} {words}>{"".join(parts)}</svg>')


def axes_of(camera: Camera) -> Float[np.ndarray, "3 3"]:
    """Return the camera's axes as rows: right, up, forward."""
    return np.array([*camera_basis(camera)], float)


def _wires(camera: Camera, depth: float) -> list[Points]:
    """Return the lines of a frustum up to a depth: around the film, counter-clockwise from its
    lower left corner, up to a tick above it, and from the eye to each corner."""
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * [camera.W, camera.H]
    sides = np.linspace(corners, np.roll(corners, -1, axis=0), SIDE, axis=1)
    border = points_at(camera, sides.reshape(-1, 2), depth)
    _, lower, upper, left = film = border[::SIDE]
    tip = (upper + left) / 2 + 0.15 * np.linalg.norm(upper - lower) * axes_of(camera)[1]
    eye = np.asarray(camera.e, float)
    return [border, np.stack([left, tip, upper]), *(np.stack([eye, corner]) for corner in film)]


def points_at(camera: Camera, places: Float[np.ndarray, "n 2"], depth: float) -> Points:
    """Return the points at a depth that show at places of the film, those far aside nearer by."""
    rays = np.asarray(rays_through(camera, places.astype(camera.e.dtype)).direction, float)
    reach = depth / np.maximum(rays @ axes_of(camera)[2], LEAST_COSINE)
    return np.asarray(camera.e, float) + reach[:, None] * rays


def points_of(scene: Scene) -> Points:
    """Return the points of an object: vertices of faces, and the ends of spheres' boxes."""
    points = [np.zeros((0, 3))]
    if scene.mesh is not None:
        used = np.unique(np.asarray(scene.mesh.faces))
        points.append(np.asarray(scene.mesh.vertices, float)[used])
    if scene.spheres is not None:
        sides = np.concatenate([np.eye(3), -np.eye(3)])
        out = np.asarray(scene.spheres.radii, float)[:, None, None] * sides
        points += [*(np.asarray(scene.spheres.centers, float)[:, None] + out)]
    return np.concatenate(points)
