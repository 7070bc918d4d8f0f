"""A mask that is black on white is noticed by its border; an object that is cut off is none."""

import numpy as np
import pytest
from oracles import drawn
from PIL import Image

import pinhole_jax as pj
from pinhole_jax import io, shapes

W, H = 96, 80
CAMERA = pj.Camera([0.3, 1.0, 5.0], [0.1, 0, 0], [0.2, 1, 0.1], 0.6, 1.0, W, H)


@pytest.fixture(scope="module")
def silhouette():
    """A mask of 8 bits with soft edges, in the middle of the film."""
    coverage = drawn(CAMERA, pj.Scene(mesh=shapes.bumpy(2)))
    return np.uint8(255 * coverage + 0.5)


def cut_off(right, top):
    """Return a mask that covers all but a corner of this size, px."""
    mask = np.full((H, W), 255, np.uint8)
    mask[:top, W - right :] = 0
    return mask


def border_of(mask):
    inside = np.zeros(mask.shape, bool)
    inside[1:-1, 1:-1] = True
    return np.mean(mask[~inside] > 127)


@pytest.mark.parametrize("mode", ["L", "RGB", "1", "LA"])
def test_a_silhouette_that_is_inverted_is_refused_and_can_be_turned(tmp_path, silhouette, mode):
    path = tmp_path / "black_on_white.png"
    image = Image.fromarray(255 - silhouette)
    if mode == "LA":  # the object is what shows through
        image = Image.merge("LA", (Image.new("L", image.size, 90), image))
    image.convert(mode).save(path)
    way = "alpha" if mode == "LA" else "luminance"
    words = f"100% of its border, .* `invert` .*: --invert.* `mask_from` {way} .*--mask-from {way}"
    with pytest.raises(ValueError, match=f"`path`: expected a mask, got .*white.png.*{words}"):
        io.load_mask(path)

    said = []
    mask = io.load_mask(path, say=said.append, invert=True)
    assert len(said) == 1
    assert said[0].endswith(", inverted")
    expected = 255 * (silhouette > 127) if mode == "1" else silhouette
    assert np.mean(mask != expected) < (0.02 if mode == "1" else 1e-9)  # Pillow dithers soft edges
    np.testing.assert_array_equal(io.load_mask(path, way), 255 - mask)
    np.testing.assert_array_equal(io.load_mask(path, way, invert=True), mask)


@pytest.mark.parametrize(("share", "corner"), [(0.4, (66, H)), (0.6, (30, H)), (0.85, (26, 27))])
def test_an_object_that_the_frame_cuts_off_is_accepted(tmp_path, share, corner):
    mask = cut_off(*corner)
    assert abs(border_of(mask) - share) < 0.02
    Image.fromarray(mask).save(tmp_path / "mask.png")
    said = []
    np.testing.assert_array_equal(io.load_mask(tmp_path / "mask.png", say=said.append), mask)
    assert said == []


def test_a_mask_that_covers_all_or_nothing_is_left_to_the_fit(tmp_path):
    for value in (0, 255):
        Image.new("L", (9, 1), value).save(tmp_path / "mask.png")
        assert np.all(io.load_mask(tmp_path / "mask.png") == value)


# --- crumbs and pinholes --------------------------------------------------------------------------


def soft_square():
    """A soft square with a hole of 25 px, an island of 9 px with soft edges, and a pinhole."""
    mask = np.zeros((120, 160))
    mask[30:90, 40:100] = 1
    mask[29, 40:100] = 0.25
    mask[50:55, 60:65] = 0
    mask[70, 80] = 0.3
    mask[9:14, 129:134] = 0.4
    mask[10:13, 130:133] = 1
    mask[90:95, 100:105] = np.eye(5)  # a thin part that hangs on by corners
    return mask


@pytest.mark.parametrize(
    "to", [np.float32, lambda m: np.uint8(np.round(255 * m)), lambda m: m > 0.49]
)
def test_crumbs_and_pinholes_are_taken_away_and_said(to):
    mask = to(soft_square())
    result, notes = io.tidy_mask(mask)
    assert result.dtype == mask.dtype
    expected = soft_square()
    expected[5:20, 120:140] = 0
    expected[70, 80] = 1
    np.testing.assert_array_equal(result, to(expected))
    assert notes == ("1 island of at most 9 px dropped", "1 hole of at most 1 px filled")
    assert io.tidy_mask(result) == (pytest.approx(result), ())


def test_what_a_mask_is_is_said_and_left():
    mask = np.zeros((60, 80), bool)
    mask[:30, 10:30] = mask[40:60, 50:60] = True
    result, notes = io.tidy_mask(mask)
    np.testing.assert_array_equal(result, mask)
    parts = "2 parts (75%, 25% of what is covered): all of one object?"
    assert notes == (parts, "the film cuts the mask off: top, bottom")
    assert io.tidy_mask(mask | True).notes == ("the mask covers all",)
    assert io.tidy_mask(mask & False).notes == ("the mask covers nothing",)
    assert io.tidy_mask(soft_square(), speck=0.0).notes == (
        "2 parts (100%, 0% of what is covered): all of one object?",
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mask": np.zeros(3)}, r"`mask`: expected shape \(H, W\)"),
        ({"mask": np.full((3, 3), np.nan)}, "`mask`: expected finite values"),
        ({"speck": 1.0}, "`speck`: expected a share of the object, 0 <= speck < 1, got 1.0"),
    ],
)
def test_what_is_no_mask_is_not_tidied(change, message):
    with pytest.raises(ValueError, match=message):
        io.tidy_mask(**{"mask": np.zeros((3, 3)), **change})
