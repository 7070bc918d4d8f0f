"""`pinhole-jax studio`: a page in the browser in which a person gets a camera from a photo."""

import argparse
import asyncio
import math
import webbrowser
from pathlib import Path

from .. import io
from .._files.naming import named
from .._files.progress import Ticker, tell
from .._studio.bench import Bench
from .._studio.session import MOST_BYTES, Session, new_session, session_from_text
from .._studio.workpiece import workpiece_of
from ..batch.inputs import read_mask, read_start
from .options import record_of


def run(options: argparse.Namespace, progress: Ticker) -> int:
    """Serve the page until interrupted; return 0.

    Raises ModuleNotFoundError where aiohttp is not installed.
    """
    from .._studio import server  # needs aiohttp

    if not 0 <= options.port < 1 << 16:
        raise ValueError(f"`port`: expected a port, 0 to 65535, got {options.port}")
    progress.say("reading mesh and photo")
    folder = Path(options.output)
    session = (_begun if options.session is None else _saved)(options)
    with named(**dict.fromkeys(("camera", "mesh", "photo"), "session")):
        bench = Bench(session, folder)
    if options.mask is not None:
        bench.take_mask(read_mask(record_of(options, tidy=False)))
    bench.look()  # raises errors before the page opens, and compiles the outline
    new_bench = lambda: Bench(bench.session, folder)

    def ready(address: str) -> None:
        tell(f"studio     {address}")
        tell(f"           files go to {folder.resolve()}; Ctrl-C ends it")
        if not options.no_browser:
            webbrowser.open(address)

    progress.done()
    try:
        asyncio.run(server.serve(server.Studio(new_bench), options.port, ready))
    except OSError as error:
        words = f"expected a port that is free, got {options.port}: {error.strerror}"
        raise ValueError(f"`port`: {words}") from error
    return 0


def _saved(options: argparse.Namespace) -> Session:
    """Return a file's session."""
    known = (options.mesh, options.photo, options.camera, options.fov, options.K, options.mask)
    if any(x is not None for x in known):
        words = "expected no MESH, PHOTO, camera or mask with it: a session has its own"
        raise ValueError(f"`session`: {words}")
    with named(path="session"):
        text = io.load_text(options.session, most_bytes=MOST_BYTES)
        return session_from_text(text, options.session)


def _begun(options: argparse.Namespace) -> Session:
    """Return the session that begins with the mesh and the photo of the command line."""
    if None in (options.mesh, options.photo):
        raise ValueError("expected MESH and PHOTO, or --session FILE")
    workpiece = workpiece_of(options.mesh, options.photo)
    known = read_start(record_of(options, free="phi"), workpiece.size)
    session = new_session(workpiece, known, options.up)
    if session.known_phi is None:
        degrees = math.degrees(float(session.camera.phi))
        tell(f"phi: assumed {degrees:.0f} degrees, and left free; give --fov if you know it")
    return session
