"""The object and the camera in space, seen from the side."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from .. import Camera, Scene, camera_basis, rays_through
from .page import Svg

#: The viewer's angles above and behind the camera's line of sight (rad).
ABOVE, BEHIND = 0.44, 0.35
#: The number of rays through each side of the film. Rays farther from the axis than this cosine
#: (78 degrees) are drawn no longer than it: at 90 degrees they would be endless.
SIDE, LEAST_COSINE = 16, 0.2
#: Width, height and margin of a frustum's picture (px).
W, H, ROOM = 240, 170, 16.0
#: The film's corners, and the world's axes with their colours.
CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, 1))
WORLD = (("x", "#d9691e"), ("y", "#3a9a4b"), ("z", "#2f6fb0"))
TEAL, GREY = "#008573", "#8fa1ad"
#: The colours of `scene_view`: faces, spheres and their border, the camera, the film, the ground.
FACE, BALL, RIM = (214, 196, 168), (196, 180, 154), (120, 105, 80)
LINE, FILM, GROUND = (0, 107, 138), (0, 150, 190, 28), (250, 251, 253)

Points = Float[np.ndarray, "n 3"]


def scene_view(camera: Camera, scene: Scene, size: int = 800) -> np.ndarray:
    """Return a parallel view, RGB uint8 (3/4 size, size, 3), of the object and the camera.

    The frustum reaches to the film through the object's middle; its tick points up. Distortion
    bends it as it bends rays through the film's border. Faces are painted from back to front,
    shaded by their angle to the view.

    ```python
    space = pj.plot.scene_view(fit.camera, scene, size=200)
    ```
    """
    from PIL import Image, ImageDraw

    axes, eye = axes_of(camera), np.asarray(camera.e, float)
    points = points_of(scene)
    middle = points.mean(axis=0)
    depth = max(float((middle - eye) @ axes[2]), 1e-6 * float(np.linalg.norm(middle - eye)), 1e-30)
    border = _border(camera)
    border = eye + depth / np.maximum(border @ axes[2], LEAST_COSINE)[:, None] * border
    film = border[::SIDE]
    tick = (film[2] + film[3]) / 2 + 0.15 * np.linalg.norm(film[2] - film[1]) * axes[1]
    wide, high = 2 * size, 2 * (3 * size // 4)  # drawn at twice the size and averaged down
    view = _side_axes(axes)
    spread = np.array([*border, eye, tick, *points])
    place, scale = _placement(spread, view, (wide, high), 0.06 * high)

    canvas = Image.new("RGB", (wide, high), GROUND)
    draw = ImageDraw.Draw(canvas, "RGBA")
    flat = lambda points: place(np.array(points)).ravel().tolist()
    draw.polygon(flat(border), FILM)
    for _, shape, *look in sorted(_solids(scene, view, place, scale), key=lambda solid: solid[0]):
        getattr(draw, shape)(*look)
    for path in (*([eye, corner] for corner in film), [*border, film[0]], [film[3], tick, film[2]]):
        draw.line(flat(path), (*LINE, 230), 4)
    draw.ellipse([*(place(eye) - 9), *(place(eye) + 9)], LINE)
    return np.asarray(canvas.resize((wide // 2, high // 2), Image.Resampling.BOX))


def frustum(camera: Camera, way: Iterable[Camera] = (), others: Sequence[Camera] = ()) -> Svg:
    """Return a parallel view of a camera as SVG, empty if its numbers are not finite.

    It shows the pyramid up to the view point, a tick upwards, and the world's axes at the view
    point. The eyes of `way`, earlier cameras of a fit, are a dotted line; those of `others` rings.
    """
    axes, eye = axes_of(camera), np.asarray(camera.e, float)
    b1, b2, v = axes * float(np.linalg.norm(np.asarray(camera.p, float) - eye))
    up = float(np.tan(float(camera.phi) / 2))
    aspect = 1.0 if camera.lens is None else float(camera.lens.aspect)
    right = up * camera.W / camera.H / aspect
    eyes = lambda cameras: [np.asarray(c.e, float) for c in cameras]
    film = [eye + v + x * right * b1 + y * up * b2 for x, y in CORNERS]
    tick, middle = eye + v + 1.3 * up * b2, eye + v
    world = middle + 0.6 * up * np.linalg.norm(v) * np.eye(3)
    steps, rings = [*eyes(way), eye], eyes(others)
    spread = np.array([*film, *world, *steps, *rings, middle, tick])
    if not np.all(np.isfinite(spread)):
        return Svg()
    place, _ = _placement(spread, _side_axes(axes), (W, H), ROOM)
    at = lambda points: " ".join(f"{x:.1f},{y:.1f}" for x, y in place(np.array(points)))
    line = lambda points, style: f'<polyline points="{at(points)}" fill="none" {style}/>'
    dot = lambda point, style: "<circle cx='{:.1f}' cy='{:.1f}' r='3.5' {}/>".format(
        *place(point), style
    )
    edge = f'stroke="{TEAL}" stroke-width="1.6"'
    parts = [f'<polygon points="{at(film)}" fill="{TEAL}" fill-opacity="0.13" {edge}/>']
    parts += [line([eye, corner], edge) for corner in film]
    parts.append(line([film[3], tick, film[2]], edge))
    for (name, colour), end in zip(WORLD, world, strict=True):
        x, y = place(end)
        parts.append(line([middle, end], f'stroke="{colour}" stroke-width="2"'))
        parts.append(f'<text x="{x:.1f}" y="{y:.1f}" fill="{colour}" font-size="11">{name}</text>')
    grey = f'stroke="{GREY}" stroke-width="1.5"'
    if len(steps) > 1:
        parts.append(line(steps, f'{grey} stroke-dasharray="2 3"'))
    parts += [dot(ring, f'fill="none" {grey}') for ring in rings]
    parts.append(dot(eye, f'fill="{TEAL}"'))
    size = f'width="{W}" height="{H}" viewBox="0 0 {W} {H}"'
    words = 'role="img" aria-label="the camera in the world" font-family="sans-serif"'
    return Svg(f'<svg xmlns="http://www.w3.org/2000/svg" {size} {words}>{"".join(parts)}</svg>')


def axes_of(camera: Camera) -> Float[np.ndarray, "3 3"]:
    """Return the camera's axes as rows: right, up, forward."""
    return np.stack([np.asarray(axis, float) for axis in camera_basis(camera)])


