"""Cameras from points: exact ones, noisy ones, and OpenCV's own photos of a chessboard."""

import tracemalloc
import warnings

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import real
from arm import check_slope, numbers_of
from chosen import full, long
from numpy.random import default_rng
from numpy.testing import assert_allclose
from oracles import camera_ahead, central_difference, off, random_camera, turned
from refusals import refusal, refuses

import pinhole_jax as pj
from pinhole_jax._points.resection import plane_of

W, H = 64, 48
EYES = np.array([[0.5, 0.4, 3.0], [-1.2, 0.5, 2.6], [0.2, 1.3, 2.7], [0.9, -0.8, 2.9]])
GRID = np.stack([*np.meshgrid(np.linspace(-1, 1, 6), np.linspace(-0.7, 0.7, 5))], -1).reshape(-1, 2)
PLANE = np.column_stack([GRID, np.zeros(30)])
SOLID = np.column_stack([GRID, np.sin(5 * GRID[:, 0]) * np.cos(3 * GRID[:, 1])])
START = camera_ahead(W, H).replace(e=[0, 0, 1], phi=0.85)


def near(eye, **more):
    return pj.Camera(eye, [0.1, 0, 0], [0.1, 1, 0.05], **{"phi": 0.75, "W": W, "H": H, **more})


NEAR = [near(eye) for eye in EYES]


def angle(a, b):
    """Radians between two cameras."""
    return float(pj.pose_error(a, b)[0])


def seen(cameras, points):
    """Points (N, 2) as a camera sees them, or (V, N, 2) as several do."""
    if isinstance(cameras, pj.Camera):
        return np.array(pj.project(cameras, points))
    return np.stack([seen(camera, points) for camera in cameras])


def test_single_view_gives_pose_and_focal_length_without_a_start():
    truth = NEAR[1]
    fit = pj.fit_points(SOLID, seen(truth, SOLID), START, free=("pose", "phi"))
    assert (fit.status, fit.names[-1]) == ("converged", "phi")
    assert max(off(fit.camera, truth), abs(float(fit.camera.phi - truth.phi))) < 1e-9
    assert fit.rms_px < 1e-8
    assert repr(fit).startswith("<PointFit: converged, rms")
    shown = "pitch", "vertical field of view", "status     converged", "rms  "
    assert all(words in str(fit) for words in shown)


def test_points_in_float64_are_no_matter_to_warn_of_where_jax_has_float32():
    truth = near(EYES[1], phi=0.85)
    seen_at = seen(truth, SOLID)
    single = jax.tree.map(lambda x: np.asarray(x, np.float32), START)
    with jax.enable_x64(False), warnings.catch_warnings():
        warnings.simplefilter("error")
        fit = pj.fit_points(SOLID, seen_at, single, weights=np.ones(30))
    assert fit.camera.e.dtype == np.float32
    assert np.max(np.abs(np.asarray(fit.camera.e) - EYES[1])) < 1e-3


def test_error_bars_are_those_of_the_linearised_problem():
    """By differences of projected points: sigma^2 (J^T J)^-1."""
    truth = NEAR[0]
    points2d = seen(truth, SOLID) + default_rng(0).normal(0, 0.1, (30, 2))
    fit = pj.fit_points(SOLID, points2d, START, free=("pose", "phi"))
    moved = lambda step: seen(fit.displaced(step), SOLID).ravel()
    J = central_difference(moved, np.zeros(7))
    rest = moved(np.zeros(7)) - points2d.ravel()
    assert_allclose(J.T @ rest, 0, atol=1e-3 * np.linalg.norm(J))
    cov = np.linalg.inv(J.T @ J) * (rest @ rest) / (60 - 7)
    assert np.max(np.abs(fit.covariance - cov) / np.outer(fit.std, fit.std)) < 1e-4
    assert_allclose(fit.rms_px, np.sqrt(rest @ rest / 30), rtol=1e-9)


