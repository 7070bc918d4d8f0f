"""Where a camera's error shows: by hand for single moves, by differences for all together."""

import re

import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import camera_ahead, central_difference, lump, normal
from results import fit_at

import pinhole_jax as pj
from pinhole_jax import plot

CAMERA = camera_ahead()
SCENE = lump(2)


def test_roll_shows_by_the_distance_from_the_middle():
    trust = plot.trust(fit_at(CAMERA, np.array([[1e-6]]), ("rotation_v",)), SCENE)
    radius = np.linalg.norm(trust.places - [48, 40], axis=1)
    assert_allclose(trust.film, 1e-3 * radius, rtol=1e-4)
    vertices = np.asarray(SCENE.mesh.vertices)
    assert trust.object == pytest.approx(1e-3 * np.hypot(*vertices[:, :2].T).max(), rel=1e-4)
    assert_allclose(trust.point, vertices[np.hypot(*vertices[:, :2].T).argmax()])


def test_shift_shows_alike_at_one_depth():
    trust = plot.trust(fit_at(CAMERA, np.array([[1e-4]]), ("e_x",)), SCENE)
    depth = 5 - np.asarray(SCENE.mesh.vertices)[:, 2].mean()
    px = 0.01 * 40 / np.tan(0.3) / depth
    assert_allclose(trust.film, px, rtol=1e-4)
    assert trust.object == pytest.approx(0.01, rel=1e-4)


def test_errors_together_equal_those_of_differences():
    mix = 1e-3 * normal((7, 7))
    fit = fit_at(CAMERA, mix @ mix.T)
    trust = plot.trust(fit, SCENE)

    def place(step):
        camera = fit.displaced(step)
        return np.stack(pj.camera_basis(camera)) @ (trust.point - np.asarray(camera.e))

    spread = np.linalg.norm(central_difference(place, np.zeros(7)) @ mix, ord=2)
    assert trust.object == pytest.approx(spread, rel=1e-4)


def test_picture_names_its_bands_and_stays_with_what_is_determined():
    lost = np.diag([np.inf, 1e-6])
    trust = plot.trust(fit_at(CAMERA, lost, ("rotation_b1", "rotation_v")), SCENE)
    assert np.all(np.isfinite(trust.film))
    bands = [float(x) for x in re.findall(r">&lt; ([\d.e-]+) px</text>", trust._repr_svg_())]
    assert bands == sorted(bands)
    assert bands[-1] >= trust.film.max()
    assert "units of the mesh" in str(trust)
    nothing = plot.trust(fit_at(CAMERA, np.array([[np.inf]]), ("rotation_b1",)), SCENE)
    assert nothing.object == 0
