"""The object and the camera in space, seen from beside."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from .._camera.camera import Camera, camera_basis
from .._camera.rays import rays_through
from .._numerics.jitted import jitted
from .._scene.scene import Scene, check_view

#: Rays through each side of the film; those as wide as this are drawn no longer.
SIDE = 16
#: (The cosine from the axis: 78 degrees. At 90 they would be endless.)
LEAST_COSINE = 0.2

_rays_through = jitted(rays_through)


def scene_view(camera: Camera, scene: Scene, size: int = 800) -> np.ndarray:
    """Return a parallel view, RGB uint8 (3/4 size, size, 3), of the object with the camera: its
    frustum reaches to the film through the object's middle, the tick shows up. Under distortion the
    frustum is bent as the rays through the film's border are.

    Faces are painted from back to front, shaded by their angle to the view.

    ```python
    space = pj.plot.scene_view(fit.camera, scene, size=200)
    ```
    """
    from PIL import Image, ImageDraw

    check_view(camera, scene)
    b1, b2, v = (np.asarray(a, float) for a in camera_basis(camera))
    eye = np.asarray(camera.e, float)
    triangles, balls = _solids(scene)
    middle = np.concatenate([triangles.reshape(-1, 3), balls[:, :3]]).mean(axis=0)
    depth = max(float((middle - eye) @ v), 1e-6 * float(np.linalg.norm(middle - eye)), 1e-30)
    border = _border(camera)
    reach = depth / np.maximum(border @ v, LEAST_COSINE)
    border = eye + reach[:, None] * border
    film = [*border[:: len(border) // 4]]
    tick = (film[2] + film[3]) / 2 + 0.15 * np.linalg.norm(film[2] - film[1]) * b2
    # From beside the line of sight, some 25 degrees above and 20 behind the camera.
    back = _unit(np.cos(0.44) * (np.cos(0.35) * b1 - np.sin(0.35) * v) + np.sin(0.44) * b2)
    right = _unit(np.cross(b2, back))
    axes = np.stack([right, np.cross(back, right), back])
    spread = [*border, eye, tick, *(b[:3] + s * b[3] for b in balls for s in (-1, 1))]
    flat = np.concatenate([np.array(spread), triangles.reshape(-1, 3)]) @ axes.T
    low, high = flat[:, :2].min(axis=0), flat[:, :2].max(axis=0)
    W, H = 2 * size, 2 * (3 * size // 4)
    scale = 0.88 * min(W / max(high[0] - low[0], 1e-30), H / max(high[1] - low[1], 1e-30))
    shift = np.array([W, H]) / 2 - scale * (low + high) / 2 * [1, -1]

    def place(points: Any) -> list[tuple[float, float]]:
        xy = np.asarray(points, float) @ axes[:2].T * [scale, -scale] + shift
        return [tuple(p) for p in xy.reshape(-1, 2).tolist()]

    canvas = Image.new("RGB", (W, H), (250, 251, 253))
    draw = ImageDraw.Draw(canvas, "RGBA")
    draw.polygon(place(border), (0, 150, 190, 28))
    corners = triangles @ axes.T
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    light = np.abs(normal[:, 2]) / np.maximum(np.linalg.norm(normal, axis=1), 1e-30)
    paint: list[tuple[float, Any]] = [
        (z, (k, None)) for k, z in enumerate(corners[..., 2].mean(axis=1).tolist())
    ]
    paint += [(float(ball[:3] @ back), (None, ball)) for ball in balls]
    flat2 = corners[..., :2] * [scale, -scale] + shift
    for _, (k, ball) in sorted(paint, key=lambda item: item[0]):
        if ball is None:
            shade = tuple(int(c * (0.35 + 0.65 * light[k])) for c in (214, 196, 168))
            draw.polygon([tuple(p) for p in flat2[k].tolist()], shade, shade)
        else:
            ((x, y),), r = place([ball[:3]]), ball[3] * scale
            draw.ellipse((x - r, y - r, x + r, y + r), (196, 180, 154), (120, 105, 80))
    for corner in film:
        draw.line(place([eye, corner]), (0, 107, 138, 230), 4)
    draw.line(place([*border, border[0]]), (0, 107, 138, 230), 4)
    draw.line(place([film[3], tick, film[2]]), (0, 107, 138, 230), 4)
    ((x, y),) = place([eye])
    draw.ellipse((x - 9, y - 9, x + 9, y + 9), (0, 107, 138))
    return np.asarray(canvas.resize((W // 2, H // 2), Image.Resampling.BOX))


def _border(camera: Camera) -> np.ndarray:
    """Return unit directions (n, 3) of rays through the film's border, counter-clockwise from its
    lower left corner, as many to each side."""
    share = np.linspace(0, 1, SIDE, endpoint=False)
    x = np.concatenate([share, np.ones(SIDE), 1 - share, np.zeros(SIDE)]) * camera.W
    y = np.concatenate([np.zeros(SIDE), share, np.ones(SIDE), 1 - share]) * camera.H
    rays = _rays_through(camera, *(jnp.asarray(z, camera.e.dtype) for z in (x, y)))
    return np.asarray(rays, float)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-30)


def _solids(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return triangles (n, 3, 3), and spheres (m, 4) as centre and radius."""
    triangles, balls = np.zeros((0, 3, 3)), np.zeros((0, 4))
    if scene.mesh is not None:
        triangles = np.asarray(scene.mesh.vertices, float)[np.asarray(scene.mesh.faces)]
    if scene.spheres is not None:
        spheres = scene.spheres.centers, scene.spheres.radii[:, None]
        balls = np.concatenate([np.asarray(x, float) for x in spheres], axis=1)
    return triangles, balls
