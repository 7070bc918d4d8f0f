"""The files of an export: the camera in any format, and the mask."""

from pathlib import Path

import numpy as np

from .. import Camera, io
from .._files.paths import written_path
from ..formats import FORMATS, write
from ..show.page import ENDINGS


def export(
    folder: Path, name: str, camera: Camera, format: str, mask: np.ndarray | None
) -> list[str]:
    """Write a camera in a format, or in all ("all"), and its mask, if any; return the paths, and
    which of them are replaced.

    Raises ValueError for other formats and names, and for a camera that the format cannot hold.
    """
    name = plain(name)
    if format not in ("all", *FORMATS):
        raise ValueError(f"`format`: expected one of all, {', '.join(FORMATS)}, got {format!r}")
    chosen = list(FORMATS) if format == "all" else [format]
    paths = {folder / (name + ENDINGS[each]): each for each in chosen}
    image = folder / f"{name}_mask.png"
    written = [written_path(path) for path in (*paths, *[image] * (mask is not None))]
    for path, each in paths.items():
        write(path, {name: camera}, each)
    if mask is not None:
        io.save_image(image, mask)
    return written


def plain(name: str) -> str:
    """Return a name for files; raise ValueError if it is a path."""
    good = 0 < len(name) <= 100 and name[0] != "." and all(c.isalnum() or c in "-_." for c in name)
    if not good:
        raise ValueError(f"`name`: expected letters, digits, - and _, got {name!r}")
    return name
