"""An error names what is wrong with a camera file, the file and the field; and the doors."""

import re
import struct

import numpy as np
import pytest
from folders import put
from numpy.testing import assert_allclose
from oracles import off, skew_camera
from refusals import refusal, refuses
from test_distortion import BROWN, camera as lens_camera
from test_formats_oracles import image_points

from pinhole_jax import formats

CAMERA = skew_camera(40, 31)
LENS = formats.cropped(CAMERA, 3, -2, 30, 25)
EYE = "[[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]"
FRAME = f'{{"file_path": "a", "transform_matrix": {EYE}}}'
SENSOR = """<scene><sensor type="perspective"><float name="fov" value="40"/>
<transform name="to_world"><scale value="1"/></transform>
<film type="hdrfilm"><integer name="width" value="8"/></film></sensor></scene>"""
OWN = '{"e": [0, 0, 5], "p": [0, 0, 0], "u": [0, 1, 0], "phi": 1, "W": 8, "H": 6}'
MATRIX = """!!opencv-matrix
   rows: 3
   cols: %d
   dt: d
   data: [ %s ]
"""
YAML = f"""%YAML:1.0
---
image_width: 40
image_height: 31
pixel_centres: "integer"
camera_names: [ "a" ]
camera_matrix: {MATRIX % (3, "40., 0., 20., 0., 40., 15., 0., 0., 1.0")}
distortion_coefficients: [ 0., 0., 0., 0., 0. ]
R: {MATRIX % (3, "1., 0., 0., 0., 1., 0., 0., 0., 1.")}
t: {MATRIX % (1, "0., 0., 3.")}
"""
#: Files that are right, as text.
RIGHT = {
    "nerf.json": f'{{"fl_x": 40, "w": 8, "h": 6, "frames": [{FRAME}]}}',
    "blender.json": f'{{"lens": 18, "resolution_x": 8, "resolution_y": 6, "matrix_world": {EYE}}}',
    "p3d.json": """{"R": [[[1, 0, 0], [0, 1, 0], [0, 0, 1]]], "T": [[0, 0, 3]], "in_ndc": false,
        "focal_length": [[4, 4]], "principal_point": [[4, 3]], "image_size": [[6, 8]]}""",
    "own.json": f'{{"schema": "pinhole_jax.cameras/1", "cameras": {{"a": {OWN}}}}}',
    "c.gltf": """{"nodes": [{"camera": 0}], "cameras": [{"type": "perspective",
        "perspective": {"yfov": 1}, "extras": {"W": 8, "H": 6}}]}""",
    "c.xml": SENSOR,
    "c.yaml": YAML,
    "cameras.txt": "1 PINHOLE 8 6 4 4 4 3\n",
    "images.txt": "1 0 1 0 0 -1 2 3 1 a.png\n\n2 0 1 0 0 -1 2 4 1 b.png\n1 2 -1 3 4 5\n",
}
ROTATION = r": expected a rotation \(orthonormal, determinant 1\)"
#: Of each file: what is changed => to what, and the error.
WRONG = {
    "nerf.json": {
        "[1, 0, 0, 1] => [1, 0.1, 0, 0]": f"`transform_matrix`{ROTATION}",
        "[1, 0, 0, 1] => [-1, 0, 0, 1]": f"`transform_matrix`{ROTATION}",
        "[0, 0, 0, 1] => [0, 0, 0, 2]": "`transform_matrix`: .* its last row 0 0 0 1, got",
        "[[1, 0 => [[NaN, 0": "`transform_matrix`: expected finite numbers",
        f'{EYE} => "x"': r"`transform_matrix`: .*got 'x' \(in '.*json', frames\[0\]\)",
        f"{EYE} => [[1, 2], [3, 4]]": r"`transform_matrix`: .*\(3, 4\) or \(4, 4\), got \[",
        "transform_matrix => matrix": "`transform_matrix`: .*no such field",
        f"[{FRAME}] => 3": "`frames`: expected a list, got 3",
        f"{FRAME} => 3": "expected fields with names, got 3",
        f"{FRAME} => {FRAME}, {FRAME}": "expected one camera of each name, got two of 'a'",
        '{ => {"k1": 0.1, "k4": -0.2, ': "`distortion`: expected k1, .* got k4 = -0.2",
        '{ => {"k1": -60, ': "`lens`: expected a distortion that holds up to the film's corners",
        '{ => {"is_fisheye": true, "p1": 1, ': "`distortion`: .* Fisheye only, got p1 = 1",
        '{ => {"is_fisheye": "maybe", ': "`is_fisheye`: expected true or false, got 'maybe'",
        '{ => {"camera_model": "ORTHO", ': "`camera_model`: expected one of OPENCV, PINHOLE",
        'l_x": 40 => l_x": true': "`fl_x`: expected a positive number, got True",
        'l_x": 40 => l_x": -4': "`fl_x`: expected a positive number, got -4",
        "fl_x => f": "`fl_x`: expected fl_x .* or camera_angle_x",
        'fl_x": 40 => camera_angle_x": 4': r"`camera_angle_x`: .*\(0, pi\) rad, got 4",
        '"w": 8 => "w": 8.5': "`w`: expected an integer of at least 1, got 8.5",
        '"h" => "x"': "`h`: expected an integer of at least 1, got no such field",
        '"w": 8, "h": 6,  => ': "`w`: .* no such field; give `size`",
    },
    "blender.json": {
        '{ => {"sensor_fit": "FILL", ': "`sensor_fit`: expected one of AUTO, HORIZONTAL, VERT",
        '{ => {"type": "ORTHO", ': "`type`: expected one of PERSP, got 'ORTHO'",
        '18 => "50mm"': "`lens`: expected a positive number, got '50mm'",
    },
    "p3d.json": {
        'false => "so"': "`in_ndc`: expected true or false, got 'so'",
        "[[0, 0, 3]] => [[0, 0]]": r"`T`: expected finite numbers of shape \(3,\), got .*camera 0",
        '{ => {"names": [], ': r"`names`: expected a list of 1, got \[\]",
        "[[4, 4]] => [[4, -4]]": r"`K`: expected positive .* fy = -4 \(in .*json', camera 0\)",
    },
    "own.json": {
        f"{OWN} => 4": "expected fields with names, got 4",
        '"p" => "q"': r"`p`: expected .*, got no such field \(in .*, cameras, a\)",
    },
    "c.gltf": {
        '"perspective", => "orthographic",': "`type`: expected one of perspective",
        '": 1 => ": 1, "aspectRatio": 2': "`aspectRatio`: expected W/H",
        '": 0 => ": 0, "scale": [2, 2, 2]': f"`matrix`{ROTATION}",
        '": 0 => ": 0, "rotation": [0, 0, 0, 2]': "`rotation`: expected a quaternion of length 1",
        '": 0 => ": 0, "matrix": [], "scale": []': "`matrix`: .*, got both it and scale",
        '": 0 => ": 1': "`camera`: expected a number below 1, got 1",
        '": 0 => ": 0, "children": [0]': "`children`: expected a tree, got a circle",
        '": 0 => ": 0, "children": 7': "`children`: expected numbers of nodes below 1, got 7",
        '": 0 => ": 0, "children": [7]': "`children`: expected numbers of nodes below 1",
        '[{"camera": 0}] => []': "`cameras`: expected a node with a camera, got none",
        "extras => x": "`W`: .* no such field; give `size`",
    },
    "c.xml": {
        "</scene> => ": "`path`: expected XML, got",
        "sensor => shape": "`sensor`: expected one in a Mitsuba scene, got none",
        "perspective => thinlens": "`type`: expected one of perspective, got 'thinlens'",
        "40 => 200": r"`fov`: expected an angle in \(0, 180\) degrees, got 200",
        "40 => $f": r"`fov`: expected a finite number, got '\$f'",
        ' value="40" => ': "`value`: expected a value, got no such field .* <float>",
        '<film => <float name="fov" value="1"/><film': "`fov`: expected one such property",
        '<film => <string name="focalLength" value="5mm"/><film': "`fov`: expected it or focal",
        '<film => <string name="fov_axis" value="z"/><film': "`fov_axis`: expected one of x, y",
        '<film => <film type="x"/><film': "`to_world`: expected one transform and one film",
        'value="1" => x="-1"': f"`to_world`{ROTATION}",
        'scale value="1" => up': "`to_world`: expected matrix, lookat, rotate, translate or sc",
        'scale value="1" => translate value="1, 2"': r"`value`: .*\(3,\) or \(\), .*<translate>",
        'scale value="1" => matrix value="1 2 3"': r"`value`: .*\(9,\) or \(16,\).* <matr",
        'scale value="1" => rotate angle="3"': "`rotate`: expected an axis, got none",
        'scale value="1" => lookat origin="0,1,0" target="0,0,0" up="0,1,0"': (
            "`up`: expected another direction than the view's"
        ),
    },
    "c.yaml": {
        "   cols: 3\n => ": r"`camera_matrix`: expected an OpenCV matrix \(rows, cols, dt, data\)",
        "dt: d => dt: 2d": "`camera_matrix`: .* in one channel, got .*'dt': '2d'",
        ", 1.0 ] =>  ]": r"`camera_matrix`: .*: rows x cols finite numbers",
        "1.0 ] => one ]": r"`camera_matrix`: .*: rows x cols finite numbers",
        "1.0 ] => .Nan ]": "`camera_matrix`: .*: rows x cols finite numbers",
        "1.0 ] => 2.0 ]": r"`camera_matrix`: expected \[\[fx, 0, cx\]",
        "camera_matrix => martix": r"`camera_matrix`: expected .*, got no such field",
        "1.0 ] => 1.0 ]\nx: &a [ *a ]": "expected YAML, .* an alias",
        '[ "a" ] => [ !!python/tuple a ]': None,
        "camera_names => &all camera_names": None,
        "width: 40 => width: wide": "`image_width`: expected an integer .* got 'wide'",
        "width: 40 => width 40": "expected YAML, got .*: line 4, 'image_height: 31': mapping",
        "height: 31 => width: 31": "expected YAML, .*: the field 'image_width' twice",
        "image_height: 31 => imageWidth: 31": "`image_width`: expected one such field, got 'im",
        '"integer" => "corner"': "`pixel_centres`: expected one of integer, half, got 'corner'",
        '[ "a" ] => [ "a", "b" ]': r"`camera_names`: expected 1 different names, got \['a', 'b",
        '[ "a" ] => [ "a"': "line 6, .*: did not find expected",
        "R: !! => Q: !!": "`R`: expected R and t, or extrinsic_parameters, got no pose",
        "\nt: !! => \ns: !!": r"`t`: expected finite numbers of shape \(3,\), got no such field",
        "0., 0., 0., 0., 0. => 0, 0, 0, 0, 0, 0, 0, 0, 1e-3, 0, 0, 0": "Rational only, got s1",
        "0., 0., 0., 0., 0. => 1, 2, 3": "`distortion_coefficients`: expected 4 or 5",
        "R: !! => rvec: [ 0, 0, 1 ]\nR: !!": "`rvec`: expected one kind of pose, got both it",
        "R: !! => rvec: [ 0, 1e9, 1 ]\nx: !!": "`rvec`: expected a turn of at most 10000 rad",
        "R: !! => extrinsic_parameters: [ 1 ]\nR: !!": "`extrinsic_parameters`: expected one",
    },
    "cameras.txt": {
        "PINHOLE => FOV": "`MODEL`: expected one of SIMPLE_PINHOLE, .* got FOV",
        " 3\n => \n": r"`PARAMS`: expected 4 numbers \(fx, fy, cx, cy\) of PINHOLE, got 3",
        "4 4 4 => 4 four 4": "`fy`: expected a positive number, got 'four'",
        "4 4 4 => 4 1_0 4": "`fy`: expected a positive number, got '1_0'",
        "4 4 4 => 4 nan 4": r"`fy`: expected a positive number, got nan \(in .*txt', line 1",
        "PINHOLE 8 6 4 4 4 3 => PINHOLE": "expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, got",
        "1 => 1.7": r"`CAMERA_ID`: expected an integer of at least 0, got 1.7 \(in .*, line 1\)",
        "1 => 2": "`CAMERA_ID`: expected a camera of .*cameras.txt', got 1",
        "\n => \n1 PINHOLE 8 6 4 4 4 3\n": "`CAMERA_ID`: expected each once, got 1 twice",
    },
    "images.txt": {
        "1 0 => inf 0": "`IMAGE_ID`: expected an integer of at least 0, got inf",
        "2 0 => 1 0": "`IMAGE_ID`: expected each once, got 1 twice",
        "0 1 0 0 => 0 2 0 0": "`QUATERNION`: expected a quaternion of length 1",
        "2 3 => 2 inf": "`TRANSLATION`: expected finite numbers",
        "1 a.png => ": "expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got",
        "\n\n => \n": r"expected the image's points \(X Y POINT3D_ID, or an empty line\)",
        "b.png => a.png": "expected one camera of each name, got two of 'a.png'",
        "1 0 => # Number of images: 3, mean\n1 0": "expected 3 entries, as its heading says, got",
    },
}


