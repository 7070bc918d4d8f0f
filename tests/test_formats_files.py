"""An error names what is wrong with a camera file, the file and the field; and the doors."""

import json
import struct

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pinhole_jax as pj
from pinhole_jax import formats

CAMERA = pj.Camera([1.0, 2, 5], [0.1, 0, 0], [0.3, 1, 0.2], 0.7, 1.0, 40, 31)
LENS = formats.cropped(CAMERA, 3, -2, 30, 25)
EYE = [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
NERF = {"fl_x": 40, "w": 8, "h": 6, "frames": [{"file_path": "a", "transform_matrix": EYE}]}
BLENDER = {"lens": 18, "resolution_x": 8, "resolution_y": 6, "matrix_world": EYE}
GLTF = {
    "nodes": [{"camera": 0}],
    "cameras": [
        {"type": "perspective", "perspective": {"yfov": 1}, "extras": {"W": 8, "H": 6}},
    ],
}
P3D = {
    "R": [np.eye(3).tolist()],
    "T": [[0, 0, 3]],
    "focal_length": [[4, 4]],
    "principal_point": [[4, 3]],
    "image_size": [[6, 8]],
    "in_ndc": False,
}


def changed(data, path, value):
    """Return a copy with one field changed, or without it (value None)."""
    data = json.loads(json.dumps(data))
    *way, last = path
    part = data
    for step in way:
        part = part[step]
    if value is None:
        del part[last]
    else:
        part[last] = value
    return data


def matrix(value):
    return {"frames": [{"file_path": "a", "transform_matrix": value}]}


SKEWED = [[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
MIRRORED = np.diag([-1.0, 1, 1, 1]).tolist()
JSON_CASES = [
    ({**NERF, **matrix(SKEWED)}, r"`transform_matrix`: expected a rotation \(orthonormal, det"),
    ({**NERF, **matrix(MIRRORED)}, "`transform_matrix`: expected a rotation"),
    ({**NERF, **matrix([[1, 2], [3, 4]])}, r"`transform_matrix`: .* of shape \(4, 4\), got \[\[1,"),
    ({**NERF, **matrix("x")}, r"`transform_matrix`: .*got 'x' \(in '.*c.json', frames\[0\]\)"),
    ({**NERF, **matrix(np.full((4, 4), np.nan).tolist())}, "`transform_matrix`: expected finite"),
    (
        {**NERF, **matrix([*EYE[:3], [0, 0, 0, 2]])},
        "`transform_matrix`: .* its last row 0 0 0 1, got",
    ),
    (changed(NERF, ["frames", 0, "transform_matrix"], None), "`transform_matrix`: .*no such field"),
    ({**NERF, "frames": 3}, "`frames`: expected a list, got 3"),
    ({**NERF, "frames": [3]}, "expected fields with names, got 3"),
    ({**NERF, "frames": NERF["frames"] * 2}, "expected one camera of each name, got two of 'a'"),
    ({**NERF, "k1": 0.1, "k4": -0.2}, "`distortion`: expected k1, .* k3 of a .* got k4 = -0.2"),
    ({**NERF, "k1": -60}, "`lens`: expected a distortion that holds up to the film's corners"),
    ({**NERF, "fl_x": True}, "`fl_x`: expected a positive number, got True"),
    ({**NERF, "fl_x": -4}, "`fl_x`: expected a positive number, got -4"),
    ({**NERF, "w": 8.5}, "`w`: expected an integer of at least 1, got 8.5"),
    ({**NERF, "camera_model": "ORTHOPHOTO"}, "`camera_model`: expected one of OPENCV, PINHOLE"),
    ({**NERF, "is_fisheye": True, "p1": 1}, "`distortion`: .* k4 of a Fisheye only, got p1 = 1"),
    (changed(NERF, ["fl_x"], None), "`fl_x`: expected fl_x .* or camera_angle_x"),
    (changed(changed(NERF, ["w"], None), ["h"], None), "`w`: .* no such field; give `size`"),
    (changed(NERF, ["h"], None), "`h`: expected an integer of at least 1, got no such field"),
    ({**changed(NERF, ["fl_x"], None), "camera_angle_x": 4}, r"`camera_angle_x`: .*\(0, pi\) rad"),
    ({**BLENDER, "sensor_fit": "FILL"}, "`sensor_fit`: expected one of AUTO, HORIZONTAL, VERTICAL"),
    ({**BLENDER, "type": "ORTHO"}, "`type`: expected one of PERSP, got 'ORTHO'"),
    ({**BLENDER, "lens": "50mm"}, "`lens`: expected a positive number, got '50mm'"),
    ({**BLENDER, "matrix_world": (2 * np.eye(4)).tolist()}, "`matrix_world`: expected a rotation"),
    (changed(BLENDER, ["lens"], None), "`lens`: expected a positive number, got no such field"),
    ({**P3D, "in_ndc": "no"}, "`in_ndc`: expected true or false, got 'no'"),
    ({**P3D, "T": [[0, 0]]}, r"`T`: expected finite numbers of shape \(1, 3\)"),
    ({**P3D, "names": []}, r"`names`: expected 1 names, got \[\]"),
    ({**P3D, "R": [SKEWED[0][:3] * 3]}, r"`R`: expected finite numbers of shape \(N, 3, 3\)"),
    (
        {**P3D, "focal_length": [[4, -4]]},
        r"`K`: expected positive focal .* fy = -4 \(in '.*c.json', camera 0\)",
    ),
    ({"e": [0, 0, 1]}, r"`p`: expected a camera's field, got no such .* \(in '.*c.json'\)"),
    ({"schema": "pinhole_jax.cameras/1", "cameras": {"a": 3}}, "expected fields with names, got 3"),
]


@pytest.mark.parametrize(("data", "message"), JSON_CASES)
def test_wrong_json(tmp_path, data, message):
    (tmp_path / "c.json").write_text(json.dumps(data))
    with pytest.raises(ValueError, match=message):
        formats.read(tmp_path / "c.json")


GLTF_CASES = [
    (changed(GLTF, ["cameras", 0, "type"], "orthographic"), "`type`: expected one of perspective"),
    (changed(GLTF, ["cameras", 0, "perspective", "aspectRatio"], 2), "`aspectRatio`: expected W/H"),
    (changed(GLTF, ["cameras", 0, "perspective", "yfov"], 4), r"`yfov`: expected an angle in"),
    (changed(GLTF, ["nodes", 0, "scale"], [2, 2, 2]), "`matrix`: expected a rotation"),
    (changed(GLTF, ["nodes", 0, "rotation"], [0, 0, 0, 2]), "`rotation`: expected a quaternion of"),
    (changed(GLTF, ["nodes", 0, "camera"], 1), "`camera`: expected a number below 1, got 1"),
    (changed(GLTF, ["nodes", 0, "children"], [0]), "`children`: expected a tree, got a circle"),
    (changed(GLTF, ["nodes", 0, "children"], 7), "`children`: expected a list, got 7"),
    (
        {
            **GLTF,
            "nodes": [{"camera": 0, "matrix": np.eye(4).ravel().tolist(), "scale": [1, 1, 1]}],
        },
        "`matrix`: expected one kind of transform, got both it and scale",
    ),
    (changed(GLTF, ["nodes", 0, "children"], [7]), "`children`: expected nodes with one parent"),
    (changed(GLTF, ["nodes"], []), "`cameras`: expected a node with a camera, got none"),
    (changed(GLTF, ["cameras", 0, "extras"], None), "`W`: .* no such field; give `size`"),
]


@pytest.mark.parametrize(("data", "message"), GLTF_CASES)
def test_wrong_gltf(tmp_path, data, message):
    (tmp_path / "c.gltf").write_text(json.dumps(data))
    with pytest.raises(ValueError, match=message):
        formats.read(tmp_path / "c.gltf")


def test_truncated_glb_is_refused(tmp_path):
    formats.write(tmp_path / "c.glb", {"a": CAMERA})
    whole = (tmp_path / "c.glb").read_bytes()
    (tmp_path / "c.glb").write_bytes(whole[:-4])
    with pytest.raises(ValueError, match=r"`path`: expected a whole glb of .* got .*: cut short"):
        formats.read(tmp_path / "c.glb")
    (tmp_path / "c.glb").write_bytes(whole[:16] + b"BIN\0" + whole[20:])
    with pytest.raises(ValueError, match="`path`: expected JSON first in a glb"):
        formats.read(tmp_path / "c.glb")
    (tmp_path / "c.glb").write_text("{")
    with pytest.raises(ValueError, match="`path`: expected glTF, got"):
        formats.read(tmp_path / "c.glb")


YAML_CASES = [
    ("rows: 3\n   cols: 3", "rows: 3", r"`camera_matrix`: expected an OpenCV matrix \(rows, cols"),
    ("dt: d", "dt: 2d", "`camera_matrix`: .* with one channel, got dt '2d'"),
    ("camera_matrix: !!", "camera_matrix: 3\nx: !!", r"`camera_matrix`: .* \(3, 3\), got 3"),
    ("camera_matrix", "camera_martix", "`camera_matrix`: .*no such field"),
    ("      1.0 ]", " ]", "`camera_matrix`: .* of 9 numbers, got 8"),
    ("      1.0 ]", " one ]", r"`camera_matrix`: expected finite numbers of a matrix, got \["),
    ("      1.0 ]", " 1.0 ]\nx: &a [ *a ]", "expected YAML, .* an alias"),
    ('[ "a" ]', "[ !!python/tuple a ]", None),
    ("camera_names", "&all camera_names", None),
    ("      1.0 ]", " .Nan ]", "`camera_matrix`: expected finite numbers"),
    ("      1.0 ]", " 2.0 ]", r"`camera_matrix`: expected \[\[fx, 0, cx\]"),
    ("image_width: 40", "image_width: wide", "`image_width`: expected an integer .* got 'wide'"),
    ("image_width: 40", "image_width 40", "line 4: expected YAML, got 'image_height: 31': mapping"),
    ("image_height: 31", "image_width: 31", "expected YAML, .*: the field 'image_width' twice"),
    ("image_height: 31", "imageWidth: 31", "`image_width`: expected one such field, got 'imageW"),
    ('"integer"', '"corner"', "`pixel_centres`: expected one of integer, half, got 'corner'"),
    ('[ "a" ]', '[ "a", "b" ]', r"`camera_names`: expected 1 different names, got \['a', 'b'\]"),
    ('[ "a" ]', '[ "a"', r"line 6: expected YAML, got .*: did not find expected"),
    ("R: !!", "Q: !!", "`R`: expected R and t, or extrinsic_parameters, got no pose"),
    ("\nt: !!", "\ns: !!", r"`t`: expected finite numbers of shape \(3,\), got no such field"),
    (
        "distortion_coefficients: !!",
        "D: [ 0, 0, 0, 0, 0, 0, 0, 0, 1e-3, 0, 0, 0 ]\nq: !!",
        "`distortion`: expected k1, .* of a Rational only, got s1 = 0.001",
    ),
    ("rows: 5\n   cols: 1", "rows: 1\n   cols: 1\n   sizes: [5]", None),
    (
        "distortion_coefficients: !!",
        "D: [ 1, 2, 3 ]\nq: !!",
        "`distortion_coefficients`: expected 4",
    ),
    (
        "camera_names",
        "rvec: [ 0, 0, 1 ]\nx",
        "`rvec`: expected one kind of pose, got both it and R",
    ),
    ("R: !!", "rvec: [ 0, 1e9, 1 ]\nx: !!", "`rvec`: expected a turn of at most 10000 rad"),
    ("camera_names", "extrinsic_parameters: [ 1 ]\nx", "`extrinsic_parameters`: expected one kind"),
]


@pytest.mark.parametrize(("old", "new", "message"), YAML_CASES)
def test_wrong_yaml(tmp_path, old, new, message):
    formats.write(tmp_path / "c.yaml", {"a": CAMERA})
    text = (tmp_path / "c.yaml").read_text()
    assert old in text
    (tmp_path / "c.yaml").write_text(text.replace(old, new, 1))
    if message is None:
        assert list(formats.read(tmp_path / "c.yaml")) == ["a"]
    else:
        with pytest.raises(ValueError, match=message):
            formats.read(tmp_path / "c.yaml")


def test_truncated_yaml_is_no_camera(tmp_path):
    """Wherever it ends within its matrices."""
    formats.write(tmp_path / "c.yaml", {"a": CAMERA})
    text = (tmp_path / "c.yaml").read_text()
    for end in range(text.index("camera_matrix"), len(text.rstrip()), 7):
        (tmp_path / "c.yaml").write_text(text[:end])
        with pytest.raises(ValueError, match="expected"):
            formats.read(tmp_path / "c.yaml")


FILM = '<film type="hdrfilm"><integer name="width" value="8"/></film>'
FOV = '<float name="fov" value="40"/>'
XML_CASES = [
    ("<scene>", "`path`: expected XML, got"),
    ("<scene/>", "`sensor`: expected one in a Mitsuba scene, got none"),
    ('<sensor type="thinlens"/>', "`type`: expected one of perspective, got 'thinlens'"),
    (FOV.replace("40", "200"), r"`fov`: expected an angle in \(0, 180\) degrees, got 200"),
    (FOV + FOV, "`fov`: expected one such property, got two"),
    (FOV + '<string name="focalLength" value="50mm"/>', "`fov`: expected it or focal_length, got"),
    (FOV + FILM, "`to_world`: expected one transform and one film, got two"),
    (FOV.replace("40", "$f"), r"`fov`: expected a finite number, got '\$f'"),
    (FOV.replace("40", "nan"), "`fov`: expected a finite number, got nan"),
    (FOV.replace(' value="40"', ""), "`value`: expected a value, got no such field .* <float>"),
    (FOV + '<string name="fov_axis" value="z"/>', "`fov_axis`: expected one of x, y, diagonal"),
    ("<up/>", r"`to_world`: expected matrix, lookat, rotate, translate or scale, got 'up'"),
    ('<scale value="2"/>', "`to_world`: expected a rotation"),
    ('<scale x="-1"/>', "`to_world`: expected a rotation"),
    (
        '<translate value="1, 2"/>',
        r"`value`: .* of shape \(3,\), got .* <translate>",
    ),
    ('<rotate angle="3"/>', "`rotate`: expected an axis, got none"),
    (
        '<matrix value="1 2 3"/>',
        r"`value`: .* of shape \(16,\), got .* <matrix>",
    ),
    (
        '<lookat origin="1,2" target="0,0,0" up="0,1,0"/>',
        r"`origin`: .* of shape \(3,\), got",
    ),
    (
        '<lookat origin="0,1,0" target="0,0,0" up="0,1,0"/>',
        "`up`: expected another direction than",
    ),
]


@pytest.mark.parametrize(("part", "message"), XML_CASES)
def test_wrong_xml(tmp_path, part, message):
    if part.startswith(("<scene", "<sensor")):
        text = part if part.startswith("<scene") else f"<scene>{part}</scene>"
    elif part.startswith("<float"):
        text = f'<scene><sensor type="perspective">{part}{FILM}</sensor></scene>'
    else:
        step = f'<transform name="to_world">{part}</transform>'
        text = f'<scene><sensor type="perspective">{FOV}{step}</sensor></scene>'
    (tmp_path / "c.xml").write_text(text)
    with pytest.raises(ValueError, match=message):
        formats.read(tmp_path / "c.xml")


CAMERAS_TXT = "1 PINHOLE 8 6 4 4 4 3\n"
IMAGES_TXT = "1 0 1 0 0 -1 2 3 1 a.png\n\n2 0 1 0 0 -1 2 4 1 b.png\n1 2 -1 3 4 5\n"
COLMAP_CASES = [
    ("PINHOLE", "FOV", "`MODEL`: expected one of SIMPLE_PINHOLE, .* got FOV"),
    ("4 4 4 3", "4 4 4", r"`PARAMS`: expected 4 numbers \(fx, fy, cx, cy\) of PINHOLE, got 3"),
    ("4 4 4 3", "4 four 4 3", "expected numbers, got could not convert .* 'four'"),
    ("4 4 4 3", "4 1_0 4 3", "expected numbers, got could not convert .* '1_0'"),
    (
        "4 4 4 3",
        "4 nan 4 3",
        r"`fy`: expected a positive number, got nan \(in .*cameras.txt', line 1",
    ),
    (
        "PINHOLE 8 6 4 4 4 3",
        "FULL_OPENCV 8 6 4 4 4 3 0 0 0 0 0 -50 0 0",
        "`lens`: expected a distortion that holds",
    ),
    ("1 PINHOLE 8 6 4 4 4 3", "1 PINHOLE", "expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, got"),
    ("1 PINHOLE", "1.7 PINHOLE", r"`CAMERA_ID`: expected a whole number, got '1.7' \(.*, line 1\)"),
    ("3 1 a.png", "3 1e999 a.png", "`CAMERA_ID`: expected a whole number, got '1e999'"),
    ("1 0 1 0", "inf 0 1 0", "`IMAGE_ID`: expected a whole number, got 'inf'"),
    ("2 0 1 0", "1 0 1 0", "`IMAGE_ID`: expected each once, got 1 twice"),
    ("1 PINHOLE", "2 PINHOLE", "`CAMERA_ID`: expected a camera of .*cameras.txt', got 1"),
    ("4 3\n", "4 3\n1 PINHOLE 8 6 4 4 4 3\n", "`CAMERA_ID`: expected each once, got 1 twice"),
    ("0 1 0 0 -1 2 3", "0 2 0 0 -1 2 3", "`QUATERNION`: expected a quaternion of length 1"),
    ("0 1 0 0 -1 2 3", "0 1 0 0 -1 2 inf", "`TRANSLATION`: expected finite numbers"),
    ("1 a.png", "", "expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got"),
    ("a.png\n\n", "a.png\n", r"expected the image's points \(X Y POINT3D_ID, or an empty"),
    ("b.png", "a.png", "expected one camera of each name, got two of 'a.png'"),
    (
        "1 0 1",
        "# Number of images: 3, mean\n1 0 1",
        "expected 3 entries, as its heading says, got 2",
    ),
]


@pytest.mark.parametrize(("old", "new", "message"), COLMAP_CASES)
def test_wrong_colmap_text(tmp_path, old, new, message):
    cameras, images = CAMERAS_TXT.replace(old, new, 1), IMAGES_TXT.replace(old, new, 1)
    (tmp_path / "cameras.txt").write_text(cameras)
    (tmp_path / "images.txt").write_text(images)
    with pytest.raises(ValueError, match=message):
        formats.read(tmp_path)


@pytest.mark.parametrize("comment", ["", "# Camera list\n"])
def test_colmap_text_may_begin_with_a_byte_order_mark(tmp_path, comment):
    for mark in ("", "\ufeff"):
        (tmp_path / f"m{mark}").mkdir()
        for name, text in (("cameras", CAMERAS_TXT), ("images", IMAGES_TXT)):
            (tmp_path / f"m{mark}" / f"{name}.txt").write_text(mark + comment + text, "utf-8")
    plain, marked = (formats.read(tmp_path / f"m{mark}") for mark in ("", "\ufeff"))
    assert [*marked] == [*plain] == ["a.png", "b.png"]
    assert np.array_equal(marked["a.png"].e, plain["a.png"].e)


def test_wrong_colmap_binary(tmp_path):
    formats.write(tmp_path, {"a": CAMERA, "b": LENS}, "colmap-binary")
    for name in ("cameras.bin", "images.bin"):
        whole = (tmp_path / name).read_bytes()
        for end in range(len(whole)):
            (tmp_path / name).write_bytes(whole[:end])
            with pytest.raises(ValueError, match=rf"expected more than {end} bytes, .*{name}"):
                formats.read(tmp_path)
        (tmp_path / name).write_bytes(whole + b"\0")
        with pytest.raises(ValueError, match=rf"expected {len(whole)} bytes, got {len(whole) + 1}"):
            formats.read(tmp_path)
        (tmp_path / name).write_bytes(whole)
    whole = (tmp_path / "cameras.bin").read_bytes()
    (tmp_path / "cameras.bin").write_bytes(whole[:12] + struct.pack("<i", 7) + whole[16:])
    with pytest.raises(ValueError, match=r"`MODEL`: expected one of .*, got number 7"):
        formats.read(tmp_path)


def test_model_is_not_written_beside_another(tmp_path):
    formats.write(tmp_path / "model", {"a": CAMERA})
    formats.write(tmp_path / "model", {"a": LENS})  # over its own kind it is
    with pytest.raises(
        ValueError, match=r"`folder`: expected none of another model, got cameras.txt"
    ):
        formats.write(tmp_path / "model", {"a": CAMERA}, "colmap-binary")
    with pytest.raises(ValueError, match=r"`cameras`: expected names COLMAP can hold, got 'a\\nb'"):
        formats.write(tmp_path / "other", {"a\nb": CAMERA})
    with pytest.raises(FileNotFoundError, match="`folder`: expected a COLMAP model"):
        formats.read(tmp_path)


@pytest.mark.parametrize(
    ("name", "cameras", "format", "message"),
    [
        ("c.glb", {"a": LENS}, None, "`cameras`: expected a centred principal point and square"),
        (
            "c.xml",
            {"a": formats.resized(CAMERA, 40, 40)},
            None,
            "`cameras`: expected square pixels, as Mitsuba",
        ),
        (
            "c.yaml",
            {"a": CAMERA, "b": LENS},
            None,
            "`cameras`: expected one K, lens and image size",
        ),
        ("c.py", {"a": CAMERA, "b": LENS}, None, "`cameras`: expected one resolution and pixel"),
        ("c.json", {}, None, "`cameras`: expected at least one, got none"),
        (
            "c.json",
            {"a": CAMERA},
            "usd",
            "`format`: expected one of json, opencv, colmap, .* 'usd'",
        ),
        (
            "c.usd",
            {"a": CAMERA},
            None,
            r"`path`: expected a folder \(COLMAP\) or one of .json, .yml",
        ),
    ],
)
def test_unsupported_cameras_are_not_written(tmp_path, name, cameras, format, message):
    with pytest.raises(ValueError, match=message):
        formats.write(tmp_path / name, cameras, format)
    assert not list(tmp_path.iterdir())


def test_unreadable_paths_are_refused_by_name(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"`path`: expected a camera file, .* no such file"):
        formats.read(tmp_path / "no.json")
    (tmp_path / "a.usd").write_text("")
    with pytest.raises(ValueError, match="formats are json, opencv, colmap, colmap-binary"):
        formats.read(tmp_path / "a.usd")
    formats.write(tmp_path / "a.py", {"a": CAMERA})
    with pytest.raises(ValueError, match="`format`: expected one that can be read, got 'blender-s"):
        formats.read(tmp_path / "a.py")
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(ValueError, match="`path`: expected JSON, got"):
        formats.read(tmp_path / "a.json")
    (tmp_path / "a.json").write_text("[]")
    with pytest.raises(ValueError, match=r"`path`: expected a JSON object, got \[\]"):
        formats.read(tmp_path / "a.json")
    (tmp_path / "a.json").write_bytes(b"\xff")
    with pytest.raises(ValueError, match=r"`path`: expected JSON, got .*: not UTF-8"):
        formats.read(tmp_path / "a.json")
    with pytest.raises(ValueError, match=r"`path`: expected a camera file, got .*: a folder"):
        formats.read(tmp_path, "json")
    with pytest.raises(ValueError, match="`format`: expected one of"):
        formats.read(tmp_path / "a.json", "usd")


def test_size_is_for_files_without_one(tmp_path):
    (tmp_path / "transforms.json").write_text(
        json.dumps({"camera_angle_x": 1.0, "frames": NERF["frames"]})
    )
    (camera,) = formats.read(tmp_path / "transforms.json", size=(20, 11)).values()
    np.testing.assert_allclose(np.tan(camera.phi / 2), np.tan(0.5) * 11 / 20, rtol=1e-12)
    for name in ("a.yaml", "own.json", "folder", "transforms_b.json", "pytorch3d.json"):
        formats.write(tmp_path / name, {"a": CAMERA})
        assert list(formats.read(tmp_path / name, size=(40, 31))) == ["a"]
        with pytest.raises(ValueError, match=r"expected .*40"):
            formats.read(tmp_path / name, size=(20, 11))
    (tmp_path / "p.json").write_text(json.dumps(changed(P3D, ["image_size"], None)))
    (camera,) = formats.read(tmp_path / "p.json", size=(8, 6)).values()
    assert (camera.W, camera.H) == (8, 6)
    (tmp_path / "s.xml").write_text(f'<sensor type="perspective">{FOV}</sensor>')
    (camera,) = formats.read(tmp_path / "s.xml", size=(8, 6)).values()
    assert (camera.W, camera.H) == (8, 6)


def test_files_are_never_half_written(tmp_path, monkeypatch):
    formats.write(tmp_path / "c.yaml", {"a": CAMERA})
    before = (tmp_path / "c.yaml").read_text()

    def broken(*paths):
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", broken)
    with pytest.raises(ValueError, match="disk full"):
        formats.write(tmp_path / "c.yaml", {"a": LENS})
    assert (tmp_path / "c.yaml").read_text() == before
    assert [p.name for p in tmp_path.iterdir()] == ["c.yaml"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"R": 2 * np.eye(3)}, r"`R`: expected a rotation .* \(in the arguments\)"),
        ({"R": "x"}, r"`R`: expected finite numbers of shape \(3, 3\), got 'x'"),
        ({"image_size": (6.5, 8)}, "`H`: expected an integer of at least 1, got 6.5"),
        ({"fov": 1.0}, "expected `focal_length` or `fov`, got both or neither"),
        ({"focal_length": [1, 2, 3]}, "`focal_length`: expected one number or two"),
        ({"focal_length": None, "fov": 60}, r"`fov`: expected an angle in \(0, pi\) rad, got 60"),
        ({"principal_point": [1]}, r"`principal_point`: expected finite numbers of shape \(2,\)"),
    ],
)
def test_wrong_pytorch3d_arguments(change, message):
    good = {"R": np.eye(3), "T": [0, 0, 3], "image_size": (6, 8), "focal_length": 1.0}
    with pytest.raises(ValueError, match=message):
        formats.from_pytorch3d(**{**good, **change})


