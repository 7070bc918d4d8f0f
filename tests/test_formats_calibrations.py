"""Calibrations as programs and people write them: OpenCV's own projections are the oracle; and
files of intrinsics alone, as calibrations, networks and COLMAP write them."""

import json

import cv2
import numpy as np
import pytest
from folders import put
from numpy.testing import assert_allclose
from refusals import pairs, refusal
from test_formats_oracles import image_points

import pinhole_jax as pj
from pinhole_jax import formats
from pinhole_jax.formats import read_intrinsics

K = np.array([[300.0, 0, 320], [0, 310, 240], [0, 0, 1]])
BENT = np.array([-0.03, 0.01, -0.004, 0.0006])
TURN, SHIFT = np.array([0.1, -0.2, 0.05]), np.array([0.1, 0.2, 0.5])
POINTS = np.random.default_rng(0).uniform([-1.2, -1, 0.6], [1.2, 1, 3], (30, 3))
BROWN, FISHEYE = "BrownConrady", "Fisheye"
HEAD = "image_width: 640\nimage_height: 480\n"
TAIL = f"rvec: {TURN.tolist()}\ntvec: {SHIFT.tolist()}\n"
MATRIX = f"camera_matrix: {{ rows: 3, cols: 3, data: {K.ravel().tolist()} }}\n"
COEFFICIENTS = f"distortion_coefficients: {BENT.tolist()}\n"


def check_sees_as_opencv(path, model):
    (camera,) = formats.read(path).values()
    assert type(camera.lens.distortion).__name__ == model
    program = cv2.fisheye if model == FISHEYE else cv2
    theirs = program.projectPoints(POINTS[:, None], TURN, SHIFT, K, BENT)[0][:, 0]
    assert_allclose(image_points(camera, POINTS), theirs + 0.5, rtol=0, atol=1e-8)


#: Lines of a file, by the model that they name; " + " parts two.
NAMED = {
    FISHEYE: """
        fisheye_model: 1
        is_fisheye: true
        fisheye: yes
        camera_model: fisheye
        distortion_model: equidistant
        model_type: KANNALA_BRANDT
        model: KannalaBrandt8
        camera_model: pinhole + distortion_model: equidistant
        distortion_model: equi
        distortion_type: "OPENCV_FISHEYE"
        lens_model: Kannala-Brandt
        lens: fisheye
        type: equidistant
        projection: Equi
        calibration_type: fisheye
        cameraModelType: KANNALA_BRANDT
        camera_model_type: kb4
        dist_model: fisheye
        Camera.type: KannalaBrandt8
        type: opencv + lens: fisheye
    """,
    BROWN: """
        # nothing
        fisheye_model: 0
        fisheye: 'off'
        distortion_model: plumb_bob
        model: D435
        distortion_model: radtan
        camera_model: radial-tangential
        camera_model: pinhole
        distortion_model: rational_polynomial
        model_type: PINHOLE
        distance: 3
        undistorted: true
        undistorted: 1
        distorted: 0
        is_distorted: 1
        distribution: x
        distinct: 3
        12: [ 1, 2 ]
        D: ~
        D:
        D: null
        fisheye_model: ~
        lens: Kowa 8mm
        type: stereo
        max_dist: 3.5
        k3: 0
        cam_dist: [ 0, 0 ]
        step_1: 3
        RGBD: [ 1, 2 ]
        undistorted_size: [ 3, 4 ]
        board: { width: 3, type: x }
        projection: perspective
    """,
}
MODELS = {line.strip(): model for model, x in NAMED.items() for line in x.strip().splitlines()}


@pairs("line, model", MODELS)
def test_lens_model_is_the_one_that_a_calibration_names(tmp_path, line, model):
    lines = line.replace(" + ", "\n")
    path = put(tmp_path, "c.yaml", f"{HEAD}{MATRIX}{COEFFICIENTS}{lines}\n{TAIL}")
    check_sees_as_opencv(path, model)


NAMES = """dist dist_coeff dist_coeffs distCoeffs DistCoeff distCoef D distortion
    distortion_coefficients distortion_coeffs distortion_parameters"""


