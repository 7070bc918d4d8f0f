"""Formats against numbers worked out by hand, and against each program's own projection."""

import json

import cv2
import numpy as np
import pytest
from folders import put
from numpy.testing import assert_allclose
from oracles import normal, off, skew_camera
from refusals import pairs, refusal
from test_distortion import BROWN, FISHEYE, RATIONAL, camera as lens_camera

import pinhole_jax as pj
from pinhole_jax import formats

POINTS = normal((20, 3)) * 0.5
BASE = skew_camera(64, 49)
CROP = formats.cropped(BASE, 3, -2, 41, 32)
CAMERAS = {"base": BASE, "crop": CROP, "stretched": formats.resized(CROP, 33, 50)}
FOUR = pj.BrownConrady(-0.2, 0.05, 1e-3, -2e-3)
MODELS = {"brown": BROWN, "four": FOUR, "fisheye": FISHEYE, "rational": RATIONAL}
LENSES = {name: lens_camera(model) for name, model in MODELS.items()}


def image_points(camera, points=POINTS):
    """Return px from the image's top-left corner, y down: what most programs call (u, v)."""
    xy = np.asarray(pj.project(camera, points))
    return np.stack([xy[..., 0], camera.H - xy[..., 1]], axis=-1)


def by_opencv(K, turn, shift, distortion, points):
    """Return the same by OpenCV, whose pixel centres are at integers."""
    return cv2.projectPoints(points, turn, shift, K, distortion)[0].reshape(-1, 2) + 0.5


def matrices(path, *names):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    return [storage.getNode(name).mat() for name in names]


# By hand: the eye is at (1, 2, 3), looks along -z, y is up; f = 4 px, 8 x 6 px. The point
# (1.5, 3, 1) lies 0.5 right, 1 up and 2 ahead: u = 4 + 4 * 0.5/2 = 5, v = 3 - 4 * 1/2 = 1.
SQUARE = {
    "a.yaml": """%YAML:1.0
---
image_width: 8
image_height: 6
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 4., 0., 3.5, 0., 4.,
       2.5, 0., 0., 1. ]   # centres at integers: 4 - 0.5, 3 - 0.5
R: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 1., 0., 0., 0., -1., 0., 0., 0., -1. ]
t: !!opencv-matrix { rows: 3, cols: 1, dt: d, data: [ -1., 2., 3. ]
""".replace("{ rows: 3, cols: 1, dt: d, data:", "\n   rows: 3\n   cols: 1\n   dt: d\n   data:"),
    "transforms.json": """{"camera_angle_x": 1.5707963267948966, "w": 8, "h": 6, "frames": [
 {"file_path": "a.png", "transform_matrix": [[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]]}]}""",
    "b.json": """{"lens": 18, "sensor_width": 36, "resolution_x": 8, "resolution_y": 6,
 "matrix_world": [[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]]}""",
    "a.gltf": """{"asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}],
 "nodes": [{"name": "above", "children": [1], "translation": [1, 0, 0],
            "rotation": [0, 0, 0.7071067811865476, 0.7071067811865476]},
           {"camera": 0, "translation": [2, 0, 3],
            "rotation": [0, 0, -0.7071067811865476, 0.7071067811865476]}],
 "cameras": [{"type": "perspective", "extras": {"W": 8, "H": 6},
              "perspective": {"yfov": 1.2870022175866, "znear": 0.1}}]}""",  # 2 atan(3/4)
    "p.json": """{"R": [[[-1,0,0],[0,1,0],[0,0,-1]]], "T": [[1,-2,3]], "in_ndc": true,
 "focal_length": [[1.3333333333333333, 1.3333333333333333]], "principal_point": [[0, 0]],
 "image_size": [[6, 8]]}""",
    "a.xml": """<scene version="3.0.0"><default name="w" value="8"/><sensor type="perspective">
 <float name="fov" value="90"/>
 <transform name="to_world"><lookat origin="1, 2, 3" target="1, 2, 0" up="0, 1, 0"/></transform>
 <film type="hdrfilm"><integer name="width" value="$w"/><integer name="height" value="6"/></film>
 </sensor></scene>""",
    "c.json": """{"e": [1,2,3], "p": [1,2,0], "u": [0,1,0], "phi": 1.2870022175866,
 "W": 8, "H": 6}""",
}
# The same eye; fx = 4, fy = 2 px, 7 x 5 px, principal point 4 px from the left and 2 from the top:
# u = 4 + 4 * 0.5/2 = 5, v = 2 - 2 * 1/2 = 1.
OBLONG = {
    "a.yaml": SQUARE["a.yaml"]
    .replace("4., 0., 3.5, 0., 4.,\n       2.5", "4., 0., 3.5, 0., 2., 1.5")
    .replace("width: 8", "width: 7")
    .replace("height: 6", "height: 5"),
    "transforms.json": """{"fl_x": 4, "fl_y": 2, "cx": 4, "cy": 2, "w": 7, "h": 5, "frames": [
 {"file_path": "a.png", "transform_matrix": [[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]]}]}""",
    "b.json": """{"lens": 20.571428571428573, "sensor_width": 36, "sensor_fit": "HORIZONTAL",
 "shift_x": -0.07142857142857142, "shift_y": -0.14285714285714285, "pixel_aspect_y": 2,
 "resolution_x": 7, "resolution_y": 5,
 "matrix_world": [[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]]}""",
    "p.json": """{"R": [[[-1,0,0],[0,1,0],[0,0,-1]]], "T": [[1,-2,3]], "in_ndc": false,
 "focal_length": [[4, 2]], "principal_point": [[4, 2]], "image_size": [[5, 7]]}""",
    "c.json": """{"e": [1,2,3], "p": [1,2,0], "u": [0,1,0], "phi": 1.7921107691391946,
 "W": 7, "H": 5, "lens": {"principal_point": [4, 3], "aspect": 2}}""",  # phi = 2 atan(5/4)
}


