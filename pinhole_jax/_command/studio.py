"""`pinhole-jax studio`: a page in the browser in which a person gets a camera from a photo."""

import argparse
import asyncio
import math
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .. import io
from .._files.naming import named, renamed
from .._files.progress import Ticker
from .._studio.bench import Bench
from .._studio.session import Session, load_session
from .._studio.subject import Subject, subject_of
from .known import known

#: What the command calls the arguments of `subject_of`.
ASKED = {"path": "MESH", "vertices": "MESH", "camera": "--camera", "mask": "--mask"}


def run(options: argparse.Namespace, progress: Ticker) -> int:
    """Serve the page until interrupted; return 0.

    Raises ModuleNotFoundError where aiohttp is not installed.
    """
    server = _server()
    if not 0 <= options.port < 1 << 16:
        raise ValueError(f"`--port`: expected a port, 0 to 65535, got {options.port}")
    tell = progress.tell
    progress.say("reading mesh and photo")
    session = None
    if options.session is not None:
        with named(path="--session"):
            session = load_session(options.session)
    subject = _subject(options, session, tell)
    mask = None
    if options.mask is not None:
        with named(path="--mask"):
            mask = io.load_mask(options.mask, options.mask_from, tell)

    def new_bench() -> Bench:
        bench = Bench(subject, Path(options.output))
        if session is not None:
            bench.resume(session)
        if mask is not None:
            bench.take_mask(mask)
        return bench

    with named(**ASKED):
        new_bench().look()  # what is wrong comes up here, and the outline's program is compiled

    def ready(address: str) -> None:
        tell(f"studio     {address}")
        tell(f"           files go to {Path(options.output).resolve()}; Ctrl-C ends it")
        if not options.no_browser:
            webbrowser.open(address)

    progress.done()
    try:
        asyncio.run(server.serve(server.Studio(new_bench), options.port, ready))
    except OSError as error:
        words = f"expected a port that is free, got {options.port}: {error.strerror}"
        raise ValueError(f"`--port`: {words}") from error
    return 0


def _server() -> Any:
    try:
        from .._studio import server
    except ModuleNotFoundError as error:
        if error.name != "aiohttp":
            raise
        raise ModuleNotFoundError(
            "expected aiohttp, which serves the page; pip install 'pinhole-jax[studio]'",
            name="aiohttp",
        ) from None
    return server


def _subject(
    options: argparse.Namespace, session: Session | None, tell: Callable[[str], Any]
) -> Subject:
    """Return the mesh and the photo of the command line or of the session."""
    files = (options.mesh, options.photo)
    if session is not None:
        if any(files):
            raise ValueError("`--session`: expected no MESH and PHOTO beside it, which it names")
        if any(x is not None for x in (options.camera, options.fov, options.K, options.mask)):
            raise ValueError(
                "`--session`: expected no camera and no mask beside it: it has its own"
            )
        with named(**{**ASKED, "path": "--session", "camera": "--session"}):
            return subject_of(session.mesh, session.photo, session.camera, tell)
    if None in files:
        raise ValueError("expected MESH and PHOTO, or --session FILE")
    words = lambda text: tell(renamed(text, ASKED))
    with named(path="PHOTO"):
        size = io.load_image(options.photo).shape[1::-1]
    camera, phi, lens = _start(options, (size[0], size[1]), tell)
    with named(**ASKED):
        phi = None if phi is None else float(phi)
        subject = subject_of(
            options.mesh, options.photo, camera, words, phi=phi, lens=lens, up=options.up
        )
    if subject.phi is None:
        degrees = math.degrees(float(subject.start.phi))
        tell(f"phi: assumed {degrees:.0f} degrees, and free: the photo does not say (--fov does)")
    return subject


def _start(options: argparse.Namespace, size: tuple[int, int], tell: Callable[[str], Any]) -> Any:
    """Return the camera to begin with, or the field of view and the lens, where they are known."""
    if options.camera is None and options.K is None and options.fov is None and not options.dist:
        return None, None, None
    unused = dict.fromkeys(("crop", "resize", "image"))
    asked = argparse.Namespace(**{**unused, **vars(options)})
    return known(asked, ("pose",), size, tell)
