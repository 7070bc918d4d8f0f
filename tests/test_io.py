import json

import equinox as eqx
import jax
import numpy as np
import pytest
import trimesh
from folders import put
from numpy.testing import assert_allclose, assert_array_equal
from oracles import skew_camera
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational
from refusals import pairs, refusal

import pinhole_jax as pj
from pinhole_jax import io

BOX = trimesh.creation.box()
CAMERA = skew_camera(30, 20, d=2.0)


def test_faces_of_a_file_share_edges(tmp_path):
    BOX.export(tmp_path / "box.stl")  # which repeats each corner
    mesh = pj.load_mesh(tmp_path / "box.stl")
    assert mesh.closed
    assert [len(x) for x in (mesh.vertices, mesh.faces, mesh.edge_vertices)] == [8, 12, 18]


def test_vertices_rounded_coarsely_are_reported(tmp_path):
    path = tmp_path / "far.stl"
    far = BOX.copy()
    far.apply_translation([1e5, 0, 0])
    far.export(path)
    with pytest.warns(UserWarning, match=r"steps of 0.0078, 1/128 of the object.*far.stl"):
        pj.load_mesh(path)
    said = []
    pj.load_mesh(path, say=said.append)
    assert "lies 1e+05 from the origin" in said[0]
    assert "the file itself has float32 numbers" in said[0]

    # Digits that float64 holds.
    corners = "v 100000.1 0 0\nv 100000.2 0.3 0\nv 100000.3 0 0.1\nf 1 2 3\n"
    text = put(tmp_path, "far.obj", corners)
    pj.load_mesh(text)
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.warns(UserWarning, match="or set jax_enable_x64") as told:
            pj.load_mesh(text)
        assert len(told) == 1
    finally:
        jax.config.update("jax_enable_x64", True)


def test_vertices_beyond_float32_load_without_a_word(tmp_path):
    path = put(tmp_path, "far.obj", "v 0 0 0\nv 1e300 0 0\nv 0 1e300 0\nf 1 2 3\n")
    assert np.max(pj.load_mesh(path).vertices) == 1e300


@pytest.mark.parametrize("lens", [None, pj.Lens([14.0, 11.0], 1.1)])
def test_cameras_go_to_files_and_back(tmp_path, lens):
    camera, path = CAMERA.replace(lens=lens), tmp_path / "deep" / "camera.json"
    io.save_camera(path, camera, note="kept")
    assert eqx.tree_equal(io.load_camera(path), camera)
    data = json.loads(path.read_text())
    assert data["note"] == "kept"
    assert_allclose(np.linalg.det([data["pose"][k] for k in ("right", "up", "forward")]), -1)


#: A field with its new value, and the error.
WRONG = {
    "e = null": "`e`: expected",
    'phi = "wide"': "`phi`: expected a finite number",
    "W = 0": "`W`: expected an integer of at least 1",
    'schema = "other/7"': "`schema`: expected one of pinhole_jax.camera/1, got 'other/7'",
    "lens = 3": "`lens`: expected fields with names, got 3",
    'lens = {"principal_point": [1, 2], "k1": 0.1}': r"`lens`: .*, got also \['k1'\]",
    "phi_degrees = 41": r"`phi_degrees`: expected 40.107, as `phi` says \(0.7 rad\), got 41",
    'phi_degrees = "wide"': "`phi_degrees`: expected a finite number, got 'wide'",
    "phi = 0.71": "`phi_degrees`: expected 40.68",
    "pose = 3": "`pose`: expected fields with names, got 3",
    'pose = {"eye": [1, 2, 6]}': r"`pose`: expected eye = \[1.0, 2.0, 5.0\], as e, p, u, phi and",
    'pose = {"up": [0, 1, 0]}': "`pose`: expected up = ",
    'pose = {"focal_px": [30, 30]}': "`pose`: expected focal_px = ",
    'pose = {"principal_point": [15, 9]}': "`pose`: expected principal_point = ",
    'pose = {"eye": [1, 2]}': "`eye`: expected finite numbers",
    "e = [1, 2, 6]": "`pose`: expected ",
}


@pairs("change, words", WRONG)
def test_wrong_fields_are_named(tmp_path, change, words):
    field, value = change.split(" = ")
    data = {**io.camera_to_dict(CAMERA), field: json.loads(value)}
    path = put(tmp_path, "camera.json", json.dumps(data))
    with refusal(words):
        io.load_camera(path)


def test_redundant_fields_may_be_left_out_or_rounded(tmp_path):
    path = tmp_path / "camera.json"
    data = io.camera_to_dict(CAMERA)
    pose = {name: np.round(value, 5).tolist() for name, value in data["pose"].items()}
    path.write_text(json.dumps({**data, "pose": pose, "phi_degrees": 40.11}))
    assert_array_equal(io.load_camera(path).phi, CAMERA.phi)
    del data["pose"], data["phi"]
    path.write_text(json.dumps({**data, "phi_degrees": 30}))
    assert_allclose(io.load_camera(path).phi, np.deg2rad(30))


