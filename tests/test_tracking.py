"""Frames of one object, each fitted from where the last one ended."""

import json
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from folders import in_trimesh
from oracles import drawn, lump, turned, usual_camera
from refusals import refusal

import pinhole_jax as pj

CAMERA = usual_camera(48, 40)
SCENE = lump(2)


@pytest.fixture
def frames(tmp_path):
    in_trimesh(SCENE.mesh).export(tmp_path / "part.ply")
    cameras = [turned(CAMERA, 3.0 * k, 1.0) for k in range(3)]
    for k, camera in enumerate(cameras):
        pj.io.save_image(tmp_path / f"{k}.png", drawn(camera, SCENE))
    fov = float(np.rad2deg(CAMERA.phi))
    files = {"mesh": str(tmp_path / "part.ply"), "fov": fov}
    return [{"id": f"{k}", "mask": str(tmp_path / f"{k}.png"), **files} for k in range(3)], cameras


def test_frames_are_tracked_from_one_to_the_next(frames, monkeypatch):
    records, cameras = frames
    starts = []
    fit_camera = pj.fit_camera

    def seen(scene, target, camera=None, **more):
        starts.append(camera)
        return fit_camera(scene, target, cameras[0] if camera is None else camera, free="pose")

    monkeypatch.setattr(pj, "fit_camera", seen)
    rows = pj.fit_many(records, track=True)
    assert [row["status"] for row in rows] == ["converged"] * 3
    assert starts[0] is None
    for start, before in zip(starts[1:], cameras, strict=False):
        angle, _ = pj.pose_error(start, before)
        assert np.rad2deg(float(angle)) < 0.2
    assert [json.loads(row["record"]) for row in rows] == records


def test_executor_beside_tracking_is_refused(frames):
    with ThreadPoolExecutor(1) as threads, refusal("with `track`"):
        pj.fit_many(frames[0], executor=threads, track=True)
