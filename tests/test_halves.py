"""Two fits, each to half of the data: how far they differ, and what that says of error bars."""

import numpy as np
import pytest
from chosen import long
from masks import wavy
from numpy.random import default_rng
from oracles import central_difference, drawn as mask_of, lump, normal, usual_camera
from refusals import refusal
from results import NAMES, fit_at
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

import pinhole_jax as pj
from pinhole_jax._camera.poses import exponential
from pinhole_jax._fit.result import MaskError
from pinhole_jax._joint.joint_fit import ObjectFit

CAMERA = usual_camera()
SCENE = lump(3)
POINTS = normal((40, 3)) * [0.5, 0.5, 0.5]


def known_by(sigma_px, names=NAMES):
    """The covariance of a camera by points whose projections err: (J' J)^-1 by differences."""
    fit = fit_at(CAMERA, np.eye(len(names)), names)
    seen = lambda step: np.asarray(pj.project(fit.displaced(step), POINTS)).ravel()
    J = central_difference(seen, np.zeros(len(names)))
    return sigma_px**2 * np.linalg.inv(J.T @ J)


def drawn(random, covariance, names=NAMES, told=1.0):
    """A fit whose camera errs by its covariance, which it reports as `told` times its size."""
    step = np.linalg.cholesky(covariance) @ random.normal(size=len(names))
    return fit_at(fit_at(CAMERA, covariance, names).displaced(step), told * covariance, names)


def checks_of(refit, count=200):
    """Checks of as many refits, and the root mean square of their differences."""
    checks = [pj.split_check(lambda _: refit(), (0, 1)) for _ in range(count)]
    return checks, np.sqrt(np.mean([check.rms**2 for check in checks]))


@pytest.mark.parametrize("names, px", [(NAMES, 0.1), (NAMES[:6], 3.0)])
def test_halves_of_right_error_bars_differ_by_chance_alone(names, px):
    """... even where rotations are uncertain by many degrees about a far eye."""
    random, covariance = default_rng(0), known_by(px, names)
    checks, rms = checks_of(lambda: drawn(random, covariance, names))
    assert kstest([check.chance for check in checks], "uniform").pvalue > 1e-3
    assert rms == pytest.approx(1, abs=0.06)
    assert np.mean([check.agrees for check in checks]) > 0.96
    assert {check.parameters for check in checks} == {len(names)}
    angles = [check.parts[0].angle for check in checks]
    assert np.rad2deg(np.median(angles)) > px


@pytest.mark.parametrize("narrow", [2.0, 4.0])
def test_narrow_error_bars_are_noticed(narrow):
    random, covariance = default_rng(1), known_by(0.5)
    checks, rms = checks_of(lambda: drawn(random, covariance, told=narrow**-2), 100)
    assert rms == pytest.approx(narrow, rel=0.1)
    assert np.mean([check.agrees for check in checks]) < (0.4 if narrow == 2 else 0.05)
    assert "TOO NARROW" in str(max(checks, key=lambda check: check.rms))


def test_difference_is_that_of_the_scene_before_the_camera():
    """The camera rolls by 2 degrees and steps back by 0.1: what it sees rolls back, farther off."""
    v = np.asarray(pj.camera_basis(CAMERA).v)
    roll = Rotation.from_rotvec(np.deg2rad(2) * v)
    away = CAMERA.replace(e=CAMERA.e - 0.1 * v, u=roll.as_matrix() @ CAMERA.u)
    covariance = known_by(0.5, NAMES[:6])
    cameras = {"a": away, "b": CAMERA}
    check = pj.split_check(lambda k: fit_at(cameras[k], covariance, NAMES[:6]), ("a", "b"))
    (part,) = check.parts
    np.testing.assert_allclose(part.difference[:3], [0, 0, -np.deg2rad(2)], atol=1e-9)
    assert part.angle == pytest.approx(np.deg2rad(2))
    assert part.difference[5] == pytest.approx(0.1)
    # Sideways it moves by the roll of a point that is not far from the points' middle.
    assert np.linalg.norm(part.difference[3:5]) < 0.02
    assert part.shift == pytest.approx(np.linalg.norm(part.difference[3:6]))


@pytest.mark.parametrize("weight", [None, np.arange(96) / 96 * np.ones((80, 1))])
def test_outline_halves_share_out_all_pixels(weight):
    mask = mask_of(CAMERA, SCENE)
    odd, even = pj.outline_halves(mask, weight=weight)
    total = np.ones((80, 96)) if weight is None else weight
    np.testing.assert_array_equal(odd + even, total)
    assert not np.any((odd > 0) & (even > 0))
    edge = (mask > 0) & (mask < 1) & (total > 0)
    assert 0.4 < np.mean(odd[edge] > 0) < 0.6


@pytest.mark.parametrize("reach, blocks", [(8.0, 16), (40.0, 6), (1e3, 6)])
def test_blocks_of_an_outline_are_longer_than_errors_reach(reach, blocks):
    y, x = np.indices((400, 400)) - 199.5
    odd, _ = pj.outline_halves(np.hypot(x, y) < 150, MaskError(1.0, reach))
    t = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    row, column = (np.round(199.5 + 149 * f(t)).astype(int) for f in (np.sin, np.cos))
    ring = odd[row, column] > 0
    assert np.sum(ring != np.roll(ring, 1)) == blocks