@pytest.mark.parametrize("file", WRONG)
def test_wrong_fields_of_every_format_are_named(tmp_path, file):
    for name, text in RIGHT.items():
        put(tmp_path, name, text)
    path = tmp_path if file.endswith("txt") else tmp_path / file
    assert formats.read(path)
    for change, message in WRONG[file].items():
        old, new = change.split(" => ")
        assert old in RIGHT[file]
        count = -1 if old == "sensor" else 1
        put(tmp_path, file, RIGHT[file].replace(old, new, count))
        if message is None:
            assert list(formats.read(path)) == ["a"]
            continue
        with refusal(message):
            formats.read(path)


def test_binary_name_that_is_no_text_is_named(tmp_path):
    formats.write(tmp_path, {"first": CAMERA}, "colmap-binary")
    images = tmp_path / "images.bin"
    images.write_bytes(images.read_bytes().replace(b"first", b"\xe0irst"))
    with refusal(r"`NAME`: expected text, got bytes that are no UTF-8 \(.*, image 1\)"):
        formats.read(tmp_path)


def test_truncated_files_are_refused(tmp_path):
    for name in ("c.glb", "c.yaml"):
        formats.write(tmp_path / name, {"a": CAMERA})
        whole = (tmp_path / name).read_bytes()
        first = whole.find(b"camera_matrix") if name == "c.yaml" else 1
        for end in range(first, len(whole.rstrip()), 7):
            (tmp_path / name).write_bytes(whole[:end])
            with refusal("expected"):
                formats.read(tmp_path / name)
    formats.write(tmp_path / "c.glb", {"a": CAMERA})
    whole = (tmp_path / "c.glb").read_bytes()
    for data, message in (
        (whole[:-4], "`path`: expected a whole glb of .* got .*: cut short"),
        (whole[:16] + b"BIN\0" + whole[20:], "`path`: expected JSON first in a glb"),
        (b"{", "`path`: expected glTF, got"),
    ):
        path = put(tmp_path, "c.glb", data)
        with refusal(message):
            formats.read(path)


