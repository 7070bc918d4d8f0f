"""Files that several commands read: masks, meshes, and the photo that a mask was made of."""

from collections.abc import Callable
from typing import Any

import numpy as np

from .. import Scene, io
from .._files.naming import named, renamed
from ..batch.records import DEFAULTS

#: The command's names of the arguments of `load_mesh` and `Mesh`.
MESH = {"path": "MESH", "vertices": "MESH"}
#: Endings of pictures.
PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp", ".pgm", ".ppm")


def check_order(mesh: str) -> None:
    """Raise ValueError where a picture stands for the mesh."""
    if mesh.lower().endswith(PICTURES):
        words = f"expected triangles, got the picture {mesh!r}: are MESH and MASK exchanged?"
        raise ValueError(f"`MESH`: {words}")


def mask_of(
    path: str, mask_from: str | None, tell: Callable[[str], Any], invert: bool = False
) -> np.ndarray:
    """Return the mask of a file."""
    with named(path="MASK", mask_from="--mask-from"):
        return io.load_mask(path, mask_from, tell, invert=invert)


def tidied(mask: np.ndarray, much: bool, tell: Callable[[str], Any]) -> np.ndarray:
    """Return a mask without crumbs and pinholes; `much`, or what nobody means."""
    if much:
        mask, done = io.tidy_mask(mask)
        tell(f"mask: {'; '.join(done) or 'no crumbs, no pinholes'}")
        return mask
    tidy, done = io.tidy_mask(mask, DEFAULTS["tidy"])
    if done := [words for words in done if words.endswith(("dropped", "filled"))]:
        tell(f"mask: {'; '.join(done)} (--no-tidy keeps them)")
        return tidy
    return mask


def scene_of(path: str, tell: Callable[[str], Any]) -> Scene:
    """Return the mesh of a file as a scene."""
    check_order(path)
    with named(**MESH):
        return Scene(mesh=io.load_mesh(path, say=lambda words: tell(renamed(words, MESH))))


def photo_beside(path: str, mask: np.ndarray, option: str) -> np.ndarray:
    """Return the picture of a file that an option names, or raise ValueError if it has not the
    mask's size."""
    with named(path=option):
        picture = io.load_image(path)
    if picture.shape[:2] != mask.shape:
        (h, w), (H, W) = picture.shape[:2], mask.shape
        raise ValueError(f"`{option}`: expected the mask's size {W} x {H}, got {w} x {h} ({path})")
    return picture
