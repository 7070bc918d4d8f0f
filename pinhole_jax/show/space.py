"""The object and the camera in space, seen from the side."""

from collections.abc import Iterable, Sequence
from functools import partial

import numpy as np
from jaxtyping import Float

from .. import Camera, Scene, camera_basis, normals, project, rays_through
from .page import Svg

#: The viewer's angles above and behind the camera's line of sight (rad), and how far away it is, in
#: sizes of the picture: perspective hardly shows.
ABOVE, BEHIND, FAR = 0.44, 0.35, 1e3
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


def viewer_of(camera: Camera, spread: Points, size: tuple[int, int], room: float) -> Camera:
    """Return a far camera behind and above another one, with all of `spread` on a film of this size
    and margin (px)."""
    b1, b2, v = axes_of(camera)
    aside = np.cos(BEHIND) * b1 - np.sin(BEHIND) * v
    back = np.cos(ABOVE) * aside + np.sin(ABOVE) * b2
    right = np.cross(b2, aside)
    axes = np.stack([right, np.cross(back, right), -back])
    low, high = ((spread @ axes.T).min(axis=0), (spread @ axes.T).max(axis=0))
    px = max(float(np.max((high - low)[:2] / (np.array(size) - 2 * room))), 1e-30)
    middle = (low + high) / 2 @ axes
    phi = 2 * np.arctan(size[1] / (2 * FAR * max(size)))
    return Camera(middle + FAR * max(size) * px * back, middle, axes[1], phi, 1.0, *size)


def places_of(viewer: Camera, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
    """Return the places of points in a camera's picture, px from its upper left corner."""
    return from_top(viewer, np.asarray(project(viewer, points.astype(viewer.e.dtype)), float))


def scene_view(camera: Camera, scene: Scene, size: int = 800) -> np.ndarray:
    """Return a view from afar, RGB uint8 (3/4 size, size, 3), of the object and the camera.

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
    viewer = viewer_of(camera, np.concatenate([*wires, points]), (wide, high), 0.06 * high)

    canvas = Image.new("RGB", (wide, high), GROUND)
    draw = ImageDraw.Draw(canvas, "RGBA")
    flat = lambda points: places_of(viewer, points).ravel().tolist()
    draw.polygon(flat(border), FILM)
    normal = np.asarray(normals(viewer.replace(W=size, H=high // 2), scene), float)
    light = np.abs(normal @ axes_of(viewer)[2])[..., None]
    there = 255 * np.any(normal, axis=-1, keepdims=True)
    shaded = np.concatenate([(0.35 + 0.65 * light) * FACE, there], axis=-1)
    lit = Image.fromarray(shaded.astype(np.uint8)).resize(canvas.size)
    canvas.paste(lit, mask=lit)
    for wire in wires:
        draw.line(flat(wire), (*LINE, 230), 4)
    draw.circle(flat(eye), 9, LINE)
    return np.asarray(canvas.reduce(2))


def frustum(camera: Camera, way: Iterable[Camera] = (), others: Sequence[Camera] = ()) -> Svg:
    """Return a view of a camera from afar as SVG, empty if its numbers are not finite.

    It shows the frustum up to the view point, as `scene_view` does, and the world's axes there. The
    eyes of `way`, earlier cameras of a fit, are a dotted line; those of `others` rings.
    """
    eyes = lambda cameras: [np.asarray(c.e, float) for c in cameras]
    steps, rings, middle = eyes([*way, camera]), eyes(others), np.asarray(camera.p, float)
    eye = steps[-1]
    border, tick, *_ = wires = _wires(camera, float(np.linalg.norm(middle - eye)))
    world = middle + np.linalg.norm(tick[1] - middle) / 2 * np.eye(3)
    spread = np.concatenate([*wires, world, [*steps, *rings, middle]])
    if not np.all(np.isfinite(spread)):
        return Svg()
    place = partial(places_of, viewer_of(camera, spread, (W, H), ROOM))
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


def from_top(camera: Camera, places: np.ndarray) -> np.ndarray:
    """Return film coordinates (..., 2) as places from the picture's upper left corner, or back."""
    return places * [1, -1] + [0, camera.H]


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
        points.append(np.asarray(scene.mesh.vertices, float)[np.unique(scene.mesh.faces)])
    if scene.spheres is not None:
        out = np.multiply.outer([1.0, -1.0], np.multiply.outer(scene.spheres.radii, np.eye(3)))
        points.append((np.asarray(scene.spheres.centers)[:, None] + out).reshape(-1, 3))
    return np.concatenate(points)