@pytest.mark.long
def test_halves_of_wavy_outlines_differ_by_their_error_bars():
    squares, count = 0.0, 0
    for seed in range(8):
        mask = wavy(mask_of(CAMERA, SCENE), default_rng(seed), 0.7, 6.0)
        fit = pj.fit_camera(SCENE, mask, CAMERA)
        refit = lambda w, m=mask, c=fit.camera: pj.fit_camera(SCENE, m, c, weight=w)
        check = pj.split_check(refit, pj.outline_halves(mask, fit.mask_error))
        squares, count = squares + check.parameters * check.rms**2, count + check.parameters
    assert 0.6 < np.sqrt(squares / count) < 1.3


@pytest.mark.parametrize("told", [1.0, long(0.1)])
def test_halves_of_noisy_points_differ_by_their_error_bars(told):
    """... by noise that is known, and by ten times as much as was said."""
    random = default_rng(2)
    cameras = [CAMERA.replace(e=e) for e in random.normal([0, 0, 6], size=(8, 3))]
    rms = []
    for _ in range(10):
        seen = np.stack([np.asarray(pj.project(c, POINTS)) for c in cameras])
        seen += 0.2 * random.normal(size=seen.shape)
        refit = lambda half: pj.fit_points(
            POINTS, half, CAMERA, shared=("phi", "principal_point"), noise_px=0.2 * told
        )
        check = pj.split_check(refit, (seen[::2], seen[1::2]))
        assert check.parts[0].names == ("phi", "principal_x", "principal_y")
        rms.append(check.rms)
    assert 0.75 / told < np.sqrt(np.mean(np.square(rms))) < 1.3 / told


def test_objects_of_halves_are_compared_about_their_middle():
    """Poses whose errors are turns about, and shifts of, a middle far from the object's origin."""
    random, middle = default_rng(3), np.array([3.0, -2, 4])
    sigma = np.array([0.005, 0.01, 0.002, 0.01, 0.01, 0.03])
    of_origin = np.eye(6)
    of_origin[3:, :3] = np.cross(middle, np.eye(3)).T  # a turn w moves the origin by middle x w
    covariance = of_origin @ np.diag(sigma**2) @ of_origin.T

    def joint():
        pose = exponential(sigma * random.normal(size=6))
        pose[:3, 3] += middle - pose[:3, :3] @ middle
        placed = {"part": ObjectFit(pose, covariance)}
        return pj.JointFit("converged", {}, placed, (), 1.0, (), {})

    checks, rms = checks_of(joint)
    assert rms == pytest.approx(1, abs=0.06)
    shift = np.sqrt(np.mean([check.parts[0].shift ** 2 for check in checks]))
    assert shift == pytest.approx(2**0.5 * np.linalg.norm(sigma[3:]), rel=0.1)


def test_modes_of_a_half_count_as_its_answer():
    covariance = known_by(0.5)
    other = fit_at(CAMERA.replace(e=-CAMERA.e), covariance)
    right = fit_at(CAMERA, covariance, status="ambiguous")
    fits = {"a": right, "b": other._replace(modes=(right,), status="ambiguous")}
    assert pj.split_check(lambda k: fits[k], ("a", "b")).rms == 0


NOTHING = np.where(np.eye(7) > 0, np.inf, np.nan)


@pytest.mark.parametrize("status", ["max_steps", "misfit", "no_overlap", "converged"])
def test_halves_that_were_not_found_or_determine_nothing_are_not_compared(status):
    covariance = NOTHING if status == "converged" else known_by(0.5)
    fits = fit_at(CAMERA, covariance), fit_at(CAMERA, covariance, status=status)
    check = pj.split_check(lambda k: fits[k], (0, 1))
    assert (check.is_conclusive, check.parameters) == (False, 0 if status == "converged" else 7)
    assert str(check).startswith("cannot tell")
    assert status in str(check)


def test_fits_with_nothing_in_common_are_refused():
    covariance = known_by(0.5, NAMES[:6])
    alone = fit_at(CAMERA, covariance, NAMES[:6])
    with refusal(r"`refit`: expected fits with a camera, .* got none"):
        pj.split_check(lambda _: (alone, alone), (0, 1))
    apart = {
        name: pj.JointFit("converged", {name: alone}, {}, (), 1.0, (), {}) for name in ("a", "b")
    }
    with refusal(r"`refit`: expected fits with a camera, .* got none"):
        pj.split_check(lambda k: apart[k], ("a", "b"))
    fits = alone, fit_at(CAMERA, known_by(0.5))
    with refusal("`refit`: expected fits of the same parameters"):
        pj.split_check(lambda k: fits[k], (0, 1))
    with refusal("`refit`: expected it to return a fit, got int"):
        pj.split_check(lambda half: half, (0, 1))
