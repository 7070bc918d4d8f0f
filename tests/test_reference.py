"""The reference set: its images are the oracle's, and a comparison finds what is wrong."""

from dataclasses import replace
from pathlib import Path

import _oracle
import _scenes
import compare
import make
import numpy as np
import pytest
from chosen import full
from numpy.testing import assert_allclose
from refusals import refusal

import pinhole_jax as pj

REFERENCE = Path(__file__).parents[1] / "experiments" / "reference"
NAMES = sorted(path.stem for path in (REFERENCE / "set").glob("*.npz"))


@pytest.fixture(scope="module")
def views():
    return _scenes.views()


def smaller(view):
    """Return the view at a third of its size: fewer pixels for the oracle."""
    centre = view.principal_point / 3
    return replace(view, W=view.W // 3, H=view.H // 3, principal_point=centre)


def test_scenes_are_twenty_with_a_file_each(views):
    assert sorted(views) == NAMES
    assert len(NAMES) == 20


@pytest.mark.parametrize("name", NAMES)
def test_oracle_confirms_the_coverage_in_the_files(views, name):
    """Without the renderer: polygons of the numbers that the file itself holds."""
    with np.load(REFERENCE / "set" / f"{name}.npz") as file:
        known = {key: file[key] for key in ("vertices", "faces", "centers", "radii", "e", "p", "u")}
        view = replace(views[name], **known, phi=float(file["phi"]))
        image = file["coverage"]
        assert file["schema"] == make.SCHEMA
        assert image.shape == (file["H"], file["W"]) == (view.H, view.W)
        assert file["derivatives"].shape == (len(file["parameters"]), *image.shape)
    some = np.zeros(image.shape, bool)
    some[::5] = True
    assert_allclose(
        _oracle.coverage(view, some)[::5], image[::5], rtol=0, atol=make.limits(view)[0]
    )


def test_file_holds_the_same_camera_as_K_R_t():
    """As another renderer reads it: OpenCV's axes, pixel centres at halves."""
    with np.load(REFERENCE / "set" / "off_centre.npz") as file:
        W, H, vertices = int(file["W"]), int(file["H"]), file["vertices"]
        lens = pj.Lens(file["principal_point"], file["aspect"])
        given = pj.Camera(*(file[key] for key in ("e", "p", "u", "phi", "d")), W, H, lens)
        u, v, w = ((vertices @ file["R"].T + file["t"]) @ file["K"].T).T
    assert_allclose(np.stack([u / w, H - v / w], axis=-1), pj.project(given, vertices), atol=1e-10)


@pytest.mark.long
@pytest.mark.parametrize("name", ["triangle", full("sphere")])
def test_derivatives_are_the_oracle_s_differences(views, name):
    view = smaller(views[name])
    found = make.made(view)
    image, derivative = make.limits(view)
    assert found.coverage_error <= image
    assert max(found.errors.values()) <= derivative
    assert set(found.errors) == set(view.parameters)
    assert np.all(found.derivatives[view.parameters.index("d")] == 0)
    film = found.derivatives[view.parameters.index("d_film")]
    assert_allclose(
        film, found.derivatives[view.parameters.index("phi")] * -np.sin(view.phi) / view.d
    )


def planted(tmp_path, **factors):
    """Write the torus's images, some times a factor, as another renderer would."""
    images = compare.images_of(REFERENCE / "set" / "torus.npz")
    spoiled = {name: images[name] * factor for name, factor in factors.items()}
    np.savez(tmp_path / "torus.npz", **spoiled)
    return compare.all_compared(tmp_path, REFERENCE / "set")


def test_comparison_names_planted_errors(tmp_path):
    found = planted(tmp_path, coverage=1, e_x=1.002, e_y=2, phi=np.pi / 180, u_z=-1, d=1)
    wrong = {name: c.suspicion for (_, name), c in found.items() if not c.agrees}
    assert sorted(wrong) == ["e_y", "phi", "u_z"]
    assert "factor of two" in wrong["e_y"]
    assert "degrees" in wrong["phi"]
    assert "sign" in wrong["u_z"]
    assert found["torus", "e_y"].correlation > 0.999999
    text = compare.table(found)
    assert text.count("DIFFERS") == 3
    assert len(text.splitlines()) == 7


def test_reference_set_agrees_with_itself(capsys):
    found = compare.all_compared(REFERENCE / "set", REFERENCE / "set")
    assert all(c.agrees for c in found.values())
    assert len(found) == 20 * 15 + 3  # 14 derivatives and coverage; k1 where a lens distorts
    assert not capsys.readouterr().out


def test_shifted_or_biased_picture_does_not_agree():
    ours = compare.images_of(REFERENCE / "set" / "bumpy.npz")["phi"]
    biased = ours.copy()
    biased[20, 30] += 100 * np.abs(ours).max()
    for theirs, known in ((np.roll(ours, 1, axis=1), ours), (biased, ours), (ours, 0 * ours)):
        assert compare.compared(known, known).agrees
        assert not compare.compared(theirs, known).agrees
    assert compare.compared(biased, ours).worst == (20, 30)


@pytest.mark.parametrize(
    "image, words",
    [
        (np.zeros((3, 5)), r"`e_x`: expected an image of shape \(48, 64\), got \(3, 5\)"),
        (np.full((48, 64), np.nan), "`e_x`: expected finite numbers, got NaN or infinity"),
    ],
)
def test_images_that_cannot_be_compared_are_refused(tmp_path, image, words):
    np.savez(tmp_path / "cube.npz", e_x=image)
    with refusal(r"cube.npz, " + words):
        compare.all_compared(tmp_path, REFERENCE / "set")