@pytest.mark.parametrize("name", NAMES.split())
def test_coefficients_have_many_names_and_forms(tmp_path, name):
    named = dict(zip(("k1", "k2", "p1", "p2"), BENT.tolist(), strict=True))
    tail = f"rvec: {TURN[:, None].tolist()}\ntvec: {SHIFT[:, None].tolist()}\n"
    for value in (BENT.tolist(), BENT[None].tolist(), named):
        text = f"%YAML:1.0\n---\n{HEAD}{MATRIX}{name}: {value}\n{tail}"
        check_sees_as_opencv(put(tmp_path, "c.yaml", text), BROWN)


REFUSED = {
    "distortion_model: omni": "`distortion_model`: expected a model of OpenCV's .*, got 'omni'",
    "camera_model: MEI": "`camera_model`: expected a model of OpenCV's",
    "model_type: inverse_brown_conrady": "`model_type`: expected a model of OpenCV's",
    "fisheye_model: maybe": "`fisheye_model`: expected true or false, got 'maybe'",
    "fisheye_model: 0\ncamera_model: fisheye": "`camera_model`: expected one model of the lens",
    "distorsion: [ 1, 2, 3, 4 ]": "`distorsion`: expected a lens's coefficients as `distortion_c",
    "radial_distortion: [ 1, 2 ]": "`radial_distortion`: expected a lens's coefficients",
    "k1: 0.1": "`k1`: expected a lens's coefficients as `distortion_coefficients: ",
    "D: [ 1, 2, 3, 4 ]": "`distortion_coefficients`: expected one such field, got 'D' too",
    "cam_dist: [ 1, 2, 3, 4 ]": "`cam_dist`: expected a lens's coefficients",
    "D1: [ 1, 2, 3, 4 ]": "`D1`: expected a lens's coefficients",
    "fisheye_D: [ 1, 2, 3, 4 ]": "`fisheye_D`: expected a lens's coefficients",
    "leftD: { rows: 1, cols: 2, data: [ 1, 2 ] }": "`leftD`: expected a lens's coefficients",
    "radial: [ 0.1, 0 ]": "`radial`: expected a lens's coefficients",
    "tangential: [ 0.1, 0 ]": "`tangential`: expected a lens's coefficients",
    "Camera.k1: 0.1": "`Camera.k1`: expected a lens's coefficients",
    "Camera: { p2: 0.1 }": "`Camera.p2`: expected a lens's coefficients",
    "left: { lens: { D: [ 1, 2 ] } }": "`left.lens.D`: expected a lens's coefficients",
    "xi: 1.2": "`xi`: expected a lens's coefficients",
    "lens: fisheye by Kowa": "`lens`: expected a model of OpenCV's .*, got 'fisheye by Kowa'",
    "type: kannala_brandt_9": "`type`: expected a model of OpenCV's",
    "fisheye: 1\ndist: [ 1, 2, 3, 4, 5 ]": "`dist`: expected 4 coefficients of a fisheye",
}


@pairs("line, message", REFUSED)
def test_lens_that_is_not_understood_is_refused(tmp_path, line, message):
    coefficients = "" if "\ndist" in line else COEFFICIENTS
    path = put(tmp_path, "c.yaml", f"{HEAD}{MATRIX}{coefficients}{line}\n{TAIL}")
    with refusal(message):
        formats.read(path)


@pytest.mark.parametrize("ending", ["yml", "xml", "json"])
@pytest.mark.parametrize("model", [BROWN, FISHEYE])
def test_opencvs_own_files_are_read(tmp_path, ending, model):
    path = tmp_path / f"out_camera_data.{ending}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in {
        "calibration_time": "a: b # c",
        "image_width": 640,
        "image_height": 480,
        "fisheye_model": int(model == FISHEYE),
        "camera_matrix": K,
        "distortion_coefficients": BENT[:, None],
        "avg_reprojection_error": 0.25,
        "extrinsic_parameters": np.r_[TURN, SHIFT][None],
        "image_points": np.zeros((2, 3, 2), np.float32),
    }.items():
        storage.write(name, value)
    storage.release()
    check_sees_as_opencv(path, model)
    known = read_intrinsics(path)
    assert_allclose(known.K, K, rtol=1e-12)
    assert type(known.distortion).__name__ == model


XML = "<opencv_storage><image_width>640</image_width>{}</opencv_storage>"
XML_CASES = {
    "<!DOCTYPE a [<!ENTITY b 'c'>]><opencv_storage/>": "`path`: expected XML, .* a DOCTYPE",
    XML.format(""): "`camera_matrix`: expected .* no such field",
    XML.format("<image_width>1</image_width>"): "expected XML, .*: the field 'image_width' twice",
    XML.format("<a>" * 99 + "</a>" * 99): "`path`: expected XML, got .*: more than 64 levels",
    XML.format("<camera_matrix>1 2"): "`path`: expected XML",
}