@pytest.mark.parametrize("common", [("phi",), ()])
def test_prior_counts_once(common):
    """Once if shared, else in each view: the estimate is the precision-weighted mean."""
    truth = NEAR
    noise = default_rng(1).normal(0, 0.2, (4, 30, 2))
    points2d, own = seen(truth, SOLID) + noise, ("pose",) if common else ("pose", "phi")
    plain = pj.fit_points(SOLID, points2d, START, own, common)
    mean, std = 0.74, plain[0].std[-1] / 1.5
    sure = pj.fit_points(SOLID, points2d, START, own, common, prior={"phi": (mean, std)})
    for a, b in zip(plain, sure, strict=True):
        assert b.status == "converged"
        known = np.array([a.std[-1] ** -2, std**-2])
        assert_allclose(b.std[-1], known.sum() ** -0.5, rtol=0.03)
        expected = known @ [float(a.camera.phi), mean] / known.sum()
        assert abs(float(b.camera.phi) - expected) < 0.05 * std


@pytest.mark.long
def test_views_share_their_intrinsics_within_bounds():
    lens = pj.Lens([W * 0.52, H * 0.47], 1.0, pj.BrownConrady(-0.2))
    truth = [near(e, lens=lens) for e in EYES]
    points2d = seen(truth, SOLID)
    points2d[1, 3] = points2d[2, 7, 0] = np.nan  # not seen
    free, held = (
        pj.fit_points(SOLID, points2d, START, shared=("phi", "principal_point", "k1"), bounds=b)
        for b in ({"k1": (-0.4, 0.1), "phi": (0.7, 0.8)}, {"k1": (-0.1, 0.1)})
    )
    for true, f, h in zip(truth, free, held, strict=True):
        assert (f.status, h.status) == ("converged", "rank_deficient")
        assert off(f.camera, true) < 1e-6
        known = lambda c: [c.phi, *c.lens.principal_point, c.lens.distortion.k1]
        assert_allclose(known(f.camera), known(true), atol=1e-6)
        assert f.camera.phi == free[0].camera.phi
        assert h.weak[-1] == "k1 is held at an end of its bounds"
        assert -0.1 <= float(h.camera.lens.distortion.k1) < -0.099


@pytest.mark.parametrize("common", [long(("phi",)), full(())])
def test_cameras_move_with_points_and_weights_as_refits_do(common):
    """Residuals are large, so the second derivatives count; one point is not seen by one view."""
    random, cameras = default_rng(3), NEAR[:3]
    points2d = seen(cameras, SOLID) + random.normal(0, 1, (3, 30, 2))
    points2d[1, 3] = np.nan
    free = ("pose",) if common else ("pose", "phi")

    def answer(points, points2d, weights):
        return numbers_of(pj.fit_points(points, points2d, cameras, free, common, weights=weights))

    inputs = [jnp.asarray(x) for x in (SOLID, points2d, random.uniform(0.5, 2, (3, 30)))]
    velocity = [jnp.asarray(random.normal(size=x.shape)) for x in inputs]
    _, by_points2d, _ = check_slope(answer, inputs, velocity, 1e-4, 1e-4)
    assert np.all(by_points2d[1, 3] == 0)


def test_priors_are_not_differentiated():
    fit = lambda x: pj.fit_points(SOLID, x, START, prior={"e_x": (0.0, 1.0)}).camera.e[0]
    with refusal("`prior`: expected none where the fit is diff"):
        jax.grad(fit)(jnp.zeros((30, 2)))
    with refusal(r"`points3d`, `points2d`, `weights`: .*outside `jit` and"):
        jax.jit(lambda x: pj.fit_points(SOLID, x, START).camera.e)(jnp.zeros((30, 2)))


