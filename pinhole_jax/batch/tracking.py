"""Frames of one object: each record is fitted from the camera of the last one."""

import json
from collections.abc import Generator, Iterable

from . import worker
from .records import Record, check_record, digest_of, plain_record, setting
from .rows import Row
from .worker import Setup


def tracked_rows(records: Iterable[Record], setup: Setup) -> Generator[Row, None, None]:
    """Yield the rows of records that are fitted in this process, one after another.

    Each starts at the camera of the last one with the same mesh that converged, unless the record
    has a camera to start from.
    """
    converged: dict[str, Row] = {}
    for record in records:
        mesh = str(record.get("mesh"))
        row = worker.run(_record_after(record, converged.get(mesh)), setup)
        row["record"] = json.dumps(plain_record(record))
        if row["hash"] is not None:
            row["hash"] = digest_of(check_record(record))
        if row["status"] == "converged":
            converged[mesh] = row
        yield row


def _record_after(record: Record, last: Row | None) -> Record:
    """Return a record that starts at a row's camera, unless it has a start of its own."""
    bent = last is not None and "distortion" in (json.loads(last["lens"]) or {})
    if last is None or {"start", "camera"} & record.keys() or (bent and "dist" not in record):
        return record
    R, t = last["R"], last["t"]
    start = [[*R[3 * k : 3 * k + 3], t[k]] for k in range(3)] + [[0.0, 0.0, 0.0, 1.0]]
    if "K" in record:
        return {**record, "start": start}
    rest = {name: value for name, value in record.items() if name not in ("fov", "resize")}
    centres = setting(json.loads(last["record"]), "pixel_centres")
    return {**rest, "K": last["K"], "pixel_centres": centres, "start": start}
