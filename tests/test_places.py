"""Where else the camera may be: no fit says `converged` and is wrong."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from chosen import full
from masks import wavy
from oracles import drawn, turned
from scipy.ndimage import binary_erosion, gaussian_filter
from views import like

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._fit import places, strategy
from pinhole_jax._fit.likelihood import Account
from pinhole_jax._fit.refine import Candidate, likeliest
from pinhole_jax._mask.kinds import Kind
from pinhole_jax._mask.pyramid import Level
from pinhole_jax._native.look import TouchedPixels
from pinhole_jax._numerics import threads
from pinhole_jax._outline.outline_errors import OutlineErrors
from pinhole_jax._scene.scene import ball_about
from pinhole_jax._solver.looks import Origin, Sums, View
from pinhole_jax._solver.moves import canonical
from pinhole_jax._solver.priors import no_others
from pinhole_jax._solver.solver import FAR_LEVEL, Solution, Solver

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
START = pj.Camera([3, 1, 0.8], [0, 0, 0], [0, 0, 1], 0.8, W=48, H=40)


@pytest.fixture(scope="module")
def honesty():
    """The experiment `honesty.py`, reduced."""
    sys.path.insert(0, str(EXPERIMENTS))
    try:
        spec = importlib.util.spec_from_file_location("honesty", EXPERIMENTS / "honesty.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(EXPERIMENTS))
    return module


@pytest.mark.long
@pytest.mark.parametrize(
    "shape", [full("plate"), full("box"), "mug", full("can"), full("ellipsoid"), full("dented")]
)
def test_no_fit_says_converged_and_is_wrong(honesty, shape, exhaustive):
    kinds = honesty.KINDS
    for number in range(12 if exhaustive else 1):
        rows = [honesty.trial(number, shape, kind) for kind in kinds]
        assert [r for r in rows if honesty.is_lie(r)] == []
        if shape in ("plate", "box"):  # and where the mask tells, the fit says so
            assert sum(r["status"] == "converged" for r in rows if r["start"]) > 0


@pytest.mark.long
def test_handle_that_only_the_mask_shows_is_not_taken_for_noise(honesty):
    row = honesty.trial(16, "mug", "noisy")
    assert not honesty.is_lie(row), row


@pytest.mark.long
@pytest.mark.parametrize(
    ("number", "shape", "kind"),
    [
        (19, "mug", "exact"),  # squares below what rounding may leave, and less still
        full(57, "mug", "8 bits"),  # ten facets on, each a minimum
        full(93, "mug", "one bit"),  # nearly the mug's axis, but not quite
        full(104, "mug", "noisy"),  # noise explains itself
        full(516, "dented", "exact"),  # a ball of facets is itself from sixty sides
        (905, "box", "one bit"),  # squares as of a right mask, but on the wrong side of a half
    ],
)
def test_fits_that_once_lied_are_honest(honesty, number, shape, kind):
    row = honesty.trial(number, shape, kind)
    assert not honesty.is_lie(row), row


@pytest.mark.full
def test_walk_leads_as_far_in_a_large_mask_as_in_a_small_one(honesty, monkeypatch):
    """Ten steps on the finest level moved the outline by ten pixels of 1024: that was 12.7 degrees
    off."""
    monkeypatch.setattr(honesty, "SIZE", 1024)
    row = honesty.trial(3, "ellipsoid", "one bit")
    assert row["degrees"] < 1, row
    assert row["status"] == "converged"


CAMERA = pj.Camera([0.3, 1.0, 5.0], [0.1, 0, 0], [0.2, 1, 0.1], 0.6, 1.0, 96, 80)


def mask_of(camera, scene):
    return drawn(camera, scene)


def degrees(fit, truth=CAMERA):
    return float(np.rad2deg(pj.pose_error(fit.camera, truth)[0]))


@pytest.mark.long
@pytest.mark.parametrize("degrees", [122, full(-75), full(40)])
def test_nearly_round_body_is_found_from_all_round_its_axis(degrees):
    """A ball with a dent: a turn about the dent shows facets alone, in valleys some degrees wide,
    and a hard mask of 800 px tells the right one from the others."""
    mesh = trimesh.creation.icosphere(subdivisions=3)
    dent = np.array([0.6, 0.64, 0.48])
    off = np.linalg.norm(mesh.vertices - dent, axis=1)
    vertices = mesh.vertices * (1 - 0.3 * np.exp(-((off / 0.35) ** 2)))[:, None]
    scene = pj.Scene(mesh=pj.Mesh(np.asarray(vertices, np.float32), np.asarray(mesh.faces)))
    side = np.cross(dent, [0, 0, 1]) / np.hypot(*dent[:2])
    pose = [np.asarray(x, np.float32) for x in (5.5 * side + 0.5 * dent, np.zeros(3), dent)]
    truth = pj.Camera(*pose, np.float32(0.6), 1.0, 800, 800)
    fit = pj.fit_camera(scene, drawn(truth, scene) > 0.5, turned(truth, dent, degrees))
    assert np.rad2deg(pj.pose_error(fit.camera, truth)[0]) < 0.3


@pytest.mark.long
@pytest.mark.parametrize("clipped", [False, True])
def test_noisy_mask_that_is_explained_is_not_searched(monkeypatch, clipped):
    """Noise is no misfit, wherever in the image it is: one descent finds the camera."""
    monkeypatch.setattr(strategy, "searched", pytest.fail)
    scene = pj.Scene(mesh=shapes.bumpy(3))
    image = mask_of(CAMERA, scene)
    for seed in range(3):
        noise = 0.02 * np.random.default_rng(seed).normal(size=image.shape)
        target = np.clip(image + noise, 0, 1) if clipped else image + noise
        fit = pj.fit_camera(scene, target, turned(CAMERA, [1, 2, 3], 8))
        assert fit.status == "converged"
        assert degrees(fit) < 1


@pytest.mark.long
def test_noisy_mask_of_a_box_is_as_ambiguous_as_an_exact_one():
    box = trimesh.creation.box((1.2, 1.32, 1.05))
    scene = pj.Scene(mesh=pj.Mesh(box.vertices, box.faces))
    mask, noise = mask_of(CAMERA, scene), np.random.default_rng(0).normal(size=(80, 96))
    for target in (mask, mask + 0.02 * noise, mask > 0.5):
        fit = pj.fit_camera(scene, target, None, phi=0.6)
        assert fit.status == "ambiguous"
        assert len(fit.modes) == 3
        assert min(map(degrees, (fit, *fit.modes))) < 1


@pytest.mark.long
def test_faceted_body_fits_as_well_one_facet_on():
    """The start is nearer to a camera one facet on: the mask cannot tell."""
    torus = trimesh.creation.torus(1.0, 0.35, major_sections=32, minor_sections=16)
    scene = pj.Scene(mesh=pj.Mesh(torus.vertices, torus.faces))
    mask = mask_of(CAMERA, scene)
    for target in (mask, mask > 0.5):
        fit = pj.fit_camera(scene, target, turned(CAMERA, [0, 0, 1], 9))
        assert fit.status in ("rank_deficient", "ambiguous")
        assert fit.modes or "the turn about the axis" in fit.weak[0]


@pytest.mark.long
@pytest.mark.parametrize("kind", ["one bit", full("blurred"), full("eroded")])
def test_contours_within_the_object_are_no_outline(kind):
    torus = trimesh.creation.torus(1.0, 0.35, major_sections=32, minor_sections=16)
    scene = pj.Scene(mesh=pj.Mesh(torus.vertices, torus.faces))
    camera = pj.Camera([3.0, 3.5, 2.0], [0.1, 0, 0], [0, 0, 1], 0.6, 1.0, 96, 80)
    mask = mask_of(camera, scene)
    target = {
        "one bit": mask > 0.5,
        "blurred": gaussian_filter(mask, 0.8),
        "eroded": binary_erosion(mask > 0.5),
    }[kind]
    fit = pj.fit_camera(scene, target, turned(camera, [1, 2, 3], 4))
    assert not any("far from the mask's edge" in words for words in fit.weak)


@pytest.mark.long
def test_sigma_does_not_fall_below_rounding():
    """Exact masks in float32: errors are a few standard errors at most."""
    scene = pj.Scene(mesh=shapes.bumpy(3))
    single = jax.tree.map(lambda x: x.astype(jnp.float32), CAMERA)
    mask = mask_of(single, pj.Scene(mesh=shapes.bumpy(3)))
    errors = []
    for k, axis in enumerate(np.eye(3)):
        start = turned(CAMERA, axis + 0.1, 8, 1 + 0.02 * k)
        fit = pj.fit_camera(scene, mask, jax.tree.map(lambda x: x.astype(jnp.float32), start))
        angle, shift = map(float, pj.pose_error(fit.camera, single))
        errors += [angle / np.linalg.norm(fit.std[:3]), shift / np.linalg.norm(fit.std[3:])]
    assert max(errors) < 4


@pytest.mark.long
def test_hard_mask_on_the_grid_leaves_a_sigma():
    """Its right camera leaves no residual at all, and still is not known better than to a part of
    a pixel."""
    box = trimesh.creation.box((1, 1, 1))
    scene = pj.Scene(mesh=pj.Mesh(box.vertices, box.faces))
    camera = pj.Camera([0, 0, 4.5], [0, 0, 0], [0, 1, 0], 2 * np.arctan(0.125 * 5), 1.0, 80, 80)
    fit = pj.fit_camera(scene, mask_of(camera, scene) > 0.5, camera, ("position",))
    px = 4 / 64  # at the front face
    assert np.all(fit.std[:2] > 0.005 * px)


@pytest.mark.long
@pytest.mark.parametrize("sides", [5, 6, full(7)])
def test_nut_fits_as_well_one_side_on(sides, monkeypatch):
    """Neighbours of the start, none of them half a turn away; the same on any number of cores, on
    which looks and descents are worked out ahead."""
    nut = trimesh.creation.cylinder(radius=1, height=0.8, sections=sides)
    scene = pj.Scene(mesh=pj.Mesh(np.asarray(nut.vertices, float), np.asarray(nut.faces)))
    camera = pj.Camera([0.5, 4.0, 3.0], [0, 0, 0], [0, 0, 1], 0.6, 1.0, 96, 80)
    half = np.pi / sides
    start = turned(camera, [0, 0, 1], np.rad2deg(0.8 * half))
    for mask in (mask_of(camera, scene), mask_of(camera, scene) > 0.5):
        monkeypatch.setattr(threads, "usable_cores", lambda: 1)
        alone = pj.fit_camera(scene, mask, start)
        monkeypatch.setattr(threads, "usable_cores", lambda: 3)
        fit = pj.fit_camera(scene, mask, start)
        assert fit.status == "ambiguous"
        views = [[f.camera.e for f in (x, *x.modes)] for x in (fit, alone)]
        np.testing.assert_array_equal(*views)
        off = [pj.pose_error(f.camera, camera)[0] for f in (fit, *fit.modes)]
        assert min(off) < 0.02


@pytest.mark.full
def test_prior_and_start_decide_the_view_of_a_round_body():
    """The front page's cup: half a turn on, the prior and the mask are as content."""
    profile = np.array([[0.0, 0], [0.55, 0], [1, 0.17], [0.43, 0.35], [0.54, 0.95], [0, 0.9]])
    scene = pj.Scene(mesh=shapes.revolved(profile, sections=32))
    camera = pj.Camera([0, -3.1, 4.9], [0.1, 0, 0.3], [0, 0, 1], 0.5, 1.0, 96, 80)
    start = turned(camera, [1, 0, 0], 7)
    mask = mask_of(camera, scene) > 0.5
    fit = pj.fit_camera(scene, mask, start, prior={"e_x": (0.0, 1e-3)})
    assert fit.status == "converged", fit
    assert pj.pose_error(fit.camera, camera)[0] < 0.03
    assert pj.fit_camera(scene, mask, start).status == "rank_deficient"
    # A drawn mask is searched from all sides: the start says all the same which one it is.
    for seed in (0, 1):
        drawn = wavy(mask_of(camera, scene), np.random.default_rng(seed), 0.7, 10.0)
        fit = pj.fit_camera(scene, drawn, start, prior={"e_x": (0.0, 1e-3)})
        assert fit.status in ("converged", "uncertain"), fit
        assert pj.pose_error(fit.camera, camera)[0] < min(2 * np.max(fit.std[:3]), 0.1)


