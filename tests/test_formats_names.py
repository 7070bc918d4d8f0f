"""What a writer writes, its reader and the other program read back, for hostile names too."""

import ast
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from oracles import skew_camera, turned

import pinhole_jax as pj
from pinhole_jax import formats

#: All of one K, which an OpenCV file asks for, and of one resolution, which a Blender scene does;
#: near and far.
BASE = skew_camera(64, 49)
CAMERAS = [turned(BASE, 50 * k, 10.0 ** (k - 3), axis=[3, 1, 2]) for k in range(6)]
HOSTILE = [
    "", " ", "a b", " a", "a ", "a  b", "a\nb", "a\r\nb", "a\tb", "\n", "\0", "a\0b", "\x01",
    "a\x01f",
    "\x1b[2J", "\x7f", "\x85", "a\x0bb", "a\x1cb", "\u2028", "\xa0", "\ufeff", "\ufffe", "\ud800",
    "é", "日本", "\U0010ffff", '"', "'", '"a"', "'a'", "\\", "\\n", 'a\\"', "a\\", "a: b", "a # b",
    "# a", "- a", "%YAML:1.0", "---", "...", "!!opencv-matrix", "[ 1, 2 ]", "a, b", "]", "{}", "~",
    "null", "true", "1", "1.5", "1e5", ".Nan", "</x>", "<!--", "]]>", "&amp;", "&#10;", "$a", "a$",
    "..", ".", "/", "../../x", "/etc/x", "a.png", "x" * 63, "x" * 64, "x" * 4095, "x" * 4096,
    "é" * 2047, "é" * 2048, "x" * 100_000, '"\nR: !!opencv-matrix\n', "a\ncamera_matrix: 3",
    "__proto__", "camera", "cameras", "name", "e", "schema", "sensor", "sensor_1", "a\nR: 3",
]  # fmt: skip


def names_of_yaml(path):
    cv2 = pytest.importorskip("cv2")
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    names = storage.getNode("camera_names")
    K = storage.getNode("camera_matrix").mat()
    assert_array_equal(K, formats.to_opencv(BASE, pixel_centres="integer")[0])
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


#: The names in a file, as the other program reads them, or a reader of its language. (Python's own
#: JSON reads the other formats as ours does.)
OTHERS = {
    "opencv": names_of_yaml,
    "colmap": names_of_model,
    "colmap-binary": names_of_model,
    "blender-script": names_of_script,
    "mitsuba": lambda path: [s.get("id") for s in ET.parse(path).iter("sensor")],
}


def check_round_trip(folder, format, names):
    """Write cameras of these names, and return whether they were taken, or raise."""
    cameras = {name: CAMERAS[k % len(CAMERAS)] for k, name in enumerate(names)}
    known = formats.FORMATS[format]
    path = folder / "".join(["a", *known.endings[-1:]])
    try:
        formats.write(path, cameras, format)
    except ValueError as error:
        assert str(error).startswith("`cameras`: expected names")  # noqa: PT017
        assert any(repr(name[:9])[1:-1] in str(error) for name in names)  # noqa: PT017
        return False
    assert format not in OTHERS or OTHERS[format](path) == list(cameras)
    if known.read is not None:
        back = formats.read(path, format)
        assert list(back) == list(cameras)
        for name, original in cameras.items():
            angle, shift = map(float, pj.pose_error(back[name], original))
            assert angle + shift / np.abs(original.e).max() < 1e-6
    return True


@pytest.mark.parametrize("format", formats.FORMATS)
def test_hostile_names_come_back_or_are_refused(tmp_path, format):
    taken = {name for name in HOSTILE if check_round_trip(tmp_path, format, [name])}
    assert {"é", "日本", "a.png", "camera", '"a"', "</x>"} <= taken
    assert ("a b" in taken) == (format != "colmap")  # whose text ends a name there
    assert not taken & {"\ud800"}
    check_round_trip(tmp_path, format, sorted(taken))
