"""Depth and normals by hand, against a published renderer, and their derivatives."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chosen import first, long
from numpy.testing import assert_allclose, assert_array_equal
from oracles import central_difference

import pinhole_jax as pj
from pinhole_jax import formats, shapes

W, H = 16, 12
CAMERA = pj.Camera([0.3, 1.0, 5.0], [0.1, 0, 0], [0.2, 1, 0.1], 0.6, 1.3, W, H)
WALL = np.array([[-9.0, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])
program = jax.jit
depth = program(pj.depth)


@pytest.fixture(scope="module")
def scene():
    return pj.Scene(mesh=shapes.bumpy(1), spheres=pj.Spheres([[1.1, 0.9, 0.2]], [0.4]))


def by_hand(camera):
    """Return the note's ray directions q, not normalised, and the axes, in numpy: (H, W, 3)."""
    e, p, u = (np.asarray(x) for x in (camera.e, camera.p, camera.u))
    v = (p - e) / np.linalg.norm(p - e)
    b1 = np.cross(v, u) / np.linalg.norm(np.cross(v, u))
    b2 = np.cross(b1, v)
    h = 2 * float(camera.d) * np.tan(float(camera.phi) / 2)
    x = ((np.arange(camera.W) + 0.5) / camera.W - 0.5) * h * camera.W / camera.H
    y = (0.5 - (np.arange(camera.H) + 0.5) / camera.H) * h
    return b1 * x[None, :, None] + b2 * y[:, None, None] + v * float(camera.d), v


@pytest.mark.long
def test_wall_facing_the_camera_has_one_depth():
    """What is returned is z, not the ray's length: that one grows towards the corners."""
    camera = pj.Camera([1, 2, 5], [1, 2, 0], [0.3, 1, 0], 0.9, 1.0, W, H)
    wall = pj.Scene(mesh=pj.Mesh(WALL, FACES))
    assert_allclose(depth(camera, wall), np.full((H, W), 5.0), rtol=1e-14)
    length = np.asarray(pj.trace(wall, pj.camera_rays(camera)).t)
    assert length[0, 0] > 5.5


@pytest.mark.parametrize("faces", [FACES, long(FACES[:, ::-1])])
def test_slanted_wall_has_its_closed_form_whatever_the_winding(faces):
    scene = pj.Scene(mesh=pj.Mesh(WALL, faces))
    q, v = by_hand(CAMERA)
    # The wall is the plane z = 0: s q reaches it where e_z + s q_z = 0.
    s = -5.0 / q[..., 2]
    assert_allclose(depth(CAMERA, scene), s * (q @ v), rtol=1e-13)
    normal = pj.normals(CAMERA, scene)
    assert_allclose(normal, np.broadcast_to([0.0, 0, 1], (H, W, 3)), atol=1e-15)


@pytest.mark.parametrize("radius", [0.7, 9.0])
def test_sphere_has_its_closed_form(radius):
    """From outside and, the eye within the larger one, from inside."""
    center = np.array([0.2, 0.3, -0.4])
    scene = pj.Scene(spheres=pj.Spheres(center[None], [radius]))
    q, v = by_hand(CAMERA)
    offset = np.asarray(CAMERA.e) - center
    a, b = np.sum(q * q, -1), q @ offset
    room = b * b - a * (offset @ offset - radius**2)
    met = room >= 0
    inside = radius > np.linalg.norm(offset)
    s = (-b + (1 if inside else -1) * np.sqrt(np.maximum(room, 0))) / a
    ahead, normal = pj.depth(CAMERA, scene), np.asarray(pj.normals(CAMERA, scene))
    assert 0 < met.sum() < met.size or inside
    assert_allclose(ahead, np.where(met, s * (q @ v), np.inf), rtol=1e-12)
    outwards = (offset + s[..., None] * q) / radius
    expected = np.where(met[..., None], -outwards if inside else outwards, 0)
    assert_allclose(normal, expected, atol=1e-12)
    assert np.all(np.sum(normal * q, axis=-1)[met] < 0)


def test_misses_and_empty_scenes_have_infinite_depth():
    away = pj.Camera([0, 0, 5], [0, 0, 9], [0, 1, 0], 0.6, 1.0, W, H)
    for scene in (pj.Scene(), pj.Scene(mesh=pj.Mesh(WALL, FACES))):
        assert np.all(np.isposinf(depth(away, scene)))
        assert_array_equal(pj.normals(away, scene), np.zeros((H, W, 3)))


