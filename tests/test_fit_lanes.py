"""Many masks side by side: the answers of fits alone, whatever a lane meets."""

import re

import jax
import numpy as np
import pytest
from oracles import drawn, turned

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._fit import fit_lanes as module
from pinhole_jax._numerics.cholesky import solve_normal
from pinhole_jax._scene.scene import padded, with_or_without_border
from pinhole_jax._solver.residuals import Capacity

W, H = 48, 40
EYES = np.array([[4, 2, 3], [-3, 4, 2], [1, -4, 4.0]])
TRUTHS = [pj.Camera(eye, [0, 0, 0], [0.1, 1, 0.2], 0.6, 1.0, W, H) for eye in EYES]
STARTS = [turned(truth, [1, 2, 3], 6, 1.03) for truth in TRUTHS]
CLOSE = np.deg2rad(1e-5)


@pytest.fixture(scope="module")
def scene():
    return pj.Scene(mesh=shapes.bumpy(2))


@pytest.fixture(scope="module")
def masks(scene):
    return np.stack([drawn(truth, scene) for truth in TRUTHS])


def angles(fits, cameras):
    return [float(pj.pose_error(fit.camera, c)[0]) for fit, c in zip(fits, cameras, strict=True)]


def test_small_systems():
    random = np.random.default_rng(0)
    root = random.normal(size=(5, 7, 7))
    A, x = root @ root.swapaxes(1, 2) + 0.1 * np.eye(7), random.normal(size=(5, 7))
    found = solve_normal(jax.numpy.asarray(A), jax.numpy.asarray((A @ x[..., None])[..., 0]))
    np.testing.assert_allclose(found, x, rtol=1e-9)
    assert np.all(np.isnan(solve_normal(-jax.numpy.eye(2), jax.numpy.ones(2))))


@pytest.mark.full
def test_lanes_find_the_cameras(scene, masks):
    fits, alone = pj.fit_lanes(scene, masks, STARTS)
    assert [fit.status for fit in fits] == ["converged"] * 3
    assert alone == ("", "", "")  # so it was the lanes that did
    assert max(angles(fits, TRUTHS)) < CLOSE
    # The whole account of a fit is there, from the start on.
    for fit, start in zip(fits, STARTS, strict=True):
        assert len(fit.history) == len(fit.steps) + 1
        assert pj.pose_error(fit.history[0].camera, start)[0] < 1e-12
        assert np.all(np.isfinite(fit.covariance))


@pytest.mark.long
def test_answers_are_those_of_fits_alone(scene, masks):
    hard = masks > 0.5
    weight = np.ones((H, W))
    weight[:, : W // 3] = 0  # an occluder
    batched = jax.tree.map(lambda *x: np.stack(x), *STARTS)
    for given, weights in ((masks, None), (hard, None), (masks, [weight] * 3)):
        fits, alone = pj.fit_lanes(scene, given, batched, weights=weights)
        ones = [None] * 3 if weights is None else weights
        single = [
            pj.fit_camera(scene, mask, start, weight=one)
            for mask, start, one in zip(given, STARTS, ones, strict=True)
        ]
        assert not any(alone)
        assert [fit.status for fit in fits] == [fit.status for fit in single]
        # (A hard mask is refined by fit_camera's own steps: as far as these go on.)
        assert max(angles(fits, [fit.camera for fit in single])) < CLOSE
        for fit, one in zip(fits, single, strict=True):
            np.testing.assert_allclose(fit.iou, one.iou, rtol=1e-6)


@pytest.mark.long
def test_a_lane_that_overflows_goes_alone(scene, masks, monkeypatch):
    monkeypatch.setattr(module, "_room", lambda lanes: Capacity(64, 64, 1, 1))
    fits, alone = pj.fit_lanes(scene, masks[:1], STARTS[:1])
    assert "outgrows the buffers" in alone[0]
    assert max(angles(fits, TRUTHS[:1])) < CLOSE


@pytest.mark.long
def test_what_a_lane_cannot_do_alone_is_said(scene, masks):
    beside = STARTS[0].replace(p=[1.5, 0, 0])  # the start sees the object elsewhere
    small = [np.zeros((H, W)) for _ in range(2)]
    small[0][19:21, 20:22] = small[1][5:9, 5:9] = 1.0
    starts = [beside, STARTS[1], STARTS[2]]
    fits, alone = pj.fit_lanes(scene, [masks[0], *small], starts)
    assert "hardly overlaps" in alone[0]
    single = [
        pj.fit_camera(scene, mask, start)
        for mask, start in zip([masks[0], *small], starts, strict=True)
    ]
    assert [fit.status for fit in fits] == [fit.status for fit in single]
    assert fits[0].status == "converged"
    assert fits[1].status != "converged"


@pytest.mark.full
def test_meshes_of_different_sizes(masks):
    shallow = shapes.bumpy(1, seed=3)
    opened = pj.Mesh(shallow.vertices, np.asarray(shallow.faces)[:-6])
    ball = pj.Spheres([[0.2, 1.3, 0.1]], [0.4])
    meshes = [shapes.bumpy(2), shallow, opened]
    scenes = [pj.Scene(mesh=mesh, spheres=ball) for mesh in meshes]
    # (Filled up as fits do it, all three share a program.)
    shown = [with_or_without_border(padded(scene)) for scene in scenes]
    targets = [np.asarray(pj.silhouette(c, s)) for c, s in zip(TRUTHS, shown, strict=True)]
    fits, alone = pj.fit_lanes(scenes, targets, STARTS, free="pose,phi")
    assert not any(alone)
    assert [fit.status for fit in fits] == ["converged"] * 3
    assert max(angles(fits, TRUTHS)) < CLOSE
    assert max(abs(float(fit.camera.phi) - 0.6) for fit in fits) < 1e-6


def test_words(scene, masks):
    one, empty = TRUTHS[0], 0 * masks[0]
    cases = {
        "`targets`: expected one for each of 2 cameras, got 3": (scene, masks, STARTS[:2]),
        "`scene`: expected one for each of 2 cameras, got 1": ([scene], masks[:2], STARTS[:2]),
        "`cameras`: expected a list, or a Camera whose arrays": (scene, masks, one),
        "`cameras`: expected at least one, got none": (scene, masks[:0], []),
        "mask 1: `target`: expected a mask that covers": (
            scene,
            [masks[0], empty],
            STARTS[:2],
        ),
        "that all have a mesh or none": (
            [scene, pj.Scene(spheres=pj.Spheres([[0, 0, 0]], [1.0]))],
            masks[:2],
            STARTS[:2],
        ),
        "with a mesh or spheres, got an empty": ([scene, pj.Scene()], masks[:2], STARTS[:2]),
        "lenses and float types that are alike": (
            scene,
            masks[:2],
            [one, one.replace(lens=pj.Lens([24.0, 20.0]))],
        ),
    }
    for words, arguments in cases.items():
        with pytest.raises(ValueError, match=re.escape(words)):
            pj.fit_lanes(*arguments)
    with pytest.raises(ValueError, match="`max_steps`: expected an integer"):
        pj.fit_lanes(scene, masks, STARTS, max_steps=0)
    with pytest.raises(ValueError, match="`outlier_px`: expected a positive"):
        pj.fit_lanes(scene, masks, STARTS, outlier_px=-1.0)