def test_colmap_text_may_begin_with_a_byte_order_mark(tmp_path):
    for comment in ("", "# Camera list\n"):
        for name in ("cameras.txt", "images.txt"):
            put(tmp_path, name, "\ufeff" + comment + RIGHT[name])
        marked = formats.read(tmp_path)
        assert [*marked] == ["a.png", "b.png"]
        assert_allclose(marked["a.png"].e, [1, 2, 3], atol=1e-12)


def test_wrong_colmap_binary(tmp_path):
    formats.write(tmp_path, {"a": CAMERA, "b": LENS}, "colmap-binary")
    for name in ("cameras.bin", "images.bin"):
        whole = (tmp_path / name).read_bytes()
        wrong = {
            whole[:end]: f"expected more than {end} bytes, .*{name}" for end in range(len(whole))
        }
        wrong[whole + b"\0"] = f"expected {len(whole)} bytes, got {len(whole) + 1}"
        if name == "cameras.bin":
            other = whole[:12] + struct.pack("<i", 7) + whole[16:]
            wrong[other] = "`MODEL`: expected one of .*, got number 7"
        for data, message in wrong.items():
            put(tmp_path, name, data)
            with refusal(message):
                formats.read(tmp_path)
        put(tmp_path, name, whole)


def test_model_is_not_written_beside_another(tmp_path):
    formats.write(tmp_path / "model", {"a": CAMERA})
    formats.write(tmp_path / "model", {"a": LENS})  # over its own kind it is
    with refusal(r"`folder`: expected none of another model, got camera"):
        formats.write(tmp_path / "model", {"a": CAMERA}, "colmap-binary")
    with pytest.raises(FileNotFoundError, match="`folder`: expected a COLMAP model"):
        formats.read(tmp_path)


