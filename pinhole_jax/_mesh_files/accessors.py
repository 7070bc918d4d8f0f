"""The arrays of a glTF file: accessors of views of buffers, as the specification (3.6) has them."""

import base64
import binascii
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np

from .._files.paths import read_bytes
from .json import at, flag, integer, member, wrong

#: An accessor of more entries than this has to bring its data (without, it stands for zeros).
MOST_WITHOUT_DATA = 1 << 20
#: The most bytes of a mesh file, or of a buffer beside it.
MOST_BYTES = 1 << 32
#: All accessors together: many may show the same data.
MOST_NUMBERS = 1 << 28
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
COMPRESSION = ("EXT_meshopt_compression", "KHR_meshopt_compression")


class Accessors:
    """The accessors of a glTF file, each read when it is asked for."""

    def __init__(self, top: dict[str, Any], file: Path, binary: bytes | None):
        self.top, self.file, self.binary = top, file, binary
        self.buffers: dict[int, bytes] = {}
        self.read: dict[tuple[int, str], np.ndarray] = {}
        self.numbers = 0

    def count(self, index: int) -> int:
        """Return how many entries an accessor says that it has."""
        return integer(at(self.top, "accessors", index), "count", f"accessors[{index}]")

    def spend(self, numbers: int, where: str) -> None:
        """Count numbers that are read or worked out; raise ValueError where they are too many."""
        self.numbers += numbers
        if self.numbers > MOST_NUMBERS:
            raise wrong(where, f"at most {MOST_NUMBERS} numbers in all", self.numbers)

    def floats(self, index: int, kind: str) -> np.ndarray:
        """Return an accessor of a type such as VEC3 as float64 (count, width)."""
        if (index, kind) not in self.read:
            self.read[index, kind] = self._floats(index, kind)
        return self.read[index, kind]

    def _floats(self, index: int, kind: str) -> np.ndarray:
        values = self._values(index, kind)
        accessor = at(self.top, "accessors", index)
        if flag(accessor, "normalized") and values.dtype.kind in "iu":
            return np.maximum(values / np.iinfo(values.dtype).max, -1.0)
        return values.astype(float)

    def integers(self, index: int) -> np.ndarray:
        """Return an accessor of unsigned integers of type SCALAR as int64 (count,)."""
        values = self._values(index, "SCALAR")
        if values.dtype.kind != "u":
            raise wrong(f"accessors[{index}].componentType", "unsigned integers", values.dtype.name)
        return values[:, 0].astype(np.int64)

    def vectors(self, index: int) -> np.ndarray:
        """Return an accessor of unsigned integers of type VEC4 as int64 (count, 4)."""
        values = self._values(index, "VEC4")
        if values.dtype.kind != "u":
            raise wrong(f"accessors[{index}].componentType", "unsigned integers", values.dtype.name)
        return values.astype(np.int64)

    def has_data(self, index: int) -> bool:
        """Return whether an accessor names any data of its own."""
        accessor = at(self.top, "accessors", index)
        return "bufferView" in accessor or "sparse" in accessor

    def _values(self, index: int, kind: str) -> np.ndarray:
        accessor, where = at(self.top, "accessors", index), f"accessors[{index}]"
        if accessor.get("type") != kind:
            raise wrong(f"{where}.type", kind, accessor.get("type"))
        component = accessor.get("componentType")
        if not isinstance(component, int) or component not in COMPONENTS:
            raise wrong(f"{where}.componentType", f"one of {[*COMPONENTS]}", component)
        dtype, width = np.dtype(COMPONENTS[component]), WIDTHS[kind]
        count = integer(accessor, "count", where)

        self.spend(count * width, f"{where}.count")
        if "bufferView" in accessor:
            values = self._view(accessor, where, dtype, width, count)
        elif count > MOST_WITHOUT_DATA:
            raise wrong(f"{where}.count", f"at most {MOST_WITHOUT_DATA} without data", count)
        else:
            values = np.zeros((count, width), dtype)
        if "sparse" in accessor:
            values = self._with_sparse(values, accessor, where)
        return values

    def _with_sparse(self, values: np.ndarray, accessor: dict, where: str) -> np.ndarray:
        """Return the values with those of a sparse accessor put in their places."""
        where = f"{where}.sparse"
        sparse = member(accessor, "sparse", where)
        number = integer(sparse, "count", where, below=len(values) + 1)
        places, entries = member(sparse, "indices", where), member(sparse, "values", where)
        component = places.get("componentType")
        if component not in (5121, 5123, 5125):
            raise wrong(f"{where}.indices.componentType", "5121, 5123 or 5125", component)
        dtype = np.dtype(COMPONENTS[component])
        index = self._view(places, f"{where}.indices", dtype, 1, number)[:, 0]
        if number and np.max(index) >= len(values):
            raise wrong(f"{where}.indices", f"numbers below {len(values)}", np.max(index))
        values = values.copy()
        values[index] = self._view(
            entries, f"{where}.values", values.dtype, values.shape[1], number
        )
        return values

    def _view(self, part: dict, where: str, dtype: np.dtype, width: int, count: int) -> np.ndarray:
        """Return (count, width) numbers of a part with `bufferView` and `byteOffset`."""
        index = integer(part, "bufferView", where)
        view, name = at(self.top, "bufferViews", index), f"bufferViews[{index}]"
        data = self._view_bytes(view, name)

        row = dtype.itemsize * width
        stride = integer(view, "byteStride", name, default=row) or row
        offset = integer(part, "byteOffset", where, default=0)
        needed = offset + (count - 1) * stride + row if count else 0
        if needed > len(data):
            raise wrong(f"{where}.count", f"at most {len(data)} bytes of {name}", needed)
        if not count:
            return np.empty((0, width), dtype)
        return np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize))

    def _view_bytes(self, view: dict, name: str) -> memoryview:
        index = integer(view, "buffer", name)
        buffer = at(self.top, "buffers", index)
        packed = [key for key in view.get("extensions", {}) if key in COMPRESSION]
        if packed and "uri" not in buffer and not (index == 0 and self.binary is not None):
            raise wrong(f"{name}.extensions", "data that are not compressed", packed[0])
        data = self._buffer(index)
        start = integer(view, "byteOffset", name, default=0)
        length = integer(view, "byteLength", name)
        if start + length > len(data):
            raise wrong(f"{name}.byteLength", f"at most {len(data) - start}", length)
        return memoryview(data)[start : start + length]

    def _buffer(self, index: int) -> bytes:
        if index not in self.buffers:
            self.buffers[index] = self._read_buffer(index)
        return self.buffers[index]

    def _read_buffer(self, index: int) -> bytes:
        buffer, where = at(self.top, "buffers", index), f"buffers[{index}]"
        length = integer(buffer, "byteLength", where)
        uri = buffer.get("uri")
        if uri is None and index == 0 and self.binary is not None:
            data = self.binary
        elif not isinstance(uri, str):
            raise wrong(f"{where}.uri", "a text", uri)
        elif uri.startswith("data:"):
            data = _of_data_uri(uri, where)
        else:
            data = read_bytes(_beside(self.file, uri, f"{where}.uri"), "a buffer", MOST_BYTES)
        if len(data) < length:
            raise wrong(f"{where}.byteLength", f"at most the {len(data)} bytes there are", length)
        return data[:length]


def _of_data_uri(uri: str, where: str) -> bytes:
    head, _, text = uri.partition(",")
    try:
        if not head.endswith(";base64"):
            raise ValueError
        return base64.b64decode(unquote(text), validate=True)
    except (ValueError, binascii.Error):
        raise wrong(f"{where}.uri", "data in base64", uri[:40]) from None


def _beside(file: Path, uri: str, where: str) -> Path:
    """Return the file that a URI names, which has to be in the mesh's folder or below it."""
    folder = file.parent.resolve()
    try:
        scheme = urlsplit(uri).scheme
        path = (folder / unquote(uri)).resolve()
        outside = bool(scheme) or not path.is_relative_to(folder)
        there = not outside and path.is_file()
    except (OSError, RuntimeError, ValueError):  # no name of a file, a circle of links
        raise wrong(where, "a file in the mesh's folder", uri[:80]) from None
    if outside:
        raise wrong(where, "a file in the mesh's folder", uri[:80])
    if not there:
        raise wrong(where, "a file that there is", uri[:80])
    return path
