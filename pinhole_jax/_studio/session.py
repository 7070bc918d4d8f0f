"""A session as one file: mesh, photo, camera, strokes, free parameters."""

import json
from typing import Any, NamedTuple

from .. import Camera
from .._files.fields import Fields
from .._files.paths import parse_json
from ..batch.inputs import Start, numbers_of, poseless_camera
from ..io import camera_from_dict, camera_to_dict
from ..names import FREE
from .hand import frame_object
from .strokes import MOST_STROKES, Work, step_of
from .workpiece import Workpiece

SCHEMA = "pinhole_jax.studio/1"
#: A guess of the field of view (rad), if nobody gives one.
PHI = 0.7
#: The most bytes of a session: masks are in it.
MOST_BYTES = 1 << 28


class Session(NamedTuple):
    """The state of a person's work on a photo.

    - `mesh`, `photo`: their files. The photo has the camera's size.
    - `camera`: the current camera. `free`: the parameters that a fit may change.
    - `strokes`: strokes and loaded masks, in order.
    - `lines`: x, y, x, y (px from the upper left corner) of two places along straight edges.
    - `known_phi`: the field of view (rad) that an option, a file or the photo gave, if any.
    """

    mesh: str
    photo: str
    camera: Camera
    free: tuple[str, ...] = ("pose",)
    strokes: Work = ()
    lines: tuple[list[float], ...] = ()
    known_phi: float | None = None


def new_session(workpiece: Workpiece, known: Start, up: str = "y") -> Session:
    """Return the session that begins with what is known of the camera: without a pose one that
    sees all of the mesh, upright along `up`; without a field of view a guess, which is free.
    """
    camera, phi = known.camera, known.phi
    if camera is None:
        start = poseless_camera(PHI if phi is None else phi, *workpiece.size, known.lens)
        camera = frame_object(start, workpiece.extent, up)
    else:
        phi = camera.phi
    free, phi = (("pose", "phi"), None) if phi is None else (("pose",), float(phi))
    return Session(workpiece.mesh, workpiece.photo, camera, free, known_phi=phi)


def session_to_text(session: Session) -> str:
    """Return a session as JSON."""
    strokes = [step._asdict() for step in session.strokes]
    camera = camera_to_dict(session.camera)
    data = {"schema": SCHEMA, **session._asdict(), "camera": camera, "strokes": strokes}
    return json.dumps(data, indent=1, allow_nan=False) + "\n"


def session_from_text(text: str, name: str = "session") -> Session:
    """Return the session of `session_to_text`, or raise ValueError naming the wrong field."""
    fields = Fields(parse_json(text, name, "a session file"), repr(name))
    fields.text("schema", (SCHEMA,))
    phi = None if fields.data.get("known_phi") is None else fields.angle("known_phi")
    try:
        camera = camera_from_dict(fields.data.get("camera") or {}, fitted=True)
        free = free_of(fields.data.get("free", ["pose"]))
        lines = tuple(numbers_of("line", ends, 4) for ends in fields.data.get("lines", []))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{error} (in {name!r})") from error
    steps = fields.parts("strokes") if "strokes" in fields else []
    if len(steps) > MOST_STROKES:
        raise fields.wrong("strokes", f"at most {MOST_STROKES}", f"{len(steps)}")
    work = tuple(step_of(step, camera.W, camera.H) for step in steps)
    return Session(fields.text("mesh"), fields.text("photo"), camera, free, work, lines, phi)


def free_of(names: Any) -> tuple[str, ...]:
    """Return the parameters that may move, or raise ValueError."""
    if not names or not {*names} <= {*FREE}:
        raise ValueError(f"`free`: expected some of {', '.join(FREE)}, got {names!r}")
    return tuple(names)
