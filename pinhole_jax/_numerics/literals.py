"""Traced programs whose known numbers are written as the compiler wants them.

`jnp.where(there, x, 0)` converts an integer in a function of its own, and x - 1 becomes x + (-1) in
XLA: it moves what makes such a number out of all loops before it works it out, and then back in, by
one loop each time that it goes through the whole program; for a mask it did so 25 times.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var, jaxpr_as_fun
from jax.lax import add_p, sub_p

#: What calls others' programs; and functions so small that their programs take the call's place.
CALLS = ("while", "scan", "cond", "jit", "pjit")
SMALL = ("_where", "clip", "remainder", "floor_divide")


def tidied(function: Callable) -> Callable:
    """Return a function of arrays, which is not differentiated any more, whose program is
    `folded`."""

    def call(*arguments: Any) -> Any:
        leaves, tree = jax.tree.flatten(arguments)
        flat = lambda *leaves: function(*tree.unflatten(leaves))
        traced, out = jax.make_jaxpr(flat, return_shape=True)(*leaves)
        program = ClosedJaxpr(folded(traced.jaxpr), traced.consts)
        return jax.tree.structure(out).unflatten(jaxpr_as_fun(program)(*leaves))

    return call


def folded(program: Jaxpr) -> Jaxpr:
    """Return a program in which numbers have the type that they are converted to, and the sign of
    what is added."""
    folding = _Folding({}, [], {})
    for eqn in program.eqns:
        folding.add(eqn)
    outvars = [folding.atom(x) for x in program.outvars]
    return program.replace(outvars=outvars, eqns=folding.eqns)


class _Folding:
    """Steps of a program, and what stands for the results of those that it does not need."""

    def __init__(self, known: dict[Var, Any], eqns: list[JaxprEqn], sums: dict):
        self.known, self.eqns, self.sums = known, eqns, sums

    def atom(self, x: Any) -> Any:
        """Return what stands for a value."""
        return x if isinstance(x, Literal) else self.known.get(x, x)

    def add(self, eqn: JaxprEqn) -> None:
        """Add a step."""
        eqn = eqn.replace(invars=[self.atom(x) for x in eqn.invars])
        name, params = eqn.primitive.name, eqn.params
        if name == "convert_element_type" and isinstance(eqn.invars[0], Literal):
            self.known[eqn.outvars[0]] = _literal(eqn.invars[0].val, eqn.outvars[0])
        elif name in ("jit", "pjit") and params["name"] in SMALL and not params["jaxpr"].consts:
            self._put_in_place(params["jaxpr"].jaxpr, eqn)
        elif name in CALLS:
            within = {k: _folded_within(v) for k, v in params.items()}
            self.eqns.append(eqn.replace(params=within))
        elif eqn.primitive in (add_p, sub_p) and isinstance(eqn.invars[1], Literal):
            self.eqns.append(self._sum(eqn))
        else:
            self.eqns.append(eqn)

    def _sum(self, eqn: JaxprEqn) -> JaxprEqn:
        """Return a step that adds a number, or takes one away, as one that adds; a whole number at
        once with the one before it."""
        x, y = list[Any](eqn.invars)
        number = np.asarray(y.val).astype(y.aval.dtype)
        number = np.negative(number) if eqn.primitive is sub_p else number
        whole = number.dtype.kind in "iu" and not isinstance(x, Literal)
        if whole and x in self.sums:
            x, before = self.sums[x]
            with np.errstate(over="ignore"):
                number = before + number
        if whole:
            self.sums[eqn.outvars[0]] = x, number
        return eqn.replace(primitive=add_p, invars=[x, _literal(number, y)])

    def _put_in_place(self, program: Jaxpr, call: JaxprEqn) -> None:
        """Put a function's program in the place of its call, its values with names of their own."""
        inner = _Folding(dict(zip(program.invars, call.invars, strict=True)), self.eqns, self.sums)
        for eqn in program.eqns:
            own = [Var(v.aval) for v in eqn.outvars]
            inner.add(eqn.replace(invars=[inner.atom(x) for x in eqn.invars], outvars=own))
            inner.known |= {v: inner.atom(x) for v, x in zip(eqn.outvars, own, strict=True)}
        pairs = zip(call.outvars, program.outvars, strict=True)
        self.known |= {v: inner.atom(x) for v, x in pairs}


def _literal(value: Any, like: Any) -> Literal:
    """Return a number of another value's type."""
    return Literal(np.asarray(value).astype(like.aval.dtype)[()], like.aval)


def _folded_within(value: Any) -> Any:
    """Return a step's parameter, programs folded."""
    if isinstance(value, ClosedJaxpr):
        return value.replace(jaxpr=folded(value.jaxpr))
    if isinstance(value, tuple) and value and isinstance(value[0], ClosedJaxpr):
        return tuple(map(_folded_within, value))
    return value
