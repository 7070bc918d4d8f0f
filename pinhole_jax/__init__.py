"""A differentiable pinhole camera that recovers pose and intrinsics from images."""

from typing import TYPE_CHECKING

__version__ = "0.1.0"

if TYPE_CHECKING:
    from ._public import *  # noqa: F403
else:
    # To import JAX takes most of a second: it waits until a name is asked for (PEP 562), so that
    # the command's help and its words about a typo need none.

    def __getattr__(name):
        """Return a public name or a module of this package, loaded where it is not yet."""
        from importlib import import_module
        from importlib.util import find_spec

        if name == "__all__":
            return [*_public_names()]
        own = name.isidentifier() and not name.startswith("__")
        if own and find_spec(f"{__name__}.{name}"):  # alone: others may wait for it to load them
            return import_module(f"{__name__}.{name}")
        if own and name in _public_names():
            return globals()[name]
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def __dir__():
        return sorted({*globals(), *_public_names()} - {"TYPE_CHECKING"})

    def _public_names():
        """Return all public names; they are this module's from then on."""
        from importlib import import_module

        public = vars(import_module(f"{__name__}._public"))
        names = {name: value for name, value in public.items() if not name.startswith("_")}
        for name, value in names.items():
            globals().setdefault(name, value)
        return names