def test_weight_of_two_equals_a_point_seen_twice():
    """And weights of inverse variances take a noise of one."""
    points2d = seen(NEAR[0], SOLID) + default_rng(5).normal(0, 0.3, (30, 2))
    weights = np.where(np.arange(30) < 10, 2.0, 1.0)
    fit = lambda rows, **more: pj.fit_points(
        SOLID[rows], points2d[rows], START.replace(phi=0.75), **more
    )
    every = np.arange(30)
    once, twice = fit(every, weights=1e-4 * weights), fit(np.append(every, every[:10]))
    assert off(once.camera, twice.camera) < 1e-7
    assert_allclose(once.rms_px, twice.rms_px, rtol=1e-7)
    assert_allclose(once.std / twice.std, ((80 - 6) / (60 - 6)) ** 0.5, rtol=1e-6)
    given = fit(every, noise_px=0.3), fit(every, noise_px=1.0, weights=np.full(30, 0.3**-2))
    assert_allclose(given[0].covariance, given[1].covariance, rtol=1e-6)
    assert_allclose(given[0].std, fit(every).std, rtol=0.3)


@pytest.mark.parametrize("points", [SOLID, PLANE], ids=["solid", "plane"])
def test_points_that_are_somewhere_else_do_not_count(points):
    """Two of five are: too many for a direct solution by all. The rest is fitted as if alone."""
    random, truth = default_rng(6), NEAR[1]
    points2d = seen(truth, points) + random.normal(0, 0.1, (30, 2))
    points2d[:12] = random.uniform(0, [W, H], (12, 2))
    start, told = START.replace(phi=0.75), []
    fit = pj.fit_points(points, points2d, start, outlier_px=0.6, progress=told.append)
    only = pj.fit_points(points[12:], points2d[12:], start)
    assert fit.status == only.status == "converged"
    assert off(fit.camera, only.camera) < 1e-6
    assert fit.weak == ("12 of 30 points are far from where they are seen, and left out",)
    assert (len(told), told[0][:9]) == (4, "1 views: ")
    assert (len(fit.history), fit.history[0].steps, only.history[-1].steps) == (5, 0, only.steps)
    assert sum(stop.steps for stop in fit.history) == fit.steps
    assert off(fit.history[-1].camera, fit.camera) < 1e-12
    assert angle(pj.fit_points(points, points2d, start).camera, truth) > 0.05


@pytest.mark.parametrize("common", [("phi",), long(())])
def test_distant_plane_is_ambiguous_by_reversed_depths(common, exhaustive):
    """And is ruled out where the camera is near, in many draws of the noise."""
    random, truth = default_rng(7), NEAR[1:3]
    points2d = seen(truth, 0.05 * PLANE) + random.normal(0, 0.05, (2, 30, 2))
    fits = pj.fit_points(0.05 * PLANE, points2d, truth, "pose", common)
    for fit, true in zip(fits, truth, strict=True):
        assert (fit.status, len(fit.modes)) == ("ambiguous", 1)
        poses = [fit.camera, fit.modes[0].camera]
        assert min(angle(c, true) for c in poses) < 0.15
        assert angle(*poses) > 0.5
    for _ in range(40 if exhaustive else 15):
        points2d = seen(truth, PLANE) + random.normal(0, 0.3, (2, 30, 2))
        for fit, true in zip(
            pj.fit_points(PLANE, points2d, truth, "pose", common), truth, strict=True
        ):
            assert (fit.status, fit.modes) == ("converged", ())
            assert angle(fit.camera, true) < 0.05


def test_boards_that_are_not_quite_flat_are_ambiguous_by_reversed_depths():
    """One as thick as a hundredth of its size, seen from far away; thick ones rule the twin out."""
    random, truth = default_rng(7), NEAR[1]
    for thick, status in ((0.003, "ambiguous"), (0.01, "ambiguous"), (1.0, "converged")):
        points = 0.05 * SOLID * [1, 1, thick]
        points2d = seen(truth, points) + random.normal(0, 0.05, (30, 2))
        twin = pj.fit_points(points * [1, 1, 0], points2d, truth).modes
        for start in (truth, *(fit.camera for fit in twin), turned(truth, 50)):
            fit = pj.fit_points(points, points2d, start)
            assert (fit.status, len(fit.modes)) == (status, int(thick < 1))
            angles = [angle(f.camera, truth) for f in (fit, *fit.modes)]
            assert min(angles) < 0.15
            assert fit.status == "converged" or max(angles) > 0.5