class Drawn(Candidate):
    """A candidate for a mask that a person drew."""

    errors = OutlineErrors(1.0, 5.0, 0.0, 20.0, np.eye(6))


@pytest.mark.parametrize(
    ("logs", "anywhere", "expected"),
    [
        ([0.0, 1.0, -30.0], True, [1, 0]),
        ([-30.0, 1.0, 0.0], True, [1, 2]),
        ([0.0, 0.1, -3.0], False, [1, 0, 2]),  # equal: the nearest to the start stands first
        ([10.0, 0.0, 0.0], False, [0]),
        ([0.0, 0.0, 3.0], False, [2, 1, 0]),  # 30 degrees from the start are 2 less
    ],
)
def test_likeliest_candidates_stand_first(logs, anywhere, expected):
    cameras = [turned(START, [0, 0, 1], degrees, 1.0) for degrees in (8, 4, 30)]
    none, near = np.zeros(0, bool), Walked(0.0)
    candidates = [
        Drawn(Solution(c, seen(), ()), seen(), Account(log, 1, 5, none, none, 0), near, near)
        for c, log in zip(cameras, logs, strict=True)
    ]
    kept = likeliest(candidates, 3, None if anywhere else START)
    assert [candidates.index(c) for c in kept] == expected


def seen(prior=0.0, sums=None) -> View:
    """A view that knows its squares alone, and shows no outline."""
    parts = np.zeros(0), np.zeros(0), sums or like(Sums), *[np.zeros(0)] * 3
    return View(*parts, prior, Blank())


