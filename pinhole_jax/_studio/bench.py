"""The bench of one tab: a person's actions on camera and mask.

An action is a method that the page calls by name, with numbers from JSON. It returns JSON-ready
values, and raises ValueError with a message for the person if it is impossible.
"""

import base64
import inspect
import json
import math
import re
import tempfile
import threading
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from .. import Fit, Progress, fit_camera, io, silhouette
from .._files.fields import Fields
from .._files.paths import written_path
from ..batch.inputs import Start, numbers_of
from ..formats import FORMATS, object_pose, write
from ..names import STATUSES
from ..plot import disagreement
from ..show.page import ENDINGS, png_of
from . import hand
from .drawing import band_of, camera_numbers, grid_lines, outline_lines, straight_lines
from .session import Session, free_of, session_from_text, session_to_text
from .strokes import (
    GUIDES,
    LoadedMask,
    Work,
    guess_mask,
    guides_around,
    mask_of,
    stroke_of,
    strokes_of,
)
from .workpiece import workpiece_of

#: The answer to an action, as JSON holds it; numbers may be arrays.
Answer = dict[str, Any]
#: The actions that the page may call.
ACTIONS = (
    "hello",
    "look",
    "move",
    "stand",
    "lens",
    "straight",
    "stroke",
    "view_guides",
    "undo",
    "redo",
    "clear",
    "load_mask",
    "fit",
    "stop",
    "way",
    "mode",
    "restore",
    "export",
    "save",
    "open",
)
#: The number of steps to undo, and of guesses from strokes that are kept for them.
MOST_UNDONE, MOST_GUESSES = 200, 16


def as_json(message: Answer) -> str:
    """Return an answer, whose numbers may be arrays, as JSON."""
    return json.dumps(message, default=np.ndarray.tolist)


class StopRequest(Exception):
    """A person stopped a fit."""


