"""Cameras from points: exact ones, noisy ones, and OpenCV's own photos of a chessboard."""

import sys
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import pinhole_jax as pj

W, H = 64, 48
BROWN = pj.BrownConrady(-0.2, 0.05, 1e-3, -2e-3, 0.01)
EYES = np.array([[0.5, 0.4, 3.0], [-1.2, 0.5, 2.6], [0.2, 1.3, 2.7], [0.9, -0.8, 2.9]])
GRID = np.stack([*np.meshgrid(np.linspace(-1, 1, 6), np.linspace(-0.7, 0.7, 5))], -1).reshape(-1, 2)
PLANE = np.column_stack([GRID, np.zeros(30)])
SOLID = np.column_stack([GRID, np.sin(5 * GRID[:, 0]) * np.cos(3 * GRID[:, 1])])
START = pj.Camera([0, 0, 1], [0, 0, 0], [0, 1, 0], 0.85, W=W, H=H)


def camera(eye, model=BROWN):
    lens = pj.Lens([W * 0.52, H * 0.47], 1.0, model)
    return pj.Camera(eye, [0.1, 0, 0], [0.1, 1, 0.05], 0.75, W=W, H=H, lens=lens)


def seen(cameras, points):
    return np.stack([np.asarray(pj.project(c, jnp.asarray(points))) for c in cameras])


def test_one_view_gives_pose_and_focal_length_from_nowhere():
    truth = pj.Camera(EYES[1], [0.1, 0, 0], [0.1, 1, 0.05], 0.75, W=W, H=H)
    fit = pj.fit_points(SOLID, seen([truth], SOLID)[0], START, free=("pose", "phi"))
    assert fit.status == "converged"
    assert fit.names[-1] == "phi"
    angle, shift = pj.pose_error(fit.camera, truth)
    assert max(float(angle), float(shift), abs(float(fit.camera.phi - truth.phi))) < 1e-9
    assert fit.rms_px < 1e-8
    assert repr(fit).startswith("<PointFit: converged, rms")
    for words in ("pitch", "vertical field of view", "status     converged", "rms  "):
        assert words in str(fit)


@pytest.mark.long
def test_views_share_their_intrinsics():
    """Three coefficients of five: a small film and exact points, of a plane."""
    truth = [camera(e) for e in EYES]
    points2d = seen(truth, PLANE)
    points2d[1, 3] = np.nan  # not seen
    points2d[2, 7, 0] = np.nan
    fits = pj.fit_points(PLANE, points2d, START)
    assert [f.status for f in fits] == ["converged"] * 4
    for fit, true in zip(fits, truth, strict=True):
        assert max(float(x) for x in pj.pose_error(fit.camera, true)) < 1e-6
        lens = fit.camera.lens
        np.testing.assert_allclose(lens.principal_point, true.lens.principal_point, atol=1e-5)
        for name, value in BROWN.coefficients().items():
            assert abs(float(getattr(lens.distortion, name)) - value) < 1e-5
    same = [np.asarray(f.camera.phi) for f in fits]
    np.testing.assert_allclose(same, same[0], rtol=1e-12)


def test_error_bars_are_those_of_the_linearised_problem():
    """By differences of projected points: sigma^2 (J^T J)^-1 with all columns in natural units."""
    truth = pj.Camera(EYES[0], [0.1, 0, 0], [0.1, 1, 0.05], 0.75, W=W, H=H)
    rng = np.random.default_rng(0)
    points2d = seen([truth], SOLID)[0] + rng.normal(0, 0.1, (30, 2))
    fit = pj.fit_points(SOLID, points2d, START, free=("pose", "phi"))
    columns = []
    for k in range(7):

        def moved(step, k=k):
            e, p, u = (np.asarray(x, float) for x in (fit.camera.e, fit.camera.p, fit.camera.u))
            if k < 3:  # turn about the eye, world axes
                axis = np.eye(3)[k]
                p, u = e + (p - e) + step * np.cross(axis, p - e), u + step * np.cross(axis, u)
            elif k < 6:
                e, p = e + step * np.eye(3)[k - 3], p + step * np.eye(3)[k - 3]
            phi = float(fit.camera.phi) + (step if k == 6 else 0)
            there = pj.Camera(e, p, u, phi, W=W, H=H)
            return seen([there], SOLID)[0].ravel()

        columns.append((moved(1e-5) - moved(-1e-5)) / 2e-5)
    J = np.stack(columns, axis=-1)
    rest = (points2d - seen([fit.camera], SOLID)[0]).ravel()
    np.testing.assert_allclose(J.T @ rest, 0, atol=1e-3 * np.linalg.norm(J))
    cov = np.linalg.inv(J.T @ J) * (rest @ rest) / (60 - 7)
    np.testing.assert_allclose(fit.std[3:], np.sqrt(np.diag(cov)[3:]), rtol=1e-4)
    np.testing.assert_allclose(fit.rms_px, np.sqrt(rest @ rest / 30), rtol=1e-9)


