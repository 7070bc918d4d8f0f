"""The compiled library: loaded and registered with JAX once, where it is wanted and runs."""

import ctypes
import warnings
from functools import cache

import jax

from .._files.native_library import HANDLERS, is_switched_off, library_path


@cache
def is_available() -> bool:
    """True if the library runs here; else a warning says once why it does not."""
    if is_switched_off():
        return False
    why = _obstacle()
    if why:
        warnings.warn(
            f"pinhole_jax runs without its compiled library ({why}): masks take some 10 times as"
            " long. With a C++ compiler, `pip install --force-reinstall --no-deps pinhole-jax`"
            " builds it.",
            RuntimeWarning,
            stacklevel=2,
        )
    return not why


@cache
def library() -> ctypes.CDLL:
    """The library's functions, for Python; it `is_available`."""
    found = ctypes.CDLL(str(library_path()))
    found.pinhole_table.restype = ctypes.c_void_p
    return found


def _obstacle() -> str:
    """Register the library; the reason why it cannot be used, empty if it can."""
    if library_path() is None:
        return "it was not built"
    try:
        # (A library that XLA refuses would take a backend down that starts later.)
        jax.devices("cpu")
        for name in HANDLERS:
            handler = jax.ffi.pycapsule(getattr(library(), name))
            jax.ffi.register_ffi_target(name, handler, platform="cpu")
    except Exception as error:  # of a loader or of another version of XLA
        return str(error).splitlines()[0] if str(error) else type(error).__name__
    return ""
