"""Frames of one object: each record is fitted from where the last one ended."""

import json
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any

from .records import Record, asked, check_record, digest_of, plain_record
from .rows import Row


class Tracking(Executor):
    """Fits records here, one after another in their order; each starts at the camera of the last
    one with the same mesh, if that converged, and has none of its own."""

    def __init__(self) -> None:
        self._last: dict[str, Row] = {}

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> "Future[Any]":
        """Return the row of a record, which is there already."""
        record, *others = args
        future, mesh = Future(), str(record.get("mesh"))
        try:
            row = fn(_begun(record, self._last.get(mesh)), *others, **kwargs)
            row["record"] = json.dumps(plain_record(record))
            if row["hash"] is not None:
                row["hash"] = digest_of(check_record(record))
        except Exception as error:
            future.set_exception(error)
            return future
        if row["status"] == "converged":
            self._last[mesh] = row
        future.set_result(row)
        return future


def _begun(record: Record, last: Row | None) -> Record:
    """Return a record that starts at a row's camera; as it is where it says where to start."""
    bent = last is not None and "distortion" in (json.loads(last["lens"]) or {})
    if last is None or {"start", "camera"} & record.keys() or (bent and "dist" not in record):
        return record
    R, t = (last[name] for name in ("R", "t"))
    start = [[*R[3 * k : 3 * k + 3], t[k]] for k in range(3)] + [[0.0, 0.0, 0.0, 1.0]]
    rest = {name: value for name, value in record.items() if name != "fov"}
    centres = asked(json.loads(last["record"]), "pixel_centres")
    known = {"K": record["K"]} if "K" in record else {"K": last["K"], "pixel_centres": centres}
    return {**rest, **known, "start": start}
