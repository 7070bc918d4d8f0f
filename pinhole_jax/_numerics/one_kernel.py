"""What XLA's CPU compiler makes a single kernel of: loops, and arithmetic of a few numbers."""

import itertools
from collections.abc import Callable, Hashable, Sequence
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jax.flatten_util import ravel_pytree
from jax.interpreters.partial_eval import dce_jaxpr
from jaxtyping import Array, Float, Int, Num, PyTree

from .alike import name_of
from .backend import for_cpus, is_for_cpus
from .later import on_each_device
from .literals import folded, tidied
from .safe import times

T = TypeVar("T")

#: Functions of which kernels were made, at most so many of them, and the programs of these.
KEPT = 256
_flats: dict[Hashable, Callable] = {}
_short: WeakKeyDictionary[ClosedJaxpr, tuple[Callable, list[bool]]] = WeakKeyDictionary()


def one_kernel(function: Callable) -> Callable:
    """Return a function of arrays that XLA's CPU compiler makes a single kernel of, loops and all.

    Of small loops it does so by itself, by these two marks. There must be no sort, no scatter and
    nothing as long as an array in it: what it fills is an argument. (What it would share out to
    several cores does not compile within a kernel.) What it fills has two entries at least: over an
    argument that need not be read, as one that is written over as a whole, the compiler aborts.
    Under `vmap` it is called for one after the other: loops side by side wait for the longest, and
    copy what they fill at each turn.
    """

    @jax.custom_batching.sequential_vmap
    def call(*arguments: Any) -> Any:
        program, leaves, back = _with_what_it_uses(function, arguments)
        # (A constant among them would be moved into the loop, and not be used any more.)
        leaves = jax.lax.optimization_barrier(leaves)
        result = jax.jit(program)(*leaves)
        return back(set_xla_metadata(result, inlineable="false", xla_cpu_small_call="true"))

    return call


def by_machine(*arguments: Any, cpu: Callable, elsewhere: Callable) -> Any:
    """Return what one function makes of arrays on a CPU, and another on other machines."""

    def there(*arguments: Any) -> Any:
        with for_cpus():
            return cpu(*arguments)

    def chosen(*arguments: Any) -> Any:
        if is_for_cpus():
            return cpu(*arguments)
        return jax.lax.platform_dependent(*arguments, cpu=there, default=elsewhere)

    return on_each_device(chosen, *arguments)


def on_cpu(function: Callable, *arguments: Any, elsewhere: Callable | None = None) -> Any:
    """Return what a function makes of arrays: on a CPU it is `one_kernel`, on other machines what
    it is by itself, or the one for `elsewhere`."""
    return by_machine(*arguments, cpu=one_kernel(function), elsewhere=elsewhere or function)


def rows(
    function: Callable[..., Sequence[Array]], ids: Int[Array, "K"], *held: Any
) -> Num[Array, "K m"]:
    """Return the row of numbers that a function makes of each id (and of what is held), none of it
    differentiated: on a CPU one kernel of a loop over the ids.

    The function reckons with single numbers. Of them the compiler makes a kernel in a tenth of the
    time that it takes over vectors of 2 or 3, whose entries it works out anew for each that asks.
    """
    return rows_of_each(lambda id, *held: lambda _: function(id, *held), 1, ids, *held)[:, 0]


def rows_of_each(
    function: Callable[..., Callable[[Array], Sequence[Array]]],
    number: int,
    ids: Int[Array, "K"],
    *held: Any,
) -> Num[Array, "K n m"]:
    """Return several `rows` of each id: `function(id, *held)` returns a function of 0, 1, ... that
    returns them. That is a loop, so that all are rounded alike."""
    ids, held = jax.lax.stop_gradient((ids, held))
    K, zero = ids.shape[0], jnp.int32(0)
    like = jax.eval_shape(lambda *held: function(zero, *held)(zero), *held)
    # (One row would be written over as a whole.)
    room = jnp.zeros((max(K * number, 2), len(like)), like[0].dtype)

    def one_by_one(ids: Array, held: tuple, table: Array) -> Array:
        def one(i, table):
            row_of = function(ids[i], *held)

            def fill(k, table):
                row = jax.lax.optimization_barrier(list(row_of(k)))
                return put(table, jnp.stack(row), i * number + k)

            return jax.lax.fori_loop(0, number, fill, table)

        return jax.lax.fori_loop(0, K, one, table)

    def beside(ids: Array, held: tuple, table: Array) -> Array:
        k = jnp.arange(number, dtype=jnp.int32)
        some = lambda i: jax.vmap(lambda k: jnp.stack(list(function(i, *held)(k))))(k)
        return table.at[: K * number].set(jax.vmap(some)(ids).reshape(K * number, -1))

    table = on_cpu(one_by_one, ids, held, room, elsewhere=beside)
    return table[: K * number].reshape(K, number, -1)


def for_both(function: Callable[[Array], Sequence[Array]]) -> tuple[list[Array], list[Array]]:
    """Return what a function makes of 0 and of 1, a few numbers each: in a loop, so that both are
    rounded alike."""
    like = jax.eval_shape(function, jnp.int32(0))
    none = [jnp.zeros(x.shape, x.dtype) for x in like]

    def one(k, found):
        new = list(function(k))
        either = lambda i, old: [jnp.where(k == i, x, y) for x, y in zip(new, old, strict=True)]
        return [either(i, old) for i, old in enumerate(found)]

    first, second = jax.lax.fori_loop(0, 2, one, [none, none])
    return first, second