def test_pixel_centres_shift_K_by_half_a_pixel():
    with pytest.raises(ValueError, match="`pixel_centres`: expected 'integer' or 'half'"):
        formats.to_opencv(CAMERA, pixel_centres="corner")
    half, integer = (formats.to_opencv(LENS, pixel_centres=c)[0] for c in ("half", "integer"))
    np.testing.assert_allclose((half - integer)[:2, 2], 0.5, rtol=0, atol=1e-12)


def test_pixel_centres_of_a_file_are_respected(tmp_path):
    formats.write_opencv(tmp_path / "c.yaml", {"a": LENS}, pixel_centres="half")
    assert max(map(float, pj.pose_error(formats.read(tmp_path / "c.yaml")["a"], LENS))) < 1e-12
    back = formats.read(tmp_path / "c.yaml")["a"].lens.principal_point
    np.testing.assert_allclose(back, LENS.lens.principal_point, atol=1e-12)
    with pytest.raises(ValueError, match="`pixel_centres`: expected 'integer' or 'half'"):
        formats.read_opencv(tmp_path / "c.yaml", pixel_centres="corner")


POINTS = jnp.asarray(np.random.default_rng(0).normal(size=(5, 3)) * 0.5)


def seen(camera):
    """Return image coordinates: px from the top-left corner, y down."""
    x, y = np.asarray(pj.project(camera, POINTS)).T
    return np.stack([x, camera.H - y], axis=1)


