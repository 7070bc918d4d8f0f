"""The detective: on masks with a known answer, and on two published renders."""

import json

import numpy as np
import pytest
import trimesh
from oracles import body, camera_ahead, drawn, lump, off
from refusals import pairs, refuses

import pinhole_jax as pj
from pinhole_jax import formats, io

W, H = 72, 56
SCENE = lump(3)
CAMERA = formats.cropped(
    pj.Camera([0.6, 1.4, 5], [0.2, 0.1, 0], [0.3, 1, 0.1], 0.55, 1.0, 80, 60), 5, 1, W, H
)
K, R, T = formats.to_opencv(CAMERA, pixel_centres="integer")
# One program serves the file: every camera has a lens, every mesh an icosphere's size.
MASK = drawn(CAMERA, SCENE) > 0.5
POSE = np.eye(4)
POSE[:3] = np.c_[R, T]
OPENGL = np.diag([1.0, -1, -1, 1])
LEFT_UP = np.diag([-1.0, -1, 1, 1])


IN_MITSUBA = LEFT_UP @ POSE
WORLD, VIEW = "world_from_camera", "camera_from_world"
#: Poses as programs write them, the program's name, and the direction.
CASES = {
    "opencv": (POSE, "OpenCV", VIEW),
    "opencv, 3 x 4": (POSE[:3], "OpenCV", VIEW),
    "nerf": (np.linalg.inv(POSE) @ OPENGL, "OpenGL", WORLD),
    "opengl view": (OPENGL @ POSE, "OpenGL", VIEW),
    "mitsuba": (np.linalg.inv(POSE) @ LEFT_UP, "Mitsuba", WORLD),
    "pytorch3d matrix": (IN_MITSUBA.T, "PyTorch3D", f"{VIEW}, row vectors"),
    "pytorch3d R, T": (
        np.c_[IN_MITSUBA[:3, :3].T, IN_MITSUBA[:3, 3]],
        "PyTorch3D",
        f"{VIEW}, rotation for row vectors",
    ),
}


@pairs("name, pose, program, direction", CASES)
def test_conventions_are_told_apart(name, pose, program, direction):
    found = formats.detect(SCENE, MASK, pose, K=K)
    best = found.hypotheses[0]
    assert program in best.axes
    assert (best.direction, best.pixel_centres, best.fov_axis) == (direction, "integer", "")
    assert found.certain
    assert best.iou > 0.999
    assert str(best) in found.sentence
    assert off(best.camera, CAMERA) < 1e-6
    assert [h.iou for h in found.hypotheses] == sorted(h.iou for h in found.hypotheses)[::-1]


def test_axis_of_the_field_of_view_is_found():
    centred = CAMERA.replace(phi=0.55, lens=pj.Lens([W / 2, H / 2]))
    mask = np.asarray(pj.silhouette(centred, SCENE, overlaps=False))
    focal = float(H / 2 / np.tan(0.55 / 2))
    for axis, side in {"vertical": H, "horizontal": W, "diagonal": np.hypot(W, H)}.items():
        fov = 2 * np.arctan(side / 2 / focal)
        found = formats.detect(SCENE, mask, POSE, fov=fov)
        assert found.hypotheses[0].fov_axis == axis
        assert found.certain
    found = formats.detect(SCENE, mask, POSE, focal_px=focal)
    assert (found.hypotheses[0].fov_axis, found.hypotheses[0].pixel_centres) == ("", "half")


def test_ball_leaves_the_axes_undecided():
    """A ball on the axis looks alike when the picture is turned upside down."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    ball = body(sphere.vertices, sphere.faces)
    camera = camera_ahead(W, H).replace(lens=pj.Lens([W / 2, H / 2]))
    _, R, t = formats.to_opencv(camera, pixel_centres="half")
    mask = np.asarray(pj.silhouette(camera, ball, overlaps=False))
    found = formats.detect(ball, mask, np.c_[R, t], fov=0.6)
    assert not found.certain
    assert "But the mask does not tell axes" in found.sentence
    assert (found.hypotheses[0].fov_axis, found.hypotheses[0].pixel_centres) == ("vertical", "half")


def test_no_reading_explains_another_objects_mask():
    mask = np.zeros((H, W), bool)
    mask[:4, :4] = True
    found = formats.detect(SCENE, mask, POSE, K=K)
    assert not found.certain
    assert found.sentence.startswith("No reading of the numbers explains the mask: the best")


@pytest.mark.long
def test_m3t_renderer_has_integer_centres(shared):
    folder = shared / "renders" / "m3t_renderer"
    given = json.loads((folder / "camera.json").read_text())
    bottle = given["objects"]["shampoo"]
    mask = io.load_image(folder / "silhouette_image.png") == bottle["id"]
    scene = pj.Scene(pj.load_mesh(folder / bottle["mesh"]))
    found = formats.detect(scene, mask, np.c_[bottle["R"], bottle["t"]], K=given["K"])
    best, next_best = found.hypotheses[:2]
    assert found.certain
    assert found.sentence.startswith(
        "x right, y down, z forward (OpenCV, COLMAP); camera_from_world; pixel centres at integer"
    )
    assert best.iou > 0.999
    assert next_best.pixel_centres == "half"
    assert next_best.iou < 0.99


test_bad_input_is_refused = refuses(
    formats.detect,
    {"scene": SCENE, "mask": MASK, "pose": POSE, "K": K},
    {
        r"`mask`: expected shape \(H, W\), got shape \(56, 72, 1\)": {"mask": MASK[..., None]},
        "`mask`: expected one that covers some pixels, got none": {"mask": np.zeros((H, W))},
        r"`pose`: expected finite numbers of shape \(3, 4\) or \(4, 4\)": {"pose": np.eye(3)},
        "`pose`: .* its last row 0 0 0 1, got": {"pose": 2 * POSE},
        r"`pose`: expected a rotation \(orthonormal": {"pose": 2 * POSE[:3]},
        "expected one of `K`, `focal_px`, `fov`, got none": {"K": None},
        "expected one of `K`, `focal_px`, `fov`, got K, fov": {"fov": 0.6},
        r"`K`: expected \[\[fx, 0, cx\]": {"K": -K},
        r"`fov`: expected an angle in \(0, pi\) rad, got 60 ": {"K": None, "fov": 60.0},
        "`focal_px`: expected a positive number, got -1 ": {"K": None, "focal_px": -1},
    },
)