class Blank(Origin):
    """Where a look showed no outline."""

    level = like(Level)._replace(origin=np.zeros(2))
    pixels = TouchedPixels(*[np.zeros(0)] * 7)

    def __init__(self):
        """Nothing is known of the look."""


class Walked(Solver):
    """A solver of six levels that descends nowhere, and says which level it was asked on; views
    leave as many squares as they are told."""

    levels: ClassVar[list[Level]] = [like(Level)._replace(scale=32.0 * 2**k) for k in range(6)]

    def __init__(self, squares, exact=False, others=None):
        ball = ball_about(np.array([[-1.0] * 3, [1.0] * 3]))
        kind = Kind("one bit", 1 / 12, 0.1, 0.05, exact)
        subject = SimpleNamespace(ball=ball)
        vars(self).update(kind=kind, subject=subject, max_steps=64, prior=None, others=others)
        vars(self).update(squares=squares, asked=[], target=np.zeros((1, 1)), weights=None)

    def look(self, unit, number=-1):
        return seen(0.1, like(Sums)._replace(touched=300.0, touched_squares=0.1))

    def descents(self, units, steps, number=-1):
        for unit in units:
            self.asked.append(number)
            yield Solution(unit, seen(self.squares), (1,))


@pytest.mark.parametrize(
    ("squares", "degrees", "asked"),
    [
        (0.12, 9, [FAR_LEVEL, -1]),  # another place, perhaps as good: the finest level says
        (0.12, 0.1, [FAR_LEVEL]),  # back at the best
        (np.nan, 9, [FAR_LEVEL]),  # a lens that folds
    ],
)
def test_walk_in_a_large_mask_ends_on_the_finest_level(squares, degrees, asked):
    solver, best = Walked(squares), Solution(canonical(START), seen(), ())
    start = canonical(turned(START, [0, 0, 1], degrees, 1.0))
    found, again = places._led_to(solver, best, [start, start])
    assert solver.asked == [*asked, FAR_LEVEL]
    assert (found is not None) == (asked[-1] == -1)
    assert again is None  # known by now, or no view


def test_walk_in_an_exact_mask_stays_on_the_finest_level():
    solver = Walked(0.12, exact=True)
    best = Solution(canonical(START), seen(), ())
    assert None not in list(places._led_to(solver, best, [canonical(START)]))
    assert solver.asked == [-1]


def test_information_of_other_views_counts_on_the_finest_level():
    assert Walked(0.12).far == FAR_LEVEL
    among_others = Walked(0.12, others=no_others(("pose",), np.dtype(float)))
    assert among_others.far == among_others.finest


@pytest.mark.parametrize(("shown", "walks"), [(0.05, 1), (0.3, 0), (np.nan, 0)])
def test_direction_that_shows_little_is_walked_along(shown, walks):
    solver = Walked(0.12)
    vars(solver).update(freed=("pose",))
    triangle = np.diag([shown, 1, 1, 1, 1, 1])
    view = replace(solver.look(None), triangle=triangle, scale=np.ones(6))
    assert len(places._doubtful(solver, Solution(canonical(START), view, ()))) == walks
