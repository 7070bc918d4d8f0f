"""Distortion through files: OpenCV's and COLMAP's own programs read it, other formats refuse it."""

import jax.numpy as jnp
import numpy as np
import pytest
from test_distortion import BROWN, FISHEYE, RATIONAL, by_opencv, camera

import pinhole_jax as pj
from pinhole_jax import formats

MODELS = {
    "brown": BROWN,
    "opencv": pj.BrownConrady(-0.2, 0.05, 1e-3, -2e-3),
    "fisheye": FISHEYE,
    "rational": RATIONAL,
}
POINTS = np.random.default_rng(0).uniform(-1, 1, (20, 3))


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize(
    "file", ["a.yaml", "colmap", "colmap-binary", "transforms.json", "camera.json"]
)
def test_distortion_survives_a_round_trip(tmp_path, model, file):
    view = camera(MODELS[model])
    if (model, file) == ("rational", "transforms.json"):
        with pytest.raises(ValueError, match=r"`cameras`: expected OpenCV's k1, .* got a Rational"):
            formats.write(tmp_path / file, {"a": view})
        return
    kind = {"format": file} if file.startswith("colmap") else {}
    formats.write(tmp_path / file, {"a": view}, **kind)
    (back,) = formats.read(tmp_path / file).values()
    assert type(back.lens.distortion) is type(view.lens.distortion)
    np.testing.assert_allclose(
        pj.project(back, jnp.asarray(POINTS)), by_opencv(view, POINTS), rtol=0, atol=1e-9
    )


@pytest.mark.parametrize("model", MODELS)
def test_colmap_itself_sees_the_same(tmp_path, model):
    pycolmap = pytest.importorskip("pycolmap")
    view = camera(MODELS[model])
    formats.write(tmp_path / "model", {"a": view}, format="colmap-binary")
    theirs = pycolmap.Reconstruction(str(tmp_path / "model"))
    (image,), (their_camera,) = theirs.images.values(), theirs.cameras.values()
    pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
    seen = np.array([their_camera.img_from_cam(pose * x) for x in POINTS]).reshape(-1, 2)
    film = np.stack([seen[:, 0], view.H - seen[:, 1]], axis=-1)
    np.testing.assert_allclose(film, by_opencv(view, POINTS), rtol=0, atol=1e-9)


@pytest.mark.parametrize("file", ["a.gltf", "a.xml", "blender.json", "pytorch3d.json"])
def test_formats_without_distortion_refuse_it(tmp_path, file):
    with pytest.raises(ValueError, match=r"expected no lens distortion, .* got a BrownConrady"):
        formats.write(tmp_path / file, {"a": camera(BROWN)})
    assert not list(tmp_path.iterdir())


def test_crops_and_resizes_keep_the_lens():
    view, points = camera(BROWN), jnp.asarray(POINTS)
    film, low = np.asarray(pj.project(view, points)), view.H - 30 - 3
    part = formats.cropped(view, 5, 3, 40, 30)
    small = formats.resized(view, view.W // 2, view.H // 4)
    np.testing.assert_allclose(pj.project(part, points), film - [5, low], atol=1e-10)
    np.testing.assert_allclose(pj.project(small, points), film * [0.5, 0.25], atol=1e-10)