def test_crops_and_resizes_are_those_of_images():
    np.testing.assert_allclose(seen(formats.cropped(LENS, 7, -3, 11, 44)), seen(LENS) - [7, -3])
    np.testing.assert_allclose(
        seen(formats.cropped(CAMERA, 0.25, 1.5, 9, 9)), seen(CAMERA) - [0.25, 1.5]
    )
    np.testing.assert_allclose(seen(formats.resized(LENS, 45, 10)), seen(LENS) * [45 / 30, 10 / 25])
    assert formats.cropped(CAMERA, 5, 3, 30, 25).lens is None  # the middle stays the middle
    assert formats.resized(CAMERA, 80, 62).lens is None
    back = formats.cropped(formats.cropped(LENS, 7, -3, 11, 44), -7, 3, LENS.W, LENS.H)
    np.testing.assert_allclose(seen(back), seen(LENS), atol=1e-12)
    both = formats.resized(formats.cropped(CAMERA, 4, 2, 20, 10), 40, 20)
    other = formats.cropped(formats.resized(CAMERA, 80, 62), 8, 4, 40, 20)
    np.testing.assert_allclose(seen(both), seen(other), atol=1e-12)


def test_crops_and_resizes_differentiate():
    def moved(phi):
        camera = pj.Camera(CAMERA.e, CAMERA.p, CAMERA.u, phi, 1.0, 40, 31)
        camera = formats.resized(formats.cropped(camera, 4, 2, 20, 10), 30, 40)
        return jnp.sum(pj.project(camera, POINTS))

    slope, h = jax.grad(moved)(0.7), 1e-5
    np.testing.assert_allclose(slope, (moved(0.7 + h) - moved(0.7 - h)) / (2 * h), rtol=1e-7)