@pairs("text, words", XML_CASES)
def test_wrong_opencv_xml(tmp_path, text, words):
    path = put(tmp_path, "c.xml", text)
    with refusal(words):
        formats.read(path, None if "storage>" in text[-9:] else "opencv")


CAMCHAIN = """cam0:
  camera_model: pinhole
  distortion_coeffs: [0.0015, 0.0004, -3.0e-05, 0.0004]
  distortion_model: radtan
  intrinsics: [385.1, 385.1, 320.1, 240.2]
  resolution: [640, 480]
"""
EUROC = """sensor_type: camera
camera_model: pinhole
intrinsics: [458.6, 457.2, 367.2, 248.3]
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 1.7e-05]
"""
SPLAT = {"id": 0, "img_name": "a", "width": 8, "height": 6, "position": [0, 0, 5], "fx": 6}
FOREIGN = {
    "camchain.yaml": (CAMCHAIN, "Kalibr.*'cam0'.*: it holds no pose; --K FILE takes"),
    "right.yaml": (CAMCHAIN.replace("cam0", "cam1"), "Kalibr.*'cam1'.* --K FILE"),
    "sensor.yaml": (EUROC, "EuRoC's .* --K FILE"),
    "imu.yaml": ("sensor_type: imu\nrate_hz: 200\n", "EuRoC's sensor.yaml"),
    "orb.yaml": ('%YAML:1.0\nCamera.type: "PinHole"\nCamera.fx: 500.0\n', "ORB-SLAM's settings"),
    "cameras.json": (json.dumps([SPLAT]), "Gaussian splatting's cameras"),
    "fspy.json": ('{"cameraTransform": {}, "imageWidth": 640}', "fSpy's camera .* export glTF"),
    "rec.json": ('[{"cameras": {}, "shots": {}}]', "OpenSfM's reconstruction .* as COLMAP"),
    "scene_camera.json": ('{"0": {"cam_K": [1], "depth_scale": 1}}', "BOP.* `pinhole-jax batch`"),
    "a.json": ('{"width": 3}', r"expected one of json, opencv, .*, got JSON with .* \['width'\]"),
    "cameras.xml": ('<document version="2"><sensor/></document>', "Metashape's .* as COLMAP"),
    "a.xml": ("<project><sensor/></project>", "expected Mitsuba's XML .*, got the root <project>"),
    "b.xml": ("<b:COLLADA xmlns:b='http://x.y'/>", "a Collada scene"),
}


@pairs("name, text, message", FOREIGN)
def test_files_of_other_programs_are_named(tmp_path, name, text, message):
    path = put(tmp_path, name, text)
    with refusal(message):
        formats.read(path)


SHARED = {"w": 640, "h": 480, "fl_x": 500, "fl_y": 510, "k1": 0.1, "p1": 0.02}
FRAMES = [
    ({"camera_angle_x": 2 * np.arctan(320 / 400)}, (400, 400, BROWN, 0.1, 0.02)),
    ({"fl_x": 300}, (300, 300, BROWN, 0.1, 0.02)),
    ({"fl_x": 300, "fl_y": 320, "k1": 0.05}, (300, 320, BROWN, 0.05, 0)),
    ({"is_fisheye": "true", "k1": 0.05}, (500, 510, FISHEYE, 0.05, None)),
    ({"is_fisheye": "false"}, (500, 510, BROWN, 0.1, 0.02)),
    ({"camera_model": "OPENCV_FISHEYE", "k2": 0.05}, (500, 510, FISHEYE, 0, None)),
]


@pytest.mark.parametrize("frame, wanted", FRAMES)
def test_frames_intrinsics_come_before_the_files(tmp_path, frame, wanted):
    fx, fy, model, k1, p1 = wanted
    frames = [{"file_path": "a", "transform_matrix": np.eye(4).tolist(), **frame}]
    path = put(tmp_path, "t.json", json.dumps({**SHARED, "frames": frames}))
    (camera,) = formats.read(path).values()
    lens = camera.lens.distortion
    assert_allclose(np.diag(camera.K)[:2], (fx, fy), rtol=1e-12)
    assert type(lens).__name__ == model
    assert (float(lens.k1), p1 and float(lens.p1)) == (k1, p1)