def _side_axes(axes: np.ndarray) -> np.ndarray:
    """Return the axes of a view from the side as rows: right, up, towards the viewer."""
    b1, b2, v = axes
    aside = np.cos(BEHIND) * b1 - np.sin(BEHIND) * v
    back = np.cos(ABOVE) * aside + np.sin(ABOVE) * b2
    right = np.cross(b2, back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back])


def _placement(
    spread: Points, view: np.ndarray, size: tuple[int, int], room: float
) -> tuple[Callable[[np.ndarray], np.ndarray], float]:
    """Return a function from points (..., 3) to px (..., 2), and its scale (px a unit): all of
    `spread` is in the picture."""
    onto = view[:2].T * [1, -1]  # y runs down
    low, high = (spread @ onto).min(axis=0), (spread @ onto).max(axis=0)
    scale = float(np.min((np.array(size) - 2 * room) / np.maximum(high - low, 1e-30)))
    shift = np.array(size) / 2 - scale * (low + high) / 2
    return (lambda points: points @ onto * scale + shift), scale


def _border(camera: Camera) -> Points:
    """Return unit directions of rays through the film's border, counter-clockwise from its lower
    left corner, `SIDE` for each side."""
    share = np.linspace(0, 1, SIDE, endpoint=False)[:, None] * [camera.W, camera.H]
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * [camera.W, camera.H]
    ways = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
    points = np.concatenate([a + way * share for a, way in zip(corners, ways, strict=True)])
    return np.asarray(rays_through(camera, points.astype(camera.e.dtype)).direction, float)


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


def _solids(
    scene: Scene, view: np.ndarray, place: Callable[[np.ndarray], np.ndarray], scale: float
) -> Iterator[tuple[Any, ...]]:
    """Yield faces and spheres: their depth, shape, place in the picture, colour and border."""
    if scene.mesh is not None:
        triangles = np.asarray(scene.mesh.vertices, float)[np.asarray(scene.mesh.faces)]
        a, b, c = np.moveaxis(triangles @ view.T, 1, 0)
        normal = np.cross(b - a, c - a)
        light = np.abs(normal[:, 2]) / np.maximum(np.linalg.norm(normal, axis=1), 1e-30)
        colours = ((0.35 + 0.65 * light[:, None]) * FACE).astype(int).tolist()
        corners = place(triangles).reshape(-1, 6).tolist()
        for depth, at, colour in zip((a + b + c)[:, 2] / 3, corners, colours, strict=True):
            yield depth, "polygon", at, tuple(colour), tuple(colour)
    if scene.spheres is not None:
        for centre, radius in zip(scene.spheres.centers, scene.spheres.radii, strict=True):
            at, r = place(np.asarray(centre, float)), float(radius) * scale
            yield float(view[2] @ centre), "ellipse", [*(at - r), *(at + r)], BALL, RIM
