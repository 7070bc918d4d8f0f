"""How a mask's outline errs: offsets measured, their size and length told, intervals that hold."""

import numpy as np
import pytest
from chosen import full
from masks import outward, wavy
from oracles import drawn, single, turned
from results import degrees
from scipy.spatial.transform import Rotation

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._mask.mask import Mask
from pinhole_jax._outline.outline_errors import ErrorModel, is_drawn, outline_errors
from pinhole_jax._outline.statistics import mask_errors
from pinhole_jax._outline.stretches import stretches_of
from pinhole_jax._rules import RULES
from pinhole_jax._solver.moves import canonical
from pinhole_jax._solver.solver import Solver
from pinhole_jax._solver.subject import Subject

SIZE = 128
CAMERA = pj.Camera([0.3, 1.0, 5.0], [0.1, 0, 0], [0.2, 1, 0.1], 0.6, 1.0, SIZE, SIZE)


@pytest.fixture(scope="module")
def scene():
    return single(pj.Scene(mesh=shapes.bumpy(3)))


@pytest.fixture(scope="module")
def image(scene):
    return drawn(single(CAMERA), scene)


def solver_of(scene, target):
    subject = Subject.from_scene(scene, np.float32)
    return Solver.on(subject, Mask(target, np.ones(target.shape), single(CAMERA)), ("pose",), 64)


def seen(scene, target):
    """Return a view at the camera, and what the mask and its weights are."""
    solver = solver_of(scene, target)
    view = solver.look(canonical(single(CAMERA)), solver.finest)
    return view, target, np.ones(target.shape)


def error(found, truth):
    """Return by how much a camera is off: small turns about its own axes, and its eye (6,)."""
    axes, wanted = (
        np.stack([np.asarray(b, float) for b in pj.camera_basis(c)]) for c in (found, truth)
    )
    turn = Rotation.from_matrix(wanted.T @ axes).as_rotvec()
    return np.concatenate([axes @ turn, np.asarray(truth.e, float) - np.asarray(found.e, float)])


@pytest.mark.long
@pytest.mark.parametrize("px", [-2.0, -0.7, 0.0, 0.4, 3.0])
def test_offset_equals_the_growth_of_the_mask_in_px(scene, image, px):
    # Distances are to pixels' middles, as a person's brush is: offsets are right to a tenth.
    stretches = stretches_of(*seen(scene, np.clip(outward(image) + px + 0.5, 0, 1)))
    assert abs(np.median(stretches.offset) - px) < 0.15 + 0.05 * abs(px)
    assert abs(np.sum(stretches.length) - np.sum(np.hypot(*np.gradient(image)))) < 2


def test_rendered_binary_mask_has_quantisation_errors_alone(scene, image):
    fit = pj.fit_camera(scene, image > 0.5, single(CAMERA))
    assert fit.mask_error == (0.0, 0.0)
    assert str(fit.mask_error) == "quantisation alone"
    ratio = fit.std / np.sqrt(np.diag(fit.independent_covariance))
    assert np.all((ratio > 0.9) & (ratio < 1.5))


