"""Derivatives forwards and backwards in one program: less to compile than in two."""

import equinox as eqx
import jax
import jax.numpy as jnp

import pinhole_jax as pj


def both_ways(function, x, direction, weight):
    """Return a function's value, its derivative along a direction, its weighted sum's gradient."""
    value, along = jax.linearize(function, x)
    (gradient,) = jax.linear_transpose(along, x)(weight)
    return value, along(direction), gradient


@eqx.filter_jit
def gradients(camera, scene, weight):
    """The derivatives of a weighted sum of the mask, by all of the camera and of the scene."""
    loss = lambda moving: jnp.sum(weight * pj.silhouette(*moving))
    return eqx.filter_grad(loss)((camera, scene))
