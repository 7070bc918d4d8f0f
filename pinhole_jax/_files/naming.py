"""What a function's error says of its arguments, said of its caller's: a command's, a record's."""

import contextlib
import re
from collections.abc import Iterator


@contextlib.contextmanager
def named(**arguments: str) -> Iterator[None]:
    """Name a caller's arguments in errors that name a function's: `path="MESH"`."""
    try:
        yield
    except (ValueError, OSError) as error:
        raise ValueError(renamed(str(error), arguments)) from error


def renamed(text: str, arguments: dict[str, str]) -> str:
    """Return an error's text with the library's names, in backticks, replaced by others."""
    # Where the library says how the command has it, that alone stays.
    text = re.sub(r"`\w+` \(on the command line: (--[^)]+)\)", r"`\1`", text)
    text = re.sub(r"`\w+` ([\w=]+) \((--[\w-]+ \1)\)", r"`\2`", text)
    return re.sub(r"`(\w+)`", lambda found: f"`{arguments.get(found[1], found[1])}`", text)