@pytest.mark.parametrize("files", [SQUARE, OBLONG])
def test_readers_match_numbers_worked_out_by_hand(tmp_path, files):
    for name, text in files.items():
        (camera,) = formats.read(put(tmp_path, name, text)).values()
        assert ((8, 6) if files is SQUARE else (7, 5)) == (camera.W, camera.H)
        assert_allclose(image_points(camera, [[1.5, 3, 1]]), [[5, 1]], atol=1e-12, err_msg=name)


@pytest.mark.parametrize("camera", ["1 PINHOLE 7 5 4 2 4 2", "1 SIMPLE_RADIAL 8 6 4 4 3 0"])
def test_colmap_by_hand(tmp_path, camera):
    (tmp_path / "cameras.txt").write_text(f"# a comment\n{camera}\n")
    # Half a turn about x, then t = -R e.
    (tmp_path / "images.txt").write_text("# Number of images: 1\n7 0 1 0 0 -1 2 3 1 a b.png\n")
    camera = formats.read(tmp_path)["a b.png"]
    assert_allclose(image_points(camera, [[1.5, 3, 1]]), [[5, 1]], atol=1e-12)


TURNED = pj.Camera([0.0, 1, 4], [0, 0, 0.2], [0, 1, 0], 0.7, 1.0, 64, 49)
ROUND_TRIPS = {
    "many.yml": {"a": BASE, 'b "2", c': TURNED},
    "own.json": CAMERAS,
    "one.yaml": CAMERAS,
    "model": CAMERAS,
    "transforms.json": CAMERAS,
    "blender.json": CAMERAS,
    "pytorch3d.json": CAMERAS,
    "one.xml": {"base": BASE, "crop": CROP},
    "scene.gltf": {"base": BASE},
    "scene.glb": {"base": BASE},
}


NO_RATIONAL = ("rational", "transforms.json")


@pairs("name, cameras", ROUND_TRIPS)
def test_round_trips_keep_the_camera(tmp_path, name, cameras):
    path = tmp_path / name
    groups = [{key: camera} for key, camera in cameras.items()]
    if name != "one.yaml":  # which has one K
        groups.append(cameras)
    if name in ("own.json", "one.yaml", "model", "transforms.json"):
        groups += [{key: LENSES[key]} for key in MODELS if (key, name) != NO_RATIONAL]
    for group in groups:
        formats.write(path, group)
        back = formats.read(path)
        assert list(back) == list(group)
        for key, camera in group.items():
            assert (back[key].W, back[key].H) == (camera.W, camera.H)
            assert type(back[key].distortion) is type(camera.distortion)
            assert_allclose(image_points(back[key]), image_points(camera), rtol=0, atol=1e-10)
        assert [*tmp_path.iterdir()] == [path]


@pytest.mark.parametrize(
    "name, lens, message",
    [
        (*NO_RATIONAL[::-1], "expected OpenCV's k1, .* got a Rational"),
        *(
            (name, "brown", "expected no lens distortion, .* got a BrownConrady")
            for name in ("a.gltf", "a.xml", "blender.json", "pytorch3d.json")
        ),
    ],
)
def test_distortion_that_a_format_cannot_hold_is_refused(tmp_path, name, lens, message):
    with refusal(f"`cameras`: {message}"):
        formats.write(tmp_path / name, {"a": LENSES[lens]})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", [*CAMERAS, "brown", "four", "rational"])
def test_opencv_reads_our_files_and_projects_alike(tmp_path, name):
    camera, path = {**CAMERAS, **LENSES}[name], tmp_path / "a.yaml"
    formats.write_opencv(path, {name: camera})
    K, R, t, bent = matrices(path, "camera_matrix", "R", "t", "distortion_coefficients")
    theirs = by_opencv(K, cv2.Rodrigues(R)[0], t, bent, POINTS)
    assert_allclose(theirs, image_points(camera), rtol=0, atol=1e-9)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert storage.getNode("image_width").real() == camera.W


