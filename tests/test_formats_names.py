"""What a writer writes, its reader and the other program read back, for hostile names too."""

import ast
import json
import struct
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings, strategies as st

import pinhole_jax as pj
from pinhole_jax import formats


def random_camera(seed):
    random = np.random.default_rng(seed)
    size = 10.0 ** random.uniform(-3, 4)
    e, p, u = random.normal(size=(3, 3))
    return pj.Camera(size * e, size * p, u, random.uniform(0.05, 2.5), 1.0, 64, 49)


#: All of one K, which an OpenCV file asks for, and of one resolution, which a Blender scene does.
FIRST = random_camera(0)
CAMERAS = [FIRST] + [
    pj.Camera(c.e, c.p, c.u, FIRST.phi, 1.0, 64, 49) for c in map(random_camera, range(1, 6))
]
HOSTILE = [
    "", " ", "a b", " a", "a ", "a  b", "a\nb", "a\r\nb", "a\tb", "\n", "\0", "a\0b", "\x01",
    "a\x01f",
    "\x1b[2J", "\x7f", "\x85", "a\x0bb", "a\x1cb", "\u2028", "\xa0", "\ufeff", "\ufffe", "\ud800",
    "é", "日本", "\U0010ffff", '"', "'", '"a"', "'a'", "\\", "\\n", 'a\\"', "a\\", "a: b", "a # b",
    "# a", "- a", "%YAML:1.0", "---", "...", "!!opencv-matrix", "[ 1, 2 ]", "a, b", "]", "{}", "~",
    "null", "true", "1", "1.5", "1e5", ".Nan", "</x>", "<!--", "]]>", "&amp;", "&#10;", "$a", "a$",
    "..", ".", "/", "../../x", "/etc/x", "a.png", "x" * 63, "x" * 64, "x" * 4095, "x" * 4096,
    "é" * 2047, "é" * 2048, "x" * 100_000, '"\nR: !!opencv-matrix\n', "a\ncamera_matrix: 3",
    "__proto__", "camera", "cameras", "name", "e", "schema", "sensor", "sensor_1",
]  # fmt: skip
NAMES = st.one_of(st.sampled_from(HOSTILE), st.text(max_size=20))


def names_of_glb(path):
    data = path.read_bytes()
    return [
        n["name"] for n in json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])["nodes"]
    ]


def names_of_yaml(path):
    cv2 = pytest.importorskip("cv2")
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    names = storage.getNode("camera_names")
    K = storage.getNode("camera_matrix").mat()
    np.testing.assert_array_equal(K, formats.to_opencv(FIRST, pixel_centres="integer")[0])
    return [names.at(k).string() for k in range(names.size())]


def names_of_model(path):
    pycolmap = pytest.importorskip("pycolmap")
    images = pycolmap.Reconstruction(str(path)).images
    return [images[key].name for key in sorted(images)]


def names_of_script(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    (cameras,) = (
        node.value
        for node in tree.body
        if isinstance(node, ast.Assign) and node.targets[0].id == "CAMERAS"
    )
    return list(ast.literal_eval(cameras))


def load(path):
    return json.loads(path.read_text(encoding="utf-8"))


#: A format's file, and the names that the other program reads in it.
OTHERS = {
    "json": ("a.json", lambda path: list(load(path).get("cameras") or [load(path)["name"]])),
    "opencv": ("a.yaml", names_of_yaml),
    "colmap": ("model", names_of_model),
    "colmap-binary": ("model", names_of_model),
    "nerf": ("a.json", lambda path: [frame["file_path"] for frame in load(path)["frames"]]),
    "blender": ("a.json", lambda path: list(load(path)["cameras"])),
    "blender-script": ("a.py", names_of_script),
    "gltf": ("a.glb", names_of_glb),
    "pytorch3d": ("a.json", lambda path: load(path)["names"]),
    "mitsuba": ("a.xml", lambda path: [s.get("id") for s in ET.parse(path).iter("sensor")]),
}


def check_round_trip(folder, format, names):
    """Write cameras of these names, and return whether they were taken, or raise."""
    cameras = {name: CAMERAS[k % len(CAMERAS)] for k, name in enumerate(names)}
    name, names_in = OTHERS[format]
    path = folder / name
    try:
        formats.write(path, cameras, format)
    except ValueError as error:
        assert str(error).startswith("`cameras`: expected names")  # noqa: PT017
        assert any(repr(name[:9])[1:-1] in str(error) for name in names)  # noqa: PT017
        return False
    assert names_in(path) == list(cameras)
    if formats.FORMATS[format].read is not None:
        back = formats.read(path, format)
        assert list(back) == list(cameras)
        for camera, original in zip(back.values(), cameras.values(), strict=True):
            assert (camera.W, camera.H) == (original.W, original.H)
            for one, other in zip(
                formats.to_opencv(camera, pixel_centres="half"),
                formats.to_opencv(original, pixel_centres="half"),
                strict=True,
            ):
                size = np.abs(other).max()
                np.testing.assert_allclose(one, other, rtol=0, atol=1e-9 * max(size, 1))
    return True


@pytest.mark.parametrize("format", OTHERS)
def test_hostile_names_come_back_or_are_refused(tmp_path, format):
    assert OTHERS.keys() == formats.FORMATS.keys()
    taken = {name for name in HOSTILE if check_round_trip(tmp_path, format, [name])}
    assert {"é", "日本", "a.png", "camera", '"a"', "</x>"} <= taken
    assert ("a b" in taken) == (format != "colmap")  # whose text ends a name there
    assert not taken & {"\ud800"}
    check_round_trip(tmp_path, format, sorted(taken))


@pytest.mark.parametrize("format", OTHERS)
@settings(
    max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(names=st.lists(NAMES, min_size=1, max_size=4, unique=True))
@example(names=["a\nR: 3", "b"])
def test_names_come_back_or_are_refused(tmp_path, format, names):
    check_round_trip(tmp_path, format, names)
