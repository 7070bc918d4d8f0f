"""Many views with shared intrinsics, and derivatives through one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from arm import check_slope, numbers_of
from chosen import full
from numpy.random import default_rng
from numpy.testing import assert_allclose
from oracles import body, camera_anywhere, drawn, lump, normal, turned
from refusals import refusal, refuses
from results import check_found, degrees
from test_alike import can, handle

import pinhole_jax as pj

SCENE = lump(3)


TRUTHS = [camera_anywhere(k) for k in range(3)]
STARTS = [turned(c, 5, 1.03, 1.04) for c in TRUTHS]


@pytest.fixture(scope="module")
def masks():
    return [drawn(c, SCENE) for c in TRUTHS]


def noisy(masks):
    random = default_rng(0)
    return [m + 0.02 * random.normal(size=m.shape) for m in masks]


@pytest.mark.parametrize("wrong", [lambda m: np.roll(m, 2, 1), lambda m: m > 0.1])
def test_wrong_mask_among_exact_ones_leaves_no_trace(masks, wrong):
    """Others were 16 to 24 sigma off by what is shared."""
    fits = pj.fit_cameras(SCENE, [masks[0], wrong(masks[1]), masks[2]], STARTS)
    assert [fits[k].status for k in (0, 2)] == ["converged"] * 2
    assert max(degrees(fits[k], TRUTHS[k]) for k in (0, 2)) < 1e-4
    assert abs(float(fits[0].camera.phi) - 0.6) < 4 * fits[0].std[-1]


def test_view_with_another_lens_widens_what_all_share(masks):
    """(Before: all `converged` without a word, a zoomed one as far off as 33 sigma.)"""
    zoomed = TRUTHS[2].replace(phi=0.84)
    seen = [mask > 0.5 for mask in (*masks[:2], drawn(zoomed, SCENE))]
    *others, odd = pj.fit_cameras(SCENE, seen, STARTS)
    assert all("what cameras share" in fit.weak[-1] for fit in (*others, odd))
    assert odd.status == "misfit"
    assert abs(float(odd.camera.phi) - 0.6) < 4 * odd.std[-1]


def test_shared_intrinsics_from_exact_masks(masks):
    fits = pj.fit_cameras(SCENE, masks, STARTS)
    assert [(f.status, f.modes, f.names[-1]) for f in fits] == [("converged", (), "phi")] * 3
    assert max(map(degrees, fits, TRUTHS)) < 1e-9
    (phi,) = {float(fit.camera.phi) for fit in fits}
    assert abs(phi - 0.6) < 1e-9


@pytest.mark.long
def test_views_without_a_start_have_the_lens_that_is_known():
    lens = pj.Lens([60, 33], 1.05)
    cameras = [camera.replace(lens=lens) for camera in TRUTHS[:2]]
    fits = pj.fit_cameras(SCENE, images(cameras, SCENE), None, phi=0.6, lens=lens)
    assert {fit.status for fit in fits} == {"converged"}
    assert max(map(degrees, fits, cameras)) < 1e-6


# --- what one view's mask leaves open ------------------------------------------------------------


def seen_from(eyes):
    return [pj.Camera(e, [0.1, 0, 0], [0.1, 0.2, 1], 0.6, 1.0, 128, 128) for e in eyes]


BOX = body(trimesh.creation.box((1.2, 1.32, 1.05)))
OF_BOX = seen_from([(3.0, -3.0, 2.5), (-2.0, 3.5, 2.0), (1.0, 4.0, -2.5)])


MUG = body(can(24) + handle(0.85, major_sections=12, minor_sections=8))
OF_MUG = seen_from([(-4.8, 0.3, 1.5), (0.5, -4.9, 1.2)])


def images(cameras, scene):
    return [drawn(camera, scene) for camera in cameras]


@pytest.mark.long
@pytest.mark.parametrize("hard", [False, full(True)])
def test_box_is_as_ambiguous_among_views_as_alone(hard):
    masks = [m > 0.5 if hard else m for m in images(OF_BOX, BOX)]
    for fit, camera in zip(pj.fit_cameras(BOX, masks, None, phi=0.6), OF_BOX, strict=True):
        assert (fit.status, len(fit.modes)) == ("ambiguous", 3)
        fits = fit, *fit.modes
        assert min(degrees(f, camera) for f in fits) < 0.1
        assert np.all(np.isfinite([f.std for f in fits]))


def test_start_rules_out_distant_cameras():
    starts = [turned(c, 4, 1.02) for c in OF_BOX[:2]]
    fits = pj.fit_cameras(BOX, images(OF_BOX[:2], BOX), starts)
    assert [(fit.status, fit.modes) for fit in fits] == [("converged", ())] * 2
    assert max(map(degrees, fits, OF_BOX)) < 1e-6


@pytest.mark.long
def test_hidden_handle_leaves_the_rotation_of_its_view_free():
    masks = [m > 0.5 for m in images(OF_MUG, MUG)]
    hidden, shown = pj.fit_cameras(MUG, masks, [turned(c, 4) for c in OF_MUG])
    assert hidden.status == "rank_deficient"
    assert "rotation about the axis (0.00, 0.00, 1.00)" in hidden.weak[0]
    assert np.all(np.isinf(hidden.std[:3]) | (hidden.std[:3] > np.deg2rad(5)))
    check_found(shown, OF_MUG[1], 1)
    for fit in pj.fit_cameras(MUG, masks, None, phi=0.6):
        assert fit.status in ("rank_deficient", "ambiguous")


@pytest.mark.long
def test_views_help_each_other_and_the_covariance_knows(masks):
    fits = pj.fit_cameras(SCENE, noisy(masks), STARTS)
    pairs = zip(noisy(masks), STARTS, strict=True)
    alone = [pj.fit_camera(SCENE, *pair, ("pose", "phi")) for pair in pairs]
    assert all(f.status == "converged" for f in fits)
    phi = [f.std[-1] for f in fits]
    assert_allclose(phi, phi[0], rtol=1e-6)
    together = sum(f.std[-1] ** -2.0 for f in alone) ** -0.5
    assert 0.9 < phi[0] / together < 1.1  # information adds up
    assert abs(float(fits[0].camera.phi) - 0.6) < 4 * phi[0]
    assert np.all(np.array([f.std for f in fits]) < 1.05 * np.array([f.std for f in alone]))


@pytest.mark.long
def test_view_with_outliers_is_named_and_spoils_no_other(masks):
    """Of one mask a stretch is cut off: believed, it is 22 degrees off, the others a degree."""
    seen, said = [mask > 0.5 for mask in masks], []
    edge = np.flatnonzero(np.any(seen[1], axis=0))[-1]
    seen[1][20:58, edge - 14 :] = False
    fits = pj.fit_cameras(SCENE, seen, STARTS, progress=said.append)
    assert [f.status for f in fits] == ["converged", "misfit", "converged"]
    named = ["far from the mask's edge" in " ".join(f.weak) for f in fits]
    assert named == [False, True, False]
    assert max(map(degrees, fits, TRUTHS)) < 0.6
    assert all(abs(float(f.camera.phi) - 0.6) < 2 * f.std[-1] for f in fits)
    assert {len(f.history) - 1 for f in fits} == {len(said)} == {len(fits[0].steps)}
    assert said[-1].startswith("3 views: ")
    assert said[-1].endswith(" steps, 0 levels left")


@pytest.mark.long
@pytest.mark.parametrize("free, off", [("position", 0.05), ((), 0.0)])
def test_partly_free_and_frozen_poses(masks, free, off):
    """The cameras' orientations, or all of their poses, are known."""
    starts = [c.replace(e=c.e + off, p=c.p + off, phi=0.62) for c in TRUTHS[:2]]
    names = ("e_x", "e_y", "e_z", "phi") if free else ("phi",)
    fits = pj.fit_cameras(SCENE, masks[:2], starts, free=free)
    for fit, camera in zip(fits, TRUTHS, strict=False):
        assert (fit.status, fit.names) == ("converged", names)
        assert_allclose(fit.camera.e, camera.e, atol=1e-9)
        assert abs(float(fit.camera.phi) - 0.6) < 1e-9


