"""A fit's file gives the fit back to the last bit, and words where it is none."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from folders import put
from numpy.testing import assert_array_equal
from oracles import single
from refusals import pairs, refusal
from results import fit_at

import pinhole_jax as pj
from pinhole_jax import formats, io

#: Thirds and roots have no short decimals.
LENS = pj.Lens([31.7, 24 + 1 / 3], 1 / 1.1, pj.BrownConrady(-0.01 / 3, 1e-3, 1e-4))
PLAIN = pj.Camera([1 / 3, 1.1, 5], [0.1, 0, 0], [0, 1, 0.1], np.sqrt(0.4), 1 / 7, 64, 48)
CAMERA = PLAIN.replace(lens=LENS)
#: What a file has for other readers.
WRITTEN_ONLY = {"std", "object_in_camera", "covariance_frame"}
STEP = {"camera": io.camera_to_dict(PLAIN), "W": 16, "H": 12, "steps": -1}


TINY = np.finfo(float).tiny / 8


def fit_of(camera, status="ambiguous", modes=()):
    covariance = [[0.1 / 3, -1e-17, np.nan], [-1e-17, TINY, -np.inf], [np.nan, -np.inf, np.inf]]
    return fit_at(
        camera,
        np.array(covariance),
        ("rotation_b1", "e_x", "phi"),
        status=status,
        rms=1 / 3,
        weak=("rotation about the axis (0.00, 1.00, 0.00)",),
        modes=tuple(modes),
        history=(pj.Progress(PLAIN, 16, 12, 0), pj.Progress(camera, 64, 48, 7)),
        unbelieved=np.array([[1 / 3, 2.0], [40.5, 17.25]]),
    )


def assert_equal(fit, other):
    jax.tree.map(lambda a, b: assert_array_equal(a, b, strict=True), fit, other)


def as_float32(fit):
    """Return the fit with cameras of float32, as if it had been made of one."""
    is_camera = lambda x: isinstance(x, pj.Camera)
    convert = lambda x: single(x) if is_camera(x) else x
    return jax.tree.map(convert, fit, is_leaf=is_camera)


FITS = {
    "all": fit_of(CAMERA, modes=[fit_of(PLAIN, "converged"), fit_of(CAMERA, "rank_deficient")]),
    "plain": fit_of(PLAIN, "converged")._replace(history=(), unbelieved=None),
    "non_finite": fit_of(CAMERA, "non_finite")._replace(
        covariance=np.full((3, 3), np.nan), rms=np.nan, iou=np.nan
    ),
    "nothing": fit_of(PLAIN)._replace(names=(), covariance=np.zeros((0, 0)), weak=()),
}
FITS["float32"] = as_float32(FITS["all"])


@pytest.mark.parametrize("fit", FITS.values(), ids=FITS)
def test_fit_comes_back_to_the_last_bit(fit, tmp_path):
    path = tmp_path / "deep" / "fit.json"
    io.save_fit(path, fit)
    assert_equal(io.load_fit(path), fit)
    assert_equal(io.fit_from_dict(io.fit_to_dict(fit)), fit)


def test_fit_file_is_strict_json_and_a_camera_file(tmp_path):
    path = tmp_path / "fit.json"
    fit = fit_of(CAMERA, modes=[fit_of(PLAIN)])
    io.save_fit(path, fit)
    data = json.loads(path.read_text(), parse_constant=pytest.fail)
    assert data == io.fit_to_dict(fit)
    std = {"rotation_b1": np.sqrt(0.1 / 3), "e_x": np.sqrt(TINY), "phi": None}
    assert data["fit"]["std"] == std
    assert data["fit"]["covariance"][2] == [None, "-Infinity", "Infinity"]
    for read in (io.load_camera, formats.read_one):
        assert jax.tree.all(jax.tree.map(np.array_equal, read(path), CAMERA))
    assert io.camera_from_dict(data["fit"]["modes"][0]).W == 64


def test_fit_that_is_not_finite_is_not_written(tmp_path):
    camera = eqx.tree_at(lambda c: c.phi, CAMERA, jnp.asarray(np.nan))
    with refusal("expected what JSON can hold"):
        io.save_fit(tmp_path / "x.json", fit_of(camera))
    assert not list(tmp_path.iterdir())


#: A field with its new value, and the error.
WRONG = {
    'schema = "pinhole_jax.fit/9"': "`schema`: expected one of pinhole_jax.fit/1, got",
    'status = "fine"': "`status`: expected one of converged, ambiguous",
    'dtype = "float16"': "`dtype`: expected one of float32, float64",
    'names = "phi"': "`names`: expected a list of texts, got 'phi'",
    'names = ["e_x", "phi"]': r"`covariance`: expected numbers of shape \(2, 2\)",
    'covariance = [["1"]]': r"`covariance`: expected numbers of shape \(3, 3\)",
    "covariance = [[1], 2, true]": r"`covariance`: expected numbers of shape \(3, 3\)",
    'rms = "small"': "`rms`: expected a number, got 'small'",
    "iou = []": r"`iou`: expected a number, got \[\]",
    "steps = [1.5]": r"`steps`: expected a list of counts, got \[1.5\]",
    "steps = [-1]": r"`steps`: expected a list of counts, got \[-1",
    "modes = [{}]": "`fit`: expected the field that `save_fit` writes",
    'history = [{"camera": {}}]': "`e`: expected a camera's field",
    'history = [{"W": 3}]': "`camera`: expected fields with names",
    f"history = [{json.dumps(STEP)}]": "`steps`: expected an integer of at least 0",
}


@pairs("change, words", WRONG)
def test_wrong_field_is_named(tmp_path, change, words):
    data, (field, value) = io.fit_to_dict(fit_of(CAMERA)), change.split(" = ")
    data["fit"][field] = json.loads(value)
    path = put(tmp_path, "fit.json", json.dumps(data))
    with refusal(f"{words}.*fit.json.*"):
        io.load_fit(path)


@pytest.mark.parametrize("field", sorted({*io.fit_to_dict(fit_of(PLAIN))["fit"]} - WRITTEN_ONLY))
def test_missing_field_is_named(tmp_path, field):
    data = io.fit_to_dict(fit_of(CAMERA))
    del data["fit"][field]
    path = put(tmp_path, "fit.json", json.dumps(data))
    with refusal(f"`{field}`: expected .*, got no such field .*fit.json"):
        io.load_fit(path)


@pairs(
    "text, message",
    {
        json.dumps(io.camera_to_dict(CAMERA)): "`fit`: expected the field .*, got no such field",
        '{"fit": 3}': "`fit`: expected .*, got 3",
        "[1]": r"expected a JSON object, got \[1\]",
        "no JSON": "`path`: expected JSON, got",
    },
)
def test_other_files_are_no_fits(tmp_path, text, message):
    path = put(tmp_path, "camera.json", text)
    with refusal(rf"{message}.*camera\.json"):
        io.load_fit(path)


def test_lens_that_folds_outside_the_object_comes_back(tmp_path):
    """A fit trusts a distortion in the object's window alone."""
    folding = pj.Lens([32, 24], 1.0, pj.BrownConrady(-3.0))
    camera = eqx.tree_at(lambda c: c.lens, CAMERA, folding)
    with refusal("folds back"):
        PLAIN.replace(lens=folding)
    fit = fit_of(camera)
    io.save_fit(tmp_path / "fit.json", fit)
    assert_equal(fit, io.load_fit(tmp_path / "fit.json"))
