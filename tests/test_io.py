import json

import jax
import numpy as np
import pytest
import trimesh
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

import pinhole_jax as pj
from pinhole_jax import io

BOX = trimesh.creation.box()
CAMERA = pj.Camera([1.0, 2, 5], [0.1, 0, 0], [0.3, 1, 0.2], 0.7, 2.0, 30, 20)


@pytest.mark.parametrize("ending", ["obj", "ply", "stl", "off", "glb"])
def test_formats_give_the_same_closed_mesh(tmp_path, ending):
    path = tmp_path / f"box.{ending}"
    BOX.export(path)
    mesh = pj.load_mesh(path)
    assert mesh.closed
    assert (mesh.vertices.shape, mesh.faces.shape, mesh.edge_vertices.shape) == (
        (8, 3),
        (12, 3),
        (18, 2),
    )
    np.testing.assert_allclose(np.ptp(np.asarray(mesh.vertices), axis=0), 1)
    assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume > 0.999


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

    text = tmp_path / "far.obj"  # digits, all of which float64 holds
    text.write_text("v 100000.1 0 0\nv 100000.2 0.3 0\nv 100000.3 0 0.1\nf 1 2 3\n")
    pj.load_mesh(text)
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.warns(UserWarning, match="or set jax_enable_x64") as told:
            pj.load_mesh(text)
        assert len(told) == 1
    finally:
        jax.config.update("jax_enable_x64", True)


def test_scenes_are_flattened_with_their_transforms(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(BOX, transform=trimesh.transformations.translation_matrix([5, 0, 0]))
    scene.add_geometry(BOX, transform=trimesh.transformations.scale_matrix(2.0))
    scene.export(tmp_path / "two.glb")
    mesh = pj.load_mesh(tmp_path / "two.glb")
    assert mesh.closed
    assert mesh.faces.shape == (24, 3)
    low, high = np.min(mesh.vertices, axis=0), np.max(mesh.vertices, axis=0)
    np.testing.assert_allclose([low, high], [[-1, -1, -1], [5.5, 1, 1]], atol=1e-6)


def test_quads_are_triangulated_and_equal_vertices_merged(tmp_path):
    # A cube of six quads, each with four vertices of its own.
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    lines = [f"v {x} {y} {z}" for quad in quads for x, y, z in corners[quad]]
    lines += [f"f {4 * k + 1} {4 * k + 2} {4 * k + 3} {4 * k + 4}" for k in range(6)]
    (tmp_path / "cube.obj").write_text("\n".join(lines))
    mesh = pj.load_mesh(tmp_path / "cube.obj")
    assert mesh.closed
    assert (mesh.vertices.shape, mesh.faces.shape) == ((8, 3), (12, 3))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("empty.obj", "", "expected a mesh file, .* empty"),
        ("points.obj", "v 0 0 0\nv 1 0 0\n", "expected a mesh with faces|readable mesh"),
        ("nan.off", "OFF\n3 1 0\n0 0 0\nnan 0 0\n0 1 0\n3 0 1 2\n", "expected finite vertices"),
        (
            "far.off",
            "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n",
            "expected faces with vertices 0 to 2|readable mesh",
        ),
        ("noise.ply", "hello", "expected a readable mesh"),
        ("mesh.txt", "v 0 0 0", "expected one of .dae, .obj"),
    ],
)
def test_bad_mesh_files_are_refused_with_the_reason(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match="`path`: " + message):
        pj.load_mesh(tmp_path / name)


def test_missing_files_and_folders_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"`path`: expected a mesh file, .*no such file"):
        pj.load_mesh(tmp_path / "no.obj")
    with pytest.raises(ValueError, match=r"`path`: .* a folder"):
        pj.load_mesh(tmp_path)


def test_real_meshes_load(shared):
    for name, faces, closed in (
        ("spot.obj", 5856, True),
        ("teapot.obj", 6320, False),
        ("counter.stl", 83750, True),
    ):
        mesh = pj.load_mesh(shared / "meshes" / name)
        assert (mesh.faces.shape[0], mesh.closed) == (faces, closed)


