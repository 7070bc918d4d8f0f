"""The door of files: what is read is bounded, and what is written is whole.

Every file from outside comes in here. It is a regular file (a pipe would hang, a device never end)
of at most this many bytes; text is UTF-8, and JSON is no deeper than cameras are.
"""

import json
import os
import re
import secrets
import stat
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO

from .interrupt import interrupts_raise

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
#: A pipe that nobody writes to, or reads from, is not waited for (Windows has none of these).
NO_WAIT = getattr(os, "O_NONBLOCK", 0)


def path_of(path: Any) -> Path:
    """Return a path, or raise ValueError where the value is none."""
    try:
        if isinstance(path, str) and not path:
            raise ValueError("`path`: expected a path, got an empty one")
        return Path(path)
    except TypeError:
        raise ValueError(f"`path`: expected a path, got {type(path).__name__}") from None


def is_folder(path: Any) -> bool:
    """Return whether there is a folder at a path; a path that no system takes has none."""
    try:
        return path_of(path).is_dir()
    except OSError:
        return False


def existing(path: Any, kind: str, most: int | None = None) -> Path:
    """Return the path of a regular file to read, of at most this many bytes.

    Raises FileNotFoundError, or ValueError where it is no regular file, too large or out of reach.
    """
    file = path_of(path)
    try:
        found = os.stat(file)
    except FileNotFoundError:
        raise FileNotFoundError(
            f"`path`: expected {kind}, got {str(path)!r}: no such file"
        ) from None
    except (OSError, ValueError) as error:  # no permission, a name too long, a zero byte
        raise ValueError(f"`path`: expected {kind}, got {_name(path)}: {reason(error)}") from error
    _check_regular(found, path, kind, most)
    return file


def opened(path: Any, kind: str, most: int | None = MOST_BYTES) -> BinaryIO:
    """Return a regular file, open for reading.

    Raises FileNotFoundError or ValueError like `existing`.
    """
    file = existing(path, kind, most)
    try:
        stream = os.fdopen(os.open(file, os.O_RDONLY | NO_WAIT), "rb")
    except OSError as error:
        raise ValueError(f"`path`: expected {kind}, got {_name(path)}: {reason(error)}") from error
    try:
        _check_regular(os.fstat(stream.fileno()), path, kind, most)  # it may be another by now
    except ValueError:
        stream.close()
        raise
    return stream


def read_bytes(path: Any, kind: str, most: int = MOST_BYTES) -> bytes:
    """Return a file's contents, or raise as `existing`."""
    with opened(path, kind, most) as stream:
        try:
            data = stream.read(most + 1)
        except OSError as error:
            words = f"`path`: expected {kind}, got {_name(path)}: {reason(error)}"
            raise ValueError(words) from error
    if len(data) > most:  # one that grows, or does not tell its size
        raise _too_large(path, kind, most)
    return data


def read_text(path: Any, kind: str) -> str:
    """Return a text file's contents, or raise as `existing`, and where it is not UTF-8."""
    return text_of(read_bytes(path, kind), path)


def text_of(data: bytes, path: Any, kind: str = "text") -> str:
    """Return the text of a file's bytes, or raise ValueError where they are not UTF-8."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"`path`: expected {kind}, got {_name(path)}: not UTF-8") from None


def read_json(path: Any, kind: str) -> Any:
    """Return what a JSON file says, or raise as `existing` and `parse_json`."""
    return parse_json(text_of(read_bytes(path, kind), path, "JSON"), path)


def parse_json(text: str, path: Any, kind: str = "JSON") -> Any:
    """Return what a file's JSON text says.

    Raises ValueError where it is none, is deeper than `MOST_DEPTH`, or names a field twice.
    """
    try:
        data = json.loads(text, object_pairs_hook=_object)
        if not is_deep(data):
            return data
    except RecursionError:  # deeper than Python goes
        pass
    except ValueError as error:
        raise ValueError(f"`path`: expected {kind}, got {_name(path)}: {error}") from None
    words = f"{kind} of at most {MOST_DEPTH} levels, got {_name(path)}: more"
    raise ValueError(f"`path`: expected {words}")


def is_stream(path: Any) -> bool:
    """Return whether to write to a path is to write to a pipe or to this process's own streams."""
    return _stream_number(path_of(path)) is not None or _kind(path_of(path)) == "a pipe"


