"""Depth and normals: those of hits, a published renderer's, and their derivatives."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from chosen import first
from numpy.testing import assert_allclose, assert_array_equal
from oracles import CORNERS, QUAD, balls, body, camera_ahead, central_difference, usual_camera
from PIL import Image
from test_silhouette import moving

import pinhole_jax as pj
from pinhole_jax import formats, shapes

W, H = 16, 12
CAMERA = usual_camera(W, H).replace(d=1.3)
WALL, FACES = 9 * CORNERS, np.array(QUAD)


@pytest.fixture(scope="module")
def scene():
    return balls([[1.1, 0.9, 0.2]], [0.4], shapes.bumpy(1))


@pytest.mark.parametrize("radius", [0.7, 9.0])
def test_depth_and_normals_are_those_of_hits_turned_towards_the_eye(radius):
    """Of faces wound either way, and of spheres, the eye within the larger one."""
    mesh = pj.Mesh(WALL, [FACES[0], FACES[1, ::-1]])
    scene = balls([[0.2, 0.3, -0.4]], [radius], mesh)
    hit, rays = pj.trace(scene, CAMERA), pj.camera_rays(CAMERA)
    assert len(np.unique(hit.primitive)) == (3 if radius < 1 else 2)
    v = np.asarray(CAMERA.p - CAMERA.e) / np.linalg.norm(CAMERA.p - CAMERA.e)
    way, normal = np.asarray(rays.direction), np.asarray(pj.normals(CAMERA, scene))
    assert_allclose(pj.depth(CAMERA, scene), hit.t * (way @ v), rtol=1e-13)
    assert np.all(np.sum(normal * way, axis=-1) < 0)
    assert_allclose(abs(np.sum(normal * hit.normal, axis=-1)), 1, rtol=1e-13)


def test_misses_and_empty_scenes_have_infinite_depth():
    away = camera_ahead(W, H).replace(p=[0, 0, 9])
    for scene in (pj.Scene(), body(WALL, FACES)):
        assert np.all(np.isposinf(pj.depth(away, scene)))
        assert_array_equal(pj.normals(away, scene), np.zeros((H, W, 3)))


@pytest.mark.long
def test_m3t_depth_image_is_reproduced(shared):
    """An OpenGL renderer's two objects, one behind the other, to the step of its 16-bit depth."""
    folder = shared / "renders" / "m3t_renderer"
    given = json.loads((folder / "camera.json").read_text())
    meshes = []
    for placed in given["objects"].values():
        mesh = pj.load_mesh(folder / placed["mesh"])
        points = np.asarray(mesh.vertices) @ np.transpose(placed["R"]) + placed["t"]
        meshes.append(trimesh.Trimesh(points, mesh.faces, process=False))
    scene = body(trimesh.util.concatenate(meshes))
    # A window of the picture, where bottle, toy and background meet.
    left, top, width, height = 380, 270, 70, 40
    K = np.array(given["K"]) - [[0, 0, left], [0, 0, top], [0, 0, 0]]
    camera = formats.from_opencv(K, np.eye(3), np.zeros(3), width, height, pixel_centres="integer")
    stored, ids = (
        np.asarray(Image.open(folder / f"{name}_image.png"))[top:, left:][:height, :width]
        for name in ("depth", "silhouette")
    )
    assert set(np.unique(ids)) == {0, 50, 150}
    near, far = given["z_near"], given["z_far"]
    theirs = near * far / (far - stored / 65535 * (far - near))
    step = theirs**2 * (far - near) / (near * far) / 65535
    ours = np.asarray(pj.depth(camera, scene))
    met = stored < 65535
    assert_array_equal(np.isfinite(ours), met)
    error = np.abs(ours - theirs)[met] / step[met]
    # Rounded to whole steps, about 0.02 mm here: half a step, and little more for its float32.
    assert np.all(np.quantile(error, [0.5, 0.99, 1]) < [0.3, 0.6, 5])


barycentric = lambda camera, scene: pj.trace(scene, camera).barycentric


@pytest.mark.parametrize("image", first(1, [pj.depth, pj.normals, barycentric]))
def test_gradients_equal_central_differences(image, scene):
    """By everything that moves."""
    values, random = moving((CAMERA, scene)), np.random.default_rng(1)
    weight = random.normal(size=(H, W, 3))

    def loss(*values):  # misses (inf) count nothing
        value = image(*eqx.tree_at(moving, (CAMERA, scene), values)).reshape(H, W, -1)
        known = jnp.where(jnp.isfinite(value), value, 0)
        return jnp.sum(known * weight[..., : value.shape[-1]])

    both = jax.jit(jax.value_and_grad(loss, argnums=tuple(range(len(values)))))
    for k, gradient in enumerate(map(np.asarray, both(*values)[1])):
        assert np.all(np.isfinite(gradient))
        for way in random.normal(size=(3, *gradient.shape)):
            others = lambda s, k=k, way=way: [*values[:k], values[k] + s * way, *values[k + 1 :]]
            wanted = central_difference(lambda s, others=others: both(*others(s))[0], 0.0, 1e-6)
            assert abs(np.sum(gradient * way) - wanted) < 1e-6 * (np.abs(gradient * way).sum() + 1)
