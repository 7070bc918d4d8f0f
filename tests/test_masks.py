"""Pictures as masks: how each is read, and which are refused, with the ways to read them."""

import json

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from oracles import drawn, lump, usual_camera
from PIL import Image
from refusals import pairs, refusal

from pinhole_jax import io

W, H = 96, 80
CAMERA = usual_camera(W, H)


def disc(softness=1.0):
    """Return a disc whose edge is soft over some pixels."""
    y, x = np.mgrid[:H, :W]
    return np.clip((28.5 - np.hypot(x - 50.3, y - 41.7)) / softness, 0, 1)


SOFT = np.uint8(np.round(255 * disc()))
INSIDE = disc() > 0.5
WHITE, BLACK = np.full_like(SOFT, 255), np.zeros_like(SOFT)
HARD = np.where(SOFT > 0, WHITE, BLACK)
CHEQUER = np.uint8(255 * (np.indices((H, W)).sum(0) // 8 % 2))
TEXTURE = default_rng(0).integers(20, 235, (H, W, 3), np.uint8)
RAMP = np.tile(np.arange(256, dtype=np.uint8), (20, 1))
FRAMED = np.pad(SOFT[1:-1, 1:-1], 1, constant_values=255)
LEVELS = default_rng(1).integers(0, 4, (9, 7), np.uint8)


def two(inside, outside, dtype=np.uint8):
    """The disc in one value on another."""
    return np.where(INSIDE, inside, outside).astype(dtype)


def palette(image, colours):
    picture = Image.fromarray(image).convert("P")
    picture.putpalette(np.ravel(colours).astype(int).tolist())
    return picture


def greys(entries):
    """The soft disc, each grey an entry of a palette."""
    return palette(SOFT, [3 * [k] for k in entries])


def channels(*parts):
    return np.dstack(parts)


def load(folder, picture, way=None, ending="png", how=(), **more):
    """Save a picture, and return the mask in it and the words on how it was read."""
    said = []
    image = picture if isinstance(picture, Image.Image) else Image.fromarray(picture)
    image.save(folder / f"mask.{ending}", **dict(how))
    mask = io.load_mask(folder / f"mask.{ending}", way, said.append, **more)
    return mask, "".join(said)


CLEAR_0, CLEAR_BLACK = {"transparency": 0}, {"transparency": (0, 0, 0)}
STEPS = {"transparency": bytes(range(256))}
ALPHA = "mask: the transparency (alpha)"
#: Pictures of the soft disc: an edge counts once, whether colours or transparency hold it.
SOFT_EDGES = {
    "grey": (SOFT,),
    "RGB": (channels(SOFT, SOFT, SOFT),),
    "black is clear": (SOFT, CLEAR_0),
    "black is clear, 16 bits": (np.uint16(257) * SOFT, CLEAR_0),
    "black is clear, RGB": (channels(SOFT, SOFT, SOFT), CLEAR_BLACK),
    "black is clear, red": (channels(SOFT, BLACK, BLACK), CLEAR_BLACK),
    "clear entry": (greys(range(256)), CLEAR_0),
    "clear entry, bytes": (greys(range(256)), {"transparency": b"\0"}),
    "white palette": (greys([255] * 256), STEPS),
    "premultiplied palette": (greys(range(256)), STEPS),
    "hard alpha": (channels(SOFT, HARD),),
    "RGB, hard alpha": (channels(SOFT, SOFT, SOFT, HARD),),
    "cyan, hard alpha": (channels(BLACK, SOFT, SOFT, HARD),),
    "alpha is the same": (channels(SOFT, SOFT),),
    "white, soft alpha": (channels(WHITE, SOFT),),
    "black, soft alpha": (channels(BLACK, SOFT),),
    "red, soft alpha": (channels(WHITE, BLACK, BLACK, SOFT),),
    "red, premultiplied": (channels(SOFT, BLACK, BLACK, SOFT),),
    "cut out of a photo": (channels(TEXTURE, SOFT),),
    "cut out of a grey photo": (channels(TEXTURE[..., 0], SOFT),),
    "opaque": (channels(SOFT, WHITE),),
    "half opaque everywhere": (channels(SOFT, WHITE // 2),),
}


@pytest.mark.parametrize("name", SOFT_EDGES)
def test_soft_edge_counts_once_whether_colours_or_transparency_hold_it(tmp_path, name):
    image, *how = SOFT_EDGES[name]
    mask, said = load(tmp_path, image, how=dict(*how))
    assert_array_equal(mask, SOFT)
    assert (said == "") == (name in ("grey", "RGB", "opaque", "half opaque everywhere"))


SMOOTH_Y, SMOOTH_X = np.mgrid[:H, :W]
SMOOTH = 150 + 60 * np.dstack(
    [np.sin(SMOOTH_X / 9), np.cos(SMOOTH_Y / 7), np.sin((SMOOTH_X + SMOOTH_Y) / 8)]
)


RADIUS = np.hypot(SMOOTH_X - 50.3, SMOOTH_Y - 41.7)[..., None]
LIT = np.sqrt(np.clip(1 - (RADIUS / 28.5) ** 2, 0, 1))
#: Pictures whose transparency alone is the mask: colours, opacity.
CUT_OUT = {
    "noise": (TEXTURE, HARD),
    "lit from the camera": (SMOOTH * LIT, HARD),
    "lit, with ambient light": (SMOOTH * (0.2 + 0.8 * LIT), HARD),
    "dark rim": (SMOOTH * (RADIUS < 26), HARD),
    "photo cut in the middle of its edge": (SMOOTH * disc()[..., None], 255 * INSIDE),
}
#: A picture, its mask, and the words on how it was read at first sight.
READ = {
    "one bit": (Image.fromarray(INSIDE), 255 * INSIDE, ""),
    "full": (WHITE, WHITE, ""),
    "empty": (BLACK, BLACK, ""),
    "values 0 and 1": (two(1, 0), 255 * INSIDE, "mask: its values 0 and 1"),
    "values 25 and 255": (two(255, 25), 255 * INSIDE, "25 and 255"),
    "a label's palette": (palette(two(1, 0), [0, 0, 0, 128, 0, 0]), 255 * INSIDE, "values 0 and 1"),
    "clear everywhere": (channels(WHITE, BLACK), BLACK, ALPHA),
    "alpha of 0 and 1": (channels(WHITE, two(1, 0)), 255 * INSIDE, "its values 0 to 1"),
    "alpha of 1 and 255": (channels(WHITE, two(255, 1)), 255 * INSIDE, "its values 1 to 255"),
    **{name: (channels(*map(np.uint8, cut)), cut[1], ALPHA) for name, cut in CUT_OUT.items()},
}


@pairs("name, image, expected, words", READ)
def test_pictures_are_read_as_masks(tmp_path, name, image, expected, words):
    mask, said = load(tmp_path, image)
    assert mask.dtype == np.uint8
    assert_array_equal(mask, expected)
    assert words in said


def test_masks_are_read_the_way_that_is_asked_for(tmp_path):
    mask, said = load(tmp_path, RAMP, "luminance")
    assert_array_equal(mask, RAMP)
    assert said == "mask: its brightness"
    entries = palette(LEVELS, [255, 0, 0, 9, 9, 9, 9, 9, 9, 0, 0, 255])  # two look alike
    for picture in (LEVELS, LEVELS.astype(np.uint16), entries):
        for k in range(4):
            mask, said = load(tmp_path, picture, f"label={k}")
            assert_array_equal(mask, 255 * (k == LEVELS))
            assert said.startswith(f"mask: label {k}, ")
            assert "edges hard" in said


def labelled(first, second, dtype=np.uint8, where="beside"):
    """A disc of one label, and another label in a corner, or in a ring about the disc."""
    y, x = np.mgrid[:H, :W]
    radius = np.hypot(x - 50.3, y - 41.7)
    labels = np.where(radius < 28.5, first, 0).astype(dtype)
    labels[(x > 80) & (y < 20) if where == "beside" else np.abs(radius - 28.5) < 2.5] = second
    return labels


def instances():
    numbers = np.zeros((H, W), np.uint16)
    for k, (row, column) in enumerate(np.ndindex(6, 10)):
        numbers[13 * row + 1 : 13 * row + 11, 9 * column + 1 : 9 * column + 8] = 26001 + k
    return numbers


TWO = labelled(1, 2)
EITHER = r"`mask_from` alpha \(--mask-from alpha\) or `mask_from` l"
FLAT = "flat areas of the values"
OPAQUE = 255 * np.sign(TWO)
RED_GREEN = np.array([(0, 0, 0), (255, 0, 0), (0, 255, 0)], np.uint8)[TWO]
NEARLY_WHITE = np.array([(0, 0, 0), (255, 255, 255), (254, 254, 254)], np.uint8)[TWO]
#: A picture, the error, and how it is saved or asked for.
REFUSED = {
    "photo": (TEXTURE, r"`path`: expected a mask, .*mask.png.* a colour picture"),
    "colours of a palette": (palette(two(1, 0), [255, 0, 0, 0, 0, 0]), "a colour picture"),
    "ramp": (RAMP, r"80% of the pixels are neither .* label=N, background="),
    "four levels": (RAMP // 64, f"{FLAT} 0, 1, 2, 3; .* `mask_from` label=1 "),
    "dark": (two(7, 0), "no lighter than 7 of 255; labels?"),
    "no alpha": (RAMP, "expected a mask, .* no transparency", {"way": "alpha"}),
    "label of colours": (RED_GREEN, "a colour picture: labels are grey values", {"way": "label=1"}),
    "one colour": (BLACK, "a picture of one colour", {"way": "background=black"}),
    "black and white object": (channels(CHEQUER, HARD), EITHER),
    "black object": (255 - SOFT, EITHER, {"how": {"transparency": 255}}),
    "white is clear": (SOFT, EITHER, {"how": {"transparency": 255}}),
    "two soft edges": (channels(SOFT, np.roll(SOFT, 3)), EITHER),
    "clear everywhere": (channels(SOFT, BLACK), "transparent everywhere; .* luminance"),
    "grey palette": (palette(TWO, np.outer([0, 255, 90], 3 * [1])), f"{FLAT} 0, 1, 2; .* label=1 "),
    "clear background": (TWO, f"{FLAT} 1, 2; .* label=1 ", {"how": CLEAR_0}),
    "clear 16 bits": (
        TWO + np.uint16(26000), f"{FLAT} 26001, 26002; ", {"how": {"transparency": 26000}}
    ),
    "RGB": (channels(*[100 * TWO] * 3), f"{FLAT} 0, 100, 200; .*: save one of them"),
    "clear RGB": (channels(*[100 * TWO] * 3), "colours #646464, #c8c8c8; ", {"how": CLEAR_BLACK}),
    "sixty instances": (instances(), r"0, 26001, 26002, .*, \.\.\.; "),
    "opaque colours": (channels(RED_GREEN, OPAQUE), "colours #00ff00, #ff0000; .* alpha"),
    "opaque RGB": (RED_GREEN, "colours #00ff00, #ff0000; .* alpha", {"how": CLEAR_BLACK}),
    "nearly white": (channels(NEARLY_WHITE, OPAQUE), "colours #fefefe, #ffffff; .* alpha"),
    "label in void": (two(7, 65535, np.uint16), "labels amid void; give `invert`"),
    "frame of one pixel": (FRAMED, "covers 100% of its border"),
    **{
        f"alpha of {values}": (
            channels(np.full_like(TWO, colour), np.array(values, np.uint8)[TWO]),
            rf"transparency \(alpha\) of the values {', '.join(map(str, sorted({*values})))};",
        )
        for values, colour in (
            ((254, 255, 255), 0), ((0, 1, 2), 200), ((0, 100, 200), 0), ((1, 2, 2), 200)
        )
    },
    **{
        f"way {way!r}": (SOFT, "`mask_from`: expected one of alpha, .*got ", {"way": way})
        for way in ("", "alpha=1", "label", "label=-1", "background=", "Alpha", "hue")
    },
    "colour": (SOFT, "`mask_from`: expected a colour .*'bluish'", {"way": "background=bluish"}),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_pictures_that_are_no_masks_are_refused_with_the_ways_to_read_them(tmp_path, name):
    image, message, *more = REFUSED[name]
    with refusal(message):
        load(tmp_path, image, **dict(*more))


@pytest.mark.parametrize("where", ["beside", "ring"])
@pytest.mark.parametrize(
    "dtype, first, second",
    [(np.uint8, 1, 2), (np.uint8, 1, 255), (np.uint16, 300, 65535), (np.int32, 1, -1),
     (np.float32, 1, 2), (np.int32, 70000, 70009)],
)  # fmt: skip
def test_labels_of_any_depth_are_refused_and_listed(tmp_path, dtype, first, second, where):
    labels = labelled(first, second, dtype, where)
    listed = ", ".join(map(str, sorted({0, first, second})))
    with refusal(
        rf"the values {listed}\b.*`mask_from` label={first} \(--mask-from label={first}\)"
    ):
        load(tmp_path, labels, ending="tiff")
    mask, said = load(tmp_path, labels, f"label={first}", ending="tiff")
    assert_array_equal(mask > 0, labels == first)
    assert ("often void" in said) == (second in (255, 65535))


@pytest.fixture(scope="module")
def silhouette():
    """A mask of 8 bits with soft edges, in the middle of the film."""
    coverage = drawn(CAMERA, lump(2))
    return np.uint8(255 * coverage + 0.5)


@pytest.mark.parametrize("mode", ["L", "RGB", "1", "LA"])
def test_inverted_silhouette_is_refused_and_can_be_turned(tmp_path, silhouette, mode):
    image = Image.fromarray(255 - silhouette)
    if mode == "LA":  # the object is what shows through
        image = Image.merge("LA", (Image.new("L", image.size, 90), image))
    image, way = image.convert(mode), "alpha" if mode == "LA" else "luminance"
    words = f"100% of its border, .* `invert` .*: --invert.* `mask_from` {way} .*--mask-from {way}"
    with refusal(f"`path`: expected a mask, got .*mask.png.*{words}"):
        load(tmp_path, image)
    mask, said = load(tmp_path, image, invert=True)
    assert said.endswith(", inverted")
    expected = 255 * (silhouette > 127) if mode == "1" else silhouette
    assert np.mean(mask != expected) < (0.02 if mode == "1" else 1e-9)  # Pillow dithers soft edges
    assert_array_equal(load(tmp_path, image, way)[0], 255 - mask)
    assert_array_equal(load(tmp_path, image, way, invert=True)[0], mask)


@pytest.mark.parametrize("right, top", [(66, H), (30, H), (26, 27)])
def test_object_cut_off_by_the_frame_is_accepted(tmp_path, right, top):
    mask = WHITE.copy()  # on 40, 60 and 85 % of the border
    mask[:top, W - right :] = 0
    assert_array_equal(load(tmp_path, mask)[0], mask)


def test_background_that_is_not_black_stays_where_edges_are_soft(tmp_path):
    soft = np.uint8(np.round(25 + 230 * disc()))
    mask, said = load(tmp_path, soft)
    assert_array_equal(mask, soft)
    assert "25 of 255" in said
    mask, _ = load(tmp_path, channels(WHITE, SOFT // 2))
    assert_allclose(mask / 255, SOFT / 255, atol=0.01)


@pytest.mark.parametrize("way", ["background=dodgerblue", "background=#1e90ff,30"])
def test_background_colour_gives_partial_coverage_at_edges(tmp_path, way):
    covered, back = disc(2.0), np.array([30, 144, 255])
    shade = np.array([200, 60, 40]) * (0.6 + 0.4 * np.arange(H) / H)[:, None, None]
    photo = covered[..., None] * shade + (1 - covered[..., None]) * back
    photo[:2, :2] = 0  # specks, one in the object
    photo[41, 50] = back
    noisy = photo + default_rng(2).normal(0, 1, photo.shape)
    mask, said = load(tmp_path, np.clip(np.round(noisy), 0, 255).astype(np.uint8), way)
    off = lambda mask: np.sqrt(np.mean((mask / 255 - covered) ** 2))
    assert off(mask) < 0.012
    assert off(255 * (mask > 127)) > 0.05  # soft edges say more
    assert np.all(mask[:2, :2] == 0)
    assert f"differs from {way[11:].split(',')[0]} by more" in said
    assert ("30.0 in CIE Lab (as told)" in said) == ("30" in way)


MILLION = "o" * 10**6
RUN_LENGTHS = {
    '[{"size": [2, 2], "counts": [4]}]': "got .*; give one of a list",
    "[[1.0, 1.0, 6.0, 1.0, 6.0, 4.0]]": "of polygons .*frPyObjects",
    "null": "got None",
    '{"counts": [4]}': "`size` and `counts`",
    '{"size": [2, -2], "counts": [4]}': "`size`",
    '{"size": [2, 2], "counts": [1.5, 2.5]}': "whole numbers",
    '{"size": [2, 2], "counts": [3]}': "runs of 4 pixels, got 3",
    '{"size": [2, 2], "counts": [5, -1]}': "at least 0",
    r'{"size": [2, 2], "counts": "\n"}': "pycocotools' text",
    f'{{"size": [2, 2], "counts": "{MILLION}"}}': "pycocotools' text",  # soon
}


@pytest.mark.parametrize("text", RUN_LENGTHS, ids=lambda text: text[:40])
def test_run_lengths_that_are_none_are_refused(text):
    with refusal(RUN_LENGTHS[text]) as caught:
        io.mask_of_rle(json.loads(text))
    assert "`rle`" in str(caught.value)


@pytest.mark.parametrize("quality", [10, 75, 100])
@pytest.mark.parametrize("picture", [SOFT, HARD])
def test_jpegs_are_masks_whose_ringing_is_small(tmp_path, quality, picture):
    mask, _ = load(tmp_path, picture, ending="jpg", how={"quality": quality})
    assert np.sqrt(np.mean((mask / 255 - picture / 255) ** 2)) < 0.1


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int32, np.float32])
@pytest.mark.parametrize("softness", [1, 3, 9])
def test_masks_of_two_levels_and_soft_edges_are_read_in_any_depth(tmp_path, dtype, softness):
    most = {np.uint16: 26001, np.float32: 1}.get(dtype, 255)
    levels = (disc(softness) * most + 0.5 * (most > 1)).astype(dtype)
    assert_allclose(load(tmp_path, levels, ending="tiff")[0] / 255, disc(softness), atol=1 / 200)
    load(tmp_path, levels.repeat(3, 0).repeat(3, 1), ending="tiff")


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
    assert_array_equal(result, to(expected))
    assert notes == ("1 island of at most 9 px dropped", "1 hole of at most 1 px filled")
    assert io.tidy_mask(result) == (pytest.approx(result), ())


def test_tidy_mask_describes_and_leaves_a_sound_mask():
    mask = np.zeros((60, 80), bool)
    mask[:30, 10:30] = mask[40:60, 50:60] = True
    result, notes = io.tidy_mask(mask)
    assert_array_equal(result, mask)
    parts = "2 parts (75%, 25% of the covered area): all one object?"
    assert notes == (parts, "the film cuts the mask off: top, bottom")
    assert io.tidy_mask(mask | True).notes == ("the mask covers all",)
    assert io.tidy_mask(mask & False).notes == ("the mask covers nothing",)
    assert io.tidy_mask(soft_square(), speck=0.0).notes == (
        "2 parts (100%, 0% of the covered area): all one object?",
    )


def test_bad_arguments_of_tidy_mask_are_refused():
    with refusal(r"`mask`: expected shape \(H, W\)"):
        io.tidy_mask(np.zeros(3))
    with refusal("`speck`: expected a share of the object, 0 <= speck < 1, got 1.0"):
        io.tidy_mask(np.zeros((3, 3)), speck=1.0)


@pytest.mark.parametrize("softness", [1, 2, 3])
@pytest.mark.parametrize("back", [0, 255])
@pytest.mark.parametrize("kind", ["two hues", "smooth"])
def test_many_colours_that_fade_to_the_background_are_refused(tmp_path, kind, softness, back):
    hues = 255 * np.dstack([SMOOTH_X < 50, 0 * SMOOTH_X, SMOOTH_X >= 50])
    share = disc(softness)[..., None]
    mixed = (SMOOTH if kind == "smooth" else hues) * share + back * (1 - share)
    with refusal(r"a soft edge, too.* alpha .*--mask-from luminance\)"):
        load(tmp_path, channels(np.uint8(np.round(mixed)), np.uint8(255 * (share > 0))))
