"""The door: a user's arguments become arrays of one float type, or an error that names them."""

import contextlib
import operator
from collections.abc import Collection, Iterable
from numbers import Real
from reprlib import repr as brief
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

# An argument of a public function: `Input[ArrayLike, "N 3"]`, `Input[int, "px"]`. A type checker
# sees the type; its shape or unit is for readers. At run time it is anything: the function's own
# check names the argument, and a checker of annotations would speak before it.
if TYPE_CHECKING:
    from typing import Annotated as Input

    from numpy.typing import ArrayLike as ArrayLike
else:
    ArrayLike = Any

    class Input:
        """An argument that the function itself checks."""

        def __class_getitem__(cls, _):
            return Any


#: The default of a required argument, where None is refused with an error of its own.
MISSING: Any = object()


def is_concrete(*values: Any) -> bool:
    """Return True if no array in the values is traced by a transformation."""
    return not any(isinstance(v, Tracer) for v in jax.tree.leaves(values))


def is_real(array: Any) -> bool:
    """Return True for an array of floats or integers."""
    return any(jnp.issubdtype(array.dtype, kind) for kind in (jnp.floating, jnp.integer))


def is_number(value: Any) -> bool:
    """Return True for one real number; True and False are none."""
    kind = Real | np.ndarray | jax.Array
    return isinstance(value, kind) and np.shape(value) == () and is_real(np.asarray(value))


def check_positive(name: str, value: Any, expected: str = "a positive number") -> None:
    """Raise ValueError unless this is a finite number above 0."""
    if not (is_number(value) and 0 < value < np.inf):
        raise ValueError(f"`{name}`: expected {expected}, got {value!r}")


def check_kind(name: str, value: Any, kind: Any, expected: str) -> None:
    """Raise ValueError unless this is of a kind, or of one of several."""
    if not isinstance(value, kind):
        raise ValueError(f"`{name}`: expected {expected}, got {type(value).__name__}")


def check_known(
    name: str, given: Iterable[Any], known: Collection[str], what: str = "names"
) -> None:
    """Raise ValueError for a name that is none of those that are known."""
    for other in given:
        if other not in known:
            raise ValueError(f"`{name}`: expected {what} among {', '.join(known)}, got {other!r}")


def check_above_zero(name: str, array: Array, expected: str) -> None:
    """Raise ValueError unless all of these numbers, if they are known, are above 0."""
    if is_concrete(array) and not np.all(np.asarray(array) > 0):
        raise ValueError(f"`{name}`: expected {expected}, got {float(np.min(array))}")


def as_count(name: str, value: Any) -> int:
    """Return an integer of at least 1, or raise ValueError."""
    with contextlib.suppress(TypeError):
        if (count := operator.index(value)) >= 1 and not isinstance(value, bool):
            return count
    raise ValueError(f"`{name}`: expected an integer of at least 1, got {value!r}")


def evenly(number: int, most: int) -> np.ndarray:
    """Indices (k,) of `most` of a number of things, or of fewer, spread evenly among them."""
    return np.unique(np.linspace(0, number - 1, most).round().astype(int))


def array_of(name: str, value: Any, expected: str) -> Any:
    """Return the value as an array: JAX's stay, others become NumPy's.

    Raises ValueError for None, a text, and lists of different lengths.
    """
    with contextlib.suppress(ValueError):
        array = value if isinstance(value, jax.Array) else np.asarray(value)
        if array.ndim or array.dtype.kind not in "OU":
            return array
    raise ValueError(f"`{name}`: expected {expected}, got {brief(value)}")


def as_array(value: Any) -> Any:
    """Return numbers as an array: JAX's stay, others become NumPy's.

    (JAX would compile a copy of each shape.)
    """
    plain = isinstance(value, np.ndarray | np.number | list | tuple | float | int)
    if plain and is_concrete(value):
        return np.asarray(value)
    return jnp.asarray(value)


def as_numpy(value: Any) -> Any:
    """Return a NumPy array, whose operations compile nothing; a traced one as it is."""
    return np.asarray(value) if is_concrete(value) else value


def float_dtype(*values: Any) -> np.dtype:
    """Return the float type that the arrays among the values ask for.

    Python numbers, lists and integer arrays ask for nothing; with no float array at all the
    answer is JAX's default (float64 with `jax_enable_x64`, else float32).
    """
    dtypes = [
        v.dtype for v in values if hasattr(v, "dtype") and jnp.issubdtype(v.dtype, jnp.floating)
    ]
    if not dtypes:
        return jnp.zeros(()).dtype
    # Half precision cannot hold pixel coordinates: it is taken for float32. A long double is more
    # than JAX knows: it is taken for float64.
    double = any(np.dtype(dtype).itemsize > 4 for dtype in dtypes)
    return jax.dtypes.canonicalize_dtype(np.float64 if double else np.float32)


def float_array(name: str, value: Any, shape: tuple[int | None, ...], dtype: np.dtype) -> Array:
    """Return the value as a finite float array of this shape (None: any size), or raise.

    Raises ValueError naming the argument, what was expected and what came. Values that are being
    traced are checked for shape only.
    """
    array = checked(name, value, shape, dtype)
    known = isinstance(array, jax.Array) and array.dtype == dtype
    return array if known else jnp.asarray(array, dtype)


def checked(name: str, value: Any, shape: tuple[int | None, ...], dtype: np.dtype) -> Any:
    """Return the value as an array, checked as in `float_array`: JAX's stay, others become NumPy's.

    NumPy's have this type: also float64, which JAX may not know.
    """
    expected = f"a real array of shape {_words(shape)}" if shape else "a real number"
    array = array_of(name, value, expected)
    if not is_real(array):
        raise ValueError(f"`{name}`: expected {expected}, got dtype {array.dtype}")
    if array.ndim != len(shape) or any(
        want is not None and want != got for want, got in zip(shape, array.shape, strict=True)
    ):
        raise ValueError(f"`{name}`: expected {expected}, got shape {array.shape}")
    if is_concrete(array):
        with np.errstate(over="ignore"):
            cast = np.asarray(array).astype(dtype)
        if not np.all(np.isfinite(cast)):
            raise ValueError(
                f"`{name}`: expected finite values, got {_first(~np.isfinite(cast), cast)}"
            )
        most = np.finfo(dtype).max / 8  # differences are finite, and sums of a few of them
        if not np.all(np.abs(cast) <= most):
            raise ValueError(
                f"`{name}`: expected values up to {most:.1e} ({dtype.name}),"
                f" got {_first(np.abs(cast) > most, cast)}"
            )
        if not isinstance(array, jax.Array):
            array = cast  # of a type that JAX knows: a long double is not
    return array


def _words(shape: tuple[int | None, ...]) -> str:
    sizes = ["N" if size is None else str(size) for size in shape]
    return f"({', '.join(sizes)}{',' if len(sizes) == 1 else ''})"


def _first(bad: Any, array: np.ndarray) -> str:
    """Return the array's first bad value, and its index."""
    index = tuple(int(i) for i in np.argwhere(bad)[0]) if array.ndim else ()
    return f"{array[index]} at index {index}" if index else f"{array}"


#: Traced within another program; runs, in 6 microseconds, outside of one.
_nothing = jax.jit(lambda: 0)


def stands_alone(*given: Any) -> bool:
    """Return True if a call with these arrays is a program of its own, not part of another."""
    return is_concrete(given) and is_concrete(_nothing())