@pytest.mark.parametrize("binary", [False, True])
def test_colmap_projects_alike_and_its_models_are_read(tmp_path, binary):
    pycolmap = pytest.importorskip("pycolmap")
    cameras = {**CAMERAS, **LENSES}
    formats.write_colmap(tmp_path / "ours", cameras, binary=binary)
    model = pycolmap.Reconstruction(str(tmp_path / "ours"))
    assert {image.name for image in model.images.values()} == set(cameras)
    for image in model.images.values():
        theirs = np.array([image.project_point(point) for point in POINTS])
        assert_allclose(theirs, image_points(cameras[image.name]), rtol=0, atol=1e-9)
    (tmp_path / "theirs").mkdir()
    (model.write_binary if binary else model.write_text)(str(tmp_path / "theirs"))
    for name in (".", f"images.{'bin' if binary else 'txt'}"):
        back = formats.read(tmp_path / "theirs" / name)
        for name, camera in cameras.items():
            assert_allclose(image_points(back[name]), image_points(camera), atol=1e-9)


def test_gltf_is_what_trimesh_writes(tmp_path):
    import trimesh

    scene = trimesh.Scene(trimesh.creation.box())  # trimesh keeps no camera of a file without one
    scene.camera = trimesh.scene.Camera(resolution=(64, 49), fov=(50, 40))
    scene.camera_transform = np.array(formats.to_blender(BASE)["matrix_world"])
    scene.export(tmp_path / "theirs.glb")
    (back,) = formats.read(tmp_path / "theirs.glb", size=(64, 49)).values()
    assert_allclose(float(back.phi), np.deg2rad(40), rtol=1e-9)
    assert off(back, BASE) < 1e-6


# Settings, and where Blender 4.5.15's `calc_matrix_camera` puts two points, in film coordinates;
# Blender works in 32-bit floats.
BLENDER = """
    AUTO       40 30 100 1   1      11.428568  6.785717 17.941173 20.44118
    AUTO       30 41 100 1   1       6.214282 12.080362 12.889702 26.07721
    HORIZONTAL 31 40 100 1.5 1       8.85714  10.450897 13.904409 26.325372
    VERTICAL   41 30 100 1   1.25   10.455352  4.01786  20.224259 20.404417
    AUTO       61 51  50 1   1.5     6.964282  7.366074 13.06985  15.900738
"""


@pytest.mark.parametrize("row", BLENDER.strip().splitlines())
def test_blender_recorded(tmp_path, row):
    fit, *numbers = row.split()
    *settings, x, y, u, v = map(json.loads, numbers)
    names = "resolution_x", "resolution_y", "resolution_percentage", "pixel_aspect_x"
    fields = dict(zip((*names, "pixel_aspect_y"), settings, strict=True)) | json.loads(
        """{"lens": 40, "sensor_width": 32, "sensor_height": 20, "shift_x": 0.125,
        "shift_y": -0.0625, "matrix_world": [[0,0,1,4], [1,0,0,0.5], [0,1,0,0.25], [0,0,0,1]]}"""
    )
    fields["sensor_fit"] = fit
    camera = formats.read(put(tmp_path, "b.json", json.dumps(fields)))["camera"]
    points = [[0.5, 0.25, -0.5], [-0.25, 0.75, 0.5]]
    assert_allclose(pj.project(camera, points), [[x, y], [u, v]], rtol=0, atol=1e-5)


def test_script_and_json_say_the_same():
    values = {}
    exec(
        formats.to_blender_script({"crop": CROP}).partition("scene =")[0].split("Matrix")[1], values
    )
    own, matrix = values["CAMERAS"]["crop"]
    assert {**own, **values["RENDER"], "matrix_world": matrix} == formats.to_blender(CROP)


# What transform_points_screen of PyTorch3D 0.7.4 gave (in float64) for two points: focal_length
# (1.75, 2) and principal_point (0.125, -0.25) in NDC; FoVPerspectiveCameras of 50 degrees and
# aspect_ratio 1.25.
PYTORCH3D = np.loadtxt(
    """
    40 40  23.991935483870968 25      9.545454545454547  17.727272727272727
    40 40  26.364343118931593 20     12.201793016328878  12.201793016328875
    31 20  17.495967741935484 12.5   10.272727272727273   8.863636363636363
    31 20  18.682171559465797 10     11.600896508164439   6.100896508164437
    21 30  12.595766129032258 17.625  5.011363636363637  13.806818181818182
    21 30  13.841280137439085 15      6.4059413335726605 10.90594133357266
    """.splitlines()
)