def by_opencv(points, points2d, true):
    """Return all exact rotations (3, 3) of three points by OpenCV, those before the camera."""
    K = pj.formats.to_opencv(true, pixel_centres="half")[0]
    uv = np.column_stack([points2d[:, 0], H - points2d[:, 1]])
    found = []
    for turn, shift in zip(*cv2.solveP3P(points, uv, K, None, cv2.SOLVEPNP_AP3P)[1:], strict=True):
        rotation = cv2.Rodrigues(turn)[0]
        left = cv2.projectPoints(points, turn, shift, K, None)[0][:, 0] - uv
        if (points @ rotation[2] + shift[2]).min() > 0 and np.abs(left).max() < 1e-6:
            found.append(rotation)
    return found


def rotation_of(camera):
    return np.asarray(pj.formats.to_opencv(camera, pixel_centres="half")[1], float)


def tumbled(rng):
    """Return a camera that looks at the middle from anywhere, its field of view 0.75."""
    return random_camera(rng, W, H).replace(phi=0.75)


def test_memory_of_many_points_grows_as_their_number():
    """The plane nearest to 3000 points: a table of all pairs would be 72 MB."""
    points = default_rng(0).normal(size=(3000, 3)) * [1, 1, 0.1]
    tracemalloc.start()
    plane = plane_of(points)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert abs(plane[1][2]) > 0.999
    assert peak < 1e6


@pytest.mark.parametrize("seed", range(6))
def test_three_points_have_all_their_exact_poses_as_modes(seed):
    """Against OpenCV's; the one nearest to the start is first, and a start at the truth is it."""
    rng = default_rng(seed)
    for k in range(5):
        true, points = tumbled(rng), rng.uniform(-1, 1, (3, 3))
        points2d = seen(true, points)
        exact = by_opencv(points, points2d, true)
        start = true if k == 0 else turned(true, 40 * k, axis=rng.normal(size=3))
        fit = pj.fit_points(points, points2d, start)
        fits = [fit, *fit.modes]
        for rotation in exact:
            assert min(np.abs(rotation_of(f.camera) - rotation).max() for f in fits) < 1e-5
        assert all(f.rms_px < 1e-5 and np.all(np.isinf(f.std)) for f in fits)
        assert fit.status == ("ambiguous" if fit.modes else "unchecked")
        away = [angle(f.camera, start) for f in fits]
        assert away == sorted(away)
        if k == 0:
            assert away[0] < 1e-6


@pytest.mark.parametrize(
    "number, free",
    [
        (3, "pose"),
        long(4, ("pose", "phi", "aspect")),
        long(5, ("pose", "phi", "aspect", "principal_point")),
    ],
)
def test_error_bars_are_infinite_where_no_coordinate_is_left_over(number, free):
    rng = default_rng(number)
    true = NEAR[0]
    points = rng.uniform(-1, 1, (number, 3))
    points2d = seen(true, points) + rng.normal(0, 0.1, (number, 2))
    fit = pj.fit_points(points, points2d, true, free)
    assert fit.status in ("unchecked", "ambiguous")
    assert np.all(np.isinf(fit.std))
    known = pj.fit_points(points, points2d, true, free, noise_px=0.1)
    assert np.all(np.isfinite(known.std))
    assert f"{2 * number} coordinates for {2 * number} unknowns: none is left over" in fit.weak[-1]
    # Points that are given again tell nothing new.
    again = np.arange(number).repeat(3)
    twice = pj.fit_points(points[again], points2d[again], true, free)
    assert twice.status in ("unchecked", "ambiguous")
    assert np.all(np.isinf(twice.std))
    assert "repeated points count once" in twice.weak[-1]


