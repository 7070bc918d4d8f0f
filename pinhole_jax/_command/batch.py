"""`pinhole-jax batch`: the cameras of a whole data set, and tables and files of them."""

import argparse
import re
from collections.abc import Iterator
from pathlib import Path

from .. import formats
from .._files.interrupt import interrupts_raise
from .._files.naming import named
from .._files.paths import written_path
from .._files.progress import Ticker, say
from ..batch import NO_FIT, Results, fit_many, fit_of, merge, read_dataset
from ..batch.inputs import check_fov
from .options import record_of
from .outputs import check_outputs


def run(options: argparse.Namespace, progress: Ticker) -> int:
    """Fit the records without a row, write tables and cameras; return 0, or 1 if any failed."""
    if options.dataset is None and not (options.merge or options.write):
        raise ValueError("`dataset`: expected a data set, --merge or --write, got none")
    rows = None if options.dataset is None else Path(options.output) / "rows"
    check_outputs(output=rows, merge=options.merge)
    if options.fov is not None:
        check_fov(options.fov)
    results = Results(options.output)
    if options.dataset is not None:
        with named(path="dataset"):
            _fit(options, results)
    counts = results.counts()
    progress.done()
    print(f"rows       {len(results)} in {options.output}")
    for status, count in counts.items():
        print(f"  {count:6d}   {status}")
    failure = next((row for row in results if row["status"] in NO_FIT), None)
    if failure is not None:
        print(f"failure    {failure['id']}: {failure['words']}")
    if written := list(_write_outputs(options, results)):
        print(f"written    {', '.join(written)}")
    return int(failure is not None)


def _fit(options: argparse.Namespace, results: Results) -> None:
    """Fit the records that have no row yet."""
    if not (options.resume or options.retry) and len(results):
        raise ValueError(
            f"`output`: expected a folder without rows, got {options.output!r}; continue that run"
            " with --resume"
        )
    data = read_dataset(
        options.dataset,
        start=options.start,
        models=options.models,
        detections=options.detections,
        **record_of(options),
    )
    shard = re.fullmatch(r"(\d{1,9})/(\d{1,9})", options.shard)
    if shard is None:
        raise ValueError(f"`shard`: expected I/N, as 3/10, got {options.shard!r}")
    say("counting records")
    with interrupts_raise():
        fit_many(
            data,
            track=options.track,
            workers=options.workers,
            out=options.output,
            progress=say,
            shard=(int(shard[1]), int(shard[2])),
            time_limit=options.time_limit or None,
            cached=not options.no_cache,
            retry=options.retry,
        )


def _write_outputs(options: argparse.Namespace, results: Results) -> Iterator[str]:
    """Write the table and the camera asked for; yield their paths, and whether they replaced."""
    if options.merge is not None:
        words = written_path(options.merge)
        with named(path="merge"):
            left_out = len(results) - merge(results, options.merge)
        yield words + f" (without {left_out} rows that have no camera)" * (left_out > 0)
    if options.write is not None:
        id, path = options.write
        words = written_path(path)
        with named(**dict.fromkeys(("id", "row", "path", "cameras"), "write")):
            formats.write(path, {id: fit_of(results.row(id)).camera})
        yield words
