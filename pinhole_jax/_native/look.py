"""A fit's look by the compiled library: compiled into a fit's program, or for Python alone."""

import ctypes
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._camera.film import FilmMap
from .._scene.scene import Scene
from .library import library
from .rasteriser import Variables, scene_arrays, variables_of

#: XLA's numbers of array types.
TYPES = {np.dtype(np.int32): 4, np.dtype(np.float32): 11, np.dtype(np.float64): 12}
#: An array in XLA's form for handlers: its size, extensions, type, data, rank, axes.
BUFFER = np.dtype("u8, u8, i4, u8, i8, u8", align=True)


class Sight(NamedTuple):
    """The variables of a view on a level of a mask, and their derivatives by n moves.

    They are those of `Variables`, without vertices where none moves.
    """

    film: Float[Array, "18"]
    lens: Float[Array, "l"]
    vertices: Float[Array, "v 3"]
    frames: Float[Array, "S 9"]
    film_by_move: Float[Array, "n 18"]
    lens_by_move: Float[Array, "n l"]
    vertices_by_move: Float[Array, "n v 3"]
    frames_by_move: Float[Array, "n S 9"]


def sight_of(film: FilmMap, scene: Scene, still: bool) -> Variables:
    """The variables of a sight, without vertices where they stand still."""
    numbers = variables_of(film, scene)
    return numbers._replace(vertices=numbers.vertices[:0]) if still else numbers


def along_each(
    at: Callable[[Array], tuple[Any, Any]], y: Float[Array, "n"]
) -> tuple[Any, Any, Any]:
    """The first result of `at`, its derivatives by each of the n numbers (n, ...), and the rest."""
    along = lambda way: jax.jvp(at, (y,), (way,), has_aux=True)
    return jax.vmap(along, out_axes=(None, 0, None))(jnp.eye(len(y), dtype=y.dtype))


class MaskLevel(NamedTuple):
    """A level of a mask, and the raster of all levels (see `_mask/pyramid.py`).

    - `size`: W and H; `start`: its place in the raster; `explained`: the explained residual.
    - `page`, `sums`, `cells`: the raster's pages, offsets of their running sums, and cells.
    """

    size: Int[Array, "2"]
    start: Int[Array, "1"]
    explained: Float[Array, "1"]
    page: Int[Array, "Q"]
    sums: Float[Array, "4 Q"]
    cells: Float[Array, "6 N"]


class TouchedPixels(NamedTuple):
    """The pixels that an outline touches, in raster order: row by row from the bottom, with one
    cell more at either end of a row.

    - `cell`, `coverage`, `weight`, `residual`: of each; weight and residual are 0 at a row's ends.
    - `after`: whether the untouched pixels that follow in the row are covered.
    - `before`: whether rows begin covered.
    - `jacobian`: the weighted residuals' derivatives by moves.
    """

    cell: np.ndarray  # (P,)
    coverage: np.ndarray  # (P,)
    weight: np.ndarray  # (P,)
    residual: np.ndarray  # (P,)
    after: np.ndarray  # (P,)
    before: bool
    jacobian: np.ndarray  # (P, n)


def look(
    sight: Sight, known: Float[Array, "m k"], scene: Scene, level: MaskLevel, model: int
) -> tuple[Float[Array, "k k"], Float[Array, "7"]]:
    """R of [J, r], with rows that are `known` beside the mask's, and the sums (see `Sums`)."""
    real, k = sight.film.dtype, len(sight.film_by_move) + 1
    shapes = [jax.ShapeDtypeStruct(shape, real) for shape in ((k, k), (7,))]
    call = jax.ffi.ffi_call("pinhole_look", shapes, vmap_method="sequential")
    triangle, sums = call(*_operands(sight, scene, level), known, model=model)
    return triangle, sums


def pixels(sight: Sight, scene: Scene, level: MaskLevel, model: int) -> TouchedPixels:
    """The pixels of a look: NumPy arrays, one entry a touched pixel."""
    table = _table(sight, scene, level, model, False)
    rows = table[1:].reshape(5 + len(sight.film_by_move), -1)
    cell, coverage, after, weight, residual = rows[:5]
    cell, after, before = cell.astype(np.int64), after.astype(bool), bool(table[0])
    return TouchedPixels(cell, coverage, weight, residual, after, before, rows[5:].T)


def outline(sight: Sight, scene: Scene, level: MaskLevel, model: int) -> Float[np.ndarray, "P k"]:
    """The outline that a look shows, a pixel a row: row, column, coverage; and means about it: how
    steep coverage is, its slope to the right and up, its derivatives by moves."""
    table = _table(sight, scene, level, model, True)
    return table.reshape(-1, 6 + len(sight.film_by_move))


def _table(
    sight: Sight, scene: Scene, level: MaskLevel, model: int, outline: bool
) -> Float[np.ndarray, "N"]:
    """A look's numbers as the library puts them together (`pinhole_table`)."""
    none = np.zeros((0, len(sight.film_by_move) + 1), np.asarray(sight.film).dtype)
    arrays = [np.ascontiguousarray(x) for x in (*_operands(sight, scene, level), none)]
    pointers, *_pointed_to = _buffers(arrays)
    data = lambda array: ctypes.c_void_p(array.ctypes.data)
    number, flags = ctypes.c_int64(), map(ctypes.c_int64, (model, outline))
    handle = library().pinhole_table(data(pointers), *flags, ctypes.byref(number))
    if handle is None:
        raise MemoryError("no memory for the pixels of a look")
    table = np.empty(number.value)
    library().pinhole_table_read(ctypes.c_void_p(handle), data(table))
    return table


def _operands(sight: Sight, scene: Scene, level: MaskLevel) -> list[Any]:
    """The library's operands of a look, in its order."""
    film, lens, _, frames, *moves = sight
    vertices, *rest = scene_arrays(scene, film.dtype)
    return [film, lens, vertices, frames, *rest, level.size, *moves, *level[1:]]


def _buffers(arrays: list[np.ndarray]) -> tuple[np.ndarray, ...]:
    """Pointers to arrays in XLA's form for handlers, and what these point to."""
    axes = np.array([n for x in arrays for n in x.shape], np.int64)
    begin, axis = axes.ctypes.data, 0
    buffers = np.empty(len(arrays), BUFFER)
    for k, x in enumerate(arrays):
        address = x.__array_interface__["data"][0]
        buffers[k] = BUFFER.itemsize, 0, TYPES[x.dtype], address, x.ndim, begin + 8 * axis
        axis += x.ndim
    pointers = buffers.ctypes.data + BUFFER.itemsize * np.arange(len(arrays), dtype=np.uintp)
    return pointers, buffers, axes
