"""A session as one file: mesh, photo, camera, strokes, free parameters."""

import json
import math
import os
from typing import Any, NamedTuple

from .. import Camera
from ..batch.inputs import numbers_of
from ..io import camera_from_dict, camera_to_dict, load_text, save_text
from ..names import FREE
from .strokes import Work, work_from_list, work_to_list

SCHEMA = "pinhole_jax.studio/1"
#: The most bytes of a session: masks are in it.
MOST_BYTES = 1 << 28


class Session(NamedTuple):
    """The state of a person's work on a photo.

    - `mesh`, `photo`: their files. The photo has the camera's size.
    - `camera`: the current camera. `free`: the parameters that a fit may change.
    - `work`: strokes and loaded masks, in order.
    - `lines`: pairs of places (px from the upper left corner) along straight edges.
    - `known_phi`: the field of view (rad) that an option, a file or the photo gave, if any.
    """

    mesh: str
    photo: str
    camera: Camera
    free: tuple[str, ...] = ("pose",)
    work: Work = ()
    lines: tuple[Any, ...] = ()
    known_phi: float | None = None


def session_to_text(session: Session) -> str:
    """Return a session as JSON."""
    data = {
        "schema": SCHEMA,
        "mesh": session.mesh,
        "photo": session.photo,
        "camera": camera_to_dict(session.camera),
        "free": list(session.free),
        "known_phi": session.known_phi,
        "strokes": work_to_list(session.work),
        "lines": [[[*map(float, end)] for end in line] for line in session.lines],
    }
    return json.dumps(data, indent=1, allow_nan=False) + "\n"


def session_from_text(text: str, name: str = "session") -> Session:
    """Return the session of `session_to_text`, or raise ValueError naming the wrong field."""
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"`path`: expected a session file, got {name!r}: {error}") from None
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        schema = data.get("schema") if isinstance(data, dict) else type(data).__name__
        raise ValueError(f"`schema`: expected {SCHEMA!r}, got {schema!r} (in {name!r})")
    for field in ("mesh", "photo"):
        if not isinstance(data.get(field), str) or not data[field]:
            raise ValueError(f"`{field}`: expected a path, got {data.get(field)!r} (in {name!r})")
    try:
        camera = camera_from_dict(data.get("camera") or {}, fitted=True)
        work = work_from_list(data.get("strokes", []), camera.W, camera.H)
        free = free_of(data.get("free", ["pose"]))
        lines = tuple(map(line_of, data.get("lines", [])))
        known_phi = _phi_or_none(data.get("known_phi"))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{error} (in {name!r})") from error
    return Session(data["mesh"], data["photo"], camera, free, work, lines, known_phi)


def save_session(path: str | os.PathLike[str], session: Session) -> None:
    """Write a session, whole or not at all."""
    save_text(path, session_to_text(session))


def load_session(path: str | os.PathLike[str]) -> Session:
    """Return the session of a file.

    Raises FileNotFoundError, or ValueError naming the field that is missing or wrong.
    """
    return session_from_text(load_text(path, most_bytes=MOST_BYTES), str(path))


def free_of(names: Any) -> tuple[str, ...]:
    """Return the parameters that may move, or raise ValueError."""
    known = ", ".join(FREE)
    if not names:
        raise ValueError(f"`free`: expected at least one of {known}, got none")
    for name in names:
        if name not in FREE:
            raise ValueError(f"`free`: expected names among {known}, got {name!r}")
    return tuple(names)


def _phi_or_none(data: Any) -> float | None:
    if data is None:
        return None
    if isinstance(data, bool) or not (isinstance(data, int | float) and 0 < data < math.pi):
        raise ValueError(f"`known_phi`: expected radians below pi, or null, got {data!r}")
    return float(data)


def line_of(data: Any) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return a line's ends, two places [x, y] near the picture, or raise ValueError."""
    a, b, c, d = ends = numbers_of("line", data, 4)
    if max(map(abs, ends)) > 1e6:
        raise ValueError("`line`: expected places on the picture (px), got some far away")
    return (a, b), (c, d)