def test_points_of_one_view_show_how_those_of_another_err():
    """Three points in one of two views; eight in the other show how points err."""
    rng, true = default_rng(2), NEAR[:2]
    points = rng.uniform(-1, 1, (8, 3))
    points2d = seen(true, points) + rng.normal(0, 0.1, (2, 8, 2))
    points2d[1, 3:] = np.nan
    many, few = pj.fit_points(points, points2d, true, shared=())
    assert (many.status, few.status) == ("converged", "ambiguous")
    assert np.all(np.isfinite(few.std))


def test_prior_that_points_contradict_is_a_misfit():
    random = default_rng(3)
    points2d = seen(NEAR[0], SOLID) + random.normal(0, 0.2, (30, 2))
    plain = pj.fit_points(SOLID, points2d, START, ("pose", "phi"))
    for k, status in {1: "converged", 20: "misfit"}.items():
        known = {"phi": (float(plain.camera.phi) + k * plain.std[-1], plain.std[-1] / 3)}
        fit = pj.fit_points(SOLID, points2d, START, ("pose", "phi"), prior=known)
        told = any("the prior of phi" in note for note in fit.weak)
        assert (fit.status, told) == (status, status == "misfit")


@pytest.mark.long
def test_prior_makes_up_for_a_missing_coordinate():
    """A known aspect: as if it were held, of four points with nine numbers for eight unknowns."""
    rng, true = default_rng(4), NEAR[0]
    points = rng.uniform(-1, 1, (4, 3))
    for _ in range(12):
        points2d = seen(true, points) + rng.normal(0, 0.05, (4, 2))
        known = {"aspect": (1.0, 1e-4)}
        fit = pj.fit_points(points, points2d, true, ("pose", "phi", "aspect"), prior=known)
        held = pj.fit_points(points, points2d, true, ("pose", "phi"))
        assert np.all(np.isfinite(fit.std))
        assert_allclose(fit.std[:-1], held.std, rtol=0.05)
        assert fit.status == held.status != "misfit"
        assert pj.pose_error(fit.camera, held.camera)[1] < 0.2 * np.max(fit.std[3:6])


def test_few_points_are_found_from_any_start_or_not_called_converged():
    """In none of 40 is the camera called converged and far off, by four sigma and a degree."""
    rng = default_rng(5)
    right = 0
    for k in range(40):
        true, number = tumbled(rng), 4 + k % 4
        points = rng.uniform(-1, 1, (number, 3)) * [1, 1, k % 3 > 0]
        noise = 0.1 * (k % 2)
        points2d = seen(true, points) + rng.normal(0, 1, (number, 2)) * noise
        axis = rng.normal(size=3)
        start = turned(true, rng.uniform(90, 180), axis=axis)
        fit = pj.fit_points(points, points2d, start)
        angles = [angle(f.camera, true) for f in (fit, *fit.modes)]
        sigma = float(np.linalg.norm(fit.std[:3]))
        right += fit.status == "converged"
        assert fit.status in ("converged", "ambiguous", "uncertain")
        assert min(angles) < max(4 * sigma, np.deg2rad(1))
        assert fit.status == "ambiguous" or angles[0] < max(4 * sigma, np.deg2rad(1))
    assert right >= 20  # those that are exact


def test_points_that_are_not_these_are_a_misfit():
    """Or are farther off than they are said to err."""
    rng, true = default_rng(6), NEAR[0]
    for number, noise_px in ((4, None), (6, None), (30, None), (30, 0.05)):
        points = rng.uniform(-1, 1, (number, 3))
        points2d = seen(true, points)
        points2d = points2d[::-1] if noise_px is None else points2d + rng.normal(0, 0.2, (30, 2))
        fit = pj.fit_points(points, points2d, true, noise_px=noise_px)
        assert fit.status == "misfit"
        assert any("(rms) from where they are seen" in words for words in fit.weak)


