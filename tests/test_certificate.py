"""The certificate passes what is right, and names the row where a fault was planted."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chosen import full
from jax.custom_derivatives import linear_call
from jax.lax import stop_gradient
from jax.tree_util import Partial
from oracles import balls, drawn, lump, single, usual_camera
from refusals import refusal, refuses

import pinhole_jax as pj

W, H = 32, 24


CAMERA = usual_camera(W, H).replace(d=1.3)
SCENE = balls([[1.2, 0.9, 0], [-0.8, -0.5, 0.5]], [0.3, 0.6])
SINGLE = single((CAMERA, SCENE))


def verdicts(certificate):
    return {row.parameter: row.verdict for row in certificate.rows}


def failures(certificate):
    return {k: v for k, v in verdicts(certificate).items() if v not in ("ok", "moves nothing")}


def blob(camera, scene):
    """A smooth image that compiles in no time: a light at a vertex or a sphere's center."""
    point = scene.spheres.centers[0] if scene.mesh is None else scene.mesh.vertices[0]
    x, y = jnp.moveaxis(pj.project(camera, point), -1, 0)
    column = jnp.arange(W, dtype=x.dtype) + 0.5
    row = H - 0.5 - jnp.arange(H, dtype=x.dtype)
    return jnp.exp(-((column[None] - x) ** 2 + (row[:, None] - y) ** 2) / 40)


def flawed(flaws, camera, scene):
    """The blob with flaws that are data, so that all share one program: a kink of this height where
    the eye's x has a value; too steep a slope there; a share of the camera's derivatives alone."""
    at, kink, steep, share = flaws
    x, known = camera.e[0], lambda v: share * v + (1 - share) * stop_gradient(v)
    image = blob(jax.tree.map(known, camera), scene) + kink * jnp.abs(x - at)
    return image + steep * (x - stop_gradient(x))


def certified(camera=CAMERA, scene=SCENE, x=9.0, kink=0.0, steep=0.0, share=1.0, **more):
    image = Partial(flawed, jnp.array([x, kink, steep, share]))
    return pj.check_gradients(camera, scene, image, verbose=False, **more)


@pytest.mark.full
def test_silhouette_of_a_bumpy_mesh_through_a_lens_passes(capsys):
    found = pj.check_gradients(CAMERA.replace(lens=pj.Lens([17.0, 11.0], 1.1)), lump(3))
    assert found.passed, found
    axes = [f"{name}.{axis}" for name in "epu" for axis in "xyz"]
    lens = ["principal_point.x", "principal_point.y", "aspect"]
    assert list(verdicts(found)) == [*axes, "phi", "d", *lens, "vertices #1", "vertices #2"]
    # d moves nothing, and neither does u along the view's own projection of it.
    assert {k for k, v in verdicts(found).items() if v != "ok"} <= {"d", "u.z", "p.z"}
    assert all(row.error < 1e-7 and row.reverse < 1e-12 for row in found.rows)
    assert capsys.readouterr().out == f"{found}\n"


@pytest.mark.long
def test_silhouette_of_spheres_in_float32_passes():
    """Held against differences in float64, which x64 allows."""
    found = pj.check_gradients(*SINGLE, image, verbose=False)
    assert found.passed, found
    assert {"centers #1", "radii #1"} < set(verdicts(found))
    assert 1e-9 < max(row.error for row in found.rows) < 1e-4
    assert max(row.step for row in found.rows) < 1e-5


def test_float32_without_x64_takes_longer_steps():
    with jax.enable_x64(False):
        found, failed = (certified(*SINGLE, share=share) for share in (1.0, 0.0))
    assert found.passed, found
    assert min(row.step for row in found.rows) > 1e-4
    assert {"e.x", "p.y", "phi"} < set(failures(failed))


def image(camera, scene):
    """The spheres are apart: less to compile."""
    return pj.silhouette(camera, scene, overlaps=False)


@jax.custom_jvp
def planted(gains, camera, scene):
    """A silhouette with a fault: its derivatives by the camera, those of pixels in forward mode,
    and in reverse mode are multiplied by `gains`: 1 is right, -1 a flipped sign, 0 a lost piece."""
    return image(camera, scene)


@planted.defjvp
def _(primals, tangents):
    (rates, *pixels), camera, scene = primals
    velocity = jax.tree.map(jnp.multiply, rates, tangents[1])
    value, change = jax.jvp(image, (camera, scene), (velocity, tangents[2]))
    times = lambda mode: lambda gains, x: gains[mode] * x
    return value, linear_call(times(0), times(1), pixels, change)


def faulty(parameters=(), pixel=(), forward=1.0, reverse=1.0):
    """Return the certificate of a fault in some parameters, or in a pixel. (Gains are data: all
    faults share one compiled program.)"""
    rates = jax.tree.map(jnp.ones_like, CAMERA)
    for name, gain in parameters:
        rates = eqx.tree_at(lambda c, name=name: getattr(c, name), rates, jnp.asarray(gain, float))
    pixels = [jnp.ones((H, W)).at[pixel].set(gain) for gain in (forward, reverse)]
    wrong = Partial(planted, (rates, *pixels))
    return pj.check_gradients(CAMERA, SCENE, wrong, verbose=False)


@pytest.fixture(scope="module")
def weak_pixel():
    """A pixel of the outline that a sphere covers by no more than a tenth."""
    cover = drawn(CAMERA, SCENE)
    return tuple(int(i) for i in np.argwhere((cover > 0.02) & (cover < 0.1))[0])