@pytest.mark.parametrize("row", range(3))
def test_pytorch3d_recorded(row):
    (W, H, *ndc), (_, _, *fov) = PYTORCH3D[2 * row : 2 * row + 2]
    R, T = [[[-0.8, 0, -0.6], [0, 1, 0], [0.6, 0, -0.8]]], [[0.125, -0.25, 3]]
    points = np.array([[0.5, 0.25, -0.5], [-0.25, 0.75, 0.5]])
    H_W = int(H), int(W)
    lens = {"focal_length": [1.75, 2], "principal_point": [0.125, -0.25]}
    camera = formats.from_pytorch3d(R, T, H_W, **lens)
    assert_allclose(image_points(camera, points).ravel(), ndc, atol=1e-12)
    back = formats.from_pytorch3d(in_ndc=False, **formats.to_pytorch3d(camera))
    assert_allclose(image_points(back, points).ravel(), ndc, atol=1e-12)
    camera = formats.from_pytorch3d(R, T, H_W, fov=np.deg2rad(50), aspect_ratio=1.25)
    assert_allclose(image_points(camera, points).ravel(), fov, atol=1e-12)


FILM = """<film type="hdrfilm"><integer name="width" value="9"/>
<integer name="height" value="7"/>{crop}</film>"""
CROPPED = "".join(
    f'<integer name="crop_{name}" value="{value}"/>'
    for name, value in {"offset_x": 2, "offset_y": 1, "width": 5, "height": 4}.items()
)
OFFSET = """<float name="principal_point_offset_x" value="0.125"/>
<float name="principal_point_offset_y" value="-0.25"/>"""
FOV, AXIS = '<float name="fov" value="40"/>', '<string name="fov_axis" value="{}"/>'
TO_WORLD = """<transform name="to_world"><rotate value="0, 1, 0" angle="30"/>
<rotate x="1" angle="-20"/><translate value="1, 2, -4"/></transform>"""
# Where Mitsuba 3.9.1 sees the point (1.3, 1.5, 0.2): its ray through here meets it (float32).
MITSUBA = {
    FOV: (10.38579, 10.39188),
    FOV + AXIS.format("y"): (9.07784, 8.86035),
    FOV + AXIS.format("smaller") + OFFSET: (7.95284, 10.61035),
    FOV + AXIS.format("larger"): (10.38579, 10.39188),
    FOV + AXIS.format("diagonal") + OFFSET: (10.83149, 13.98106),
    '<string name="focal_length" value="35mm"/>': (8.89082, 8.64136),
    "": (10.77259, 10.8448),
}


@pairs("sensor, u, v", MITSUBA)
def test_mitsuba_recorded(tmp_path, sensor, u, v):
    for crop, corner in (("", (0, 0)), (CROPPED, (2, 1))):
        text = f'<scene version="3.0.0"><sensor type="perspective">{sensor}{TO_WORLD}'
        path = put(tmp_path, "s.xml", f"{text}{FILM.format(crop=crop)}</sensor></scene>")
        camera = formats.read(path)["sensor"]
        assert ((5, 4) if crop else (9, 7)) == (camera.W, camera.H)
        seen = image_points(camera, [1.3, 1.5, 0.2])
        assert_allclose(seen, np.subtract([u, v], corner), rtol=0, atol=1e-5)


def test_poses_that_opencv_wrote(shared):
    """OpenCV's own calibration of 13 photos."""
    file = shared / "calib/opencv_chessboard/left_intrinsics.yml"
    cameras = formats.read(file)
    assert list(cameras) == [str(k) for k in range(13)]
    names = "camera_matrix", "distortion_coefficients", "extrinsic_parameters"
    K, bent, poses = matrices(file, *names)
    corners = np.array([[0.025 * x, 0.025 * y, 0] for x in range(9) for y in range(6)])
    for camera, pose in zip(cameras.values(), poses, strict=True):
        theirs = by_opencv(K, pose[:3], pose[3:], bent, corners)
        assert_allclose(theirs, image_points(camera, corners), rtol=0, atol=1e-9)


def test_published_files(shared):
    """NeRF's lego, and a file that is no camera to us, with an error that says so."""
    (camera,) = formats.read(
        shared / "cameras/nerf_blender_lego/transforms_train.json", size=(800, 800)
    ).values()
    assert_allclose(float(camera.phi), 0.6911112070083618, rtol=1e-12)
    assert_allclose(camera.e, [-0.05379832, 3.84547043, 1.20808232], atol=1e-8)
    # The scene's middle is what it looks at.
    assert_allclose(pj.project(camera, np.zeros(3)), [400, 400], atol=20)
    with refusal("`intrinsics`: expected finite numbers of shape .3, 3., got .*f_u"):
        formats.read(shared / "photos/m3t_shampoo/color_camera.yaml")