def replace_file(path: Any, data: bytes | Iterable[bytes], *, lasting: bool = False) -> None:
    """Write a file, whole or not at all: a temporary file beside it is renamed.

    What is at the path decides. A file is replaced; of a link to a file (or to nothing) the link
    is. A pipe that is being read is written to, and so are /dev/stdout and /dev/stderr. `lasting`:
    the disk has it before the name says so, whatever becomes of the machine.

    Raises ValueError for folders, devices and sockets, and for what cannot be written.
    """
    target, data = path_of(path), [data] if isinstance(data, bytes) else data
    try:
        if is_stream(target):
            _write_through(target, data)
        elif (kind := _kind(target)) not in (None, "a file"):
            raise ValueError(kind)
        else:
            _replace(target, data, lasting)
    except (OSError, ValueError) as error:
        raise ValueError(
            f"`path`: expected a file to write, got {_name(path)}: {reason(error)}"
        ) from error


def check_writable(path: Any) -> None:
    """Raise ValueError, as `replace_file` would, where a file cannot be written: folders are made
    and a file is written there, and both are removed again."""
    target = path_of(path)
    try:
        if is_stream(target):
            return
        if (kind := _kind(target)) not in (None, "a file"):
            raise ValueError(kind)
        made = [folder for folder in target.parents if not folder.exists()]
        trial = target.parent / f"tmp{secrets.token_hex(8)}"
        _replace(trial, [b""], lasting=False)
        trial.unlink()
        for folder in made:
            folder.rmdir()
    except (OSError, ValueError) as error:
        raise ValueError(
            f"`path`: expected a file to write, got {_name(path)}: {reason(error)}"
        ) from error


def reason(error: Exception) -> str:
    """Return the first line of what a reader or a writer of files raised."""
    if isinstance(error, ModuleNotFoundError) and error.name in ("chardet", "charset_normalizer"):
        return "bytes that are no text in UTF-8"
    words = (isinstance(error, OSError) and error.strerror) or str(error)
    first = words.splitlines()[0] if words else type(error).__name__
    return re.sub(r"\s*<_io\.[^>]*>", "", first)  # how a reader calls the stream that it was given


def _check_regular(found: os.stat_result, path: Any, kind: str, most: int | None) -> None:
    if not stat.S_ISREG(found.st_mode):
        what = "a folder" if stat.S_ISDIR(found.st_mode) else "not a regular file"
        raise ValueError(f"`path`: expected {kind}, got {_name(path)}: {what}")
    if most is not None and found.st_size > most:
        raise _too_large(path, kind, most)


def _too_large(path: Any, kind: str, most: int) -> ValueError:
    words = f"{kind} of at most {most} bytes, got {_name(path)}: more"
    return ValueError(f"`path`: expected {words}")


def _name(path: Any) -> str:
    words = repr(str(path))
    return words if len(words) < 300 else words[:99] + "..."


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    data = dict(pairs)
    if len(data) < len(pairs):
        seen: set[str] = set()
        twice = next(name for name, _ in pairs if name in seen or seen.add(name))
        raise ValueError(f"the field {twice[:60]!r} twice")
    return data


def is_deep(data: Any) -> bool:
    """Tell if lists and maps are nested deeper than `MOST_DEPTH`."""
    level = [data]
    for _ in range(MOST_DEPTH + 1):
        level = [x for part in level for x in _inside(part) if isinstance(x, (dict, list))]
    return bool(level)


def _inside(part: Any) -> Iterable[Any]:
    if isinstance(part, dict):
        return part.values()
    return part if isinstance(part, list) else ()


def _stream_number(target: Path) -> int | None:
    return STREAMS.get(os.path.abspath(target))


def _kind(target: Path) -> str | None:
    """Return what is at a path, through links: None if nothing is."""
    try:
        mode = os.stat(target).st_mode
    except FileNotFoundError:
        return None
    kinds = (
        (stat.S_ISREG, "a file"),
        (stat.S_ISDIR, "a folder"),
        (stat.S_ISFIFO, "a pipe"),
        (stat.S_ISSOCK, "a socket"),
    )
    return next((words for is_kind, words in kinds if is_kind(mode)), "a device")


def _write_through(target: Path, data: Iterable[bytes]) -> None:
    number = _stream_number(target)
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
