"""Numbers in the lines of a text, all at once."""

import codecs
import re
import warnings

import numpy as np

#: A comment begins a word: Windows writes NaN and infinity as 1.#QNAN, -1.#IND00 and 1.#INF.
COMMENT = re.compile(rb"(?<!\S)#[^\r\n]*")
UTF_16 = codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE


def strip_mark(data: bytes) -> bytes:
    """Return text without UTF-8's byte order mark, or raise ValueError where it is UTF-16."""
    if data.startswith(UTF_16) or 0 in data[:2]:
        raise ValueError("text in UTF-16: save it as UTF-8")
    return data.removeprefix(codecs.BOM_UTF8)


def parse_numbers(text: bytes, kind: type, what: str) -> np.ndarray:
    """Return the numbers of a text, float or int, parted by white space.

    Raises ValueError, which names them by `what`, for words that are no numbers.
    """
    try:
        with warnings.catch_warnings(action="error", category=DeprecationWarning):
            # Of white space alone it makes a number.
            return np.fromstring(text if text.strip() else b"", dtype=kind, sep=" ")
    except (DeprecationWarning, ValueError):
        raise ValueError(f"expected numbers in {what}, got {_no_number(text, kind)}") from None


def _no_number(text: bytes, kind: type) -> str:
    """Return the first word that is no number."""
    for word in text.split():
        try:
            kind(word)
        except ValueError:
            return repr(word[:30].decode(errors="replace"))
    return "something else"


def to_integers(numbers: np.ndarray, what: str) -> np.ndarray:
    """Return floats as integers, or raise ValueError, which names them by `what`."""
    if not (np.all(np.abs(numbers) <= 2**53) and np.array_equal(numbers, np.round(numbers))):
        raise ValueError(f"expected whole numbers in {what}, got others")
    return numbers.astype(int)


def parse_rows(lines: list[bytes], kind: type, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of all lines in a row, and how many each line has, (L,).

    Raises ValueError as `parse_numbers`, and for a sign alone, which NumPy joins to what follows.
    """
    counts = np.array([len(line.split()) for line in lines], int)
    numbers = parse_numbers(b"\n".join(lines), kind, what)
    if numbers.size != np.sum(counts):
        raise ValueError(f"expected {np.sum(counts)} numbers in {what}, got {numbers.size}")
    return numbers, counts


def parse_points(lines: list[bytes]) -> np.ndarray:
    """Return the first three numbers of each line, (L, 3); what follows them are colours and such.

    Raises ValueError where there are fewer.
    """
    numbers, counts = parse_rows(lines, float, "vertices")
    if np.any(counts < 3):
        raise ValueError(f"vertex {np.argmin(counts) + 1}: {np.min(counts)} coordinates")
    starts = np.cumsum(counts) - counts
    return numbers[starts[:, None] + np.arange(3)]
