"""The bench of one tab: a person's actions on camera and mask.

An action is a method that the page calls by name, with numbers from JSON. It returns JSON-ready
values, and raises ValueError with a message for the person if it is impossible.
"""

import base64
import inspect
import math
import tempfile
import threading
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from .. import Camera, Fit, Progress, fit_camera, io, silhouette
from ..batch.inputs import numbers_of
from ..formats import FORMATS
from . import hand
from .descriptions import fit_description, mask_description, with_held_phi
from .drawing import camera_numbers, grid_lines, outline_lines, straight_lines
from .exports import export, path_words, plain
from .session import Session, free_of, line_of, save_session, session_from_text
from .strokes import (
    LoadedMask,
    Stroke,
    Work,
    guess_mask,
    guides_around,
    guides_of,
    mask_of,
    stroke_of,
)
from .workpiece import Workpiece, workpiece_of

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


class StopRequest(Exception):
    """A person stopped a fit."""


class Bench:
    """A tab's camera, mask and fit; `folder` is where files are written."""

    def __init__(self, workpiece: Workpiece, folder: Path) -> None:
        self.workpiece, self.folder = workpiece, folder
        self.camera: Camera = workpiece.start
        self.known_phi = workpiece.phi
        self.free: tuple[str, ...] = ("pose",) if self.known_phi is not None else ("pose", "phi")
        self.work: Work = ()
        self.lines: tuple[Any, ...] = ()
        self.result: Fit | None = None
        self.mask: np.ndarray | None = None
        self._candidates: tuple[Fit, ...] = ()
        self._phi_was_free, self._held_phi = False, None
        self._guess = _guesses_of(workpiece)
        self._redo_stack: list[Work] = []
        self._undo_stack: list[Work] = []
        self._straight = False
        self._stopping = threading.Event()
        self._lock, self._fits = threading.Lock(), False

    def act(self, name: str, numbers: dict[str, Any], push: Callable[[Any], None]) -> Any:
        """Do an action and return its answer; `push` sends news to the page meanwhile.

        Raises ValueError for unknown actions, wrong numbers, and while a fit runs.
        """
        if name not in ACTIONS:
            raise ValueError(f"`do`: expected one of {', '.join(ACTIONS)}, got {name!r}")
        if name == "stop":
            self._stopping.set()
            return {}
        if self._fits:
            raise ValueError("a fit is running: wait for it, or stop it")
        with self._lock:
            action = getattr(self, name)
            if name == "fit":
                numbers = {**numbers, "push": push}
            try:
                inspect.signature(action).bind(**numbers)
            except TypeError as error:
                raise ValueError(f"`{name}`: {error}") from None
            self._fits = name == "fit"
            try:
                return action(**numbers)
            finally:
                self._fits = False

    def hello(self) -> dict[str, Any]:
        """Return the contents of a page that opens."""
        W, H = self.workpiece.size
        return {
            "mesh": Path(self.workpiece.mesh).name,
            "photo": Path(self.workpiece.photo).name,
            "W": W,
            "H": H,
            "free": list(self.free),
            "formats": list(FORMATS),
            "folder": str(self.folder),
            "view": self.look(),
            "mask": self._mask_description(),
            "fit": None if self.result is None else self._fit_description(self.result),
        }

    def look(self) -> dict[str, Any]:
        """Return the view of the current camera."""
        camera = self.camera
        return {
            "camera": camera_numbers(camera),
            "outline": outline_lines(camera, self.workpiece.scene),
            "grid": grid_lines(camera) if self._straight else [],
            "lines": straight_lines(camera, self.lines),
            "is_fit": self.result is not None and camera is self.result.camera,
            "upright": hand.upright(camera),
            "phi_is_assumed": self._phi_from() == "assumed",
        }

    def _phi_from(self) -> str | None:
        """Return the origin of the field of view, None if a person, a file or the photo gave it."""
        is_ = lambda phi: math.isclose(float(self.camera.phi), float(phi), rel_tol=1e-6)
        if self.known_phi is not None and is_(self.known_phi):
            return None
        fitted = self._phi_was_free and any(is_(each.camera.phi) for each in self._candidates)
        return "from an earlier fit" if fitted else "assumed"

    def move(self, turn: Any = (0, 0, 0), shift: Any = (0, 0), nearer: Any = 1) -> dict[str, Any]:
        """Turn the object (rad: right, up, clockwise), shift it (px: right, down), scale its
        distance."""
        moves = [*numbers_of("turn", turn, 3), *numbers_of("shift", shift, 2)]
        (factor,) = numbers_of("nearer", nearer, 1)
        if not factor > 0:
            raise ValueError(f"`nearer`: expected a positive factor, got {factor}")
        extent, camera = self.workpiece.extent, self.camera
        if any(moves[:3]):
            camera = hand.turn_object(camera, extent.centre, *moves[:3])
        if any(moves[3:]):
            camera = hand.shift_object(camera, extent.centre, *moves[3:])
        self.camera = camera if factor == 1 else hand.scale_distance(camera, extent, factor)
        return self.look()

    def stand(self, up: str) -> dict[str, Any]:
        """Look at the whole object, standing with its axis x, y or z upwards."""
        self.camera = hand.frame_object(self.camera, self.workpiece.extent, up)
        return self.look()

    def lens(self, phi_degrees: Any = None, **changes: Any) -> dict[str, Any]:
        """Change the field of view, or numbers of the lens as `hand.with_lens` names them."""
        if phi_degrees is not None:
            (degrees,) = numbers_of("phi_degrees", phi_degrees, 1)
            phi = np.deg2rad(degrees)
            self.camera = hand.with_phi(self.camera, self.workpiece.extent.centre, float(phi))
        if changes:
            values = numbers_of("lens", list(changes.values()), len(changes))
            self.camera = hand.with_lens(self.camera, dict(zip(changes, values, strict=True)))
        return self.look()

    def straight(self, grid: Any, line: Any = None, clear: Any = False) -> dict[str, Any]:
        """Show a grid of straight lines or not; add a line through two places, or drop them all."""
        self._straight = bool(grid)
        if clear:
            self.lines = ()
        if line is not None:
            self.lines = (*self.lines, line_of(line))
        return self.look()

    def stroke(self, **data: Any) -> dict[str, Any]:
        """Draw: see `strokes.stroke_of`."""
        return self._push_work((*self.work, stroke_of(data)))

    def view_guides(self) -> dict[str, Any]:
        """Guide the guess by the view: object well within the outline, background well outside."""
        inside = np.asarray(silhouette(self.camera, self.workpiece.scene)) > 0.5
        if not np.any(inside):
            raise ValueError("the object is not in the picture: turn or shift it there first")
        return self._push_work((*self.work, *guides_around(inside)))

    def undo(self) -> dict[str, Any]:
        """Take back the last stroke or mask."""
        if not self._undo_stack:
            raise ValueError("nothing to undo")
        self._redo_stack.append(self.work)
        return self._set_work(self._undo_stack.pop())

    def redo(self) -> dict[str, Any]:
        """Restore the stroke or mask that was taken back last."""
        if not self._redo_stack:
            raise ValueError("nothing to redo")
        self._undo_stack.append(self.work)
        return self._set_work(self._redo_stack.pop())

    def clear(self) -> dict[str, Any]:
        """Drop all strokes and masks."""
        return self._push_work(()) if self.work else self._mask_description()

    def load_mask(self, data: str, name: str = "mask") -> dict[str, Any]:
        """Take a mask from a picture's file (in base64)."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "mask"
            path.write_bytes(base64.b64decode(data))
            try:
                mask = io.load_mask(path)
            except ValueError as error:
                raise ValueError(str(error).replace(str(path), name)) from error
        return self.take_mask(mask)

    def take_mask(self, mask: np.ndarray) -> dict[str, Any]:
        """Take a mask (H, W), uint8, in place of the strokes."""
        W, H = self.workpiece.size
        if mask.shape != (H, W):
            size = f"{mask.shape[1]} x {mask.shape[0]}"
            raise ValueError(f"`mask`: expected the photo's size {W} x {H}, got {size}")
        return self._push_work((*self.work, LoadedMask(mask)))

    def fit(
        self,
        free: Sequence[str],
        search: bool = False,
        refine: bool = False,
        push: Callable[[Any], None] | None = None,
    ) -> dict[str, Any]:
        """Fit the camera to the mask, from the current view or (`search`) from all views; then,
        with `refine`, to the photo."""
        if self.mask is None or not np.any(self.mask):
            raise ValueError("there is no mask yet: draw on the object, or load one")
        self._stopping.clear()
        self.free = free_of(free)
        focal_is_free = not {"phi", "d"}.isdisjoint(self.free)
        held = None if focal_is_free else self._phi_from()
        start = None if search else self.camera
        known: Any = {"phi": self.camera.phi, "lens": self.camera.lens} if search else {}
        known["photo"] = self.workpiece.picture if refine else None
        on_step = partial(self._on_step, push)
        try:
            fit = fit_camera(
                self.workpiece.scene,
                self.mask,
                start,
                self.free,
                progress=on_step,
                record=True,
                **known,
            )
        except StopRequest:
            raise ValueError("stopped: the camera has not changed") from None
        self._candidates = tuple(with_held_phi(each, held) for each in (fit, *fit.modes))
        self._phi_was_free, self._held_phi = focal_is_free, held
        self.result, self.camera = self._candidates[0], fit.camera
        return {"fit": self._fit_description(self.result), "view": self.look()}

    def _on_step(self, push: Callable[[Any], None] | None, progress: Progress) -> None:
        if self._stopping.is_set():
            raise StopRequest
        if push is not None:
            push(self._stop_description(progress))

    def _stop_description(self, stop: Progress) -> dict[str, Any]:
        return {
            "words": str(stop),
            "camera": camera_numbers(stop.camera),
            "outline": outline_lines(stop.camera, self.workpiece.scene),
        }

    def way(self) -> dict[str, Any]:
        """Return each step of the last fit, from its start."""
        if self.result is None or not self.result.history:
            raise ValueError("there is no result yet: fit first")
        return {"stops": [self._stop_description(stop) for stop in self.result.history]}

    def mode(self, number: Any) -> dict[str, Any]:
        """Take one of the cameras that fit the mask: 0 is the best, the others are its modes."""
        if not (isinstance(number, int) and 0 <= number < len(self._candidates)):
            count = len(self._candidates)
            raise ValueError(f"`number`: expected one of {count} cameras, got {number!r}")
        best = self._candidates[0]
        self.result = self._candidates[number]._replace(status=best.status, modes=best.modes)
        self.camera = self.result.camera
        return {"fit": self._fit_description(self.result), "view": self.look()}

    def restore(self) -> dict[str, Any]:
        """Go back to the camera of the last fit."""
        if self.result is None:
            raise ValueError("there is no result yet: fit first")
        self.camera = self.result.camera
        return self.look()

    def export(self, format: str, name: str) -> dict[str, Any]:
        """Write the current camera in a format, or in all of them ("all"), and the mask, if any."""
        return {"written": export(self.folder, name, self.camera, format, self.mask)}

    def save(self, name: str, free: Sequence[str]) -> dict[str, Any]:
        """Write the session as one file."""
        self.free = free_of(free)
        path = self.folder / f"{plain(name)}.studio.json"
        written = path_words(path)
        save_session(path, self.session())
        return {"written": [written]}

    def session(self) -> Session:
        """Return the session as it is."""
        mesh, photo = (str(Path(p).resolve()) for p in (self.workpiece.mesh, self.workpiece.photo))
        return Session(mesh, photo, self.camera, self.free, self.work, self.lines, self.known_phi)

    def open(self, text: str, name: str = "session") -> dict[str, Any]:
        """Continue a session from its file's text."""
        self.resume(session_from_text(text, name))
        return self.hello()

    def resume(self, session: Session) -> None:
        """Continue a session."""
        files = session.mesh, session.photo
        own = str(Path(self.workpiece.mesh).resolve()), str(Path(self.workpiece.photo).resolve())
        if files != own:
            self.workpiece = workpiece_of(*files, session.camera)
            self._guess = _guesses_of(self.workpiece)
        elif self.workpiece.size != (session.camera.W, session.camera.H):
            raise ValueError("`camera`: expected one of the photo's size")
        self.camera, self.free, self.lines = session.camera, session.free, session.lines
        self.known_phi, self.result, self._candidates = session.known_phi, None, ()
        work = session.work
        self._undo_stack, self._redo_stack = [work[:k] for k in range(len(work))][-MOST_UNDONE:], []
        self._set_work(work)

    def _push_work(self, work: Work) -> dict[str, Any]:
        self._undo_stack = [*self._undo_stack, self.work][-MOST_UNDONE:]
        self._redo_stack = []
        return self._set_work(work)

    def _set_work(self, work: Work) -> dict[str, Any]:
        W, H = self.workpiece.size
        self.work, self.mask = work, mask_of(work, self._guess(guides_of(work)), W, H)
        return self._mask_description()

    def _mask_description(self) -> dict[str, Any]:
        described = mask_description(self.mask, self.work)
        return {**described, "can_undo": bool(self._undo_stack), "can_redo": bool(self._redo_stack)}

    def _fit_description(self, fit: Fit) -> dict[str, Any]:
        described = fit_description(fit, self.workpiece.scene, self.mask, self._held_phi)
        modes = [m.iou for m in self._candidates] if fit.status != "non_finite" else []
        chosen = [m.camera is fit.camera for m in self._candidates].index(True)
        return {**described, "modes": modes, "chosen": chosen}


def _guesses_of(workpiece: Workpiece) -> Callable[[tuple[Stroke, ...]], np.ndarray | None]:
    """Return a function from strokes to a guess; it keeps some, so that undo needs no new one."""
    return lru_cache(MOST_GUESSES)(lambda guides: guess_mask(workpiece.picture, guides))
