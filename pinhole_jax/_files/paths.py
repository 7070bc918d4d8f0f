"""The door of files: what is read is bounded, and what is written is whole.

Every file from outside comes in here. It is a regular file (a pipe would hang, a device never end)
of bounded size. Text is UTF-8, and the depth of JSON is bounded.
"""

import json
import os
import re
import secrets
import stat
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO
from xml.parsers import expat

from .interrupt import interrupts_raise

#: A file's or a folder's path, as users give it.
FilePath = str | os.PathLike[str]
#: The most bytes of a file that is read as a whole, and the deepest nesting of JSON.
MOST_BYTES = 1 << 26
MOST_DEPTH = 64
#: The names of a process's own streams, and their numbers.
STREAMS = {
    "/dev/stdout": 1,
    "/dev/fd/1": 1,
    "/proc/self/fd/1": 1,
    "/dev/stderr": 2,
    "/dev/fd/2": 2,
    "/proc/self/fd/2": 2,
}
#: The kinds of things at a path, by their letter in a listing of files.
KINDS = {"-": "a file", "d": "a folder", "p": "a pipe", "s": "a socket"}
#: A pipe that nobody writes to, or reads from, is not waited for (Windows has none of these).
NO_WAIT = getattr(os, "O_NONBLOCK", 0)


def as_path(path: Any) -> Path:
    """Return a path, or raise ValueError where the value is none."""
    try:
        if isinstance(path, str) and not path:
            raise ValueError("`path`: expected a path, got an empty one")
        return Path(path)
    except TypeError:
        raise ValueError(f"`path`: expected a path, got {type(path).__name__}") from None


def file_and_name(path: Any) -> tuple[Path, str | None]:
    """Return the path and the name of FILE:NAME, or a path and None."""
    file = as_path(path)
    if file.exists() or ":" not in file.name:
        return file, None
    head, _, name = str(path).rpartition(":")
    return as_path(head), name


def open_file(path: Any, kind: str, most: int = MOST_BYTES) -> BinaryIO:
    """Return a regular file of at most this many bytes, open for reading.

    Raises FileNotFoundError, or ValueError where it is no regular file, too large or out of reach.
    """
    file = as_path(path)
    with refusal(path, kind):  # no permission, a name too long, a zero byte
        if _is_file(file):
            if file.stat().st_size > most:
                raise ValueError(f"more than {most} bytes")
            return os.fdopen(os.open(file, os.O_RDONLY | NO_WAIT), "rb")
    raise FileNotFoundError(f"`path`: expected {kind}, got {str(path)!r}: no such file")


def read_bytes(path: Any, kind: str, most: int = MOST_BYTES) -> bytes:
    """Return a file's contents, or raise as `open_file`."""
    with open_file(path, kind, most) as stream, refusal(path, kind):
        size = os.fstat(stream.fileno()).st_size or MOST_BYTES
        data = stream.read(min(size, most) + 1)
        if len(data) > most:  # one that grows, or does not tell its size
            raise ValueError(f"more than {most} bytes")
    return data


def read_text(path: Any, kind: str, most: int = MOST_BYTES) -> str:
    """Return a text file's contents, or raise as `open_file`, and where it is not UTF-8."""
    return decode_text(read_bytes(path, kind, most), path)


def decode_text(data: bytes, path: Any, kind: str = "text") -> str:
    """Return the text of a file's bytes, or raise ValueError where they are not UTF-8."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"`path`: expected {kind}, got {_name(path)}: not UTF-8") from None


def read_json(path: Any, kind: str, most: int = MOST_BYTES) -> Any:
    """Return the data of a JSON file, or raise as `open_file` and `parse_json`."""
    return parse_json(decode_text(read_bytes(path, kind, most), path, "JSON"), path)


def parse_json(text: str, path: Any, kind: str = "JSON") -> Any:
    """Return the data of a file's JSON text; ValueError where it is none or names a field twice."""
    return parse_data(lambda: json.loads(text, object_pairs_hook=as_fields), path, kind)


def parse_data(parse: Callable[[], Any], path: Any, kind: str) -> Any:
    """Return the data that a file's parser makes; ValueError where they have more than
    `MOST_DEPTH` levels, or the parser raises it."""
    with refusal(path, kind):
        with suppress(RecursionError):  # deeper than Python goes
            data = parse()
            if not is_deep(data):
                return data
        raise ValueError(f"more than {MOST_DEPTH} levels")


def parse_xml(data: bytes | str, path: Any, kind: str = "XML") -> ET.Element:
    """Return the root of a file's XML; tags keep their prefixes, whether or not declared.

    Raises ValueError where it is none, or has a DOCTYPE, whose entities can grow without bound.
    """
    builder, parser = ET.TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = builder.data, _doctype
    with refusal(path, kind):
        parser.Parse(data, True)
    return builder.close()


