"""How a mask's outline errs: offsets measured, their size and length told, intervals that hold."""

import re

import intervals
import numpy as np
import pytest
from chosen import full
from honesty import signed_distance
from masks import wavy
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from oracles import CORNERS, QUAD, body, drawn, lump, single, turned, usual_camera
from results import check_found, degrees, sigma
from views import solver_of

import pinhole_jax as pj
from pinhole_jax._outline.stretches import quantised
from pinhole_jax._solver.moves import canonical

SIZE = 128
CAMERA = single(usual_camera(SIZE, SIZE))
SCENE = single(lump(3))
IMAGE = drawn(CAMERA, SCENE)


def test_rendered_binary_mask_has_quantisation_errors_alone():
    fit = pj.fit_camera(SCENE, IMAGE > 0.5, CAMERA)
    assert fit.mask_error == (0.0, 0.0)
    assert str(fit.mask_error) == "quantisation alone"
    ratio = fit.std / np.sqrt(np.diag(fit.independent_covariance))
    assert np.all((ratio > 0.75) & (ratio < 1.5))  # (along edges errors cancel)


@pytest.mark.parametrize("times", [2, 4])
def test_shrunk_drawing_is_no_rendering(times):
    """A drawn mask whose pixels were averaged has the values of one that was sampled."""
    truth, big = CAMERA, single(CAMERA.replace(W=times * SIZE, H=times * SIZE))
    hard = wavy(drawn(big, SCENE), default_rng(0), 0.8 * times, 12 * times)
    small = hard.reshape(SIZE, times, SIZE, times).mean((1, 3), dtype=np.float32)
    fit = pj.fit_camera(SCENE, small, turned(truth, 5))
    assert fit.mask_error.px > 0.2
    check_found(fit, truth, 3 * sigma(fit))
    assert sigma(fit) > 2 * sigma(fit._replace(covariance=fit.independent_covariance))


@pytest.mark.parametrize("roll", [0.1, full(0.5), 9.0, full(30.0)])
def test_errors_of_one_bit_are_alike_along_rows_and_cancel_across(roll):
    """Gradients at the truth, of a plate that lies anywhere among the pixels: their covariance in
    units of that of independent pixels, in the best-seen and the other directions."""
    scene, random = single(body(CORNERS * [1, 0.7, 1], QUAD)), default_rng(0)
    up = [np.sin(np.deg2rad(roll)), np.cos(np.deg2rad(roll)), 0]
    views = []
    for x, y, z in random.uniform(-1, 1, (60, 3)) * [0.05, 0.05, 0.1]:
        camera = single(pj.Camera([x, y, 5 + z], [x, y, 0], up, 0.6, 1.0, SIZE, SIZE))
        solver, _ = solver_of(camera, scene, drawn(camera, scene) > 0.5)
        views.append(solver.look(canonical(camera), solver.finest))
    triangles = np.array([view.triangle for view in views], float)
    gradients = np.einsum("kij,ki->kj", triangles, [view.along for view in views])
    independent = np.mean(np.swapaxes(triangles, 1, 2) @ triangles, axis=0) / 12
    unit = np.linalg.inv(np.linalg.cholesky(independent))
    sampled = np.linalg.eigvalsh(np.cov(unit @ gradients.T, bias=True))
    told = np.linalg.eigvalsh(unit @ np.mean([*map(quantised, views)], axis=0) @ unit.T / 12)
    if roll < 1:
        assert sampled[-1] > 20
        assert np.all((told > sampled / 2) & (told < 2.5 * sampled))
    else:
        assert np.all((sampled < told) & (told < 1))


@pytest.mark.long
def test_edge_that_is_off_by_much_of_the_object_is_a_doubt():
    """42 px large, grown by 3 px. (A gear's mask by a smooth gear's mesh: 46 % too far.)"""
    camera = single(usual_camera(64, 64))
    mask = wavy(drawn(camera, SCENE), default_rng(0), 0.5, 10, bias=3)
    fit = pj.fit_camera(SCENE, mask, turned(camera, 3))
    assert fit.status == "uncertain"
    assert re.match(r"the mask's edge is \d\.\d px off, 1\d% of the object's size", fit.weak[0])


