"""A mask that is black on white is noticed by its border; an object that is cut off is none."""

from typing import Any

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
def test_inverted_silhouette_is_refused_and_can_be_turned(tmp_path, silhouette, mode):
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
def test_object_cut_off_by_the_frame_is_accepted(tmp_path, share, corner):
    mask = cut_off(*corner)
    assert abs(border_of(mask) - share) < 0.02
    Image.fromarray(mask).save(tmp_path / "mask.png")
    said = []
    np.testing.assert_array_equal(io.load_mask(tmp_path / "mask.png", say=said.append), mask)
    assert said == []


def test_full_and_empty_masks_are_left_to_the_fit(tmp_path):
    for value in (0, 255):
        Image.new("L", (9, 1), value).save(tmp_path / "mask.png")
        assert np.all(io.load_mask(tmp_path / "mask.png") == value)


# --- transparency and colours ---------------------------------------------------------------------


def disc(softness=1.0):
    """Return a disc whose edge is soft over some pixels."""
    y, x = np.mgrid[:H, :W]
    return np.clip((28.5 - np.hypot(x - 50.3, y - 41.7)) / softness, 0, 1)


SOFT = np.uint8(np.round(255 * disc()))
WHITE, BLACK = np.full_like(SOFT, 255), np.zeros_like(SOFT)
HARD = np.where(SOFT > 0, WHITE, BLACK)
CHEQUER = np.uint8(255 * (np.indices((H, W)).sum(0) // 8 % 2))
TEXTURE = np.random.default_rng(0).integers(20, 235, (H, W, 3), np.uint8)


def palette(entries):
    """The soft disc, each grey an entry of a palette."""
    image = Image.fromarray(SOFT).convert("P")
    image.putpalette([channel for k in entries for channel in (k, k, k)])
    return image


def channels(*parts):
    return Image.fromarray(np.dstack(parts))


@pytest.mark.parametrize(
    ("image", "how"),
    [
        pytest.param(Image.fromarray(SOFT), {"transparency": 0}, id="grey, black is clear"),
        pytest.param(Image.fromarray(np.uint16(257) * SOFT), {"transparency": 0}, id="16 bits"),
        pytest.param(channels(SOFT, SOFT, SOFT), {"transparency": (0, 0, 0)}, id="RGB"),
        pytest.param(channels(SOFT, BLACK, BLACK), {"transparency": (0, 0, 0)}, id="red"),
        pytest.param(palette(range(256)), {"transparency": 0}, id="palette"),
        pytest.param(palette(range(256)), {"transparency": b"\0"}, id="palette, bytes"),
        pytest.param(palette([255] * 256), {"transparency": bytes(range(256))}, id="white palette"),
        pytest.param(palette(range(256)), {"transparency": bytes(range(256))}, id="premultiplied"),
        pytest.param(channels(SOFT, HARD), {}, id="hard alpha"),
        pytest.param(channels(SOFT, SOFT, SOFT, HARD), {}, id="RGBA, hard alpha"),
        pytest.param(channels(BLACK, SOFT, SOFT, HARD), {}, id="cyan, hard alpha"),
        pytest.param(channels(SOFT, SOFT), {}, id="alpha is the same"),
        pytest.param(channels(WHITE, SOFT), {}, id="white, soft alpha"),
        pytest.param(channels(BLACK, SOFT), {}, id="black, soft alpha"),
        pytest.param(channels(WHITE, BLACK, BLACK, SOFT), {}, id="red, soft alpha"),
        pytest.param(channels(SOFT, BLACK, BLACK, SOFT), {}, id="red, premultiplied"),
        pytest.param(channels(TEXTURE, SOFT), {}, id="cut out of a photo"),
        pytest.param(channels(TEXTURE[..., 0], SOFT), {}, id="cut out of a grey photo"),
        pytest.param(channels(SOFT, WHITE), {}, id="opaque"),
        pytest.param(channels(SOFT, WHITE // 2), {}, id="half opaque everywhere"),
    ],
)
def test_soft_edge_counts_once_whether_colours_or_transparency_hold_it(tmp_path, image, how):
    image.save(tmp_path / "mask.png", **how)
    np.testing.assert_array_equal(io.load_mask(tmp_path / "mask.png"), SOFT)


@pytest.mark.parametrize(
    ("image", "how"),
    [
        pytest.param(channels(CHEQUER, HARD), {}, id="black and white object"),
        pytest.param(Image.fromarray(255 - SOFT), {"transparency": 255}, id="black object"),
        pytest.param(Image.fromarray(SOFT), {"transparency": 255}, id="white is clear"),
        pytest.param(channels(SOFT, np.roll(SOFT, 3)), {}, id="two soft edges"),
    ],
)
def test_transparency_that_contradicts_colours_is_refused(tmp_path, image, how):
    image.save(tmp_path / "mask.png", **how)
    with pytest.raises(
        ValueError, match=r"`mask_from` alpha \(--mask-from alpha\) or `mask_from` l"
    ):
        io.load_mask(tmp_path / "mask.png")


def test_picture_that_is_transparent_everywhere_is_refused(tmp_path):
    channels(SOFT, BLACK).save(tmp_path / "mask.png")
    with pytest.raises(ValueError, match=r"transparent everywhere; .* luminance"):
        io.load_mask(tmp_path / "mask.png")
    np.testing.assert_array_equal(io.load_mask(tmp_path / "mask.png", "luminance"), SOFT)
    channels(WHITE, BLACK).save(tmp_path / "mask.png")
    assert not np.any(io.load_mask(tmp_path / "mask.png"))


def fading(softness):
    """Return a red and blue disc, and one of a smooth texture, that fade over some pixels."""
    y, x = np.mgrid[:H, :W]
    left = x < 50
    two = 255 * np.dstack([left, 0 * left, ~left])
    smooth = 150 + 60 * np.dstack([np.sin(x / 9), np.cos(y / 7), np.sin((x + y) / 8)])
    share = disc(softness)[..., None]
    return {
        "two hues": (two, share),
        "smooth": (smooth, share),
        "noise": (TEXTURE, share),
        "grey": (np.dstack([TEXTURE[..., 0]] * 3) // 2 + 100, share),
    }


@pytest.mark.parametrize("kind", ["two hues", "smooth", "noise", "grey"])
@pytest.mark.parametrize("softness", [1, 2, 3])
@pytest.mark.parametrize("back", [0, 255])
def test_many_colours_that_fade_to_the_background_are_refused(tmp_path, kind, softness, back):
    if back and kind in ("noise", "grey"):
        pytest.skip("about as light as their background")
    colours, share = fading(softness)[kind]
    mixed = np.uint8(np.round(colours * share + back * (1 - share)))
    channels(mixed, np.uint8(255 * (share > 0))).save(tmp_path / "mask.png")
    with pytest.raises(ValueError, match=r"a soft edge, too.* alpha .*--mask-from luminance\)"):
        io.load_mask(tmp_path / "mask.png")


def cut_outs():
    """Yield pictures whose transparency alone is the mask, and how they are called."""
    y, x = np.mgrid[:H, :W]
    radius = np.hypot(x - 50.3, y - 41.7)
    lit = np.sqrt(np.clip(1 - (radius / 28.5) ** 2, 0, 1))[..., None]
    (smooth, share), half = fading(1)["smooth"], disc() > 0.5
    yield "noise", TEXTURE, HARD > 0
    yield "noise on black", TEXTURE * (HARD > 0)[..., None], HARD > 0
    yield "lit from the camera", smooth * lit, HARD > 0
    yield "lit, with ambient light", smooth * (0.2 + 0.8 * lit), HARD > 0
    yield "dark rim", smooth * (radius < 26)[..., None], HARD > 0
    yield "photo cut in the middle of its edge", smooth * share, half
    yield "photo on green", smooth * share + np.array([40, 120, 40]) * (1 - share), half


@pytest.mark.parametrize(
    ("colours", "opaque"), [pytest.param(c, o, id=k) for k, c, o in cut_outs()]
)
def test_object_cut_out_hard_is_its_transparency(tmp_path, colours, opaque):
    channels(np.uint8(colours), np.uint8(255 * opaque)).save(tmp_path / "mask.png")
    np.testing.assert_array_equal(io.load_mask(tmp_path / "mask.png"), 255 * opaque)


# --- labels ---------------------------------------------------------------------------------------


def labelled(first, second, dtype, where="beside"):
    """A disc of one label, and another label in a corner, or in a ring about the disc."""
    y, x = np.mgrid[:H, :W]
    radius = np.hypot(x - 50.3, y - 41.7)
    labels = np.where(radius < 28.5, first, 0).astype(dtype)
    labels[(x > 80) & (y < 20) if where == "beside" else np.abs(radius - 28.5) < 2.5] = second
    return labels


@pytest.mark.parametrize(
    ("dtype", "first", "second"),
    [
        (np.uint8, 1, 2),
        (np.uint8, 1, 255),
        (np.uint8, 250, 251),
        (np.uint8, 128, 255),
        (np.uint16, 26001, 26002),
        (np.uint16, 1, 1000),
        (np.uint16, 300, 65535),
        (np.int32, 70000, 70001),
        (np.int32, 1, -1),
        (np.float32, 1, 2),
    ],
)
@pytest.mark.parametrize("where", ["beside", "ring"])
def test_labels_of_any_depth_are_refused_and_listed(tmp_path, dtype, first, second, where):
    if where == "ring" and second - first == 1 and first > 9:
        pytest.skip("the same but for an edge")
    labels = labelled(first, second, dtype, where)
    Image.fromarray(labels).save(tmp_path / "mask.tiff")
    listed = ", ".join(map(str, sorted({0, first, second})))
    hint = rf"`mask_from` label={first} \(--mask-from label={first}\)"
    with pytest.raises(ValueError, match=rf"the values {listed}\b.*{hint}") as caught:
        io.load_mask(tmp_path / "mask.tiff")
    assert ("often void" in str(caught.value)) == (second in (255, 65535))
    said = []
    mask = io.load_mask(tmp_path / "mask.tiff", f"label={first}", said.append)
    np.testing.assert_array_equal(mask > 0, labels == first)
    assert ("often void" in said[0]) == (second in (255, 65535))


def test_labels_of_a_palette_or_a_clear_background_are_refused(tmp_path):
    labels = labelled(1, 2, np.uint8)
    grey = Image.fromarray(labels).convert("P")
    grey.putpalette([0, 0, 0, 255, 255, 255, 90, 90, 90])
    coloured = Image.fromarray(labels).convert("P")
    coloured.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])
    rgb = Image.fromarray(np.dstack([100 * labels] * 3))
    cases: list[tuple[Image.Image, dict[str, Any], str]] = [
        (grey, {}, "0, 1, 2; .* label=1 "),
        (coloured, {"transparency": 0}, "1, 2; .* label=1 "),
        (Image.fromarray(labels), {"transparency": 0}, "1, 2; .* label=1 "),
        (Image.fromarray(labels + np.uint16(26000)), {"transparency": 26000}, "26001, 26002; "),
        (rgb, {}, "0, 100, 200; save it as grey"),
        (rgb, {"transparency": (0, 0, 0)}, "100, 200; save it as grey"),
    ]
    for image, how, listed in cases:
        image.save(tmp_path / "mask.png", **how)
        with pytest.raises(ValueError, match=f"flat areas of the values {listed}"):
            io.load_mask(tmp_path / "mask.png")


def test_sixty_instances_of_one_class_are_refused(tmp_path):
    numbers = np.zeros((H, W), np.uint16)
    for k, (row, column) in enumerate(np.ndindex(6, 10)):
        numbers[13 * row + 1 : 13 * row + 11, 9 * column + 1 : 9 * column + 8] = 26001 + k
    Image.fromarray(numbers).save(tmp_path / "mask.png")
    with pytest.raises(ValueError, match=r"0, 26001, 26002, .*, \.\.\.; "):
        io.load_mask(tmp_path / "mask.png")


@pytest.mark.parametrize(
    ("first", "second", "listed"),
    [
        ((255, 0, 0), (0, 255, 0), "#00ff00, #ff0000"),
        ((255, 255, 255), (254, 254, 254), "#fefefe, #ffffff"),
    ],
)
def test_opaque_instances_on_transparency_are_refused(tmp_path, first, second, listed):
    labels = labelled(1, 2, np.uint8)
    colours = np.array([(0, 0, 0), first, second], np.uint8)[labels]
    channels(colours, 255 * np.uint8(labels > 0)).save(tmp_path / "rgba.png")
    Image.fromarray(colours).save(tmp_path / "rgb.png", transparency=(0, 0, 0))
    for name in ("rgba", "rgb") if first[1] == 0 else ("rgba",):
        with pytest.raises(ValueError, match=f"flat areas of the colours {listed}; .* alpha"):
            io.load_mask(tmp_path / f"{name}.png")
    assert np.all(io.load_mask(tmp_path / "rgba.png", "alpha") == 255 * (labels > 0))


@pytest.mark.parametrize("values", [(254, 255, 255), (0, 1, 2), (0, 100, 200), (1, 2, 2)])
@pytest.mark.parametrize("colour", [0, 200])
def test_labels_in_the_transparency_are_refused(tmp_path, values, colour):
    opaque = np.array(values, np.uint8)[labelled(1, 2, np.uint8)]
    channels(np.full_like(opaque, colour), opaque).save(tmp_path / "mask.png")
    listed = ", ".join(map(str, sorted({*values})))
    with pytest.raises(ValueError, match=rf"transparency \(alpha\) of the values {listed};"):
        io.load_mask(tmp_path / "mask.png")


@pytest.mark.parametrize("values", [(0, 1), (0, 128), (1, 255), (0, 254)])
def test_transparency_of_two_values_is_a_mask(tmp_path, values):
    inside = disc() > 0.5
    channels(WHITE, np.where(inside, values[1], values[0]).astype(np.uint8)).save(
        tmp_path / "mask.png"
    )
    said = []
    mask = io.load_mask(tmp_path / "mask.png", say=said.append)
    np.testing.assert_array_equal(mask, 255 * inside)
    assert said == [f"mask: the transparency (alpha), its values {values[0]} to {values[1]}"]
    channels(WHITE, SOFT // 2).save(tmp_path / "mask.png")
    assert np.max(np.abs(io.load_mask(tmp_path / "mask.png") / 255 - SOFT / 255)) < 0.01


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("amid", ["frame", "all"])
@pytest.mark.parametrize("label", [1, 7])
def test_label_amid_void_is_advised(tmp_path, dtype, amid, label):
    inside = disc() > 0.5
    labels = np.full((H, W), np.iinfo(dtype).max, dtype)
    if amid == "frame":
        labels[1:-1, 1:-1] = 0
    labels[inside] = label
    Image.fromarray(labels).save(tmp_path / "mask.png")
    with pytest.raises(ValueError, match=f"often void; .*label={label} ") as caught:
        io.load_mask(tmp_path / "mask.png")
    assert "invert" not in str(caught.value)
    mask = io.load_mask(tmp_path / "mask.png", f"label={label}")
    np.testing.assert_array_equal(mask, 255 * inside)


def test_frame_of_one_pixel_is_to_be_cropped(tmp_path):
    framed = np.full((H, W), 255, np.uint8)
    framed[1:-1, 1:-1] = np.asarray(SOFT)[1:-1, 1:-1]
    Image.fromarray(framed).save(tmp_path / "mask.png")
    with pytest.raises(ValueError, match="a frame of one pixel: crop it"):
        io.load_mask(tmp_path / "mask.png")


def test_background_that_is_not_black_is_taken_out_or_told(tmp_path):
    inside = disc() > 0.5
    Image.fromarray(np.where(inside, np.uint8(255), np.uint8(25))).save(tmp_path / "mask.png")
    said = []
    mask = io.load_mask(tmp_path / "mask.png", say=said.append)
    np.testing.assert_array_equal(mask, 255 * inside)
    soft = np.uint8(np.round(25 + 230 * disc()))
    Image.fromarray(soft).save(tmp_path / "mask.png")
    np.testing.assert_array_equal(io.load_mask(tmp_path / "mask.png", say=said.append), soft)
    assert "25 and 255" in said[0]
    assert "25 of 255" in said[1]


def test_run_lengths_of_several_masks_are_not_called_polygons():
    from pycocotools import mask as coco

    stack = np.asfortranarray(np.dstack([disc() > 0.5] * 3).astype(np.uint8))
    encoded: Any = coco.encode(stack)
    polygon = [1.0, 1.0, 6.0, 1.0, 6.0, 4.0]
    for rle, words in (
        (encoded, "a list of 3 masks: give one of them"),
        (encoded[:1], "a list of 1 mask: give one of them"),
        ([], "no mask"),
        (np.zeros(0), "no mask"),
        (np.array(3.0), "got array"),
        (np.array(polygon), "polygons; .*frPyObjects"),
        (np.array(polygon).reshape(3, 2), "polygons; .*frPyObjects"),
        ([np.array(polygon)], "polygons; .*frPyObjects"),
        (polygon, "polygons; .*frPyObjects"),
        (stack[..., 0], "a mask already"),
    ):
        with pytest.raises(ValueError, match=f"`rle`: .*{words}"):
            io.mask_of_rle(rle)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("quality", [10, 40, 75, 95, 100])
def test_masks_of_jpegs_are_masks_in_any_file(tmp_path, quality):
    for mask in (SOFT, HARD):
        Image.fromarray(mask).save(tmp_path / "mask.jpg", quality=quality)
        with Image.open(tmp_path / "mask.jpg") as lossy:
            lossy.save(tmp_path / "mask.png")
        for name in ("mask.jpg", "mask.png"):
            assert np.mean(np.abs(io.load_mask(tmp_path / name) / 255 - mask / 255)) < 0.03


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int32, np.float32])
def test_masks_of_two_levels_and_soft_edges_are_read_in_any_depth(tmp_path, dtype):
    mosts = (255,) if dtype == np.uint8 else (1000, 26001)
    for softness in (1, 3, 9):
        for most in mosts:
            image = disc(softness) * most
            image = image.astype(dtype) if dtype == np.float32 else np.round(image).astype(dtype)
            Image.fromarray(image).save(tmp_path / "mask.tiff")
            mask = io.load_mask(tmp_path / "mask.tiff")
            np.testing.assert_allclose(mask / 255, disc(softness), atol=1 / 200)
    enlarged = np.round(mosts[0] * disc()).astype(dtype).repeat(3, 0).repeat(3, 1)
    Image.fromarray(enlarged).save(tmp_path / "mask.tiff")
    assert io.load_mask(tmp_path / "mask.tiff").shape == (3 * H, 3 * W)


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
def test_crumbs_and_pinholes_are_removed_and_reported(to):
    mask = to(soft_square())
    result, notes = io.tidy_mask(mask)
    assert result.dtype == mask.dtype
    expected = soft_square()
    expected[5:20, 120:140] = 0
    expected[70, 80] = 1
    np.testing.assert_array_equal(result, to(expected))
    assert notes == ("1 island of at most 9 px dropped", "1 hole of at most 1 px filled")
    assert io.tidy_mask(result) == (pytest.approx(result), ())


def test_tidy_mask_describes_and_leaves_a_sound_mask():
    mask = np.zeros((60, 80), bool)
    mask[:30, 10:30] = mask[40:60, 50:60] = True
    result, notes = io.tidy_mask(mask)
    np.testing.assert_array_equal(result, mask)
    parts = "2 parts (75%, 25% of the covered area): all one object?"
    assert notes == (parts, "the film cuts the mask off: top, bottom")
    assert io.tidy_mask(mask | True).notes == ("the mask covers all",)
    assert io.tidy_mask(mask & False).notes == ("the mask covers nothing",)
    assert io.tidy_mask(soft_square(), speck=0.0).notes == (
        "2 parts (100%, 0% of the covered area): all one object?",
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mask": np.zeros(3)}, r"`mask`: expected shape \(H, W\)"),
        ({"mask": np.full((3, 3), np.nan)}, "`mask`: expected finite values"),
        ({"speck": 1.0}, "`speck`: expected a share of the object, 0 <= speck < 1, got 1.0"),
    ],
)
def test_bad_arguments_of_tidy_mask_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        io.tidy_mask(**{"mask": np.zeros((3, 3)), **change})
