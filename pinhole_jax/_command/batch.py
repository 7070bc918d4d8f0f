"""`pinhole-jax batch`: the cameras of a whole data set, and what is made of their rows."""

import argparse
import contextlib
import re
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from .. import Fisheye, formats
from .._files.interrupt import interrupts_raise
from .._files.naming import named
from .._files.progress import Ticker
from ..batch import (
    NO_FIT,
    Count,
    Dataset,
    Results,
    fit_many,
    fit_of,
    merge,
    read_dataset,
    shard_of,
)
from .known import check_fov, names_of
from .outputs import check_outputs, replaced

#: What the command calls the arguments of the library.
ASKED = {
    "out": "--output",
    "workers": "--workers",
    "shard": "--shard",
    "time_limit": "--time-limit",
    "retry": "--retry",
    "items": "DATASET",
    "path": "DATASET",
    "models": "--models",
    "detections": "--detections",
}


def run(options: argparse.Namespace, progress: Ticker) -> int:
    """Fit what is not done, write what is asked for; return 0, or 1 where a record failed."""
    if options.dataset is None and not (options.merge or options.write):
        raise ValueError("`DATASET`: expected one, or --merge or --write, got none")
    rows = None if options.dataset is None else Path(options.output) / "rows"
    check_outputs(output=rows, merge=options.merge)
    if options.fov is not None:
        check_fov(options.fov, progress.tell)
    with named(out="--output"):
        results = Results(options.output)
    if options.dataset is not None:
        with named(**ASKED):
            _fit(options, results, progress.say)
    counts = results.counts()
    progress.done()
    print(f"rows       {len(results)} in {options.output}")
    for status, count in counts.items():
        print(f"  {count:6d}   {status}")
    asked = [options.merge, options.write and options.write[1]]
    there = replaced([path for path in asked if path is not None])
    if written := list(_written(options, results)):
        print(f"written    {', '.join(written)}{there}")
    return 1 if NO_FIT.keys() & counts.keys() else 0


def _fit(options: argparse.Namespace, results: Results, say: Callable[[str], Any]) -> None:
    """Fit the records that have no row yet."""
    shard = _shard(options.shard)
    data = _dataset(options)
    resume = options.resume or options.retry is not None
    if not resume and not results.ids().isdisjoint(_ids(data, shard)):
        raise ValueError(
            f"`--output`: expected a folder without rows of DATASET, got {options.output!r};"
            " --resume goes on with what is not done"
        )
    say("counting records")
    on_step: Callable[[Count], Any] = lambda count: say(str(count))
    with interrupts_raise(), _ended_as_interrupted():
        fit_many(
            data,
            track=options.track,
            workers=options.workers,
            out=options.output,
            progress=on_step,
            shard=shard,
            time_limit=options.time_limit or None,
            cached=not options.no_cache,
            retry=_statuses(options.retry),
        )


@contextlib.contextmanager
def _ended_as_interrupted() -> Iterator[None]:
    """Let a scheduler's SIGTERM be what Ctrl-C is: what is done is written first."""

    def interrupted(number: int, frame: Any) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupted)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _dataset(options: argparse.Namespace) -> Dataset:
    return read_dataset(
        options.dataset,
        start=options.start,
        models=options.models,
        detections=options.detections,
        free=",".join(names_of(options.free)),
        camera=options.camera,
        fov=options.fov,
        mask_from=options.mask_from,
        invert=options.invert or None,
        tidy=options.tidy or (False if options.no_tidy else None),
        **_intrinsics(options),
    )


def _intrinsics(options: argparse.Namespace) -> dict[str, Any]:
    """Return the fields of records that say what `--K`, `--dist` and `--pixel-centres` do."""
    if options.K is None:
        if options.dist is not None:
            raise ValueError("`--dist`: expected --K beside it, got none")
        return {}
    K, dist, centres = options.K, options.dist, options.pixel_centres
    if isinstance(K, str):
        with named(path="--K"):
            camera = formats.read_intrinsics(K, size=(1, 1), pixel_centres=centres)
        if isinstance(camera.distortion, Fisheye):
            raise ValueError("`--K`: expected OpenCV's distortion, got a fisheye: give --camera")
        K = formats.to_opencv(camera, pixel_centres=centres)[0].ravel().tolist()
        if camera.distortion is not None:
            dist = [*camera.distortion.coefficients().values()]
    return {"K": K, "dist": dist, "pixel_centres": centres}


def _ids(data: Dataset, shard: tuple[int, int]) -> Iterator[str]:
    number, count = shard
    return (r["id"] for r in data if shard_of(r["id"], count) == number - 1)


def _statuses(text: str | None) -> list[str]:
    return [] if text is None else [name.strip() for name in text.split(",")]


def _shard(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
    if found is None:
        raise ValueError(f"`--shard`: expected I/N, as 3/10, got {text!r}")
    return int(found[1]), int(found[2])


def _written(options: argparse.Namespace, results: Results) -> Iterator[str]:
    """Write what is asked for; yield the paths."""
    if options.merge is not None:
        with named(path="--merge"):
            count = merge(results, options.merge)
        left_out = len(results) - count
        yield options.merge + (f" (without {left_out} rows that have no camera)" * (left_out > 0))
    if options.write is not None:
        id, path = options.write
        with named(id="--write", row="--write", path="--write", cameras="--write"):
            formats.write(path, {id: fit_of(results.row(id)).camera})
        yield path
