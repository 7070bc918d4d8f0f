"""Hypothesis draws the hard cases of `stress.py`, and properties of any image.

All meshes are filled up to one size, so that they share a compiled program.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stress
from chosen import first
from hypothesis import HealthCheck, given, settings, strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose
from slopes import gradients

import pinhole_jax as pj

SEEDS = st.integers(0, 2**32 - 1)
few = settings(
    derandomize=True,
    deadline=None,
    max_examples=4,
    database=None,
    suppress_health_check=[*HealthCheck],
)


def image(view):
    camera, vertices = stress.rounded(view, np.float64)
    return np.asarray(pj.silhouette(camera, stress.scene_of(view, vertices)))


def drawn(seed):
    """Return one of the views in which rounding is worth no more than 1e-12 px."""
    random = default_rng(seed)
    cases = (stress.usual, stress.inside, stress.on_vertex_plane, stress.degenerate, stress.wide)
    return random, cases[random.integers(len(cases))](random)


PAIRS = [
    (name, kind)
    for k, name in enumerate(stress.CASES)
    for kind in (sorted(stress.TYPES), sorted(stress.TYPES, reverse=True))[k % 2]
]
SLOPED = sorted({*stress.CASES} - {"1000 px in a row or column"})


@pytest.mark.parametrize("name, kind", first(1, PAIRS, of=4))
@few
@given(seed=SEEDS)
def test_hard_cases_are_right_to_some_epsilons(name, kind, seed):
    dtype = stress.TYPES[kind]
    view = stress.CASES[name](default_rng(seed))
    try:
        stress.rounded(view, dtype)
    except ValueError as error:
        assert ": expected" in str(error)  # noqa: PT017
        return
    error = stress.worst(view, dtype)
    assert error <= stress.LIMIT * view.unit * np.finfo(dtype).eps


@pytest.mark.long
@few
@given(seed=SEEDS)
def test_order_of_faces_and_vertices_does_not_matter(seed):
    random, v = drawn(seed)
    order = random.permutation(len(v.vertices))
    faces = np.argsort(order)[v.faces]
    faces = np.roll(faces, random.integers(3), axis=1)[random.permutation(len(faces))]
    assert_allclose(
        image(v._replace(vertices=v.vertices[order], faces=faces)), image(v), atol=1e-11
    )


@pytest.mark.long
@pytest.mark.parametrize("name", first(1, SLOPED, of=8))
@settings(few, max_examples=2)
@given(seed=SEEDS)
def test_derivatives_are_finite_and_know_no_origin(name, seed):
    """Moving all vertices is moving eye and view point the other way."""
    random = default_rng(seed)
    view = stress.CASES[name](random)
    camera, vertices = stress.rounded(view, np.float64)
    weight = jnp.asarray(random.normal(size=(camera.H, camera.W)))
    d_camera, d_scene = gradients(camera, stress.scene_of(view, vertices), weight)
    for leaf in jax.tree.leaves((d_camera, d_scene)):
        assert np.all(np.isfinite(leaf))
    mesh, spheres = d_scene.mesh, d_scene.spheres
    along = np.asarray(mesh.vertices if spheres is None else spheres.centers)
    eye, aim = np.asarray(d_camera.e), np.asarray(d_camera.p)
    scale = max(np.abs(x).sum(axis=0).max() for x in (along, eye, aim))
    assert_allclose(along.sum(axis=0), -(eye + aim), atol=1e-8 * scale)
