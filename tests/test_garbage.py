"""Whatever comes in gives the documented result or an error that names the argument."""

import json
import re
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from chosen import first
from PIL import Image
from refusals import refusal

import pinhole_jax as pj
from pinhole_jax import io, plot, report

CAMERA = {"e": [0.3, 1, 5.0], "p": [0, 0, 0.0], "u": [0, 1.0, 0], "phi": 0.6, "d": 1.0}
SIZE = {"W": 24, "H": 18}
NO_NUMBERS = [
    np.nan, np.inf, -np.inf, None, "x", [], {}, b"ab", 1j, object(), True, 10**400,
    np.array([1, 2, 3], object), np.array([True] * 3), np.array(["a"]), np.longdouble("1e4000"),
    np.full(3, np.nan), np.datetime64("2020"), np.zeros((3, 3, 1)),
]  # fmt: skip
BOX = trimesh.creation.box()


# --- arguments -----------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", NO_NUMBERS, ids=lambda x: repr(x)[:20])
def test_no_argument_takes_what_is_no_number(bad):
    for name in (*CAMERA, *SIZE):
        with refusal(f"`{name}`: expected .*, got"):
            pj.Camera(**{**CAMERA, **SIZE, name: bad})
    for name, make in {
        "vertices": lambda: pj.Mesh(bad, [[0, 1, 2]]),
        "faces": lambda: pj.Mesh(np.eye(3), bad),
        "centers": lambda: pj.Spheres(bad, [1.0]),
        "radii": lambda: pj.Spheres([[0, 0, 0.0]], bad),
        "principal_point": lambda: pj.Lens(bad),
        "aspect": lambda: pj.Lens([1.0, 2], bad),
    }.items():
        with refusal(f"`{name}`: expected .*, got"):
            make()


VIEW, SCENE = pj.Camera(**CAMERA, **SIZE), pj.Scene(pj.Mesh(BOX.vertices, BOX.faces))
VIEWS, MASK = jax.tree.map(lambda x: np.stack([x, x]), VIEW), np.zeros((18, 24))
RAYS = pj.Rays(np.zeros(3), np.ones(3))
NAMES = "expected names like 'pose', or several: 'pose,phi'"