def _doctype(*_: object) -> None:
    raise ValueError("a DOCTYPE, which is not read")


def is_stream(path: Any) -> bool:
    """True if a path is a pipe or one of this process's own streams."""
    target = as_path(path)
    return os.path.abspath(target) in STREAMS or _kind(target) == "a pipe"


def written_path(path: FilePath) -> str:
    """Return a path to write as text, and whether that replaces a file, or files of a folder."""
    return f"{path}{' (replaced)' * (not is_stream(path) and as_path(path).exists())}"


def replace_file(path: Any, data: bytes | Iterable[bytes], *, lasting: bool = False) -> None:
    """Write a file, whole or not at all: a temporary file beside it is renamed.

    What is at the path decides. A file is replaced; of a link to a file (or to nothing) the link
    is. A pipe that is being read is written to, and so are /dev/stdout and /dev/stderr. `lasting`:
    the disk has it before the name says so, whatever becomes of the machine.

    Raises ValueError for folders, devices and sockets, and for what cannot be written.
    """
    target, data = as_path(path), [data] if isinstance(data, bytes) else data
    with refusal(path, "a file to write"):
        if is_stream(target):
            _write_through(target, data)
        else:
            _is_file(target)
            _replace(target, data, lasting)


def check_writable(path: Any) -> None:
    """Raise ValueError, as `replace_file` would, where a file cannot be written: folders are made
    and a file is written there, and both are removed again."""
    target = as_path(path)
    with refusal(path, "a file to write"):
        if is_stream(target):
            return
        _is_file(target)
        made = [folder for folder in target.parents if not folder.exists()]
        trial = target.parent / f"tmp{secrets.token_hex(8)}"
        _replace(trial, [b""], lasting=False)
        trial.unlink()
        for folder in made:
            folder.rmdir()


@contextmanager
def refusal(path: Any, kind: str, *others: type[Exception]) -> Iterator[None]:
    """Raise ValueError with the path and the `kind` of file that was expected, for any reason that
    files have, and for `others`."""
    try:
        yield
    except (OSError, ValueError, expat.ExpatError, *others) as error:
        words = f"`path`: expected {kind}, got {_name(path)}: {reason(error)}"
        raise ValueError(words) from error


def reason(error: Exception) -> str:
    """Return the first line of an error that a reader or a writer of files raised."""
    words = (isinstance(error, OSError) and error.strerror) or str(error)
    first = words.splitlines()[0] if words else type(error).__name__
    return re.sub(r"\s*<_io\.[^>]*>", "", first)  # how a reader calls the stream that it was given


def _is_file(target: Path) -> bool:
    """True for a file, False where there is nothing; ValueError where there is something else."""
    if (kind := _kind(target)) not in (None, "a file"):
        raise ValueError(kind)
    return kind is not None


def _name(path: Any) -> str:
    words = repr(str(path))
    return words if len(words) < 300 else words[:99] + "..."


def as_fields(pairs: Iterable[tuple[str, Any]], kind: str = "field") -> dict[str, Any]:
    """Return named values as a dict, or raise ValueError where a name comes again."""
    fields: dict[str, Any] = {}
    for name, value in pairs:
        if name in fields:
            raise ValueError(f"the {kind} {name[:60]!r} twice")
        fields[name] = value
    return fields


def is_deep(data: Any, levels: int = MOST_DEPTH) -> bool:
    """True if lists and maps are nested deeper than this many levels."""
    if not isinstance(data, dict | list):
        return False
    parts = data.values() if isinstance(data, dict) else data
    return levels == 0 or any(is_deep(part, levels - 1) for part in parts)


def _kind(target: Path) -> str | None:
    """Return the kind of thing at a path, through links; None if there is nothing."""
    try:
        return KINDS.get(stat.filemode(os.stat(target).st_mode)[0], "a device")
    except FileNotFoundError:
        return None


def _write_through(target: Path, data: Iterable[bytes]) -> None:
    number = STREAMS.get(os.path.abspath(target))
    if number is None:
        handle = os.open(target, os.O_WRONLY | NO_WAIT)  # an error if nobody reads it
        os.set_blocking(handle, True)
    else:
        sys.stdout.flush()
        handle = os.dup(number)
    with open(handle, "wb") as stream:
        stream.writelines(data)


def _replace(target: Path, data: Iterable[bytes], lasting: bool) -> None:
    if target.is_symlink() and os.readlink(target).startswith("/proc/"):
        raise ValueError("a stream of a process")
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.parent / f"tmp{secrets.token_hex(8)}{target.suffix[:9]}"
    with interrupts_raise():
        try:
            with open(temporary, "xb") as stream:
                stream.writelines(data)
                if lasting:
                    stream.flush()
                    os.fsync(stream.fileno())
            temporary.replace(target)
        finally:
            temporary.unlink(missing_ok=True)
