"""Binary glTF: a head, a chunk of JSON, and chunks of data."""

import struct

#: glTF's mark, version 2, the sizes of the file and of the first chunk, whose kind is JSON.
HEAD = struct.Struct("<4s4I")
MAGIC, VERSION, JSON_CHUNK = b"glTF", 2, 0x4E4F534A


def json_size(head: bytes, size: int) -> int | None:
    """Return the size of the JSON behind the head of a file of this size; None for plain JSON.

    Raises ValueError for a file that is cut short, of another version, or begins with other data.
    """
    if head[:4] != MAGIC:
        return None
    _, version, whole, length, kind = HEAD.unpack(head[: HEAD.size].ljust(HEAD.size, b"\0"))
    if not HEAD.size + length <= whole <= size:
        raise ValueError(f"expected a whole glb of {whole} bytes, got {size}: cut short")
    if version != VERSION or kind != JSON_CHUNK:
        raise ValueError(f"expected JSON first in a glb of version {VERSION}, got other data")
    return length


def pack_glb(text: bytes, rest: bytes = b"") -> bytes:
    """Return the binary file of some JSON and the chunks that follow it."""
    text += b" " * (-len(text) % 4)
    size = HEAD.size + len(text) + len(rest)
    return HEAD.pack(MAGIC, VERSION, size, len(text), JSON_CHUNK) + text + rest