# --- intrinsics alone ----------------------------------------------------------------------------

FLAT = K.ravel().tolist()
HALVES = np.array([[300.0, 0, 320.5], [0, 310, 240.5], [0, 0, 1]])
KNOWN = [*BENT.tolist(), 0.0]
ROS = f"""image_width: 640
image_height: 480
camera_name: narrow
camera_matrix: {{rows: 3, cols: 3, data: {FLAT}}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: {KNOWN}}}
rectification_matrix: {{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
projection_matrix: {{rows: 3, cols: 4, data: [9, 0, 9, 0, 0, 9, 9, 0, 0, 0, 1, 0]}}
"""
KALIBR = f"""cam0:
  camera_model: pinhole
  distortion_model: radtan
  distortion_coeffs: {KNOWN[:4]}
  intrinsics: [300, 310, 320, 240]
  resolution: [640, 480]
"""
COLMAP = "# Camera list\n1 OPENCV 640 480 300 310 320.5 240.5 -0.03 0.01 -0.004 0.0006\n"
NUMBERS = {"fx": 300, "fy": 310, "cx": 320, "cy": 240}
#: A message of ROS 2, as `ros2 topic echo --once /camera_info` prints it.
CAMERA_INFO = json.dumps(
    {"height": 480, "width": 640, "distortion_model": "plumb_bob", "d": KNOWN, "k": FLAT}
    | {"r": np.eye(3).ravel().tolist(), "p": np.eye(3, 4).ravel().tolist()}
    | {"binning_x": 0, "roi": {"width": 0, "do_rectify": False}}
)
FILES = {
    "ros.yaml": ROS,
    "camera_info.yaml": CAMERA_INFO,
    "camchain.yaml": KALIBR,
    "cameras.txt": COLMAP,
    "two/cameras.txt": COLMAP + "2 PINHOLE 640 480 500 500 320 240\n",
    "named.json": json.dumps({**NUMBERS, "width": 640, "height": 480, "dist": KNOWN[:4]}),
    "nested.json": json.dumps({"intrinsics": NUMBERS, "dist": KNOWN[:4]}),
    "matrix.json": json.dumps({"intrinsics": [K.tolist()], "dist": KNOWN[:4], "depth": "a.npy"}),
    "flat.json": json.dumps({"cam_K": FLAT, "dist": KNOWN[:4]}),
    "transforms.json": json.dumps(
        {"fl_x": 300, "fl_y": 310, "cx": 320.5, "cy": 240.5, "w": 640, "h": 480, "frames": []}
        | dict(zip(("k1", "k2", "p1", "p2"), KNOWN, strict=False))
    ),
}


def check_lens(camera):
    assert (camera.W, camera.H) == (640, 480)
    matrix, _, _ = formats.to_opencv(camera, pixel_centres="half")
    assert_allclose(matrix, HALVES, rtol=1e-12)
    coefficients = camera.distortion.coefficients()
    assert_allclose([*map(float, coefficients.values())], KNOWN, rtol=1e-12)


@pairs("name, text", FILES)
def test_intrinsics_are_read_with_their_lens(name, text, tmp_path):
    path = put(tmp_path, name, text)
    asked = f"{path}:1" if name.startswith("two") else path
    check_lens(read_intrinsics(asked, size=(640, 480)))


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


#: A file's name and text, by the error.
NO_INTRINSICS = {
    "sides count as 1": ("unit.json", '{"K": [[1.2, 0, 0.5], [0, 1.6, 0.5], [0, 0, 1]]}'),
    r"`K`: expected .*, or fx, fy, cx, cy, got \[1.0, 2.0\]": ("few.json", '{"K": [1.0, 2.0]}'),
    "got no fy": ("none.json", '{"fx": 300, "cx": 1, "cy": 1}'),
    "OpenSfM": ("shots.json", '{"shots": {}}'),
    "FILE:NAME with a name among": ("cameras.txt", FILES["two/cameras.txt"]),
}


@pairs("words, name, text", NO_INTRINSICS)
def test_file_without_intrinsics_is_refused(words, name, text, tmp_path):
    path = put(tmp_path, name, text)
    with refusal(words):
        read_intrinsics(path, size=(640, 480))
