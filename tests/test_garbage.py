"""Whatever comes in gives the documented result or an error that names the argument."""

import re
import signal
import struct
import zlib
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest
import trimesh
from chosen import first
from fuzz_readers import broken, damaged, ring, targets
from numpy.random import default_rng
from numpy.testing import assert_array_equal
from oracles import balls, body, cast
from PIL import Image
from processes import printed
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


VIEW, SCENE = pj.Camera(**CAMERA, **SIZE), body(BOX)
VIEWS, MASK = jax.tree.map(lambda x: np.stack([x, x]), VIEW), np.zeros((18, 24))
RAYS, JOINT = pj.Rays(np.zeros(3), np.ones(3)), pj.JointView(SCENE, MASK)
NAMES = "expected names like 'pose', or several: 'pose,phi'"
READER, RAGGED = "(`pj.io.load_mask` reads files)", [[1, 0], [1]]
SHAPE = "expected the camera's shape (H, W) = (18, 24)"


def calls(*given, **more):
    """Return the functions' calls with arguments that are none of theirs."""
    return lambda *functions: [partial(f, *given, **more) for f in functions]


def fit(function=pj.fit_camera, camera=VIEW, mask=MASK, **more):
    """Return a fit's calls, with each of some values of an argument."""
    ((name, values),) = more.items()
    return [partial(function, SCENE, mask, camera, **{name: value}) for value in values]


fits = partial(fit, pj.fit_cameras, [VIEW], [MASK])
#: Calls whose arguments are swapped or of the wrong kind, by the words that they earn.
CALLS = {
    "`scene`, `rays`: expected a Scene and Rays or a Camera, got Rays, Scene": calls(RAYS, SCENE)(
        pj.trace, pj.occluded
    ),
    "`rays`: expected one camera, got several": calls(SCENE, VIEWS)(pj.trace),
    "`camera`, `scene`: expected a Camera and a Scene, got Scene, Camera": calls(SCENE, VIEW)(
        pj.depth, pj.normals, pj.silhouette, pj.observability, pj.check_gradients
    ),
    "`camera`, `scene`: expected a Camera and a Scene, got Camera, Mesh": calls(VIEW, SCENE.mesh)(
        pj.silhouette
    ),
    "`camera`: expected a Camera, got Scene": calls(SCENE)(
        pj.camera_basis, partial(io.save_camera, "c.json"), pj.formats.to_blender
    ),
    "`camera`: expected one camera, got several": [
        *calls(VIEWS)(io.camera_to_dict, pj.formats.to_pytorch3d),
        *calls(VIEWS, SCENE)(pj.silhouette, pj.normals),
        *calls(VIEWS, np.zeros(3))(pj.project),
    ],
    "`cameras`: expected a dict of Cameras by their names, got Camera": calls("c.json", VIEW)(
        pj.formats.write, pj.formats.write_opencv
    ),
    "`cameras['a']`: expected one camera, got several": calls("c.json", {"a": VIEWS})(
        pj.formats.write
    ),
    "`targets`: expected masks (H, W) in a list, got NoneType": calls(SCENE, None, [VIEW])(
        pj.fit_cameras
    ),
    "`views`: expected JointViews in a list, got JointView": calls(JOINT, VIEW)(pj.fit_joint),
    "`views[0]`: expected a JointView, got Scene": calls([SCENE], VIEW)(pj.fit_joint),
    "`cameras`: expected a Camera, or a dict of them, got list": calls([JOINT], [VIEW])(
        pj.fit_joint
    ),
    "`bodies`: expected at least one Mesh, got Scene": calls([SCENE])(pj.Assembly),
    "`executor`: expected a concurrent.futures.Executor, got 'dask'": calls([], executor="dask")(
        pj.fit_many
    ),
    "`items`: expected records, one after another, got {'id': 'a'}": calls({"id": "a"})(
        pj.fit_many
    ),
    "`items`: expected records, one after another, got 3": calls(3)(pj.fit_many),
    "`items[0]`: expected a mapping of fields, got str": calls(["a"])(pj.fit_many),
    "`record`: expected a mapping of fields, got str": calls("a")(pj.fit_one),
    f"`free`: {NAMES}": fit(free=[None, 3]),
    f"`shared`: {NAMES}": fits(shared=[None]),
    "`shared`: expected names among phi, d, ": fits(shared=["foo"]),
    "`shared`: expected names among pose, ": fit(pj.fit_cameras, None, [MASK], shared=["foo"]),
    "`shared`: expected coefficients of a BrownConrady": fits(shared=["k4"]),
    "`outlier_px`: expected a positive number of px, got": [
        *fit(outlier_px=["2", [2], True, np.nan, np.inf]), *fits(outlier_px=["a"])
    ],
    "`noise_px`: expected a positive number of px, got": [
        *(c for x in ("a", [1], True) for c in calls(MASK, MASK, VIEW, noise_px=x)(pj.fit_points))
    ],
    f"`points2d`: expected real numbers of shape (N, 2), or (V, N, 2) for V views, got {RAGGED}":
        calls(np.eye(3), RAGGED, VIEW)(pj.fit_points),
    f"`points3d`: expected a real array of shape (18, 3), got {RAGGED}": calls(
        RAGGED, MASK[:, :2], VIEW
    )(pj.fit_points),
    f"`target`: {SHAPE} {READER}, got 'mask.png'": fit(mask="mask.png", max_steps=[1]),
    f"`target`: expected shape (H, W) {READER}, got 'mask.png'": fit(
        camera=None, mask="mask.png", phi=[0.6]
    ),
    f"`target`: {SHAPE}, got None": fit(mask=None, max_steps=[1]),
    f"`target`: {SHAPE}, got {RAGGED}": fit(mask=RAGGED, max_steps=[1]),
    f"`weight`: {SHAPE}, got {RAGGED}": fit(weight=[RAGGED]),
    "`max_steps`: expected an integer of at least 1": [
        *fit(max_steps=["3", True]), *fits(max_steps=[2.5])
    ],
    "`prior`: expected a dict of names and their": fit(prior=[[1, 2]]),
    "`prior`: expected (mean, standard deviation) of 'e_x', got": fit(
        prior=[{"e_x": pair} for pair in (("a", 1), (0, True), ([0, 0], 1), {1, 2}, (0, np.inf))]
    ),
    "`bounds`: expected a dict of names and their": fit(bounds=[[1, 2]]),
    "`phi`: expected an angle (rad), got Camera": fit(camera=None, phi=[VIEW]),
    "`phi`: expected an angle (rad), got bool": fit(camera=None, phi=[True]),
    "`fit`: expected a Fit, got Camera": [
        *calls(VIEW)(plot.levels),
        *calls(VIEW, SCENE)(plot.off_px, plot.outline_sigma),
        *calls(VIEW, SCENE, MASK)(report.page),
    ],
    "`mask_b`: expected a mask of (18, 24), the shape of `mask_a`, got (9, 24)": calls(
        MASK, MASK[:9]
    )(pj.iou),
    "`path`: expected a path, got ndarray": calls(MASK)(
        pj.load_mesh, pj.formats.read, io.load_mask
    ),
}  # fmt: skip


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
    printed("-c", code, Path(__file__).parent)


