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


def test_covariance_equals_that_of_one_dense_matrix(three):
    """All residuals' derivatives by all unknowns side by side; what is known of some among them."""
    views, _, starts = three
    known = {"phi": (0.61, 0.002), "e_x": (0.0, 3.0)}
    problem = joint_problem(views, starts, "pose", outlier_px=2.0, prior=known, shared="phi")
    assert (problem.size, len(problem.priors)) == (19, 4)
    path = descend(problem, problem.start, lambda words: None, range(problem.levels, 0, -1))
    found = finish(problem, path, lambda words: None).found
    layout = found.problem
    seen, rows = found.descent.seen, []
    for k, one in enumerate(seen):
        rows.append(np.zeros((len(one.view.triangle), layout.size)))
        rows[-1][:, layout.columns(k)] = np.asarray(one.view.triangle) @ one.moves
    noise, state = layout.noise(seen), found.descent.state
    beliefs = np.zeros((4, layout.size))
    beliefs[0, layout.place("one", "phi")] = noise / 0.002
    for k, name in enumerate(NAMES):
        x = layout.place(name, "pose")[3:]
        beliefs[1 + k, x] = noise / 3 * state.poses[name][0, :3]
    whole = np.concatenate([*rows, beliefs])
    # (What phi follows of its own unknown, a logarithm of the focal length, a difference says.)
    step = np.zeros(layout.size)
    step[layout.place("one", "phi")] = h = 1e-6
    phi = lambda sign: float(layout.stepped(state, sign * step).lenses["three"].phi)
    slope = (phi(1) - phi(-1)) / (2 * h)
    whole[-4] *= slope
    inverse_normal = np.linalg.inv(whole.T @ whole)
    by_priors = inverse_normal @ whole[-4:].T @ whole[-4:] @ inverse_normal
    by_masks = np.zeros_like(inverse_normal)
    for k, (one, gradient) in enumerate(zip(seen, found.gradients, strict=True)):
        by = np.zeros((layout.size, len(gradient)))
        by[layout.columns(k)] = layout.weights[k] * one.moves.T
        by_masks += found.wider * inverse_normal @ by @ gradient @ by.T @ inverse_normal
    expected = by_masks + noise**2 * by_priors
    size = np.sqrt(np.diag(expected))
    close = lambda a, b, place: np.allclose(
        a / np.outer(size[place], size[place]),
        b[np.ix_(place, place)] / np.outer(size[place], size[place]),
        atol=1e-6,
    )
    everything = np.arange(layout.size)
    own = [np.append(layout.place(n, "pose"), layout.place("one", "phi")) for n in NAMES]
    assert all(close(found.covariance(x), expected, x) for x in (everything, *own))
    touched, squares = (
        sum(float(getattr(x.view.sums, name)) for x in seen)
        for name in ("touched", "touched_squares")
    )
    variance = squares / (touched - layout.size)
    told = variance * inverse_normal + (noise**2 - variance) * by_priors
    assert close(found.independent(everything), told, everything)


@pytest.mark.long
def test_groups_of_cameras_have_a_lens_each(scenes):
    truths = {f"{k}": lone(k, 0.6 if k < 2 else 0.7)[0] for k in range(4)}
    views = [pj.JointView(scenes[0], drawn(c, scenes[0]), camera=n) for n, c in truths.items()]
    starts = {n: lone(int(n), 0.65)[1] for n in truths}
    fit = pj.fit_joint(views, starts, shared={"phi": [("0", "1"), ("3", "2")]})
    assert fit.status == "converged"
    phi = {n: float(f.camera.phi) for n, f in fit.cameras.items()}
    assert phi["0"] == phi["1"] != phi["2"] == phi["3"]
    assert abs(phi["0"] - 0.6) < 1e-9
    assert abs(phi["2"] - 0.7) < 1e-9
    assert all(max(apart(f.camera, truths[n])) < 1e-7 for n, f in fit.cameras.items())