def test_lens_that_would_fold_is_told():
    """Of one view the rows are one off: the best lens that it has for itself folds."""
    points2d = seen(NEAR, PLANE) + 0.3 * np.random.default_rng(0).normal(size=(4, 30, 2))
    points2d[1] = np.roll(points2d[1].reshape(5, 6, 2), 1, axis=0).reshape(30, 2)
    start = START.replace(e=[0, 0, 3], lens=pj.Lens([32, 24], 1, pj.BrownConrady()))
    for fit in pj.fit_points(PLANE, points2d, start, shared=None):
        assert fit.status == "max_steps"
        assert "folds within the film" in fit.weak[-1]


LINE = np.linspace([-1.0, 0, 0], [1, 0.2, 0.1], 5)


@pytest.mark.parametrize(
    "points, free, lost, words",
    [
        *((LINE[[*map(int, rows)]], "pose", 3, "not visible") for rows in ("012", "01010", "000")),
        (SOLID[[0, 5, 14]], ("pose", "phi"), 7, "6 coordinates for 7 unknowns"),
    ],
)
def test_points_that_do_not_show_all_are_rank_deficient(points, free, lost, words):
    true = NEAR[0]
    fit = pj.fit_points(points, seen(true, points), true, free)
    assert fit.status == "rank_deficient"
    assert np.all(np.isinf(fit.std[:lost]))
    assert any(words in note for note in fit.weak)


@pytest.mark.parametrize("part", ["position", "orientation"])
def test_parts_of_the_pose_are_found_from_any_start(part):
    rng = default_rng(7)
    for _ in range(10):
        true, points = tumbled(rng), rng.uniform(-1, 1, (4, 3))
        other, shift = tumbled(rng), 2 * rng.normal(size=3)
        start = true.replace(e=true.e + shift, p=true.p + shift)
        if part == "orientation":
            start = other.replace(e=true.e, p=true.e + other.p - other.e)
        fit = pj.fit_points(points, seen(true, points), start, part)
        assert fit.status == "converged"
        assert off(fit.camera, true) < 1e-6


test_bad_points_are_refused = refuses(
    pj.fit_points,
    {"points3d": PLANE, "points2d": np.ones((30, 2)), "camera": START},
    {
        "`prior`: expected free parameters among e_x, e_y, e_z, got": {"prior": {"phi": (0, 1)}},
        r"`points2d`: expected real numbers of shape \(N, 2\)": {"points2d": np.zeros((30, 3))},
        "`points2d`: expected finite values, or NaN": {"points2d": np.full((30, 2), np.inf)},
        "`points2d`: expected at least 3 points": {"points2d": np.full((30, 2), np.nan)},
        "`weights`: expected at least 3 points in each": {"weights": np.zeros(30)},
        r"`points3d`: expected a real array of shape \(30, 3\)": {"points3d": np.zeros((29, 3))},
        "`camera`: expected one for each of 1 views, got 2": {"camera": [START, START]},
        "`camera`: expected a Camera": {"camera": None},
        r"`free`: expected coefficients of a BrownConrady \(k1, k2, p1, p2, k3\)": {"free": "k4"},
        "`shared`: expected names among phi": {"shared": "pose"},
        r"`weights`: expected a real array of shape \(30,\), got": {"weights": np.ones(29)},
        "`weights`: expected none below 0, got -1": {"weights": np.full(30, -1.0)},
        "`noise_px`: expected a positive number of px, got 0": {"noise_px": 0.0},
        "`outlier_px`: expected a positive number of px, got 0": {"outlier_px": 0.0},
    },
)


def around(number):
    """Cameras about the points, nearer and farther."""
    turns = 2 * np.pi * np.arange(number) / number
    distances = 2.6 + 0.3 * (np.arange(number) % 3)
    return [near([np.cos(t), np.sin(t), d]) for t, d in zip(turns, distances, strict=True)]