def test_what_points_do_not_show_is_said():
    line = np.linspace([-1.0, 0, 0], [1, 0.2, 0.1], 30)
    truth = pj.Camera(EYES[0], [0.1, 0, 0], [0.1, 1, 0.05], 0.75, W=W, H=H)
    fit = pj.fit_points(line, seen([truth], line)[0], truth, free=("pose", "phi"))
    assert fit.status == "rank_deficient"
    assert any("is not visible" in words for words in fit.weak)


@pytest.mark.parametrize("common", [("phi",), ()])
def test_a_prior_adds_its_information_once(common):
    """Of what views share once, else to each view: the estimate is the precision-weighted mean."""
    truth = [pj.Camera(e, [0.1, 0, 0], [0.1, 1, 0.05], 0.75, W=W, H=H) for e in EYES]
    noise = np.random.default_rng(1).normal(0, 0.2, (4, 30, 2))
    points2d, own = seen(truth, SOLID) + noise, ("pose",) if common else ("pose", "phi")
    plain = pj.fit_points(SOLID, points2d, START, own, common)
    mean, std = 0.74, plain[0].std[-1] / 1.5
    sure = pj.fit_points(SOLID, points2d, START, own, common, prior={"phi": (mean, std)})
    for a, b in zip(plain, sure, strict=True):
        assert b.status == "converged"
        known = np.array([a.std[-1] ** -2, std**-2])
        np.testing.assert_allclose(b.std[-1], known.sum() ** -0.5, rtol=0.03)
        expected = known @ [float(a.camera.phi), mean] / known.sum()
        assert abs(float(b.camera.phi) - expected) < 0.05 * std


@pytest.mark.long
def test_points_keep_bounds():
    truth = [camera(e, pj.BrownConrady(-0.2)) for e in EYES]
    fit = lambda **more: pj.fit_points(
        SOLID, seen(truth, SOLID), START, shared=("phi", "principal_point", "k1"), **more
    )
    free, wide, held = (
        fit(bounds=b) for b in (None, {"k1": (-0.4, 0.1), "phi": (0.7, 0.8)}, {"k1": (-0.1, 0.1)})
    )
    for f, w, h in zip(free, wide, held, strict=True):
        assert f.status == w.status == "converged"
        np.testing.assert_allclose(w.camera.phi, f.camera.phi, rtol=1e-9)
        assert h.status == "rank_deficient"
        assert h.weak[-1] == "k1 is held at an end of its bounds"
        assert -0.1 <= float(h.camera.lens.distortion.k1) < -0.099


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"prior": {"phi": (0, 1)}}, "`prior`: expected free parameters among e_x, e_y, e_z, got"),
        ({"points2d": np.zeros((30, 3))}, r"`points2d`: expected real numbers of shape \(N, 2\)"),
        ({"points2d": np.full((30, 2), np.inf)}, "`points2d`: expected finite values, or NaN"),
        ({"points2d": np.full((30, 2), np.nan)}, "`points2d`: expected at least 3 points in each"),
        ({"points3d": np.zeros((29, 3))}, r"`points3d`: expected a real array of shape \(30, 3\)"),
        ({"camera": [START, START]}, "`camera`: expected one for each of 1 views, got 2"),
        ({"camera": None}, "`camera`: expected a Camera"),
        ({"free": "k4"}, r"`free`: expected coefficients of a BrownConrady \(k1, k2, p1, p2, k3\)"),
        ({"shared": "pose"}, "`shared`: expected names among phi"),
    ],
)
def test_bad_points_are_said_in_words(change, message):
    arguments = {"points3d": PLANE, "points2d": np.ones((30, 2)), "camera": START, **change}
    with pytest.raises((ValueError, TypeError), match=message):
        pj.fit_points(**arguments)


def test_chessboards_are_calibrated_as_opencv_calibrates_them(shared):
    sys.path.insert(0, str(Path(__file__).parents[1] / "experiments"))
    import chessboards

    _, seen_at, size = chessboards.corners(shared / "calib" / "opencv_chessboard")
    ours, fits = chessboards.by_fit(chessboards.board(), seen_at, size)
    theirs = chessboards.by_opencv(chessboards.board(), seen_at, size)
    assert {f.status for f in fits} == {"converged"}
    assert ours["rms_px"] <= theirs["rms_px"] * 1.0001
    assert abs(ours["focal_px"] / theirs["focal_px"] - 1) < 1e-3
    assert abs(ours["k1"] - theirs["k1"]) < 0.01
    # All views have one intrinsics block.
    assert (
        len({float(f.camera.phi) for f in fits}) == 1
        or np.ptp([float(f.camera.phi) for f in fits]) < 1e-12
    )
    # What OpenCV's own file says, made by another version from the same photos.
    assert abs(ours["focal_px"] / 535.916 - 1) < 1e-3
    assert abs(ours["k1"] + 0.26637) < 0.01
    lens = eqx.filter(fits[0].camera.lens, eqx.is_inexact_array)
    assert lens.distortion.k1.dtype == np.float64