# --- scenes --------------------------------------------------------------------------------------


def test_empty_scenes_cover_nothing():
    none = np.zeros((0, 3))
    for scene in (
        pj.Scene(),
        body(none, none.astype(int)),
        body(np.eye(3), [[0, 0, 0], [1, 1, 2]]),
        balls(none, none[:, 0]),
    ):
        assert not np.any(pj.silhouette(VIEW, scene))
        if scene.mesh is None or not len(scene.mesh.faces):
            with refusal("`scene`: expected a Scene with a mesh or"):
                pj.fit_camera(scene, np.eye(18, 24), VIEW)


@pytest.mark.parametrize("kind", first(0, ["float32", "float64"], of=2))
def test_random_bits_as_vertices_are_refused_or_seen_without_nan(kind, exhaustive):
    """Random exponents: products of coordinates overflow, differences lose all digits."""
    dtype = np.dtype(kind)
    camera = cast(VIEW, dtype)
    random, refused = default_rng(0), 0
    faces = random.integers(0, 12, (20, 3))  # the same always: they share a program
    meshes = 500 if exhaustive else 15
    for _ in range(meshes):
        vertices = np.frombuffer(random.bytes(36 * dtype.itemsize), dtype).reshape(12, 3)
        try:
            mesh = pj.Mesh(vertices, faces)
        except ValueError as error:
            words = "`vertices`: expected (finite values|values up to .*), got"
            assert re.match(words, str(error))  # noqa: PT017
            refused += 1
            usable = np.abs(vertices) < np.finfo(dtype).max / 8
            mesh = pj.Mesh(np.where(usable, vertices, 0), faces)
        hit = pj.trace(pj.Scene(mesh), camera)
        assert not np.any(np.isnan(hit.t))
        assert np.all(np.isfinite(hit.normal)) & np.all(np.isfinite(hit.barycentric))
        image = np.asarray(pj.silhouette(camera, pj.Scene(mesh)))
        assert np.all((image >= 0) & (image <= 1 + 64 * np.finfo(dtype).eps))
    assert 0 < refused < meshes


@pytest.mark.long
@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_rays_that_are_no_rays_miss_and_leave_others_alone(bad):
    scene = balls([[0.0, 0, 2]], [0.5], pj.shapes.bumpy(1))
    rays = np.tile([[[0.1, 0.2, 5.0]], [[0.0, 0, -1]]], (1, 5, 1))  # origins, directions
    whole = pj.trace(scene, pj.Rays(*rays))
    rays[0, 1, 0], rays[1, 2], rays[1, 3] = bad, 0, np.nan
    hit = pj.trace(scene, pj.Rays(*rays))
    assert hit.primitive[1:4].tolist() == [-1] * 3
    for x, y in zip(hit, whole, strict=True):
        assert_array_equal(x[::4], y[::4])
        assert not np.any(np.isnan(x))


# --- files ---------------------------------------------------------------------------------------


def test_damaged_files_are_refused_by_name_or_read_as_finite_numbers(tmp_path, exhaustive):
    random = default_rng(0)
    signal.signal(signal.SIGPROF, ring)
    for name, target in targets(tmp_path).items():
        path = tmp_path / target.file
        for _ in range(500 if exhaustive else 40):
            data = damaged(target.valid, random)
            path.write_bytes(data)
            assert broken(target, path) is None, (name, data)


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


def test_tiffs_with_fewer_rows_than_they_say_are_refused(tmp_path):
    Image.fromarray(np.eye(20, dtype=np.uint8)).save(path := tmp_path / "x.tiff")
    whole, height = path.read_bytes(), lambda rows: struct.pack("<HHII", 257, 4, 1, rows)
    path.write_bytes(whole.replace(height(20), height(10**5)))
    with refusal("`path`: expected a readable image.*rows are missing"):
        io.load_mask(path)


def test_images_of_floats_are_finite(tmp_path):
    path = tmp_path / "x.tiff"
    save = lambda x: Image.fromarray(np.array([[x, 1], [0, 0.5]], np.float32)).save(path)
    for bad in (np.nan, np.inf):
        save(bad)
        with refusal(r"`path`: expected .* NaN or infinity"):
            io.load_mask(path)
    save(-3)
    assert_array_equal(io.load_mask(path), [[0, 255], [0, 128]])


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