@pytest.mark.parametrize("px", [1.0, full(2.0)])
def test_size_of_errors_is_that_of_a_mask_as_it_was_drawn(px):
    masks = [wavy(IMAGE, default_rng(seed), px, 10.0) for seed in range(4)]
    errors = [pj.fit_camera(SCENE, mask, CAMERA).mask_error.px for mask in masks]
    assert 0.5 < np.median(errors) / px < 2


def test_mask_without_some_pixels_of_its_outline_is_drawn():
    """... though its stretches err by no more than those of a rendered one."""
    mask, outline = IMAGE > 0.5, np.argwhere((IMAGE > 0.02) & (IMAGE < 0.98))
    mask[tuple(outline[:: len(outline) // 12].T)] ^= True
    assert pj.fit_camera(SCENE, mask, CAMERA).mask_error.px > 0


@pytest.mark.long
def test_rendered_triangle_soup_is_not_taken_for_drawn():
    """Pixels in which several edges lie err for each of them."""
    random = default_rng(0)
    corners = random.normal(0, 0.5, (200, 1, 3)) + random.normal(0, 0.2, (200, 3, 3))
    soup = single(body(corners.reshape(-1, 3), np.arange(600).reshape(-1, 3)))
    mask = np.asarray(pj.silhouette(CAMERA, soup)) > 0.5
    assert pj.fit_camera(soup, mask, CAMERA).mask_error.px < 0.1


def test_rendered_soft_mask_has_no_mask_error():
    fit = pj.fit_camera(SCENE, IMAGE, CAMERA)
    assert fit.mask_error is None
    assert_array_equal(fit.covariance, fit.independent_covariance)


def held(trials):
    """How many intervals hold, of fits to masks of a lump that waver by 0.3 to 2 px."""
    return intervals.summary([intervals.trial(k, "bumpy", "one bit") for k in trials])


def test_intervals_hold_for_masks_that_waver():
    found = held(range(3))
    assert found["hold"] > 0.8
    assert found["if independent"] < 0.5  # what they would be without


@pytest.mark.full
def test_intervals_hold_as_often_as_they_say(exhaustive):
    found = held(range(3, 63 if exhaustive else 11))
    assert 0.9 < found["hold"] < 0.99
    assert 0.3 < found["error / sigma"] < 0.9


def test_pixels_of_zero_weight_are_no_mask_error():
    shown = np.add.outer(np.arange(SIZE), np.arange(SIZE)) >= SIZE
    mask = (IMAGE > 0.5) & shown
    fit = pj.fit_camera(SCENE, mask, CAMERA, weight=1.0 * shown)
    assert fit.mask_error == (0.0, 0.0)


@pytest.mark.long
def test_scale_of_the_weights_does_not_matter():
    # (Generalised least squares end a tenth of a standard error apart.)
    for mask, rtol in ((IMAGE > 0.5, 0.05), (wavy(IMAGE, default_rng(0), 1, 10), 1.0)):
        one, other = (
            pj.fit_camera(SCENE, mask, CAMERA, weight=np.full(mask.shape, scale))
            for scale in (1.0, 0.01)
        )
        assert_allclose(one.mask_error.px, other.mask_error.px, rtol=rtol)
        assert one.status == other.status
        assert_allclose(one.std, other.std, rtol=rtol)


def test_mask_that_shows_little_is_uncertain():
    small = single(CAMERA.replace(e=[1.8, 6.0, 30.0]))
    mask = wavy(drawn(small, SCENE), default_rng(0), 1.5, 8.0)
    fit = pj.fit_camera(SCENE, mask, small)
    assert fit.status in ("uncertain", "ambiguous")
    assert np.max(fit.std[:3]) > np.deg2rad(4)
    assert any("degrees (1 sigma)" in words or "is not visible" in words for words in fit.weak)


@pytest.mark.parametrize("px", [3.0, full(-2.0)])
def test_mask_that_is_grown_all_round_does_not_turn_the_camera(px):
    """(The least squares of pixels are 3.5 and 2.4 degrees off.)"""
    grown, start = signed_distance(IMAGE) > -px, turned(CAMERA, 5)
    fit = pj.fit_camera(SCENE, grown, start)
    check_found(fit, CAMERA, min(0.5, 3 * sigma(fit)))
    assert degrees(pj.fit_camera(SCENE, grown, start, outlier_px=None), CAMERA) > 1