class Bench:
    """A tab's session, mask and fit; `folder` is where files are written."""

    def __init__(self, session: Session, folder: Path) -> None:
        self.folder, self._straight = folder, False
        self._push: Callable[[Any], None] = lambda news: None
        self._stopping = threading.Event()
        self._lock, self._is_fitting = threading.Lock(), False
        self.resume(session)

    def resume(self, session: Session) -> None:
        """Continue a session."""
        workpiece = workpiece_of(session.mesh, session.photo)
        (W, H), (w, h) = workpiece.size, (session.camera.W, session.camera.H)
        if (w, h) != (W, H):
            words = f"expected one of the photo's size {W} x {H}, got {w} x {h}"
            raise ValueError(f"`camera`: {words}")
        self.workpiece = workpiece
        self.session = session._replace(mesh=workpiece.mesh, photo=workpiece.photo)
        # (It keeps some guesses, so that undo needs no new one.)
        self._guess = lru_cache(MOST_GUESSES)(lambda guides: guess_mask(workpiece.picture, guides))
        #: The last fit with all its cameras, and the number of the one that was chosen.
        self.fits: tuple[Fit, ...] = ()
        self.chosen = 0
        self._assumption = ""
        #: All states of the work that can be gone back to; `_at` is the place of the current one.
        self._works = [session.strokes[:k] for k in range(len(session.strokes) + 1)][-MOST_UNDONE:]
        self._go_to(len(self._works) - 1)

    @property
    def result(self) -> Fit | None:
        """Return the last fit, at the camera that was chosen."""
        return self.fits[self.chosen] if self.fits else None

    def _show(self, **changes: Any) -> Answer:
        """Change the session; return the view."""
        self.session = self.session._replace(**changes)
        return self.look()

    def act(self, name: str, numbers: dict[str, Any], push: Callable[[Any], None]) -> Any:
        """Do an action and return its answer; `push` sends news to the page meanwhile.

        Raises ValueError for unknown actions, wrong numbers, and while a fit runs.
        """
        if name not in ACTIONS:
            raise ValueError(f"`do`: expected one of {', '.join(ACTIONS)}, got {name!r}")
        if name == "stop":
            self._stopping.set()
            return {}
        if self._is_fitting:
            raise ValueError("a fit is running: wait for it, or stop it")
        with self._lock:
            action = getattr(self, name)
            try:
                inspect.signature(action).bind(**numbers)
            except TypeError as error:
                raise ValueError(f"`{name}`: {error}") from None
            self._push, self._is_fitting = push, name == "fit"
            try:
                return action(**numbers)
            finally:
                self._is_fitting = False

    def hello(self) -> Answer:
        """Return the contents of a page that opens."""
        W, H = self.workpiece.size
        return {
            "mesh": Path(self.workpiece.mesh).name,
            "photo": Path(self.workpiece.photo).name,
            "W": W,
            "H": H,
            "free": list(self.session.free),
            "formats": list(FORMATS),
            "view": self.look(),
            "mask": self._mask_description(),
            "fit": self._fit_description(),
        }

    def look(self) -> Answer:
        """Return the view of the current camera."""
        camera = self.session.camera
        return {
            "camera": camera_numbers(camera),
            "outline": outline_lines(camera, self.workpiece.scene),
            "grid": grid_lines(camera) if self._straight else [],
            "lines": straight_lines(camera, self.session.lines),
            "is_fit": self.result is not None and camera is self.result.camera,
            "upright": hand.upright(camera),
            "phi_is_assumed": self._phi_from() == "assumed",
        }

    def _phi_from(self) -> str:
        """Return the origin of the field of view, "" if a person, a file or the photo gave it."""
        camera, known = self.session.camera, self.session.known_phi
        is_ = lambda phi: math.isclose(float(camera.phi), float(phi), rel_tol=1e-6)
        if known is not None and is_(known):
            return ""
        focal_was_free = self.fits and not {"phi", "d"}.isdisjoint(self.fits[0].names)
        fitted = focal_was_free and any(is_(fit.camera.phi) for fit in self.fits)
        return "from an earlier fit" if fitted else "assumed"

    def move(self, turn: Any = (0, 0, 0), shift: Any = (0, 0), nearer: Any = 1) -> Answer:
        """Turn the object (rad: right, up, clockwise), shift it (px: right, down), scale its
        distance."""
        moves = numbers_of("turn", turn, 3), numbers_of("shift", shift, 2)
        (factor,) = numbers_of("nearer", nearer, 1)
        if not factor > 0:
            raise ValueError(f"`nearer`: expected a positive factor, got {factor}")
        extent = self.workpiece.extent
        return self._show(camera=hand.moved(self.session.camera, extent, *moves, factor))

    def stand(self, up: str) -> Answer:
        """Look at the whole object, standing with its axis x, y or z upwards."""
        return self._show(camera=hand.frame_object(self.session.camera, self.workpiece.extent, up))

    def lens(self, phi_degrees: Any = None, **changes: Any) -> Answer:
        """Change the field of view, or numbers of the lens as `hand.with_lens` names them."""
        camera = self.session.camera
        if phi_degrees is not None:
            (degrees,) = numbers_of("phi_degrees", phi_degrees, 1)
            camera = hand.with_phi(camera, self.workpiece.extent.centre, math.radians(degrees))
        if changes:
            values = numbers_of("lens", list(changes.values()), len(changes))
            camera = hand.with_lens(camera, dict(zip(changes, values, strict=True)))
        return self._show(camera=camera)

    def straight(self, grid: Any, line: Any = None, clear: Any = False) -> Answer:
        """Show a grid of straight lines or not; add a line through two places, or drop them all."""
        self._straight = bool(grid)
        lines = () if clear else self.session.lines
        return self._show(lines=lines if line is None else (*lines, numbers_of("line", line, 4)))

    def stroke(self, **data: Any) -> Answer:
        """Draw: see `strokes.stroke_of`."""
        return self._push_work((*self.session.strokes, stroke_of(Fields(data, "a stroke"))))

    def view_guides(self) -> Answer:
        """Guide the guess by the view: object well within the outline, background well outside."""
        inside = np.asarray(silhouette(self.session.camera, self.workpiece.scene)) > 0.5
        if not np.any(inside):
            raise ValueError("the object is not in the picture: turn or shift it there first")
        return self._push_work((*self.session.strokes, *guides_around(inside)))

    def undo(self) -> Answer:
        """Take back the last stroke or mask."""
        return self._go_to(self._at - 1)

    def redo(self) -> Answer:
        """Restore the stroke or mask that was taken back last."""
        return self._go_to(self._at + 1)

    def clear(self) -> Answer:
        """Drop all strokes and masks."""
        return self._push_work(()) if self.session.strokes else self._mask_description()

    def load_mask(self, data: str, name: str = "mask") -> Answer:
        """Take a mask from a picture's file (in base64)."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "mask"
            path.write_bytes(base64.b64decode(data))
            try:
                mask = io.load_mask(path)
            except ValueError as error:
                raise ValueError(str(error).replace(str(path), name)) from error
        return self.take_mask(mask)

    def take_mask(self, mask: np.ndarray) -> Answer:
        """Take a mask (H, W), uint8, in place of the strokes."""
        W, H = self.workpiece.size
        if mask.shape != (H, W):
            size = f"{mask.shape[1]} x {mask.shape[0]}"
            raise ValueError(f"`mask`: expected the photo's size {W} x {H}, got {size}")
        return self._push_work((*self.session.strokes, LoadedMask(png_of(mask))))

    def fit(self, free: Sequence[str], search: bool = False, refine: bool = False) -> Answer:
        """Fit the camera to the mask, from the current view or (`search`) from all views; then,
        with `refine`, to the photo."""
        if self.mask is None or not np.any(self.mask):
            raise ValueError("there is no mask yet: draw on the object, or load one")
        self._stopping.clear()
        camera, free = self.session.camera, free_of(free)
        self.session = self.session._replace(free=free)
        assumption = self._phi_from() if {"phi", "d"}.isdisjoint(free) else ""

        def on_step(progress: Progress) -> None:
            if self._stopping.is_set():
                raise StopRequest
            self._push(self._stop_description(progress))

        start = Start(None, camera.phi, camera.lens) if search else Start(camera)
        try:
            fit = fit_camera(
                self.workpiece.scene,
                self.mask,
                free=free,
                photo=self.workpiece.picture if refine else None,
                progress=on_step,
                record=True,
                **start._asdict(),
            )
        except StopRequest:
            raise ValueError("stopped: the camera has not changed") from None
        each = (mode._replace(status=fit.status, modes=fit.modes) for mode in (fit, *fit.modes))
        self.fits = tuple(with_assumed_phi(mode, assumption) for mode in each)
        self._assumption = assumption
        return self.mode(0)

    def _stop_description(self, stop: Progress) -> Answer:
        return {
            "words": str(stop),
            "camera": camera_numbers(stop.camera),
            "outline": outline_lines(stop.camera, self.workpiece.scene),
        }

    def way(self) -> Answer:
        """Return each step of the last fit, from its start."""
        return {"stops": [self._stop_description(stop) for stop in self._fitted().history]}

    def mode(self, number: Any) -> Answer:
        """Take one of the cameras that fit the mask: 0 is the best, the others are its modes."""
        if not (isinstance(number, int) and 0 <= number < len(self.fits)):
            count = len(self.fits)
            raise ValueError(f"`number`: expected one of {count} cameras, got {number!r}")
        self.chosen = number
        view = self._show(camera=self.fits[number].camera)
        return {"fit": self._fit_description(), "view": view}

    def restore(self) -> Answer:
        """Go back to the camera of the last fit."""
        return self._show(camera=self._fitted().camera)

    def _fitted(self) -> Fit:
        if self.result is None:
            raise ValueError("there is no result yet: fit first")
        return self.result

    def export(self, format: str, name: str) -> Answer:
        """Write the current camera in a format, or in all of them ("all"), and the mask, if any."""
        name = plain(name)
        if format not in ("all", *FORMATS):
            raise ValueError(f"`format`: expected one of all, {', '.join(FORMATS)}, got {format!r}")
        written = []
        for each in FORMATS if format == "all" else [format]:
            path = self.folder / (name + ENDINGS[each])
            written.append(written_path(path))
            write(path, {name: self.session.camera}, each)
        if self.mask is not None:
            path = self.folder / f"{name}_mask.png"
            written.append(written_path(path))
            io.save_image(path, self.mask)
        return {"written": written}

    def save(self, name: str, free: Sequence[str]) -> Answer:
        """Write the session as one file."""
        self.session = self.session._replace(free=free_of(free))
        path = self.folder / f"{plain(name)}.studio.json"
        written = written_path(path)
        io.save_text(path, session_to_text(self.session))
        return {"written": [written]}

    def open(self, text: str, name: str = "session") -> Answer:
        """Continue a session from its file's text."""
        self.resume(session_from_text(text, name))
        return self.hello()

    def _push_work(self, work: Work) -> Answer:
        self._works = [*self._works[: self._at + 1], work][-MOST_UNDONE:]
        return self._go_to(len(self._works) - 1)

    def _go_to(self, place: int) -> Answer:
        """Take the work at a place of all states."""
        if not 0 <= place < len(self._works):
            raise ValueError(f"nothing to {'undo' if place < 0 else 'redo'}")
        self._at, work = place, self._works[place]
        self.session = self.session._replace(strokes=work)
        self.mask = mask_of(work, self._guess(strokes_of(work, GUIDES)), *self.workpiece.size)
        return self._mask_description()

    def _mask_description(self) -> Answer:
        mask = self.mask
        return {
            "png": None if mask is None else png_of(mask),
            "share": 0.0 if mask is None else float(np.mean(mask > 127)),
            "guides": [stroke._asdict() for stroke in strokes_of(self.session.strokes, GUIDES)],
            "can_undo": self._at > 0,
            "can_redo": self._at < len(self._works) - 1,
        }

    def _fit_description(self) -> Answer | None:
        """Return the fit's status, table, notes, outline with its band, K, R and t."""
        fit, mask, scene = self.result, self.mask, self.workpiece.scene
        if fit is None:
            return None
        described = {"status": fit.status, "meaning": STATUSES[fit.status], "chosen": self.chosen}
        if self._assumption and fit.status == "uncertain":
            described["meaning"] = f"use it as a start only: {fit.weak[0].partition(';')[0]}"
        if fit.status == "non_finite":
            none = {"iou": None, "rows": [], "notes": [], "band": None, "pose": "", "modes": []}
            return {**described, **none}
        notes = () if mask is None else disagreement(fit.camera, scene, mask)
        return {
            **described,
            "iou": fit.iou,
            "rows": [row.cells() for row in fit.parameters.rows],
            "notes": [*fit.weak, *notes],
            "band": band_of(fit, scene),
            "pose": str(object_pose(fit, pixel_centres="integer")),
            "modes": [mode.iou for mode in self.fits],
        }


def with_assumed_phi(fit: Fit, phi_from: str) -> Fit:
    """Return a fit that names the guess of the field of view that it held fixed.

    The camera is only as right as that guess, so it has not `converged`. `phi_from` is the guess's
    origin, "" if somebody gave it.
    """
    if not phi_from:
        return fit
    words = f"field of view {phi_from}: {np.rad2deg(float(fit.camera.phi)):.1f} degrees"
    words += "; the sigmas ignore its error: let the fit change it, or give --fov"
    status = "uncertain" if fit.status == "converged" else fit.status
    return fit._replace(status=status, weak=(words, *fit.weak))


def plain(name: str) -> str:
    """Return a name for files; raise ValueError if it is a path."""
    if not re.fullmatch(r"[\w-][\w.-]{0,99}", name):
        raise ValueError(f"`name`: expected letters, digits, - and _, got {name!r}")
    return name