#: Calls whose arguments are swapped or of the wrong kind, by the words that they earn.
CALLS = {
    "`scene`, `rays`: expected a Scene and Rays or a Camera, got Rays, Scene": [
        lambda: pj.trace(RAYS, SCENE),
        lambda: pj.occluded(RAYS, SCENE),
    ],
    "`rays`: expected one camera, got several": [lambda: pj.trace(SCENE, VIEWS)],
    "`camera`, `scene`: expected a Camera and a Scene, got Scene, Camera": [
        lambda: pj.depth(SCENE, VIEW),
        lambda: pj.normals(SCENE, VIEW),
        lambda: pj.silhouette(SCENE, VIEW),
        lambda: pj.observability(SCENE, VIEW),
        lambda: pj.check_gradients(SCENE, VIEW),
    ],
    "`camera`, `scene`: expected a Camera and a Scene, got Camera, Mesh": [
        lambda: pj.silhouette(VIEW, SCENE.mesh)
    ],
    "`camera`: expected a Camera, got Scene": [
        lambda: pj.camera_basis(SCENE),
        lambda: io.save_camera("c.json", SCENE),
        lambda: pj.formats.to_blender(SCENE),
    ],
    "`camera`: expected one camera, got several": [
        lambda: io.camera_to_dict(VIEWS),
        lambda: pj.formats.to_pytorch3d(VIEWS),
        lambda: pj.silhouette(VIEWS, SCENE),
        lambda: pj.normals(VIEWS, SCENE),
        lambda: pj.project(VIEWS, np.zeros(3)),
    ],
    "`cameras`: expected a dict of Cameras by their names, got Camera": [
        lambda: pj.formats.write("transforms.json", VIEW),
        lambda: pj.formats.write_opencv("camera.yaml", VIEW),
    ],
    "`cameras['a']`: expected one camera, got several": [
        lambda: pj.formats.write("transforms.json", {"a": VIEWS})
    ],
    "`cameras`: expected at least one, got none": [lambda: pj.formats.write("transforms.json", {})],
    "`targets`: expected masks (H, W) in a list, got NoneType": [
        lambda: pj.fit_cameras(SCENE, None, [VIEW])
    ],
    "`views`: expected JointViews in a list, got JointView": [
        lambda: pj.fit_joint(pj.JointView(SCENE, MASK), VIEW)
    ],
    "`views[0]`: expected a JointView, got Scene": [lambda: pj.fit_joint([SCENE], VIEW)],
    "`cameras`: expected a Camera, or a dict of them, got list": [
        lambda: pj.fit_joint([pj.JointView(SCENE, MASK)], [VIEW])
    ],
    "`bodies`: expected at least one Mesh, got Scene": [lambda: pj.Assembly([SCENE])],
    "`executor`: expected a concurrent.futures.Executor, got 'dask'": [
        lambda: pj.fit_many([], executor="dask")
    ],
    "`items`: expected records, one after another, got {'id': 'a'}": [
        lambda: pj.fit_many({"id": "a"})
    ],
    "`items`: expected records, one after another, got 3": [lambda: pj.fit_many(3)],
    "`item`: expected a mapping of fields, got str": [
        lambda: pj.fit_many(["a"]),
        lambda: pj.fit_one("a"),
    ],
    f"`free`: {NAMES}": [
        lambda: pj.fit_camera(SCENE, MASK, VIEW, None),
        lambda: pj.fit_camera(SCENE, MASK, VIEW, 3),
    ],
    f"`shared`: {NAMES}": [lambda: pj.fit_cameras(SCENE, [MASK], [VIEW], shared=None)],
    "`max_steps`: expected an integer of at least 1": [
        lambda: pj.fit_camera(SCENE, MASK, VIEW, max_steps="3"),
        lambda: pj.fit_cameras(SCENE, [MASK], [VIEW], max_steps=2.5),
    ],
    "`prior`: expected a dict of names and their": [
        lambda: pj.fit_camera(SCENE, MASK, VIEW, prior=[1, 2])
    ],
    "`bounds`: expected a dict of names and their": [
        lambda: pj.fit_camera(SCENE, MASK, VIEW, bounds=[1, 2])
    ],
    "`phi`: expected an angle (rad), got Camera": [
        lambda: pj.fit_camera(SCENE, MASK, None, phi=VIEW)
    ],
    "`fit`: expected a Fit, got Camera": [
        lambda: plot.levels(VIEW),
        lambda: plot.off_px(VIEW, SCENE),
        lambda: plot.outline_sigma(VIEW, SCENE),
        lambda: report.page(VIEW, SCENE, MASK),
    ],
    "`mask_b`: expected a mask of (18, 24), the shape of `mask_a`, got (9, 24)": [
        lambda: pj.iou(MASK, MASK[:9])
    ],
    "`path`: expected a path, got ndarray": [
        lambda: pj.load_mesh(MASK),
        lambda: pj.formats.read(MASK),
        lambda: io.load_mask(MASK),
    ],
}


