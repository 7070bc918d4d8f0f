"""The fields of a glTF file's JSON, with checks that name them."""

from typing import Any


def wrong(name: str, expected: str, got: Any) -> ValueError:
    """Return the error of a field."""
    words = f"{got}"
    return ValueError(f"`{name}`: expected {expected}, got {words[:80]}")


def integer(
    part: dict, name: str, where: str, *, default: int | None = None, below: int | None = None
) -> int:
    """Return a field that counts: a whole number of at least 0, or of its default if left out."""
    value = part.get(name, default)
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise wrong(f"{where}.{name}", "a whole number of at least 0", value)
    if below is not None and value >= below:
        raise wrong(f"{where}.{name}", f"a number below {below}", value)
    return value


def flag(part: dict, name: str) -> bool:
    """Return whether a field is there and true."""
    return part.get(name, False) is True


def numbers(part: dict, name: str, where: str, size: int | None = None) -> list[float]:
    """Return a field that is a list of numbers, `size` of them."""
    value = part.get(name)
    if not isinstance(value, list) or (size is not None and len(value) != size):
        raise wrong(f"{where}.{name}", f"a list of {size or 'the'} numbers", value)
    if not all(type(x) in (int, float) and abs(x) < 1e300 for x in value):
        raise wrong(f"{where}.{name}", "finite numbers", value)
    return [float(x) for x in value]


def items(part: dict, name: str, where: str = "") -> list:
    """Return a field that is a list, [] if it is left out."""
    value = part.get(name, [])
    if not isinstance(value, list):
        raise wrong(f"{where}.{name}".lstrip("."), "a list", type(value).__name__)
    return value


def at(top: dict, name: str, index: int) -> dict:
    """Return an entry of a list of objects."""
    entries = items(top, name)
    if not 0 <= index < len(entries):
        raise wrong(name, f"more than {index} of them", len(entries))
    if not isinstance(entries[index], dict):
        raise wrong(f"{name}[{index}]", "an object", type(entries[index]).__name__)
    return entries[index]


def member(part: dict, name: str, where: str) -> dict:
    """Return a field that is an object, {} if it is left out."""
    value = part.get(name, {})
    if not isinstance(value, dict):
        raise wrong(f"{where}.{name}".lstrip("."), "an object", type(value).__name__)
    return value
