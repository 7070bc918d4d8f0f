"""Where the compiled library is, and whether it is wanted: asked before JAX is loaded."""

import os
from pathlib import Path

#: `PINHOLE_JAX_NATIVE=0` chooses JAX's own arrays in its place, a path another build of it.
SWITCH = "PINHOLE_JAX_NATIVE"
#: The library's handlers, by the names that JAX calls them.
HANDLERS = (
    "pinhole_image",
    "pinhole_image_push",
    "pinhole_image_pull",
    "pinhole_look",
    "pinhole_walk",
)
NAMES = ("libpinhole.so", "libpinhole.dylib", "pinhole.dll")


def is_switched_off() -> bool:
    """Whether the environment chooses arrays."""
    return os.environ.get(SWITCH) == "0"


def library_path() -> Path | None:
    """The library, None where it was not built."""
    other = os.environ.get(SWITCH, "")
    if os.sep in other:
        return Path(other)
    folder = Path(__file__).parents[1] / "_native"
    return next((folder / name for name in NAMES if (folder / name).exists()), None)