@pytest.mark.parametrize("lens", [None, pj.Lens([14.0, 11.0], 1.1)])
def test_cameras_go_to_files_and_back(tmp_path, lens):
    camera = pj.Camera(CAMERA.e, CAMERA.p, CAMERA.u, 0.7, 2.0, 30, 20, lens)
    io.save_camera(tmp_path / "deep" / "camera.json", camera, note="kept")
    back = io.load_camera(tmp_path / "deep" / "camera.json")
    for name in ("e", "p", "u", "phi", "d"):
        np.testing.assert_array_equal(getattr(back, name), getattr(camera, name))
    assert (back.W, back.H) == (30, 20)
    assert (back.lens is None) == (lens is None)
    data = json.loads((tmp_path / "deep" / "camera.json").read_text())
    assert data["note"] == "kept"
    np.testing.assert_allclose(
        np.linalg.det([data["pose"][k] for k in ("right", "up", "forward")]), -1
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"e": None}, "`e`: expected"),
        ({"phi": "wide"}, "`phi`: expected a finite number"),
        ({"W": 0}, "`W`: expected an integer of at least 1"),
        ({"schema": "other/7"}, "`schema`: expected one of pinhole_jax.camera/1, got 'other/7'"),
        ({"lens": 3}, "`lens`: expected principal_point"),
        ({"phi_degrees": 41}, r"`phi_degrees`: expected 40.107, as `phi` says \(0.7 rad\), got 41"),
        ({"phi_degrees": "wide"}, "`phi_degrees`: expected a finite number, got 'wide'"),
        ({"phi": 0.71}, "`phi_degrees`: expected 40.68"),
        ({"pose": 3}, r"expected fields with names, got 3 \(in .*, pose\)"),
        (
            {"pose": {"eye": [1, 2, 6]}},
            r"`pose`: expected eye = \[1.0, 2.0, 5.0\], as e, p, u, phi and",
        ),
        ({"pose": {"up": [0, 1, 0]}}, "`pose`: expected up = "),
        ({"pose": {"focal_px": [30, 30]}}, "`pose`: expected focal_px = "),
        ({"pose": {"principal_point": [15, 9]}}, "`pose`: expected principal_point = "),
        ({"pose": {"eye": [1, 2]}}, "`eye`: expected finite numbers"),
        ({"e": [1, 2, 6]}, "`pose`: expected "),
    ],
)
def test_wrong_fields_are_named(tmp_path, change, message):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({**io.camera_to_dict(CAMERA), **change}))
    with pytest.raises(ValueError, match=message):
        io.load_camera(path)


def test_redundant_fields_may_be_left_out_or_rounded(tmp_path):
    path = tmp_path / "camera.json"
    data = io.camera_to_dict(CAMERA)
    pose = {name: np.round(value, 5).tolist() for name, value in data["pose"].items()}
    path.write_text(json.dumps({**data, "pose": pose, "phi_degrees": 40.11}))
    np.testing.assert_array_equal(io.load_camera(path).phi, CAMERA.phi)
    del data["pose"], data["phi"]
    path.write_text(json.dumps({**data, "phi_degrees": 30}))
    np.testing.assert_allclose(io.load_camera(path).phi, np.deg2rad(30))


