"""Cells that are covered all over, though pieces of contour lie in them: folds of what is behind.

A piece is hidden if it has a layer on both sides, at its middle and after as many fewer as those
that it may meet on the way can take. Where all pieces are hidden, no part of the cell is uncovered,
since each part but the whole has a piece on its border. That takes one look at each pair of pieces,
where a sweep looks at all pairs at each halt: of a scan's overlapping pixels four of five are
covered, and most of these are told by this.

Nothing is called hidden that is not: where rounding may decide (a piece that another one touches),
the layers are counted that may be taken away.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._numerics.safe import safe_divide
from .sweep import Cells, Lines, along_x

#: Roundings by which heights in a cell may be off.
SLACK = 32


def all_hidden(cells: Cells, corner: Float[Array, "C"]) -> Bool[Array, "C"]:
    """Return which cells, of straight pieces, are covered all over for sure.

    `corner` is the winding number at their lower left corners.
    """
    lines = jax.tree.map(lambda x: x.T, along_x(cells))
    # (Worked out for each pair in a kernel of its own: sums of it are several times faster.)
    layers = jax.lax.optimization_barrier(_least_layers(lines))
    least = corner[None] + jnp.sum(layers, axis=1) + jnp.minimum(lines.jump, 0)
    there = lines.jump != 0
    shown = there & (lines.u0 < lines.u1) & (least < 0.5)
    # (A point at the corner may end the layers there: it has no side in the cell to be looked at.)
    narrow = there & (lines.u0 == lines.u1)
    return (corner > 0.5) & ~jnp.any(shown | narrow, axis=0)


def _least_layers(lines: Lines) -> Float[Array, "M M C"]:
    """Return what the second piece of a pair adds at least to the layers below the first one, from
    its corner on."""
    M, _ = lines.u0.shape
    middle, jump = _of_both((lines.u0 + lines.u1) / 2)[0], _of_both(lines.jump)[1]
    slack = SLACK * jnp.finfo(jump.dtype).eps
    others = (~jnp.eye(M, dtype=bool))[..., None]
    touches = lambda x: jnp.abs(x) <= slack

    above = _gap(lines, middle)
    # (All as it is just before the middle: a piece that begins there counts no more than its step.)
    there = others & (_of_both(lines.u0)[1] < middle) & (middle <= _of_both(lines.u1)[1])
    least = jnp.where(touches(above), jnp.minimum(jump, 0), jnp.where(above > 0, jump, 0))
    layers = jnp.where(there, least, 0)
    for halt, step in zip(*(x.reshape(2, M, -1) for x in (lines.halt, lines.step)), strict=True):
        layers = layers + jnp.where(_of_both(halt)[1] < middle, _of_both(step)[1], 0)

    # At its own ends a piece meets the next ones of its chain, and no others matter.
    low, high = _span(lines)
    first, last = _gap(lines, low), _gap(lines, high)
    ends = touches(first) & (low > _of_both(lines.u0)[0])
    ends |= touches(last) & (high < _of_both(lines.u1)[0])
    crosses = ~touches(first) & ~touches(last) & ((first < 0) != (last < 0))
    meets = others & (low < high) & (ends | crosses)
    return layers - jnp.where(meets, jnp.abs(jump), 0)


def _of_both(x: Float[Array, "M C"]) -> tuple[Array, Array]:
    """Return what the first and the second of each pair of pieces has."""
    return x[:, None], x[None]


def _span(lines: Lines) -> tuple[Float[Array, "M M C"], Float[Array, "M M C"]]:
    """Return where both pieces of a pair are: from and to, nowhere if that is not less."""
    return jnp.maximum(*_of_both(lines.u0)), jnp.minimum(*_of_both(lines.u1))


def _gap(lines: Lines, u: Float[Array, "M #M C"]) -> Float[Array, "M M C"]:
    """Return by how much the second of each pair of straight pieces is below the first."""
    slope = safe_divide(lines.v1 - lines.v0, lines.u1 - lines.u0)
    columns = (_of_both(x) for x in (lines.v0, lines.u0, slope))
    one, other = (v + (u - u0) * s for v, u0, s in zip(*columns, strict=True))
    return one - other