NAMES = "`format`: expected one of json, opencv, colmap, .* 'usd'"


UNSUPPORTED = {
    "`cameras`: expected a centred principal point and square": ("c.glb", {"a": LENS}),
    "`cameras`: expected square pix": ("c.xml", {"a": formats.resized(CAMERA, 40, 40)}),
    "`cameras`: expected one K, lens and image": ("c.yaml", {"a": CAMERA, "b": LENS}),
    "`cameras`: expected one resolution and pixel": ("c.py", {"a": CAMERA, "b": LENS}),
    "`cameras`: expected at least one, got none": ("c.json", {}),
    r"`path`: expected a folder \(COLMAP\) or one of .json": ("c.usd", {"a": CAMERA}),
    NAMES: ("c.json", {"a": CAMERA}, "usd"),
}


@pytest.mark.parametrize("message", UNSUPPORTED)
def test_unsupported_cameras_are_not_written(tmp_path, message):
    name, *given = UNSUPPORTED[message]
    with refusal(message):
        formats.write(tmp_path / name, *given)
    assert not list(tmp_path.iterdir())


UNREADABLE = {
    "formats are json, opencv, colmap, colmap-binary": ("a.usd", b""),
    "`format`: expected one that can be read, got 'blender-s": ("a.py", b""),
    "`path`: expected JSON, got": ("a.json", b"{"),
    r"`path`: expected one of json, opencv, .*, got \[\] \(in": ("a.json", b"[]"),
    "`path`: expected JSON, got .*: not UTF-8": ("a.json", b"\xff"),
    NAMES: ("a.json", b"{}", "usd"),
}