def bent(views, random):
    """Errors (V, 30, 2) that are smooth over the points of each view: 0.2 px a coefficient."""
    x, y = GRID.T
    shapes = np.stack([x, y, x * x, x * y, y * y], axis=-1)
    return shapes @ random.normal(0, 0.2, (views, 5, 2))


def lens(points2d, noise_px=None):
    """The first view's fit with a lens that all share."""
    shared = "phi", "principal_point"
    return pj.fit_points(SOLID, points2d, NEAR[0], shared=shared, noise_px=noise_px)[0]


def test_error_bars_hold_where_the_errors_of_a_view_are_alike():
    """By 10 refits of 12 views (by independent errors, those of 20 were off by 2.0 sigma, rms)."""
    exact, by = seen(around(12), SOLID), []
    for seed in range(10):
        random = default_rng(seed)
        fit = lens(exact + bent(12, random) + random.normal(0, 0.05, exact.shape))
        numbers = [float(fit.camera.phi), *np.asarray(fit.camera.lens.principal_point)]
        by.append((np.array(numbers) - [0.75, W / 2, H / 2]) / fit.std[-3:])
    assert 0.7 < np.sqrt(np.mean(np.square(by))) < 1.3


def test_error_bars_stay_where_errors_are_independent_or_given():
    """They are those by `noise_px`, times how much larger the residuals are."""
    random, exact = default_rng(0), seen(around(20), SOLID)
    noisy = exact + random.normal(0, 0.1, exact.shape)
    shown, given = lens(noisy), lens(noisy, 0.1)
    assert 0.9 < shown.std[-1] / given.std[-1] < 1.1
    assert_allclose(shown.std / given.std, shown.std[-1] / given.std[-1], rtol=1e-5)
    alike = noisy + bent(20, random)
    shown, given = lens(alike), lens(alike, 0.1)
    assert 0.9 < given.std[-1] / lens(noisy, 0.1).std[-1] < 1.1
    larger = np.linalg.eigvals(np.linalg.solve(given.covariance, shown.covariance)).real
    assert np.max(larger) > 2 * np.min(larger)


@pytest.mark.parametrize("points", [SOLID, PLANE], ids=["solid", "plane"])
def test_error_bars_hold_where_neighbouring_points_err_alike(points):
    """By a lens that is left out: eyes were 12 to 16 sigma off, and are up to 5."""
    random, most = default_rng(8), {0.0: 4, -0.1: 6}
    for k in range(8):
        for k1 in most:
            truth = near(EYES[k % 4], lens=pj.Lens([W / 2, H / 2], 1.0, pj.BrownConrady(k1)))
            points2d = seen(truth, points) + random.normal(0, 0.02, (30, 2))
            fit = pj.fit_points(points, points2d, near(EYES[k % 4]))
            assert any("residuals of neighbouring points" in note for note in fit.weak) == (k1 < 0)
            step = np.asarray(fit.camera.e - truth.e)
            squares = step @ np.linalg.solve(fit.covariance[3:6, 3:6], step)
            assert 0.1 < squares**0.5 < most[k1]


def test_chessboards_are_calibrated_as_opencv_calibrates_them(shared):
    seen_at, size = real.corners(shared / "calib" / "opencv_chessboard")
    ours, fits = real.by_fit(real.board(), seen_at, size)
    theirs = real.by_opencv(real.board(), seen_at, size)
    assert {f.status for f in fits} == {"converged"}
    assert ours["rms_px"] <= theirs["rms_px"] * 1.0001
    assert abs(ours["focal_px"] / theirs["focal_px"] - 1) < 1e-3
    assert abs(ours["k1"] - theirs["k1"]) < 0.01
    assert np.ptp([float(f.camera.phi) for f in fits]) < 1e-12
    # What OpenCV's own file says, made by another version from the same photos.
    assert abs(ours["focal_px"] / 535.916 - 1) < 1e-3
    assert abs(ours["k1"] + 0.26637) < 0.01