def test_bad_windows_are_refused():
    with pytest.raises(ValueError, match="`left`: expected finite values"):
        formats.cropped(CAMERA, np.nan, 0, 5, 5)
    for change in (
        lambda W: formats.cropped(CAMERA, 0, 0, W, 5),
        lambda W: formats.resized(CAMERA, W, 5),
    ):
        with pytest.raises(ValueError, match="`W`: expected an integer of at least 1"):
            change(0)
        with pytest.raises(ValueError, match="`W`: expected an integer of at least 1"):
            change(2.5)


def test_camera_is_read_by_name(tmp_path):
    camera = lambda y: pj.Camera([0, y, 5], [0, 0, 0], [0, 1, 0], 0.6, 1, 8, 6)
    formats.write(tmp_path / "two.json", {"a": camera(0), "b": camera(1)})
    formats.write(tmp_path / "one.json", {"a": camera(0)})
    assert float(formats.read_one(f"{tmp_path}/two.json:b").e[1]) == 1
    assert float(formats.read_one(tmp_path / "one.json").e[1]) == 0
    assert float(formats.read_one(f"{tmp_path}/one.json:a", size=(9, 9)).e[1]) == 0
    with pytest.raises(ValueError, match=r"`path`: expected one camera, or a name .* got 2 in"):
        formats.read_one(tmp_path / "two.json")
    with pytest.raises(ValueError, match=r"`path`: expected a name among .*, got 'c'"):
        formats.read_one(f"{tmp_path}/two.json:c")
    with pytest.raises(FileNotFoundError):
        formats.read_one(tmp_path / "no.json")