@pytest.mark.long
def test_depth_and_silhouette_show_the_same_surface(scene):
    """A pixel that is wholly covered has a depth, one that is wholly free has none."""
    cover = np.asarray(pj.silhouette(CAMERA, scene))
    met = np.isfinite(depth(CAMERA, scene))
    assert np.all(met[cover > 1 - 1e-9])
    assert not np.any(met[cover < 1e-9])
    assert_allclose(np.linalg.norm(pj.normals(CAMERA, scene), axis=-1), met, atol=1e-14)


@pytest.mark.long
def test_m3t_depth_image_is_reproduced(shared):
    """An OpenGL renderer's two objects, one behind the other, to the step of its 16-bit depth."""
    from PIL import Image

    folder = shared / "renders" / "m3t_renderer"
    given = json.loads((folder / "camera.json").read_text())
    vertices, faces, count = [], [], 0
    for placed in given["objects"].values():
        mesh = pj.load_mesh(folder / placed["mesh"])
        vertices.append(np.asarray(mesh.vertices) @ np.transpose(placed["R"]) + placed["t"])
        faces.append(np.asarray(mesh.faces) + count)
        count += len(vertices[-1])
    scene = pj.Scene(mesh=pj.Mesh(np.concatenate(vertices), np.concatenate(faces)))
    # A window of the picture, where bottle, toy and background meet.
    left, top, width, height = 380, 270, 70, 40
    K = np.array(given["K"]) - [[0, 0, left], [0, 0, top], [0, 0, 0]]
    camera = formats.from_opencv(K, np.eye(3), np.zeros(3), width, height, pixel_centres="integer")
    window = np.s_[top : top + height, left : left + width]
    stored = np.asarray(Image.open(folder / "depth_image.png")).astype(float)[window]
    ids = np.asarray(Image.open(folder / "silhouette_image.png"))[window]
    assert set(np.unique(ids)) == {0, 50, 150}
    near, far = given["z_near"], given["z_far"]
    theirs = near * far / (far - stored / 65535 * (far - near))
    step = theirs**2 * (far - near) / (near * far) / 65535
    ours = np.asarray(depth(camera, scene))
    met = stored < 65535
    assert_array_equal(np.isfinite(ours), met)
    error = np.abs(ours - theirs)[met] / step[met]
    # Rounded to whole steps, about 0.02 mm here: half a step, and little more for its float32.
    assert np.quantile(error, 0.99) < 0.6
    assert np.median(error) < 0.3
    assert error.max() < 5


def loss_of(image, scene):
    """Return a scalar of everything that moves, and its values; misses (inf) count nothing."""
    weight = np.random.default_rng(0).normal(size=(H, W, 3))
    where = lambda x: (
        *(x[0].e, x[0].p, x[0].u, x[0].phi),
        *(x[1].mesh.vertices, x[1].spheres.centers, x[1].spheres.radii),
    )

    def loss(*values):
        value = image(*eqx.tree_at(where, (CAMERA, scene), values))
        value = value if value.ndim == 3 else value[..., None]
        return jnp.sum(jnp.where(jnp.isfinite(value), value, 0) * weight[..., : value.shape[-1]])

    return loss, where((CAMERA, scene))


def both_of(loss, values):
    """Return a program of a loss and its gradient: one compiles sooner than two."""
    return jax.jit(jax.value_and_grad(loss, argnums=tuple(range(len(values)))))


@pytest.mark.parametrize("image", first(1, [pj.depth, pj.normals]))
def test_gradients_equal_central_differences(image, scene):
    loss, values = loss_of(image, scene)
    slopes = both_of(loss, values)
    _, gradients = slopes(*values)
    random = np.random.default_rng(1)
    for k, gradient in enumerate(map(np.asarray, gradients)):
        assert np.all(np.isfinite(gradient))
        size, shape = gradient.size, gradient.shape
        ways = np.eye(size).reshape(-1, *shape) if size <= 3 else random.normal(size=(3, *shape))
        for way in ways:
            others = lambda s, k=k, way=way: [*values[:k], values[k] + s * way, *values[k + 1 :]]
            wanted = central_difference(lambda s, others=others: slopes(*others(s))[0], 0.0, 1e-6)
            assert abs(np.sum(gradient * way) - wanted) < 1e-6 * (np.abs(gradient).max() + 1)
    # Flat normals know nothing of the camera, but the sphere's do; radii and vertices move both.
    assert all(np.abs(g).max() > 1e-3 for g in gradients)