@pytest.mark.parametrize("message", UNREADABLE)
def test_unreadable_paths_are_refused_by_name(tmp_path, message):
    name, data, *format = UNREADABLE[message]
    path = put(tmp_path, name, data)
    with refusal(message):
        formats.read(path, *format)


def test_size_is_for_files_without_one(tmp_path):
    for name, text in {
        "transforms.json": f'{{"camera_angle_x": 1, "frames": [{FRAME}]}}',
        "p.json": RIGHT["p3d.json"].replace("image_size", "x"),
        "s.xml": re.sub("(?s)<film.*</film>", "", SENSOR),
    }.items():
        (camera,) = formats.read(put(tmp_path, name, text), size=(20, 11)).values()
        assert (camera.W, camera.H) == (20, 11)
    for name in ("a.yaml", "own.json", "folder", "transforms_b.json", "pytorch3d.json"):
        formats.write(tmp_path / name, {"a": CAMERA})
        assert list(formats.read(tmp_path / name, size=(40, 31))) == ["a"]
        with refusal(r"expected .*40"):
            formats.read(tmp_path / name, size=(20, 11))


def test_files_are_never_half_written(tmp_path, monkeypatch):
    formats.write(tmp_path / "c.yaml", {"a": CAMERA})
    before = (tmp_path / "c.yaml").read_text()

    def broken(*paths):
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", broken)
    with refusal("disk full"):
        formats.write(tmp_path / "c.yaml", {"a": LENS})
    assert (tmp_path / "c.yaml").read_text() == before
    assert [p.name for p in tmp_path.iterdir()] == ["c.yaml"]


test_wrong_pytorch3d_arguments_are_refused = refuses(
    formats.from_pytorch3d,
    {"R": np.eye(3), "T": [0, 0, 3], "image_size": (6, 8), "focal_length": 1.0},
    {
        r"`R`: expected finite numbers of shape \(3, 3\), got 'x'": {"R": "x"},
        "`H`: expected an integer of at least 1, got 6.5": {"image_size": (6.5, 8)},
        "expected `focal_length` or `fov`, got both or neither": {"fov": 1.0},
        "`focal_length`: expected one number or two": {"focal_length": [1, 2, 3]},
    },
)

