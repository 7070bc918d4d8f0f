"""Text and JSON files: what is read is bounded, what is written is whole."""

from .._files.paths import MOST_BYTES, FilePath, read_json, read_text, replace_file


def load_text(path: FilePath, *, most_bytes: int = MOST_BYTES) -> str:
    """Return a text file's contents (UTF-8).

    Raises FileNotFoundError, or ValueError for a folder, a pipe or a device, for more than
    `most_bytes` (64 MiB), and for text that is not UTF-8.

    ```python
    page = pj.io.load_text("page.html")
    ```
    """
    return read_text(path, "a text file", most_bytes)


def load_json(path: FilePath) -> object:
    """Return the contents of a JSON file.

    Raises as `load_text`, and ValueError for text that is not JSON, is nested more than 64 levels
    deep, or names a field twice.

    ```python
    data = pj.io.load_json("camera.json")
    ```
    """
    return read_json(path, "a JSON file")


def save_text(path: FilePath, text: str) -> None:
    """Write text to a file, as UTF-8: all of it, or nothing.

    Raises ValueError for a folder or a device, and for what cannot be written.

    ```python
    pj.io.save_text("page.html", "<h1>Part 12</h1>")
    ```
    """
    replace_file(path, text.encode(errors="backslashreplace"))  # a file's name may be no text
