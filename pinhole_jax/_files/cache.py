"""Where compiled programs are kept from one process to the next, if a user wants that."""

import os
from pathlib import Path

import jax
from jax.experimental.compilation_cache import compilation_cache

from .paths import FilePath


def cache(folder: FilePath | None = None) -> Path:
    """Keep compiled programs in a folder, from which later processes read them; return the folder.

    The default is `pinhole_jax` in the user's cache folder (`$XDG_CACHE_HOME`, else `~/.cache`):
    where the command keeps its own. A later process's first fit then waits for tracing alone. It
    sets JAX's `jax_compilation_cache_dir`, for all of the process; delete the folder to clear it.
    Raise ValueError where there is no home folder and none is given.

    ```python
    folder = pj.cache()  # compiled programs are kept there from now on
    ```
    """
    if folder is None:
        try:
            home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
            folder = Path(home) / "pinhole_jax"
        except RuntimeError:
            raise ValueError("`folder`: expected one, as you have no home folder") from None
    jax.config.update("jax_compilation_cache_dir", os.fspath(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    compilation_cache.reset_cache()  # else what was set at the first program of all holds
    return Path(folder)