def test_single_pixels_tell_a_drawn_mask_whose_stretches_err_by_no_more_than_one_bit(scene, image):
    """A mask that is shrunk may look like another camera's: all offsets are small there."""
    mask, outline = image > 0.5, np.argwhere((image > 0.02) & (image < 0.98))
    mask[tuple(outline[:: len(outline) // 12].T)] ^= True
    shares = [outline_errors(*seen(scene, mask), 1 / 12, hard).computed for hard in (True, False)]
    assert shares[0] < 0.05 < shares[1]
    assert is_drawn(mask_errors(solver_of(scene, mask), seen(scene, mask)[0]))
    assert outline_errors(*seen(scene, image > 0.5), 1 / 12, True).computed == 1


@pytest.mark.long
def test_rendered_triangle_soup_is_not_taken_for_drawn():
    """Pixels in which several edges lie err for each of them."""
    random = np.random.default_rng(0)
    corners = random.normal(0, 0.5, (800, 1, 3)) + random.normal(0, 0.1, (800, 3, 3))
    soup = single(pj.Scene(mesh=pj.Mesh(corners.reshape(-1, 3), np.arange(2400).reshape(-1, 3))))
    image = drawn(single(CAMERA), soup)
    for mask, is_wavy in ((image > 0.5, False), (wavy(image, random, 0.3, 20), True)):
        assert is_drawn(mask_errors(solver_of(soup, mask), seen(soup, mask)[0])) == is_wavy


def test_rendered_soft_mask_has_no_mask_error(scene, image):
    fit = pj.fit_camera(scene, image, single(CAMERA))
    assert fit.mask_error is None
    np.testing.assert_array_equal(fit.covariance, fit.independent_covariance)


def intervals(scene, image, trials):
    """Return errors in standard errors (trials, 6), as stated and if pixels were independent."""
    stated, independent = [], []
    for trial in trials:
        random = np.random.default_rng(trial)
        px, length = np.exp(random.uniform(np.log([0.3, 2]), np.log([2, 30])))
        mask = wavy(image, random, px, length, random.uniform(-1, 1))
        fit = pj.fit_camera(scene, mask, single(turned(CAMERA, [0.3, 1, 0.2], 3.0)))
        off = np.abs(error(fit.camera, CAMERA))
        stated.append(off / fit.std)
        independent.append(off / np.sqrt(np.diag(fit.independent_covariance)))
    return np.array(stated), np.array(independent)


def test_intervals_hold_for_masks_that_waver(scene, image):
    stated, independent = intervals(scene, image, range(3))
    assert np.mean(stated < 1.96) > 0.8
    assert np.mean(independent < 1.96) < 0.5  # what they would be without


@pytest.mark.full
def test_intervals_hold_as_often_as_they_say(scene, image, exhaustive):
    stated, _ = intervals(scene, image, range(3, 63 if exhaustive else 11))
    assert 0.9 < np.mean(stated < 1.96) < 0.99
    assert 0.3 < np.median(stated) < 0.9


@pytest.mark.parametrize("px", [0.3, 1.0, 1.5])
def test_squares_feel_the_share_of_a_move_that_errors_leave(scene, image, px):
    # An outline that is farther than a pixel from the mask's pulls no harder for being farther.
    half_px = np.tan(0.3) * 5.2 / SIZE
    at = lambda x: drawn(single(CAMERA.replace(e=CAMERA.e + x, p=CAMERA.p + x)), scene)
    moved, in_full = [], 0.0
    for way in half_px * np.eye(3)[:2]:
        moved += [at(way), at(-way)]
        in_full += np.sum((at(way / 10) - at(-way / 10)) ** 2) * 10**2 / 2
    measured, felt = [], []
    for seed in range(12):
        mask = wavy(image, np.random.default_rng(seed), px, 10)
        bent = sum(np.sum((x - mask) ** 2) - np.sum((image - mask) ** 2) for x in moved)
        errors = outline_errors(*seen(scene, mask), 1 / 12, hard=True)
        assert errors is not None
        measured.append(bent / in_full)
        felt.append(errors.felt)
    assert np.mean(felt) == pytest.approx(np.mean(measured), abs=0.2)


def test_gradient_at_the_truth_is_as_large_as_its_covariance_says(scene, image):
    squares = []
    for seed in range(16):
        random = np.random.default_rng(seed)
        view, *mask = seen(scene, wavy(image, random, 1.0, 10, 0.5 * random.normal()))
        errors = outline_errors(view, *mask, 1 / 12, hard=True)
        assert errors is not None
        pull = np.asarray(view.triangle, float).T @ np.asarray(view.along, float)
        squares.append(pull @ np.linalg.solve(errors.felt**2 * errors.gradient, pull) / len(pull))
    assert 0.5 < np.median(squares) < 2


def test_pixels_of_zero_weight_are_no_mask_error(scene, image):
    shown = np.add.outer(np.arange(SIZE), np.arange(SIZE)) >= SIZE
    view, target, ones = seen(scene, (image > 0.5) & shown)
    told, untold = (stretches_of(view, target, weight) for weight in (1.0 * shown, ones))
    assert np.max(np.abs(told.offset)) < 1 < np.max(np.abs(untold.offset))


@pytest.mark.long
def test_scale_of_the_weights_does_not_matter(scene, image):
    # (Descents end some thousandths of a px apart, and a profile is taken at a few places.)
    for mask, rtol in ((image > 0.5, 0.05), (wavy(image, np.random.default_rng(0), 1, 10), 1.0)):
        one, other = (
            pj.fit_camera(scene, mask, single(CAMERA), weight=np.full(mask.shape, scale))
            for scale in (1.0, 0.01)
        )
        assert one.mask_error == other.mask_error
        assert one.status == other.status
        np.testing.assert_allclose(one.std, other.std, rtol=rtol)


def test_mask_that_shows_little_is_uncertain(scene):
    small = pj.Camera([1.8, 6.0, 30.0], [0.1, 0, 0], [0.2, 1, 0.1], 0.6, 1.0, SIZE, SIZE)
    shown = drawn(single(small), scene)
    fit = pj.fit_camera(scene, wavy(shown, np.random.default_rng(0), 1.5, 8.0), single(small))
    assert fit.status in ("uncertain", "ambiguous")
    assert any("degrees (1 sigma)" in words for words in fit.weak)


@pytest.mark.parametrize("px", [3.0, full(-2.0)])
def test_mask_that_is_grown_all_round_does_not_turn_the_camera(scene, image, px):
    """(The least squares of pixels are 3.5 and 2.4 degrees off.)"""
    grown, start = outward(image) > -px, turned(single(CAMERA), [1, 2, 3], 5)
    fit = pj.fit_camera(scene, grown, start)
    assert fit.status == "converged"
    assert degrees(fit, single(CAMERA)) < min(0.5, 3 * np.rad2deg(np.linalg.norm(fit.std[:3])))
    assert degrees(pj.fit_camera(scene, grown, start, outlier_px=None), single(CAMERA)) > 1


@pytest.mark.parametrize(("power", "length"), [(1, 16), (2, 40)])
def test_ellipsoids_hold_for_errors_of_a_circle_that_are_rough_or_smooth(power, length):
    """(The oracle: offsets drawn by their covariance's Cholesky factor; the right move is none.)"""
    turn = 2 * np.pi * np.arange(60) / 60
    at = 40 * np.column_stack([np.cos(turn), np.sin(turn)])
    by_move = np.column_stack([f(k * turn) for k in (1, 2) for f in (np.cos, np.sin)])
    distance = np.linalg.norm(at[:, None] - at, axis=-1)
    root = np.linalg.cholesky(np.exp(-((distance / length) ** power)) + 1e-6 * np.eye(60))
    model = ErrorModel(at, 1e-3 / 4.2, RULES.lengths, RULES.shapes)
    random, held = np.random.default_rng(0), []
    for _ in range(40):
        fit = model.fit(root @ random.normal(size=60), by_move)
        held.append(fit.move @ np.linalg.solve(fit.covariance, fit.move) < 9.49)  # (95 % of four)
    assert np.mean(held) > 0.85


def test_evidence_without_gross_offsets_equals_that_of_the_others():
    """(The oracle: a model of the others' places alone.)"""
    random = np.random.default_rng(0)
    at = np.concatenate([np.zeros((20, 2)), random.normal(size=(20, 2))]) * 9
    gross, offset = np.arange(40) < 20, random.normal(size=40)
    by_move = random.normal(size=(40, 3)) * ~gross[:, None]
    shapes = [(1.0, 0.2, 0.0), (2.0, 0.0, 0.0)]
    whole = ErrorModel(at, 0.1, (6.0, 40.0), shapes).evidence(offset, by_move, gross)
    some = ErrorModel(at[20:], 0.1, (6.0, 40.0), shapes).evidence(offset[20:], by_move[20:])
    for a, b in zip(whole, some, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9)