@pytest.mark.long
@pytest.mark.parametrize("known", [None, {"phi": (0.604, 0.004), "e_x": (1.0, 3.0)}])
def test_single_view_equals_fit_camera(masks, known):
    mask = noisy(masks)[0]
    (one,) = pj.fit_cameras(SCENE, [mask], STARTS[:1], prior=known)
    fit = pj.fit_camera(SCENE, mask, STARTS[0], ("pose", "phi"), prior=known)
    assert_allclose(one.camera.e, fit.camera.e, atol=1e-6 if known is None else 1e-4)
    assert_allclose(one.std, fit.std, rtol=2e-3)
    pixels = [np.diag(x.independent_covariance) for x in (one, fit)]
    assert_allclose(*pixels, rtol=4e-3)


@pytest.mark.parametrize("several", [False, True])
def test_prior_that_masks_contradict_is_a_misfit(masks, several):
    hard = [mask > 0.5 for mask in masks]
    for mean, status in {0.6: "converged", 0.8: "misfit"}.items():
        known = {"phi": (mean, 0.002)}
        if several:
            fit, *_ = pj.fit_cameras(SCENE, hard, STARTS, prior=known)
        else:
            fit = pj.fit_camera(SCENE, hard[0], STARTS[0], ("pose", "phi"), prior=known)
        told = any("the prior of phi" in note for note in fit.weak)
        assert (fit.status, told) == (status, status == "misfit")