DIAGONAL = np.diag([70.0, 70, 1])
test_wrong_opencv_arguments_are_refused = refuses(
    formats.from_opencv,  # (and so `Camera.from_K`)
    {"K": DIAGONAL, "R": np.eye(3), "t": [0, 0, 3], "W": 64, "H": 48, "pixel_centres": "half"},
    {
        "`R`: expected a rotation matrix": {"R": 2 * np.eye(3)},
        "`R`: expected a rotation": {"R": -np.eye(3)},
        "`R`: expected a real array of shape": {"R": [[1], [2, 3]]},
        "`t`: expected finite values, got nan at index .2": {"t": [0, 0, np.nan]},
        "`t`: expected a real array of shape .* got None": {"t": None},
        "`pixel_centres`: expected 'integer' or 'half', got 'corner'": {"pixel_centres": "corner"},
        "`pixel_centres`: expected 'integer' or": {"pixel_centres": np.array(["half"] * 2)},
        "`K`: expected no skew, got 1": {"K": DIAGONAL + np.eye(3, k=1)},
        r"`K`: expected \[\[fx, 0, cx\]": {"K": np.zeros((3, 3))},
        "`K`: expected positive focal lengths .*fy = -70": {"K": np.diag([70.0, -70, 1])},
        "`K`: expected positive focal lengths .*fy = 1e.200": {"K": np.diag([70.0, 1e200, 1])},
        r"`K`: expected a real array of shape \(3, 3\), got": {"K": [[70, 0], [0, 70, 1]]},
        r"`K`: expected a real array of shape \(3, 3\), got 'K'": {"K": "K"},
        "`W`: expected an integer of at least 1, got None": {"W": None},
        "`H`: expected an integer of at least 1, got '48'": {"H": "48"},
    },
)


def test_pixel_centres_of_a_file_are_those_that_it_names(tmp_path):
    path = tmp_path / "c.yaml"
    formats.write_opencv(path, {"a": LENS}, pixel_centres="half")
    back = formats.read(path)["a"]
    assert off(back, LENS) < 1e-12
    assert_allclose(back.lens.principal_point, LENS.lens.principal_point, atol=1e-12)
    with refusal("`pixel_centres`: expected 'integer' or 'half'"):
        formats.read_opencv(path, pixel_centres="corner")


def test_name_alone_is_that_of_one_pose(tmp_path):
    alone = YAML.replace('[ "a" ]', "b")
    assert [*formats.read(put(tmp_path, "c.yaml", alone))] == ["b"]
    poses = "extrinsic_parameters: [ [ 0, 0, 0, 0, 0, 3 ], [ 0, 0, 0, 0, 0, 4 ] ]\n"
    two = put(tmp_path, "c.yaml", alone.partition("R: ")[0] + poses)
    with refusal("`camera_names`: expected 2 different names, got 'b'"):
        formats.read(two)


def test_crops_and_resizes_are_those_of_images():
    crop, resize, bent = formats.cropped, formats.resized, lens_camera(BROWN)
    for camera, film in (
        (crop(bent, 5, 3, 40, 30), image_points(bent) - [5, 3]),
        (resize(bent, bent.W // 2, bent.H // 4), image_points(bent) * [0.5, 0.25]),
        (crop(CAMERA, 0.25, 1.5, 9, 9), image_points(CAMERA) - [0.25, 1.5]),
        (crop(crop(LENS, 7, -3, 11, 44), -7, 3, LENS.W, LENS.H), image_points(LENS)),
        (resize(crop(CAMERA, 4, 2, 20, 10), 40, 20), 2 * (image_points(CAMERA) - [4, 2])),
    ):
        assert_allclose(image_points(camera), film, atol=1e-12)
    assert crop(CAMERA, 5, 3, 30, 25).lens is None  # the middle stays the middle
    assert resize(CAMERA, 80, 62).lens is None


def test_bad_windows_are_refused():
    with refusal("`left`: expected finite values"):
        formats.cropped(CAMERA, np.nan, 0, 5, 5)
    with refusal("`W`: expected an integer of at least 1"):
        formats.resized(CAMERA, 2.5, 5)


def test_camera_is_read_by_name(tmp_path):
    path = tmp_path / "two.json"
    formats.write(path, {"a": CAMERA, "b": LENS})
    assert formats.read_one(f"{path}:b", size=(9, 9)).W == LENS.W
    for asked, message in (
        (path, r"expected one camera, or FILE:NAME .* got 2 cameras"),
        (f"{path}:c", r"`path`: expected one .* among .*, got 'c'"),
    ):
        with refusal(message):
            formats.read_one(asked)
    formats.write(path, {"a": CAMERA})
    assert formats.read_one(path).W == CAMERA.W