def test_arguments_that_are_swapped_or_of_another_kind_are_named():
    # In a process whose functions are as users have them: here, types are checked before.
    code = """
import re, sys
sys.path.insert(0, sys.argv[1])
import test_garbage
from refusals import refusal
for words, calls in test_garbage.CALLS.items():
    for call in calls:
        with refusal(re.escape(words)):
            call()
"""
    here = Path(__file__).parent
    command = [sys.executable, "-c", code, str(here)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# --- scenes --------------------------------------------------------------------------------------


def test_empty_scenes_cover_nothing():
    for scene in (
        pj.Scene(),
        pj.Scene(mesh=pj.Mesh(np.zeros((0, 3)), np.zeros((0, 3), int))),
        pj.Scene(mesh=pj.Mesh(np.eye(3), np.zeros((0, 3), int))),
        pj.Scene(mesh=pj.Mesh(np.eye(3), [[0, 0, 0], [1, 1, 2]])),
        pj.Scene(spheres=pj.Spheres(np.zeros((0, 3)), np.zeros(0))),
    ):
        assert not np.any(pj.silhouette(VIEW, scene))
        if scene.mesh is None or not scene.mesh.edge_faces.shape[0]:
            with refusal("`scene`: expected a Scene with a mesh or"):
                pj.fit_camera(scene, np.eye(18, 24), VIEW)


@pytest.mark.long
def test_million_faces_are_rendered(exhaustive):
    cells = 708 if exhaustive else 50
    x, y = np.meshgrid(*[np.linspace(-1, 1, cells)] * 2)
    vertices = np.stack([x, y, 0.1 * np.sin(9 * x)], axis=-1).reshape(-1, 3)
    at = np.arange(cells * (cells - 1)).reshape(cells - 1, cells)[:, :-1].ravel()
    a, b, c, d = at, at + 1, at + cells, at + cells + 1
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    image = np.asarray(pj.silhouette(VIEW, pj.Scene(mesh=pj.Mesh(vertices, faces))))
    assert 0 < image.sum() < image.size
    assert image.min() >= 0
    assert image.max() <= 1


@eqx.filter_jit
def image_slopes(camera, scene):
    return eqx.filter_grad(lambda moving: jnp.sum(pj.silhouette(*moving)))((camera, scene))


@pytest.mark.parametrize("kind", first(0, ["float32", "float64"], of=2))
def test_random_bits_as_vertices_are_refused_or_seen_without_nan(kind, exhaustive):
    """Random exponents: products of coordinates overflow, differences lose all digits."""
    dtype, bits = np.dtype(kind), {"float32": np.uint32, "float64": np.uint64}[kind]
    camera = pj.Camera(*(np.asarray(x, dtype) for x in CAMERA.values()), **SIZE)
    rays = pj.camera_rays(camera)
    random, refused = np.random.default_rng(0), 0
    faces = random.integers(0, 12, (20, 3))  # the same always: they share a program
    meshes = 500 if exhaustive else 15
    for _ in range(meshes):
        vertices = random.integers(0, 2 ** (8 * dtype.itemsize), (12, 3), bits).view(dtype)
        try:
            mesh = pj.Mesh(vertices, faces)
        except ValueError as error:
            words = "`vertices`: expected (finite values|values up to .*), got"
            assert re.match(words, str(error))  # noqa: PT017
            refused += 1
            usable = np.abs(vertices) < np.finfo(dtype).max / 8
            mesh = pj.Mesh(np.where(usable, vertices, 0), faces)
        scene = pj.Scene(mesh=mesh)
        hit = pj.trace(scene, rays)
        assert not np.any(np.isnan(hit.t))
        assert np.all(np.isfinite(hit.normal))
        assert np.all(np.isfinite(hit.barycentric))
        image = pj.silhouette(camera, scene)
        slopes = image_slopes(camera, scene) if exhaustive else ()
        assert np.min(image) >= 0
        assert np.max(image) <= 1 + 64 * np.finfo(dtype).eps
        assert not any(np.any(np.isnan(x)) for x in jax.tree.leaves(slopes))
    assert 0 < refused < meshes


@pytest.mark.long
@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_rays_that_are_no_rays_miss_and_leave_others_alone(bad):
    scene = pj.Scene(mesh=pj.shapes.bumpy(1), spheres=pj.Spheres([[0.0, 0, 2]], [0.5]))
    origin = np.tile([0.1, 0.2, 5.0], (5, 1))
    direction = np.tile([0.0, 0, -1], (5, 1))
    whole = pj.trace(scene, pj.Rays(jnp.asarray(origin), jnp.asarray(direction)))
    origin[1, 0], direction[2], direction[3] = bad, 0, np.nan
    hit = pj.trace(scene, pj.Rays(jnp.asarray(origin), jnp.asarray(direction)))
    assert hit.primitive.tolist() == [*whole.primitive[:1], -1, -1, -1, *whole.primitive[4:]]
    for x, y in zip(hit, whole, strict=True):
        np.testing.assert_array_equal(x[::4], y[::4])
        assert not np.any(np.isnan(x))


# --- mesh files ----------------------------------------------------------------------------------


def spoilt(whole, changes):
    """Return a file's bytes cut short at some places, and with some bytes changed, many times."""
    random, size = np.random.default_rng(0), len(whole)
    copies = [whole[:k] for k in (0, 1, 4, 8, 20, 30, size // 3, size // 2, size - 2)]
    for _ in range(changes):
        data = bytearray(whole)
        for k in random.integers(0, size, 5):
            data[k] = random.integers(256)
        copies.append(bytes(data))
    return [*copies, random.bytes(500)]


@pytest.mark.parametrize("ending", ["obj", "ply", "stl", "off", "glb"])
def test_mesh_files_cut_short_or_with_wrong_bytes(tmp_path, ending):
    path = tmp_path / f"box.{ending}"
    BOX.export(path)
    for data in spoilt(path.read_bytes(), 5):
        path.write_bytes(data)
        try:
            assert np.all(np.isfinite(pj.load_mesh(path).vertices))
        except ValueError as error:
            assert "`path`: expected" in str(error) or "(in " in str(error)  # noqa: PT017
    assert [*tmp_path.iterdir()] == [path]


# --- images --------------------------------------------------------------------------------------


def png(W, H):
    chunk = lambda n, x: struct.pack(">I", len(x)) + n + x + struct.pack(">I", zlib.crc32(n + x))
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", W, H, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    "data", [b"", b"hello", png(10**5, 10**5), png(2**31 - 1, 2**31 - 1), png(0, 5), png(40, 40)]
)
def test_files_that_are_no_images_or_claim_to_be_huge(tmp_path, data):
    (tmp_path / "x.png").write_bytes(data)
    with refusal("`path`: expected a readable image"):
        io.load_mask(tmp_path / "x.png")


@pytest.mark.parametrize("ending", ["png", "jpg", "tiff", "bmp", "webp", "pgm"])
def test_images_cut_short_or_with_wrong_bytes(tmp_path, ending):
    mask = np.zeros((20, 30), np.uint8)
    mask[5:15, 8:20] = 255
    path = tmp_path / f"x.{ending}"
    Image.fromarray(mask).save(path)
    for data in spoilt(path.read_bytes(), 40):
        path.write_bytes(data)
        try:
            assert io.load_mask(path).dtype == np.uint8
        except ValueError as error:
            assert "`path`: expected" in str(error)  # noqa: PT017


def test_images_of_floats_are_finite(tmp_path):
    for bad in (np.nan, np.inf):
        Image.fromarray(np.array([[bad, 1], [0, 0.5]], np.float32)).save(tmp_path / "x.tiff")
        with refusal(r"`path`: expected .* NaN or infinity"):
            io.load_mask(tmp_path / "x.tiff")
    Image.fromarray(np.array([[-3, 1], [0, 0.5]], np.float32)).save(tmp_path / "x.tiff")
    np.testing.assert_array_equal(io.load_mask(tmp_path / "x.tiff"), [[0, 255], [0, 128]])


# --- what is written -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "image",
    [np.full((3, 3), np.nan), np.full((3, 3), np.inf), np.full((3, 3), 200), np.zeros(3),
     np.zeros((3, 3, 2)), np.zeros((3, 3, 5)), np.zeros((0, 3)), np.zeros((3, 3), complex)],
)  # fmt: skip
def test_images_that_cannot_be_written(tmp_path, image):
    with refusal("`image`: expected"):
        io.save_image(tmp_path / "x.png", image)
    assert not [*tmp_path.iterdir()]


def test_paths_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    image = np.zeros((2, 2, 4), np.uint8)
    for name in (".", "file/x.png", "x.jpg", "x.xyz"):
        with refusal("`path`: expected"):
            io.save_image(tmp_path / name, image)
    for more in ({"x": np.nan}, {"x": object()}, {"x": 1j}):
        with refusal(r"`more`: expected what JSON can hold, got \['x'\]"):
            io.save_camera(tmp_path / "x.json", VIEW, **more)
    assert [x.name for x in tmp_path.iterdir()] == ["file"]


# --- camera files --------------------------------------------------------------------------------

NO_FIELDS = [None, "x", [], {}, True, [True] * 3, [[1, 2, 3]], [1, 2], [None] * 3, 1e400,
             float("nan"), 10**400, [10**400] * 3, ["1", "2", "3"], -1, 0, [1, 2, "3"]]  # fmt: skip


@pytest.mark.parametrize("name", ["e", "p", "u", "phi", "d", "W", "H", "schema", "lens"])
def test_wrong_fields_of_a_camera_file_are_named(tmp_path, name):
    good = io.camera_to_dict(VIEW)
    del good["phi_degrees"], good["pose"]  # with these `phi` may be left out
    for bad in NO_FIELDS:
        if name == "lens" and bad is None:
            continue
        (tmp_path / "c.json").write_text(json.dumps({**good, name: bad}))
        words = f"`{name}`.*expected|lens[)]" if name == "lens" else f"`{name}`.*expected"
        with refusal(words):
            io.load_camera(tmp_path / "c.json")