test_bad_input_is_refused = refuses(
    pj.fit_cameras,
    {"scene": BOX, "targets": np.zeros((3, 80, 96)), "cameras": STARTS},
    {
        "`targets`: expected at least one mask": {"targets": []},
        "`phi`: expected None with `cameras`": {"phi": 0.6},
        "`cameras`: expected one for each of 3 masks, got 1": {"cameras": STARTS[:1]},
        "`weights`: expected one for each of 3 masks, got 1": {"weights": [None]},
        "`shared`: expected names among phi, d": {"shared": "pose", "free": "phi"},
        "`shared`: expected names among .* got 'zoom'": {"shared": "zoom"},
    },
)

# --- through the fit -----------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("kind, tolerance", [("exact", 1e-4), full("noisy", 1e-2), ("hard", 3e-2)])
def test_derivative_by_the_mesh_equals_refits(masks, kind, tolerance):
    """A fit stops within its tolerance, and the second derivatives of coverage jump."""
    target = {"exact": masks[0], "noisy": noisy(masks)[0], "hard": masks[0] > 0.5}[kind]
    start = eqx.tree_at(lambda c: c.phi, STARTS[0], TRUTHS[0].phi)

    def eye(vertices):
        moved = body(vertices, np.asarray(SCENE.mesh.faces))
        return pj.fit_camera(moved, target, start).camera.e

    vertices = SCENE.mesh.vertices
    wrong = 0.01 * jnp.asarray(normal(vertices.shape, 1))
    check_slope(eye, [vertices], [wrong], 1e-3, tolerance)


@pytest.mark.full
@pytest.mark.parametrize("free", ["pose", "position"])
def test_views_move_with_masks_and_weights_as_refits_do(masks, free):
    """Of two views, both of whose masks and one of whose weights change."""
    starts = STARTS[:2] if free == "pose" else [c.replace(phi=0.61) for c in TRUTHS[:2]]

    def answer(a, b, weight):
        given = {"weights": [weight, None], "outlier_px": None}
        return numbers_of(pj.fit_cameras(SCENE, [a, b], starts, free=free, **given))

    random = default_rng(2)
    inputs = [*map(jnp.asarray, noisy(masks[:2])), jnp.ones((80, 96))]
    velocity = [jnp.asarray(random.normal(size=(80, 96))) for _ in inputs]
    check_slope(answer, inputs, velocity, 1e-4, 1e-3)


def test_priors_on_views_are_not_differentiated(masks):
    fit = lambda t: pj.fit_cameras(SCENE, [t], STARTS[:1], prior={"phi": (0.6, 0.1)})[0].camera.phi
    with refusal("`prior`: expected none where the fit is diff"):
        jax.grad(fit)(jnp.asarray(masks[0]))
