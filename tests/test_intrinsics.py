"""Files of intrinsics alone, as calibrations, networks and COLMAP write them."""

import json

import numpy as np
import pytest
from folders import put
from numpy.testing import assert_allclose
from refusals import refusal

import pinhole_jax as pj
from pinhole_jax.formats import read_intrinsics

cv2 = pytest.importorskip("cv2")

K = np.array([[300.0, 0, 321], [0, 310, 238], [0, 0, 1]])
HALVES = np.array([[300.0, 0, 321.5], [0, 310, 238.5], [0, 0, 1]])
BENT = [-0.21, 0.07, 0.001, -0.002]
FLAT = K.ravel().tolist()
ROS = f"""image_width: 640
image_height: 480
camera_name: narrow
camera_matrix: {{rows: 3, cols: 3, data: {FLAT}}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: {[*BENT, 0.0]}}}
rectification_matrix: {{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
projection_matrix: {{rows: 3, cols: 4, data: [9, 0, 9, 0, 0, 9, 9, 0, 0, 0, 1, 0]}}
"""
KALIBR = f"""cam0:
  camera_model: pinhole
  distortion_model: radtan
  distortion_coeffs: {BENT}
  intrinsics: [300, 310, 321, 238]
  resolution: [640, 480]
"""
COLMAP = "# Camera list\n1 OPENCV 640 480 300 310 321.5 238.5 -0.21 0.07 0.001 -0.002\n"
NAMED = {"fx": 300, "fy": 310, "cx": 321, "cy": 238}
#: A message of ROS 2, as `ros2 topic echo --once /camera_info` prints it.
CAMERA_INFO = json.dumps(
    {"height": 480, "width": 640, "distortion_model": "plumb_bob", "d": [*BENT, 0.0], "k": FLAT}
    | {"r": np.eye(3).ravel().tolist(), "p": np.eye(3, 4).ravel().tolist()}
    | {"binning_x": 0, "roi": {"width": 0, "do_rectify": False}}
)
FILES = {
    "ros.yaml": ROS,
    "camera_info.yaml": CAMERA_INFO,
    "camchain.yaml": KALIBR,
    "cameras.txt": COLMAP,
    "two/cameras.txt": COLMAP + "2 PINHOLE 640 480 500 500 320 240\n",
    "named.json": json.dumps({**NAMED, "width": 640, "height": 480, "dist": BENT}),
    "nested.json": json.dumps({"intrinsics": NAMED, "dist": BENT}),
    "matrix.json": json.dumps({"intrinsics": [K.tolist()], "dist": BENT, "depth": "a.npy"}),
    "flat.json": json.dumps({"cam_K": FLAT, "dist": BENT}),
    "transforms.json": json.dumps(
        {"fl_x": 300, "fl_y": 310, "cx": 321.5, "cy": 238.5, "w": 640, "h": 480, "frames": []}
        | dict(zip(("k1", "k2", "p1", "p2"), BENT, strict=True))
    ),
}


def check_lens(camera):
    assert (camera.W, camera.H) == (640, 480)
    matrix, _, _ = pj.formats.to_opencv(camera, pixel_centres="half")
    assert_allclose(matrix, HALVES, rtol=1e-12)
    coefficients = camera.distortion.coefficients()
    assert_allclose([*map(float, coefficients.values())], [*BENT, 0], rtol=1e-12)


@pytest.mark.parametrize("name", FILES)
def test_intrinsics_are_read_with_their_lens(name, tmp_path):
    path = put(tmp_path, name, FILES[name])
    asked = f"{path}:1" if name.startswith("two") else path
    check_lens(read_intrinsics(asked, size=(640, 480)))


def test_intrinsics_that_opencv_wrote_are_read(tmp_path):
    file = cv2.FileStorage(str(tmp_path / "calibration.yml"), cv2.FILE_STORAGE_WRITE)
    for name, value in (("image_width", 640), ("image_height", 480)):
        file.write(name, value)
    file.write("camera_matrix", K)
    file.write("distortion_coefficients", np.array([*BENT, 0.0])[None])
    file.release()
    check_lens(read_intrinsics(tmp_path / "calibration.yml"))


def test_intrinsics_of_a_camera_file_leave_its_pose_out(tmp_path):
    lens = {"pixel_centres": "integer", "distortion": pj.BrownConrady(*BENT)}
    camera = pj.Camera.from_K(K, np.eye(3), [0, 0, 9], 640, 480, **lens)
    pj.io.save_camera(tmp_path / "camera.json", camera)
    found = read_intrinsics(tmp_path / "camera.json")
    check_lens(found)
    assert_allclose(found.e, [0, 0, 1], atol=1e-12)


def test_row_of_numbers_is_a_matrix_in_json(tmp_path):
    found = read_intrinsics(put(tmp_path, "K.json", json.dumps(K.tolist())), size=(640, 480))
    assert_allclose(found.K, K, rtol=1e-12)
    assert found.distortion is None


@pytest.mark.parametrize(
    "name, text, words",
    [
        (
            "unit.json",
            json.dumps({"K": [[1.2, 0, 0.5], [0, 1.6, 0.5], [0, 0, 1]]}),
            "sides count as 1",
        ),
        (
            "few.json",
            json.dumps({"K": [1.0, 2.0]}),
            r"`K`: expected .*, or fx, fy, cx, cy, got \[1.0, 2.0\]",
        ),
        ("none.json", json.dumps({"fx": 300, "cx": 1, "cy": 1}), "got no fy"),
        ("shots.json", json.dumps({"shots": {}}), "OpenSfM"),
        ("cameras.txt", FILES["two/cameras.txt"], "FILE:NAME with a name among"),
    ],
)
def test_file_without_intrinsics_is_refused(name, text, words, tmp_path):
    path = put(tmp_path, name, text)
    with refusal(words):
        read_intrinsics(path, size=(640, 480))
