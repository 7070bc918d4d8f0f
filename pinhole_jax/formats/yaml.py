"""The part of YAML that OpenCV's FileStorage writes: named numbers, texts, lists and matrices.

No pattern here looks twice at a character (`++`, `*+`: what is taken is not given back), so that
the time goes with the text's length.
"""

import math
import re
from typing import Any

import numpy as np

NAME = re.compile(r"[A-Za-z_][\w.\- ]*+")
#: A text in quotes; one that does not end goes to the end.
QUOTED = r"""(?:"(?:[^"\\]|\\.)*+"?+|'[^']*+'?+)"""
#: A comment's beginning, or what may hide one: a text in quotes.
COMMENT = re.compile(rf"(?<![^\s,\[]){QUOTED}|(?<!\S)#")
ITEM = re.compile(rf"\s*+{QUOTED}?+[^,]*+")
#: A field of a matrix, its value in brackets or a word.
FIELD = re.compile(r"\b(\w++)\s*+:\s*+(\[[^\]]*+\]?+|[^\s\[\],}]++)")
INTEGER = re.compile(r"[+-]?\d{1,18}")
NUMBER = re.compile(r"[+-]?(?:\d++\.?\d*+|\.\d++)(?:[eE][+-]?\d++)?")
#: What FileStorage escapes and can read again: not its `\xNN`, which swallows the letters behind.
ESCAPES = {"\\": "\\", '"': '"', "\n": "n", "\r": "r", "\t": "t"}
#: FileStorage refuses longer texts.
MOST_BYTES = 4095


def parse(text: str, where: str) -> dict[str, Any]:
    """Return the top-level names of a FileStorage document with their values.

    `!!opencv-matrix` becomes a float64 array; nested maps are kept as text, unread.

    Raises ValueError naming the line or field where the text is not of that kind or ends early.
    """
    found: dict[str, list[str]] = {}
    last = None
    for number, raw in enumerate(text.split("\n"), 1):
        line = _without_comment(raw).rstrip()
        if not line.strip() or line.startswith(("%", "---", "...")):
            continue
        if line[0] in " \t-" and last is not None:
            found[last].append(line.strip())
            continue
        name, colon, rest = line.partition(":")
        last = name.rstrip()
        if not colon or not NAME.fullmatch(last) or not (rest + " ")[0].isspace():
            words = f"expected `name: value`, got {raw[:80]!r}"
            raise ValueError(f"line {number}: {words} (in {where})")
        if last in found:
            raise ValueError(f"`{last}`: expected one such field, got two (in {where})")
        found[last] = [rest.strip()]
    return {name: _value(name, lines, where) for name, lines in found.items()}


def matrix(name: str, array: np.ndarray) -> str:
    """Return a matrix as FileStorage writes it."""
    numbers = [repr(float(x)) for x in array.ravel()]
    lines = [", ".join(numbers[k : k + 4]) for k in range(0, len(numbers), 4)]
    data = ",\n       ".join(lines)
    rows, cols = array.shape
    return (
        f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n"
        f"   data: [ {data} ]\n"
    )


def quoted(text: str) -> str:
    """Return a text in quotes."""
    return '"' + "".join(f"\\{ESCAPES[c]}" if c in ESCAPES else c for c in text) + '"'


def can_hold(text: str) -> bool:
    """Return whether FileStorage reads a quoted text as it was: short, no control characters."""
    control = any(c < " " and c not in ESCAPES for c in text)
    return len(text.encode()) <= MOST_BYTES and not control


def _unquoted(text: str) -> str:
    if text[0] == "'":
        return text[1:-1].replace("''", "'")
    meant = {letter: character for character, letter in ESCAPES.items()}

    def character(found: re.Match) -> str:
        code = str(found[1])
        return chr(int(code[1:], 16)) if len(code) > 1 else meant.get(code, code)

    return re.sub(r"\\(x[0-9a-fA-F]{1,2}|.)", character, text[1:-1])


def _value(name: str, lines: list[str], where: str) -> Any:
    head, body = lines[0], lines[1:]
    tag = re.match(r"!!(\S+)\s*(.*)$", head)
    if tag is not None:
        head = tag[2]
    joined = " ".join([head, *body]).strip()
    is_map = bool(body) and not head and re.match(r"\w+\s*:", body[0])
    if (tag is not None and tag[1].startswith("opencv-")) or (
        is_map and re.search(r"\brows\s*:", joined) and re.search(r"\bdata\s*:", joined)
    ):
        return _matrix(name, joined, where)
    if is_map:
        return joined
    if head.startswith("["):
        if not joined.endswith("]"):
            raise ValueError(f"`{name}`: expected a list that ends with ], got none (in {where})")
        return [_scalar(x) for x in _split(joined[1:-1])]
    if not head and body:
        return [_scalar(x[1:].strip()) for x in body if x.startswith("-")]
    return _scalar(joined)


def _matrix(name: str, text: str, where: str) -> np.ndarray:
    expected = f"`{name}`: expected an OpenCV matrix (rows, cols, dt, data)"
    fields = dict(FIELD.findall(text))
    kind, data = fields.get("dt", "d").strip('"'), fields.get("data", "")
    sizes = fields.get("sizes", f"[{fields.get('rows', '')},{fields.get('cols', '')}]")
    size = [_scalar(n) for n in sizes[1:-1].split(",")]
    if not data.startswith("[") or not data.endswith("]") or not _are_sizes(size):
        raise ValueError(f"{expected}, got {text[:60]!r} (in {where})")
    if kind not in ("d", "f", "i", "u", "c", "w", "s"):
        raise ValueError(f"{expected} with one channel, got dt {kind[:9]!r} (in {where})")
    numbers = [_scalar(x) for x in _split(data[1:-1])]
    wrong = [x for x in numbers if isinstance(x, str)]
    if wrong or len(numbers) != math.prod(size):
        got = repr(wrong[0][:60]) if wrong else str(len(numbers))
        raise ValueError(f"{expected} of {math.prod(size)} numbers, got {got} (in {where})")
    return np.asarray(numbers, float).reshape(size)


def _are_sizes(values: list) -> bool:
    return len(values) <= 8 and all(isinstance(n, int) and n >= 0 for n in values)


def _scalar(text: str) -> Any:
    """Return a number where the text is one (also .Nan, -.Inf), else the text without quotes."""
    plain = text.strip()
    if len(plain) >= 2 and plain[0] == plain[-1] and plain[0] in "\"'":
        return _unquoted(plain)
    special = {".nan": np.nan, ".inf": np.inf, "-.inf": -np.inf}
    if plain.lower() in special:
        return special[plain.lower()]
    if INTEGER.fullmatch(plain):
        return int(plain)
    if NUMBER.fullmatch(plain):
        return float(plain)
    return plain


def _split(text: str) -> list[str]:
    """Return the items of a list: commas within quotes do not part them."""
    return [item.strip() for item in ITEM.findall(text) if item.strip()]


def _without_comment(line: str) -> str:
    starts = (found.start() for found in COMMENT.finditer(line) if found[0] == "#")
    return line[: next(starts, len(line))]
