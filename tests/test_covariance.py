"""Covariance as a matrix: the same in any frame, unit and file, and that of refits."""

import calibration
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from oracles import body, drawn, normal, turned, usual_camera
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

import pinhole_jax as pj
from pinhole_jax import formats, io

CAMERA = usual_camera(64, 48)
OTHER = turned(CAMERA, 60, axis=[0, 1, 0.2])
MESH = pj.shapes.bumpy(2)
POINTS = np.random.default_rng(0).uniform(-1, 1, (20, 3))
AXES = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
#: A rotation, a shift and a factor from the tests' world to others.
HERE = (np.eye(3), np.zeros(3), 1.0)
WORLDS = {
    "another frame": (AXES, np.array([3.0, -2, 7]), 1.0),
    "millimetres": (np.eye(3), np.zeros(3), 1000.0),
}


def moved(points, world):
    axes, shift, times = world
    return times * (np.asarray(points) @ axes.T + shift)


def moved_camera(camera, world):
    up = world[0] @ np.asarray(camera.u)
    return camera.replace(e=moved(camera.e, world), p=moved(camera.p, world), u=up)


def noisy(camera):
    mask = drawn(camera, pj.Scene(MESH))
    return mask + 0.01 * normal(mask.shape, 1)


def scene_in(world):
    return body(moved(MESH.vertices, world), MESH.faces)


def one_view(world):
    return pj.fit_camera(
        scene_in(world), noisy(CAMERA), moved_camera(CAMERA, world), ("pose", "phi")
    )


def two_cameras(world):
    scene, given = scene_in(world), {"a": CAMERA, "b": OTHER}
    views = [pj.JointView(scene, noisy(c), camera=name) for name, c in given.items()]
    starts = {name: moved_camera(c, world) for name, c in given.items()}
    return pj.fit_joint(views, starts, shared="phi").cameras["b"]


def points(world):
    seen = np.asarray(pj.project(CAMERA, POINTS))
    seen = seen + 0.2 * normal(seen.shape, 2)
    return pj.fit_points(moved(POINTS, world), seen, moved_camera(CAMERA, world), ("pose", "phi"))


def assert_alike(covariance, expected):
    std = np.sqrt(np.diag(expected))
    assert_allclose(covariance / np.outer(std, std), expected / np.outer(std, std), atol=1e-4)


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("fit", [one_view, two_cameras, points])
def test_covariance_follows_the_world(fit, world):
    here, there = fit(HERE), fit(WORLDS[world])
    axes, _, times = WORLDS[world]
    by = block_diag(np.eye(3), times * axes, 1.0)
    assert here.names == there.names
    assert_alike(there.covariance, by @ here.covariance @ by.T)


FILES = "c.yaml transforms.json blender.json pytorch3d.json c.xml c.gltf own.json"


@pytest.mark.parametrize("name", FILES.split())
def test_start_of_any_convention_gives_the_same_covariance(tmp_path, name):
    scene, mask = pj.Scene(MESH), noisy(CAMERA)
    formats.write(tmp_path / name, {"camera": CAMERA})
    (start,) = formats.read(tmp_path / name).values()
    fit, other = (pj.fit_camera(scene, mask, c, ("pose", "phi")) for c in (CAMERA, start))
    assert_alike(other.covariance, fit.covariance)
    io.save_fit(tmp_path / "fit.json", other)
    assert_array_equal(io.load_fit(tmp_path / "fit.json").covariance, other.covariance)


@pytest.mark.long
@pytest.mark.parametrize("name", ["one view", "points"])
def test_predicted_covariance_is_that_of_refits(tmp_path, name):
    """By as much as 60 samples of it tell, 99 times of 100."""
    asked = calibration.Options(tmp_path, trials=60, only=(name,))
    row = calibration.matrix(asked)["table"][name]
    least, most, angle = row["by chance"]
    assert row["converged"] == 60
    assert row["least eigenvalue"] > least
    assert row["most"] < most
    assert row["worst direction, degrees"] < angle
