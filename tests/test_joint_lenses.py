"""Joint fits of cameras that share a lens."""

import equinox as eqx
import numpy as np
import pytest
from arm import OFF, SIZE, apart
from oracles import drawn
from scipy.spatial.transform import Rotation
from scipy.stats import t

import pinhole_jax as pj
from pinhole_jax._camera.poses import at_pose, inverse, pose_of
from pinhole_jax._joint.door import joint_problem
from pinhole_jax._joint.levels import descend, finish
from pinhole_jax._solver import levenberg_marquardt

NAMES = ("one", "two", "three")


def lone(seed, phi):
    """Return a camera somewhere about the object, and one some degrees off it."""
    axes = Rotation.random(random_state=seed).as_matrix()
    camera = pj.Camera(-5 * axes[2], [0, 0, 0], axes[1], phi, 1.0, SIZE, SIZE)
    return camera, at_pose(camera, pose_of(camera) @ (OFF if seed else inverse(OFF)))


@pytest.fixture(scope="module")
def three(scenes):
    """Noisy masks by three cameras of one kind of lens, and starts."""
    random = np.random.default_rng(5)
    truths, starts = zip(*(lone(k, 0.6) for k in range(3)), strict=True)
    noise = lambda: 0.03 * random.normal(size=(SIZE, SIZE))
    views = [
        pj.JointView(scenes[0], drawn(camera, scenes[0]) + noise(), camera=name)
        for name, camera in zip(NAMES, truths, strict=True)
    ]
    off = [s.replace(phi=phi) for s, phi in zip(starts, (0.6, 0.62, 0.64), strict=True)]
    return views, dict(zip(NAMES, truths, strict=True)), dict(zip(NAMES, off, strict=True))


def test_cameras_that_share_phi_are_those_of_fit_cameras(three):
    """But for their error bars, which grow in a joint fit where views differ by chance."""
    views, truths, starts = three
    scene, masks = views[0].scene, [view.target for view in views]
    pj.fit_camera(scene, masks[0], starts["one"], ("pose", "phi"))
    programs = levenberg_marquardt.descended._cached._cache_size()
    fit = pj.fit_joint(views, starts, shared="phi")
    others = pj.fit_cameras(scene, masks, [*starts.values()])
    assert programs == levenberg_marquardt.descended._cached._cache_size()
    assert fit.status == "converged"
    assert len({float(f.camera.phi) for f in fit.cameras.values()}) == 1
    wider = fit.excess * t.ppf(0.975, 2) / 1.96 if fit.excess > 1 else 1.0
    for (name, one), other in zip(fit.cameras.items(), others, strict=True):
        assert one.names == other.names
        assert eqx.tree_equal(one.camera, other.camera)
        np.testing.assert_allclose(one.std, wider * other.std, rtol=1e-3)
        assert max(apart(one.camera, truths[name])) < 1
        assert (len(one.history), one.history[0].steps) == (len(one.steps) + 1, 0)
        assert max(apart(one.history[0].camera, starts[name])) < 1e-9
        assert max(apart(one.history[-1].camera, one.camera)) < 1e-9
    assert abs(float(fit.cameras["one"].camera.phi) - 0.6) < 4 * fit.cameras["one"].std[-1]


@pytest.mark.long
def test_groups_of_cameras_have_a_lens_each(scenes):
    truths = {f"{k}": lone(k, 0.6 if k < 2 else 0.7)[0] for k in range(4)}
    views = [pj.JointView(scenes[0], drawn(c, scenes[0]), camera=n) for n, c in truths.items()]
    starts = {n: lone(int(n), 0.65)[1] for n in truths}
    fit = pj.fit_joint(views, starts, shared={"phi": [("0", "1"), ("3", "2")]})
    assert fit.status == "converged"
    phi = [float(fit.cameras[n].camera.phi) for n in "0123"]
    assert len({*phi}) == 2
    np.testing.assert_allclose(phi, [0.6, 0.6, 0.7, 0.7], atol=1e-9)
    assert all(max(apart(f.camera, truths[n])) < 1e-7 for n, f in fit.cameras.items())


def test_covariance_equals_that_of_one_dense_matrix(three):
    """All residuals' derivatives by all unknowns side by side; what is known of some among them."""
    views, _, starts = three
    known, silent = {"phi": (0.61, 0.002), "e_x": (0.0, 3.0)}, lambda words: None
    problem = joint_problem(views, starts, "pose", outlier_px=2.0, prior=known, shared="phi")
    assert (problem.size, len(problem.priors)) == (19, 4)
    path = descend(problem, problem.start, silent, range(problem.levels, 0, -1))
    found = finish(problem, path, silent).found
    layout, seen, state = found.problem, found.descent.seen, found.descent.state
    noise, everything = layout.noise(found.descent), np.arange(layout.size)
    by = [x.moves @ np.eye(19)[layout.columns(k)] for k, x in enumerate(seen)]
    # (What phi follows of its own unknown, a logarithm of the focal length, a difference says.)
    lens, beliefs = layout.place("one", "phi"), np.zeros((4, 19))
    step = 1e-6 * (everything == lens)
    ends = [float(layout.stepped(state, x).lenses["three"].phi) for x in (step, -step)]
    beliefs[0, lens] = noise / 0.002 * (ends[0] - ends[1]) / 2e-6
    for k, name in enumerate(NAMES):
        beliefs[1 + k, layout.place(name, "pose")[3:]] = noise / 3 * state.poses[name][0, :3]
    rows = [np.asarray(x.view.triangle) @ moves for x, moves in zip(seen, by, strict=True)]
    whole = np.concatenate([*rows, beliefs])
    inverse = np.linalg.inv(whole.T @ whole)
    by_priors = inverse @ beliefs.T @ beliefs @ inverse
    roots = [w * inverse @ moves.T for w, moves in zip(layout.weights, by, strict=True)]
    by_masks = [found.wider * x @ g @ x.T for x, g in zip(roots, found.gradients, strict=True)]
    expected = sum(by_masks) + noise**2 * by_priors

    def check(actual, expected, place):
        size = np.sqrt(np.diag(expected))[place]
        off = actual - expected[np.ix_(place, place)]
        assert np.max(np.abs(off / np.outer(size, size))) < 1e-6

    own = [np.append(layout.place(name, "pose"), lens) for name in NAMES]
    for place in (everything, *own):
        check(found.by_masks.covariance(place), expected, place)
    total = lambda name: sum(float(getattr(x.view.sums, name)) for x in seen)
    variance = total("touched_squares") / (total("touched") - layout.size)
    told = variance * inverse + (noise**2 - variance) * by_priors
    check(found.by_pixels.covariance(everything), told, everything)
