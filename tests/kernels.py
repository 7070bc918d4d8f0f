"""How many kernels a compiled program has: what it takes to compile follows their number.

A copy of an array is none: it is moved as it is (`memcpy`), nothing is compiled for it.
"""

import re
from typing import NamedTuple

#: Instructions that start no kernel of their own.
FREE = {
    "after-all",
    "bitcast",
    "call",
    "conditional",
    "constant",
    "copy",
    "get-tuple-element",
    "parameter",
    "tuple",
    "while",
}
#: The mark of a call that the compiler makes a single kernel, with all that is in it.
ONE = 'xla_cpu_small_call="true"'


class Kernels(NamedTuple):
    """Kernels of a program; those that are compiled (equal ones once, but loops that are one kernel
    each time); `while` loops."""

    all: int
    distinct: int
    loops: int


def kernels(text: str) -> Kernels:
    """Return the kernels in an optimised program's text (`compiled.as_text()`)."""
    bodies, entry = _computations(text)
    number, loops, distinct, todo, done = 0, 0, set(), [entry], set()
    while todo:
        name = todo.pop()
        if name in done:
            continue
        done.add(name)
        for line in bodies[name]:
            operation = _operation(line)
            loops += operation == "while"
            # (What reads one of the results of such a call bears its mark, too.)
            one = operation == "call" and ONE in line
            if operation in FREE and not one:
                todo += [n for n in _called(line) if n in bodies]
                continue
            number += 1
            distinct.add(line if one else _canonical(line, bodies))
    return Kernels(number, len(distinct), loops)


def _computations(text: str) -> tuple[dict[str, list[str]], str]:
    """Return the instructions of each computation, and the name of the one that is run."""
    bodies: dict[str, list[str]] = {}
    entry = name = ""
    for line in text.splitlines():
        head = re.match(r"(ENTRY )?%?([\w.\-]+) \(.*\{$", line)
        if head:
            name = head.group(2)
            bodies[name] = []
            entry = name if head.group(1) else entry
        elif " = " in line and name:
            marks = ", " + ONE if ONE in line else ""
            cut = re.sub(r", (metadata|backend_config|frontend_attributes)=\{.*", "", line.strip())
            bodies[name].append(cut + marks)
    return bodies, entry


def _operation(line: str) -> str:
    """Return an instruction's operation, which follows the type of its result."""
    rest, depth = line.split(" = ", 1)[1], 0
    for place, sign in enumerate(rest):
        depth += (sign in "([{") - (sign in ")]}")
        if sign == " " and depth == 0:
            return rest[place + 1 :].split("(", 1)[0]
    raise ValueError(f"expected a type and an operation, got {line!r}")


def _called(line: str) -> list[str]:
    """Return the computations that an instruction runs."""
    single = re.findall(r"(?:body|condition|to_apply|calls|\w+_computation)=%?([\w.\-]+)", line)
    lists = re.findall(r"branch_computations=\{([^}]*)\}", line)
    return single + [name.strip().lstrip("%") for names in lists for name in names.split(",")]


def _canonical(line: str, bodies: dict[str, list[str]]) -> str:
    """Return a kernel's text with its values numbered in order, with what it calls."""
    lines, queue, calls = [], [line], []
    while queue:
        one = queue.pop()
        lines.append(one)
        calls += [name for name in _called(one) if name in bodies]
        while calls:
            queue += reversed(bodies[calls.pop()])
    numbers: dict[str, str] = {}
    number = lambda found: numbers.setdefault(found.group(), f"%{len(numbers)}")
    return "\n".join(re.sub(r"%[\w.\-]+", number, x).removeprefix("ROOT ") for x in lines)