def save_exif(path, size, orientation=1, **tags):
    """Save a photo (a light patch in the stored picture's upper left) with EXIF data."""
    image = Image.new("RGB", size)
    image.paste((255, 255, 255), (0, 0, size[0] // 3, size[1] // 3))
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    exif[ExifTags.IFD.Exif] = {ExifTags.Base[k].value: v for k, v in tags.items()}
    image.save(path, exif=exif, quality=95)


# Where the stored picture's first row and column are in an upright one (EXIF 2.3, 4.6.4 A).
UPPER_LEFT_SEEN_AT = {1: "tl", 2: "tr", 3: "br", 4: "bl", 5: "tl", 6: "tr", 7: "br", 8: "bl"}


@pytest.mark.parametrize("orientation", range(1, 9))
def test_photos_are_turned_upright_masks_too(tmp_path, orientation):
    save_exif(tmp_path / "p.jpg", (60, 36), orientation)
    seen = io.load_image(tmp_path / "p.jpg")[..., 0]
    assert seen.shape == ((36, 60) if orientation < 5 else (60, 36))
    place = UPPER_LEFT_SEEN_AT[orientation]
    row, column = 0 if place[0] == "t" else -1, 0 if place[1] == "l" else -1
    assert seen[row, column] > 200
    assert np.mean(seen > 128) == pytest.approx(1 / 9, abs=0.02)
    for way in (None, "background=black"):
        mask = io.load_mask(tmp_path / "p.jpg", way)
        assert mask.shape == seen.shape
        assert mask[row, column] > 200


FULL_FRAME = {"FocalLengthIn35mmFilm": 50}
# A sensor of 23.5 x 15.6 mm with 6000 x 4000 pixels, in pixels to the inch.
SENSOR = {
    "FocalLength": 35.0,
    "FocalPlaneXResolution": 6000 / (23.5 / 25.4),
    "FocalPlaneResolutionUnit": 2,
    "ExifImageWidth": 6000,
    "ExifImageHeight": 4000,
}


@pytest.mark.parametrize(
    "size, orientation, tags, height_mm, focal_mm",
    [
        ((60, 40), 1, FULL_FRAME, 24, 50),
        ((60, 40), 6, FULL_FRAME, 36, 50),  # held upright
        ((40, 60), 1, FULL_FRAME, 36, 50),
        ((80, 60), 1, FULL_FRAME, 0.6 * np.hypot(36, 24), 50),  # 4:3 of the same diagonal
        ((60, 40), 1, SENSOR, 23.5 * 2 / 3, 35),  # a smaller copy
        ((60, 40), 8, SENSOR, 23.5, 35),
        ((40, 60), 1, SENSOR, 23.5, 35),  # turned by a program that forgot the sizes
        ((60, 40), 1, {**FULL_FRAME, **SENSOR}, 24, 50),
    ],
)
def test_exif_gives_the_field_of_view(tmp_path, size, orientation, tags, height_mm, focal_mm):
    save_exif(tmp_path / "p.jpg", size, orientation, **tags)
    fov = io.photo_fov(tmp_path / "p.jpg")
    assert fov.phi == pytest.approx(2 * np.arctan(height_mm / 2 / focal_mm), rel=1e-6)
    assert ("35mm" in fov.words) == ("FocalLengthIn35mmFilm" in tags)


@pytest.mark.parametrize(
    "tags",
    [
        {},
        {"FocalLengthIn35mmFilm": 0},  # unknown
        {"FocalLength": 35.0},  # without the sensor's size
        {**SENSOR, "ExifImageHeight": 6000},  # cropped since
        {**SENSOR, "FocalPlaneResolutionUnit": 1},  # no unit
        {**SENSOR, "FocalLength": IFDRational(1, 0)},
    ],
)
def test_exif_that_does_not_tell_gives_nothing(tmp_path, tags):
    save_exif(tmp_path / "p.jpg", (60, 40), **tags)
    assert io.photo_fov(tmp_path / "p.jpg") is None


def test_exif_that_contradicts_itself_says_so(tmp_path):
    save_exif(tmp_path / "p.jpg", (60, 40), FocalLengthIn35mmFilm=100, **SENSOR)
    assert "0.54 times as long" in io.photo_fov(tmp_path / "p.jpg").words


@pytest.mark.parametrize("full", [1, 255, 65535])
@pytest.mark.parametrize("kind", [bool, "u1", "i2", "u2", "i8", "u4"])
def test_masks_of_two_values_are_read_as_coverage(kind, full):
    mask = np.array([[0, full, full]]).astype(kind)
    if np.all(mask == [[0, full, full]]):
        assert_array_equal(io.as_coverage(mask), [[0, 1, 1]])


def test_floats_are_held_to_coverage_and_labels_are_none():
    assert_array_equal(io.as_coverage(np.array([[0.0, 1, 1.5]])), [[0, 1, 1]])
    with refusal("`mask`: expected integers that are all 0 or 1"):
        io.as_coverage(np.array([[0, 3, 7]]))
    with refusal(r"`mask`: expected shape \(H, W\)"):
        io.as_coverage(np.zeros(3))


def test_text_and_json_are_written_whole_and_read_back(tmp_path):
    path = tmp_path / "deep" / "page.txt"
    io.save_text(path, "größer <b>1</b> \udcff")
    assert io.load_text(path) == r"größer <b>1</b> \udcff"
    with refusal(r"expected a text file, got .*: more than 10 bytes"):
        io.load_text(path, most_bytes=10)
    io.save_text(path, '{"a": [1, 2]}')
    assert io.load_json(path) == {"a": [1, 2]}


@pytest.mark.parametrize("channels", [(), (3,), (4,)])
def test_picture_of_any_kind_is_read_as_rgb(tmp_path, channels):
    image = np.random.default_rng(0).integers(0, 255, (4, 5, *channels), np.uint8)
    io.save_image(tmp_path / "image.png", image)
    expected = image[..., :3] if channels else np.stack([image] * 3, axis=-1)
    assert_array_equal(io.load_image(tmp_path / "image.png", rgb=True), expected)
