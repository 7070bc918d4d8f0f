"""Rays as they go down the tree: each turned so that it runs along the third axis."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .bvh import permuted
from .components import Parts, largest


class Ray(NamedTuple):
    """A ray, or many, turned so that it runs along the third axis, upwards.

    - `axes`: which axes are its three.
    - `near`, `far`: which planes of a box it passes first and last, of those across each axis.
    - `scale`: how deep it goes while it passes a unit of length across each axis.
    - `again`: the same, as an array of its own (see `Beam.most`).
    - `slack`: how much sooner or later a plane may be passed than is worked out.
    - `line`: origin and slopes, as primitives' tests take them.
    - `real`: whether all this is finite.
    """

    axes: Parts
    near: Parts
    far: Parts
    scale: Parts
    again: Parts
    slack: Parts
    line: Parts
    real: Bool[Array, "*rays"]


def turned(origin: Parts, direction: Parts, axis: Int[Array, "N"]) -> Ray:
    """Return rays as they go down the tree.

    The slack is some times the rounding of the boxes' and the primitives' tests: what a primitive's
    test finds its boxes never hide. The tree's lengths are about 1.
    """
    dtype = direction[0].dtype
    along, o = permuted(direction, axis, 1), permuted(origin, axis, 1)
    sign = jnp.where(along[2] < 0, -1, 1).astype(dtype)
    slopes = [along[0] / (along[2] * sign), along[1] / (along[2] * sign), sign]
    eps, reach = jnp.finfo(dtype).eps, 4 + largest(origin)
    axes = [(axis + k) % 3 for k in (1, 2, 3)]
    upper = [jnp.where(slope < 0, 3, 0).astype(jnp.int32) for slope in slopes]
    near = [k + up for k, up in zip(axes, upper, strict=True)]
    far = [k + 3 - up for k, up in zip(axes, upper, strict=True)]
    scale, slack = [], []
    for slope in slopes:
        size = jnp.maximum(jnp.abs(slope), eps)  # flatter ones go aside by less than the slack
        scale.append(jnp.where(slope < 0, -1 / size, 1 / size))
        slack.append(16 * eps * reach * (1 + size) / size)
    line = [o[0], o[1], o[2] * sign, slopes[0], slopes[1]]
    deep = [x * y for x, y in zip(o, scale, strict=True)]
    real = jnp.equal(sum(x * 0 for x in (*deep, *slack, *line)), 0)
    return Ray(axes, near, far, scale, list(scale), slack, line, real)
