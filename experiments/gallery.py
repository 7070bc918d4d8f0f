"""What does a camera see? Mask, depth and normals of one shape, side by side.

The shape is made by code: a bumpy closed mesh with a sphere before it. Depth is drawn from near
(light) to far (dark), normals with the usual colours: x, y, z of the normal from -1..1 as R, G, B.
"""

import sys
from pathlib import Path

import numpy as np

import pinhole_jax as pj
from pinhole_jax import io

SIZE = 256
GAP = 8


def view() -> tuple[pj.Camera, pj.Scene]:
    scene = pj.Scene(mesh=pj.shapes.bumpy(5), spheres=pj.Spheres([[0.75, -0.45, 1.1]], [0.35]))
    camera = pj.Camera(
        e=[1.6, 1.2, 4.6], p=[0.05, -0.05, 0.1], u=[0, 1, 0], phi=0.66, W=SIZE, H=SIZE
    )
    return camera, scene


def grey(depth: np.ndarray) -> np.ndarray:
    """Return 1 (nearest) to 0.2 (farthest), and 0 where nothing is met."""
    met = np.isfinite(depth)
    near, far = depth[met].min(), depth[met].max()
    return np.where(met, 1 - 0.8 * (np.where(met, depth, near) - near) / (far - near), 0)


def main() -> None:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    camera, scene = view()
    mask = np.asarray(pj.silhouette(camera, scene), float)
    depth = np.asarray(pj.depth(camera, scene), float)
    normals = np.asarray(pj.normals(camera, scene), float)
    met = np.isfinite(depth)
    differ = np.mean(np.where(met, 1 - mask, mask))
    print(
        f"The mask covers {mask.sum():.1f} px, and {met.sum()} pixel centres have a depth, from"
        f" {depth[met].min():.2f} to {depth[met].max():.2f}; mean difference {differ:.4f}."
    )
    colours = np.where(met[..., None], (normals + 1) / 2, 0)
    panels = [np.repeat(mask[..., None], 3, 2), np.repeat(grey(depth)[..., None], 3, 2), colours]
    gap = np.ones((SIZE, GAP, 3))
    row = np.concatenate([panels[0], gap, panels[1], gap, panels[2]], axis=1)
    io.save_image(folder / "gallery.png", np.round(255 * row).astype(np.uint8))
    print(f"Picture: {folder / 'gallery.png'}")


if __name__ == "__main__":
    main()