def put(x: Array, value: Any, place: Array) -> Array:
    """Return an array with an entry, or a table with a row, written over: in place, within a
    kernel, if it is not read as it was thereafter."""
    return jax.lax.dynamic_update_index_in_dim(x, jnp.asarray(value, x.dtype), place, 0)


def opened(
    number: Array, later: Callable[..., Array], *lists: Array, read: Callable = lambda x, k: x[k]
) -> tuple[Array, ...]:
    """Return the place of one more among a number of entries in order, and the lists with those
    that come later moved up by one; `later(k, *lists)` says whether the entry at k does."""
    goes_on = lambda s: (s[0] > 0) & later(jnp.maximum(s[0] - 1, 0), *s[1:])
    shift = lambda s: (s[0] - 1, *(put(x, read(x, s[0] - 1), s[0]) for x in s[1:]))
    return jax.lax.while_loop(goes_on, shift, (number, *lists))


def _with_what_it_uses(function: Callable, arguments: tuple) -> tuple[Callable, list, Callable]:
    """Return a function as one of those arrays among its arguments that it uses, these, and the way
    back from what it returns: the compiler aborts where a kernel is given others."""
    leaves, tree = jax.tree.flatten(arguments)
    traced = jax.jit(_flat(function, tree)).trace(*leaves)
    if traced.jaxpr not in _short:
        jaxpr, consts = traced.jaxpr.jaxpr, traced.jaxpr.consts
        short, used = dce_jaxpr(folded(jaxpr), [True] * len(jaxpr.outvars))
        _short[traced.jaxpr] = jaxpr_as_fun(ClosedJaxpr(short, consts)), used
    program, used = _short[traced.jaxpr]
    back = jax.tree.structure(traced.out_info).unflatten
    return program, list(itertools.compress(leaves, used)), back


def _flat(function: Callable, tree: Any) -> Callable:
    """Return a function of the leaves of its arguments: one function for all that do the same,
    since JAX keeps what it has traced as long as that is there."""
    flat = lambda *leaves: function(*tree.unflatten(leaves))
    name = name_of(function)
    if name is None:
        return flat
    if len(_flats) >= KEPT:
        _flats.clear()
    return _flats.setdefault((name, tree, is_for_cpus()), flat)


def at_once(
    function: Callable[..., PyTree[Float[Array, "..."]]],
) -> Callable[..., PyTree[Float[Array, "..."]]]:
    """Return a function of a few numbers (a pytree of them), and of others that are held, to a few
    numbers, that is one kernel on a CPU: with its derivative by the first argument, where that is
    asked for.

    Each small step of such arithmetic is a kernel else, and takes the compiler as long as one that
    goes through thousands of numbers.
    """

    @jax.custom_jvp
    def call(x, held):
        return _shaped(function, x, held)(_table(function, x, held, False)[:, 0])

    @call.defjvp
    def _(primals, tangents):
        x, held = primals
        found, back = _table(function, x, held, True), _shaped(function, x, held)
        return back(found[:, 0]), back(times(found[:, 1:], ravel_pytree(tangents[0])[0]))

    return lambda x, *held: call(x, jax.lax.stop_gradient(held))


def with_slopes(function: Callable, x: Float[Array, "n"], *held: Any) -> tuple[Any, Any]:
    """Return what `at_once` of a function does, and its derivatives along each entry of `x`, with a
    leading axis (n): what comes next is pushed forward along these, with no product before it."""
    table, back = _table(function, x, held, True), _shaped(function, x, held)
    return back(table[:, 0]), jax.vmap(back)(table[:, 1:].T)


def _table(function: Callable, x: PyTree, held: tuple, columns: bool) -> Float[Array, "m columns"]:
    """Return what a function returns, flat, and if asked for its derivatives along all of `x`."""
    numbers, back = ravel_pytree(x)
    flat = lambda numbers, held: ravel_pytree(function(back(numbers), *held))[0]

    def both(numbers, held):
        value = flat(numbers, held)[:, None]
        if not columns:
            return value
        return jnp.concatenate([value, jax.jacfwd(flat)(numbers, held)], axis=1)

    @jax.custom_jvp
    def call(numbers, held):
        return on_cpu(both, numbers, held)

    # (A derivative of these goes step by step.)
    call.defjvp(lambda primals, tangents: jax.jvp(both, primals, tangents))
    return call(numbers, held)


def _shaped(function: Callable, x: PyTree, held: tuple) -> Callable[[Array], Any]:
    """Return the way back from numbers to what a function returns."""
    like = jax.eval_shape(function, x, *held)
    return ravel_pytree(jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), like))[1]


def one_by_one(function: Callable[[], T]) -> T:
    """Return what a function of nothing returns, which is not differentiated.

    Under `vmap` it is called for one after the other: its loops copy nothing then.
    """
    made = eqx.filter_closure_convert(function)
    arrays, rest = eqx.partition(made, eqx.is_array)

    @jax.custom_batching.sequential_vmap
    def call(arrays: Any) -> Any:
        return tidied(lambda arrays: eqx.combine(arrays, rest)())(arrays)

    return call(jax.lax.stop_gradient(arrays))
