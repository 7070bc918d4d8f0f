"""The part of YAML that OpenCV's FileStorage writes: named numbers, texts, lists and matrices."""

import re
from typing import Any

import numpy as np

NAME = re.compile(r"([A-Za-z_][\w.\- ]*?)\s*:(?:\s+(.*))?$")


def parse(text: str, where: str) -> dict[str, Any]:
    """Return the top-level names of a FileStorage document with their values.

    `!!opencv-matrix` becomes a float64 array; nested maps are kept as text, unread.

    Raises ValueError naming the line or field where the text is not of that kind or ends early.
    """
    found: dict[str, list[str]] = {}
    last = None
    for number, raw in enumerate(text.splitlines(), 1):
        line = _without_comment(raw).rstrip()
        if not line.strip() or line.startswith(("%", "---", "...")):
            continue
        if line[0] in " \t-" and last is not None:
            found[last].append(line.strip())
            continue
        match = NAME.match(line)
        if match is None:
            raise ValueError(f"line {number}: expected `name: value`, got {raw!r} (in {where})")
        last = match[1]
        if last in found:
            raise ValueError(f"`{last}`: expected one such field, got two (in {where})")
        found[last] = [match[2] or ""]
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
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


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
    shape = [re.search(rf"\b{field}\s*:\s*(\d+)\b", text) for field in ("rows", "cols")]
    sizes = re.search(r"\bsizes\s*:\s*\[([\d\s,]+)\]", text)
    kind = re.search(r"\bdt\s*:\s*\"?(\w+)\"?", text)
    data = re.search(r"\bdata\s*:\s*\[(.*)\]\s*$", text)
    if data is None or (sizes is None and None in shape):
        raise ValueError(f"{expected}, got {text[:60]!r} (in {where})")
    if kind is not None and kind[1] not in ("d", "f", "i", "u", "c", "w", "s"):
        raise ValueError(f"{expected} with one channel, got dt {kind[1]!r} (in {where})")
    if sizes is not None:
        size = [int(n) for n in sizes[1].split(",") if n.strip()]
    else:
        size = [int(found[1]) for found in shape if found is not None]
    numbers = [_scalar(x) for x in _split(data[1])]
    wrong = [x for x in numbers if isinstance(x, str)]
    if wrong or len(numbers) != int(np.prod(size)):
        got = repr(wrong[0]) if wrong else str(len(numbers))
        raise ValueError(f"{expected} of {int(np.prod(size))} numbers, got {got} (in {where})")
    return np.asarray(numbers, float).reshape(size)


def _scalar(text: str) -> Any:
    """Return a number where the text is one (also .Nan, -.Inf), else the text without quotes."""
    plain = text.strip()
    if len(plain) >= 2 and plain[0] == plain[-1] and plain[0] in "\"'":
        return plain[1:-1].replace('\\"', '"').replace("\\\\", "\\")
    special = {".nan": np.nan, ".inf": np.inf, "-.inf": -np.inf}
    if plain.lower() in special:
        return special[plain.lower()]
    if re.fullmatch(r"[+-]?\d+", plain):
        return int(plain)
    if re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", plain):
        return float(plain)
    return plain


def _split(text: str) -> list[str]:
    """Return the items of a list: commas within quotes do not part them."""
    items = re.findall(r'\s*"(?:[^"\\]|\\.)*"\s*|[^,]+', text)
    return [item.strip() for item in items if item.strip()]


def _without_comment(line: str) -> str:
    found = re.match(r"""(?:[^"'#]|"(?:[^"\\]|\\.)*"|'[^']*'|(?<!\s)#|["'])*?(?=\s#|^#|$)""", line)
    return line if found is None else line[: found.end()]