def test_missing_fields_and_files_that_are_no_json(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text("[1, 2]")
    with pytest.raises(ValueError, match=r"expected fields with names, got \[1, 2\]"):
        io.load_camera(path)
    path.write_text('{"e": [0, 0, 1]}')
    with pytest.raises(ValueError, match="`p`: expected a camera's field"):
        io.load_camera(path)
    path.write_text("{")
    with pytest.raises(ValueError, match="expected JSON"):
        io.load_camera(path)
    with pytest.raises(FileNotFoundError, match="expected a camera file"):
        io.load_camera(tmp_path / "no.json")


def test_masks_are_grey_or_transparency(tmp_path):
    random = np.random.default_rng(0)
    mask = (random.random((5, 7)) > 0.5).astype(np.uint8) * 255
    Image.fromarray(mask).save(tmp_path / "grey.png")
    Image.fromarray(mask > 0).save(tmp_path / "one_bit.png")
    Image.fromarray(np.dstack([mask] * 3)).save(tmp_path / "rgb.png")
    colour = random.integers(0, 255, (5, 7, 3), np.uint8)
    Image.fromarray(np.dstack([colour, mask])).save(tmp_path / "alpha.png")
    for name in ("grey", "one_bit", "rgb", "alpha"):
        np.testing.assert_array_equal(io.load_mask(tmp_path / f"{name}.png"), mask)
    Image.fromarray(colour).save(tmp_path / "photo.png")
    with pytest.raises(ValueError, match=r"`path`: expected a mask, .* a colour picture"):
        io.load_mask(tmp_path / "photo.png")
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(ValueError, match="`path`: expected a readable image"):
        io.load_mask(tmp_path / "text.png")
    with pytest.raises(FileNotFoundError, match="expected an image file"):
        io.load_mask(tmp_path / "none.png")


def test_grey_picture_is_refused_with_the_ways_to_read_it(tmp_path):
    path = tmp_path / "ramp.png"
    ramp = np.tile(np.arange(256, dtype=np.uint8), (20, 1))
    Image.fromarray(ramp).save(path)
    with pytest.raises(ValueError, match=r"80% of the pixels are neither .* label=N, background="):
        io.load_mask(path)
    np.testing.assert_array_equal(io.load_mask(path, "luminance"), ramp)
    with pytest.raises(ValueError, match=r"expected a mask, .* no transparency"):
        io.load_mask(path, "alpha")
    Image.fromarray(ramp // 64).save(path)
    with pytest.raises(
        ValueError, match=r"flat areas of the values 0, 1, 2, 3; .* `mask_from` label=1 "
    ):
        io.load_mask(path)
    Image.fromarray(np.uint8(7 * (ramp > 99))).save(path)
    with pytest.raises(ValueError, match=r"no lighter than 7 of 255; `mask_from` label=7"):
        io.load_mask(path)


def test_pictures_of_the_values_0_and_1_are_masks(tmp_path):
    inside = np.zeros((8, 9), bool)
    inside[2:6, 3:7] = True
    grey, coloured = (Image.fromarray(np.uint8(inside), mode) for mode in ("L", "P"))
    coloured.putpalette([0, 0, 0, 128, 0, 0])
    for image, words in ((grey, "its values 0 and 1"), (coloured, "its palette's entry 1")):
        image.save(tmp_path / "mask.png")
        said = []
        mask = io.load_mask(tmp_path / "mask.png", say=said.append)
        np.testing.assert_array_equal(mask, np.uint8(255 * inside))
        assert said == [f"mask: {words}"]
    coloured.putpalette([255, 0, 0, 0, 0, 0])  # which of the two is the object?
    coloured.save(tmp_path / "mask.png")
    with pytest.raises(ValueError, match="a colour picture"):
        io.load_mask(tmp_path / "mask.png")


@pytest.mark.parametrize("kind", ["grey", "palette", "16 bits"])
def test_label_image_gives_the_pixels_of_one_label(tmp_path, kind):
    labels = np.random.default_rng(1).integers(0, 4, (9, 7), np.uint8)
    if kind == "palette":
        image = Image.fromarray(labels).convert("P")
        image.putpalette([255, 0, 0, 9, 9, 9, 9, 9, 9, 0, 0, 255])  # two entries look alike
    else:
        image = Image.fromarray(labels.astype(np.uint8 if kind == "grey" else np.uint16))
    image.save(tmp_path / "labels.png")
    said = []
    for number in range(4):
        mask = io.load_mask(tmp_path / "labels.png", f"label={number}", said.append)
        np.testing.assert_array_equal(mask, 255 * (labels == number))
    assert "mask: label 3, " in said[3]
    assert "edges hard" in said[3]
    with pytest.raises(ValueError, match="no pixel with the label 7; there are 0, 1, 2, 3"):
        io.load_mask(tmp_path / "labels.png", "label=7")
    Image.fromarray(np.dstack([labels] * 3)).save(tmp_path / "rgb.png")
    with pytest.raises(ValueError, match="mode RGB: labels are grey values or a palette's"):
        io.load_mask(tmp_path / "rgb.png", "label=1")


def test_background_colour_gives_partial_coverage_at_edges(tmp_path):
    # A disk with a hole, 40 times finer than its pixels: coverage by counting.
    n, fine = 64, 40
    y, x = (np.mgrid[: n * fine, : n * fine] + 0.5) / fine
    r = np.hypot(x - 30.3, y - 33.1)
    disk = ((r < 22.4) & (r > 6.2)).reshape(n, fine, n, fine).mean(axis=(1, 3))
    random = np.random.default_rng(2)
    shade = np.array([200, 60, 40]) * (0.6 + 0.4 * np.arange(n) / n)[:, None, None]
    back = np.array([30, 144, 255])
    photo = disk[..., None] * shade + (1 - disk[..., None]) * back
    photo[:2, :2] = 0  # specks, one in the object
    photo[14, 30] = back
    noisy = np.clip(np.round(photo + random.normal(0, 1, photo.shape)), 0, 255).astype(np.uint8)
    Image.fromarray(noisy).save(tmp_path / "photo.png")
    with pytest.raises(ValueError, match=r"`path`: expected a mask, .* a colour picture"):
        io.load_mask(tmp_path / "photo.png")
    for way in ("background=dodgerblue", "background=#1e90ff,30"):
        said = []
        mask = io.load_mask(tmp_path / "photo.png", way, said.append) / 255
        assert np.sqrt(np.mean((mask - disk) ** 2)) < 0.012
        assert np.sqrt(np.mean((np.round(mask) - disk) ** 2)) > 0.05  # soft edges say more
        assert np.all(mask[:2, :2] == 0)
        assert said[0].startswith("mask: what differs from " + way[11:].split(",")[0] + " by more")
    assert "by more than 30.0 in CIE Lab (as told)" in said[0]
    Image.new("RGB", (9, 9)).save(tmp_path / "photo.png")
    with pytest.raises(ValueError, match="a picture of one colour"):
        io.load_mask(tmp_path / "photo.png", "background=black")


@pytest.mark.parametrize("way", ["", "alpha=1", "label", "label=-1", "background=", "Alpha", "hue"])
def test_unknown_mask_source_is_refused(tmp_path, way):
    with pytest.raises(ValueError, match=r"`mask_from`: expected one of alpha, .*got "):
        io.load_mask(tmp_path / "none.png", way)


def test_unknown_colour_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"`mask_from`: expected a colour such as .*'bluish'"):
        io.load_mask(tmp_path / "none.png", "background=bluish")


def test_jpeg_ringing_costs_less_than_a_threshold(tmp_path):
    n = 96
    y, x = np.mgrid[:n, :n] + 0.5
    disk = np.clip(30.4 - np.hypot(x - 47.2, y - 45.9) + 0.5, 0, 1)  # soft over a pixel
    Image.fromarray(np.round(255 * disk).astype(np.uint8)).save(tmp_path / "m.jpg", quality=75)
    mask = io.load_mask(tmp_path / "m.jpg") / 255
    error = lambda a: np.sqrt(np.mean((a - disk) ** 2))
    assert 0 < error(mask) < 0.4 * error(np.round(mask))


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
    ("size", "orientation", "tags", "height_mm", "focal_mm"),
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
        {"FocalLength": 35.0},  # of what sensor?
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


def test_files_are_never_half_written(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text("before")
    with pytest.raises(ValueError, match="Out of range"):
        io.save_camera(path, CAMERA, rms=float("nan"))
    assert path.read_text() == "before"
    assert [p.name for p in tmp_path.iterdir()] == ["camera.json"]


@pytest.mark.parametrize("mask", [[[0.0, 1, 1.5]], [[False, True, True]], [[0, 255, 255]]])
def test_masks_of_any_type_are_read_as_coverage(mask):
    array = np.array(mask, np.uint8 if mask[0][1] == 255 else None)
    np.testing.assert_array_equal(io.as_coverage(array), [[0, 1, 1]])


def test_mask_of_labels_is_no_coverage():
    with pytest.raises(ValueError, match="`mask`: expected integers that are all 0 or 1"):
        io.as_coverage(np.array([[0, 3, 7]]))
    with pytest.raises(ValueError, match=r"`mask`: expected shape \(H, W\)"):
        io.as_coverage(np.zeros(3))


def test_text_is_written_whole_and_read_back(tmp_path):
    path = tmp_path / "deep" / "page.txt"
    io.save_text(path, "größer <b>1</b> \udcff")
    assert io.load_text(path) == r"größer <b>1</b> \udcff"
    with pytest.raises(ValueError, match="`path`: expected a text file of at most 10 bytes"):
        io.load_text(path, most_bytes=10)
    with pytest.raises(ValueError, match="`path`: expected a file to write"):
        io.save_text(tmp_path, "")


def test_json_names_each_field_once(tmp_path):
    path = tmp_path / "data.json"
    io.save_text(path, '{"a": [1, 2]}')
    assert io.load_json(path) == {"a": [1, 2]}
    io.save_text(path, '{"a": 1, "a": 2}')
    with pytest.raises(ValueError, match=r"`path`: expected JSON, got .*data\.json"):
        io.load_json(path)


def test_picture_of_any_kind_is_read_as_rgb(tmp_path):
    for shape in ((4, 5), (4, 5, 3), (4, 5, 4)):
        image = np.random.default_rng(0).integers(0, 255, shape).astype(np.uint8)
        io.save_image(tmp_path / "image.png", image)
        rgb = io.load_image(tmp_path / "image.png", rgb=True)
        expected = image[..., :3] if image.ndim == 3 else np.stack([image] * 3, axis=-1)
        np.testing.assert_array_equal(rgb, expected)