@pytest.mark.long
@pytest.mark.parametrize("name", ["e", "phi", *(full(name) for name in "pu")])
def test_flipped_sign_is_caught_and_named(name):
    """Of one coordinate, or of phi; no other row is accused."""
    vector = name != "phi"
    found = faulty([(name, [-1.0, 1, 1] if vector else -1.0)])
    assert not found.passed
    assert failures(found) == {f"{name}.x" if vector else name: "wrong derivative"}
    (row,) = (row for row in found.rows if row.verdict == "wrong derivative")
    np.testing.assert_allclose(row.derivative, -row.difference, rtol=1e-6)
    np.testing.assert_allclose(row.error, 2, rtol=1e-6)


MOVING = {"e.x", "p.y", "u.x", "phi", "centers #1", "radii #1"}


@pytest.mark.long
@pytest.mark.parametrize("gain", [-1.0, 0.0])
def test_sign_flipped_in_one_pixel_is_caught(weak_pixel, gain):
    """Or a lost piece: forward and reverse agree, and no sum over hundreds of pixels would tell."""
    found = faulty(pixel=weak_pixel, forward=gain, reverse=gain)
    wrong = [row for row in found.rows if row.verdict == "wrong derivative"]
    assert {row.parameter for row in wrong} == set(failures(found)) >= MOVING
    assert {row.pixel for row in wrong} == {weak_pixel}
    assert wrong[0].derivative == pytest.approx(gain * wrong[0].difference, abs=1e-9)
    assert abs(wrong[0].difference) > 1e-3


@pytest.mark.long
@pytest.mark.parametrize(
    "gains, verdict",
    [
        ({"reverse": 0.0}, "reverse differs"),
        ({"forward": np.nan}, "not finite"),
        ({"reverse": np.nan}, "not finite"),
    ],
)
def test_modes_that_differ_and_nan_are_failures(weak_pixel, gains, verdict):
    found = faulty(pixel=weak_pixel, **gains)
    assert not found.passed
    assert set(failures(found).values()) == {verdict}
    assert set(failures(found)) >= MOVING


@pytest.mark.long
def test_parameter_whose_derivative_is_nan_is_named():
    assert failures(faulty([("phi", np.nan)]))["phi"] == "not finite"


@pytest.mark.long
@pytest.mark.parametrize(
    "wrong, verdict",
    [
        (lambda c, s: jnp.log(-blob(c, s)), "not finite"),
        # Out of the frame derivatives and differences are all 0: that proves nothing.
        (lambda c, s: jnp.zeros((H, W)), "moves nothing"),
    ],
)
def test_image_that_is_not_finite_or_does_not_move_fails(wrong, verdict):
    found = pj.check_gradients(CAMERA, SCENE, wrong, verbose=False)
    assert set(verdicts(found).values()) == {verdict}
    assert not found.passed
    assert ("FAILED: nothing moves the image" in str(found)) == (verdict == "moves nothing")


def test_camera_at_a_kink_is_undecided():
    """The derivative lies between the slopes to either side, which says little: no pass."""
    found = certified(x=0.3, kink=1.0)
    assert failures(found) == {"e.x": "undecided"}
    assert found.rows[0].kinks == W * H
    assert not found.passed
    assert str(found).startswith("UNDECIDED: at a kink in e.x; move the camera a little\n")
    assert failures(certified(x=0.3, kink=1.0, steep=2.0)) == {"e.x": "wrong derivative"}


@pytest.mark.parametrize("steps", [0.9, 0.6, 0.3, -0.2])
def test_kink_beside_the_camera_is_no_fault(steps):
    """A smaller step does not meet it, and the slope at the camera itself is found."""
    step = certified().rows[0].step
    beside = {"x": 0.3 + steps * step, "kink": 1.0}
    found = certified(**beside)
    assert found.passed, found
    assert found.rows[0].kinks == 0
    assert failures(certified(**beside, steep=0.01)) == {"e.x": "wrong derivative"}


def test_certificate_prints_as_a_table():
    lines = str(certified(share=0.0, directions=1)).split("\n")
    assert lines[0].startswith("FAILED: 9 of 13 derivatives (e.x, e.y, e.z, p.x,")
    assert lines[1].split() == [*pj.Certificate.__annotations__["rows"].__args__[0]._fields]
    assert len(lines) == 2 + 13
    at = lines[1].index("verdict")
    assert {line[at:] for line in lines[2:]} == {"ok", "wrong derivative", "moves nothing"}
    assert str(certified(directions=3)).startswith("passed: 17 derivatives, forward and reverse\n")


test_bad_input_is_refused = refuses(
    pj.check_gradients,
    {"camera": CAMERA, "scene": SCENE, "image": blob, "verbose": False},
    {
        r"`image`: .* \(24, 32\), got .*\(32, 24\)": {"image": lambda c, s: jnp.zeros((W, H))},
        "`image`: .* got int64 of shape": {"image": lambda c, s: jnp.zeros((H, W), int)},
        "`image`: .* got tuple": {"image": lambda c, s: (c.phi,)},
        "`tolerance`: expected a positive number, got 0.0": {"tolerance": 0.0},
        "`directions`: expected an integer of at least 1, got 0": {"directions": 0},
    },
)


def test_traced_input_is_refused():
    with refusal("`camera`: expected values, got traced ones"):
        eqx.filter_jit(lambda c: pj.check_gradients(c, SCENE, verbose=False).passed)(CAMERA)
