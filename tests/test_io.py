import json

import numpy as np
import pytest
import trimesh
from PIL import Image

import pinhole_jax as pj
from pinhole_jax import io

BOX = trimesh.creation.box()
CAMERA = pj.Camera([1.0, 2, 5], [0.1, 0, 0], [0.3, 1, 0.2], 0.7, 2.0, 30, 20)


@pytest.mark.parametrize("ending", ["obj", "ply", "stl", "off", "glb"])
def test_every_format_gives_the_same_closed_mesh(tmp_path, ending):
    path = tmp_path / f"box.{ending}"
    BOX.export(path)
    mesh = pj.load_mesh(path)
    assert mesh.closed
    assert (mesh.vertices.shape, mesh.faces.shape, mesh.edge_vertices.shape) == (
        (8, 3),
        (12, 3),
        (18, 2),
    )
    np.testing.assert_allclose(np.ptp(np.asarray(mesh.vertices), axis=0), 1)
    assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume > 0.999


def test_scenes_are_flattened_with_their_transforms(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(BOX, transform=trimesh.transformations.translation_matrix([5, 0, 0]))
    scene.add_geometry(BOX, transform=trimesh.transformations.scale_matrix(2.0))
    scene.export(tmp_path / "two.glb")
    mesh = pj.load_mesh(tmp_path / "two.glb")
    assert mesh.closed
    assert mesh.faces.shape == (24, 3)
    low, high = np.min(mesh.vertices, axis=0), np.max(mesh.vertices, axis=0)
    np.testing.assert_allclose([low, high], [[-1, -1, -1], [5.5, 1, 1]], atol=1e-6)


def test_quads_are_triangulated_and_equal_vertices_merged(tmp_path):
    # A cube of six quads, each with four vertices of its own.
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    lines = [f"v {x} {y} {z}" for quad in quads for x, y, z in corners[quad]]
    lines += [f"f {4 * k + 1} {4 * k + 2} {4 * k + 3} {4 * k + 4}" for k in range(6)]
    (tmp_path / "cube.obj").write_text("\n".join(lines))
    mesh = pj.load_mesh(tmp_path / "cube.obj")
    assert mesh.closed
    assert (mesh.vertices.shape, mesh.faces.shape) == ((8, 3), (12, 3))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("empty.obj", "", "expected a mesh file, .* empty"),
        ("points.obj", "v 0 0 0\nv 1 0 0\n", "expected a mesh with faces|readable mesh"),
        ("nan.off", "OFF\n3 1 0\n0 0 0\nnan 0 0\n0 1 0\n3 0 1 2\n", "expected finite vertices"),
        (
            "far.off",
            "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n",
            "expected faces with vertices 0 to 2|readable mesh",
        ),
        ("noise.ply", "hello", "expected a readable mesh"),
        ("mesh.txt", "v 0 0 0", "expected one of .obj"),
    ],
)
def test_what_is_wrong_with_a_mesh_file_is_said(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match="`path`: " + message):
        pj.load_mesh(tmp_path / name)


def test_a_missing_file_and_a_folder(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"`path`: expected a mesh file, .*no such file"):
        pj.load_mesh(tmp_path / "no.obj")
    with pytest.raises(ValueError, match=r"`path`: .* a folder"):
        pj.load_mesh(tmp_path)


def test_real_meshes_load(shared):
    for name, faces, closed in (
        ("spot.obj", 5856, True),
        ("teapot.obj", 6320, False),
        ("counter.stl", 83750, True),
    ):
        mesh = pj.load_mesh(shared / "meshes" / name)
        assert (mesh.faces.shape[0], mesh.closed) == (faces, closed)


@pytest.mark.parametrize("lens", [None, pj.Lens([14.0, 11.0], 1.1)])
def test_cameras_go_to_files_and_back(tmp_path, lens):
    camera = pj.Camera(CAMERA.e, CAMERA.p, CAMERA.u, 0.7, 2.0, 30, 20, lens)
    io.save_camera(tmp_path / "deep" / "camera.json", camera, note="kept")
    back = io.load_camera(tmp_path / "deep" / "camera.json")
    for name in ("e", "p", "u", "phi", "d"):
        np.testing.assert_array_equal(getattr(back, name), getattr(camera, name))
    assert (back.W, back.H) == (30, 20)
    assert (back.lens is None) == (lens is None)
    data = json.loads((tmp_path / "deep" / "camera.json").read_text())
    assert data["note"] == "kept"
    np.testing.assert_allclose(
        np.linalg.det([data["pose"][k] for k in ("right", "up", "forward")]), -1
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"e": None}, "`e`: expected"),
        ({"phi": "wide"}, "`phi`: expected a real number"),
        ({"W": 0}, "`W`: expected an integer of at least 1"),
        ({"schema": "other/7"}, "`schema`: expected 'pinhole_jax.camera/1', got 'other/7'"),
        ({"lens": 3}, "`lens`: expected principal_point"),
    ],
)
def test_wrong_fields_are_named(tmp_path, change, message):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({**io.camera_to_dict(CAMERA), **change}))
    with pytest.raises(ValueError, match=message):
        io.load_camera(path)


def test_missing_fields_and_files_that_are_no_json(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text("[1, 2]")
    with pytest.raises(ValueError, match="expected a JSON object, got list"):
        io.load_camera(path)
    path.write_text('{"e": [0, 0, 1]}')
    with pytest.raises(ValueError, match="expected the field 'p'"):
        io.load_camera(path)
    path.write_text("{")
    with pytest.raises(ValueError, match="expected JSON"):
        io.load_camera(path)
    with pytest.raises(FileNotFoundError, match="expected a camera file"):
        io.load_camera(tmp_path / "no.json")


def test_masks_are_grey_or_transparency(tmp_path):
    random = np.random.default_rng(0)
    mask = (random.random((5, 7)) > 0.5).astype(np.uint8) * 255
    Image.fromarray(mask).save(tmp_path / "grey.png")
    Image.fromarray(mask > 0).save(tmp_path / "one_bit.png")
    Image.fromarray(np.dstack([mask] * 3)).save(tmp_path / "rgb.png")
    colour = random.integers(0, 255, (5, 7, 3), np.uint8)
    Image.fromarray(np.dstack([colour, mask])).save(tmp_path / "alpha.png")
    for name in ("grey", "one_bit", "rgb", "alpha"):
        np.testing.assert_array_equal(io.load_mask(tmp_path / f"{name}.png"), mask)
    Image.fromarray(colour).save(tmp_path / "photo.png")
    with pytest.raises(ValueError, match=r"`path`: expected a mask .* a colour picture"):
        io.load_mask(tmp_path / "photo.png")
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(ValueError, match="`path`: expected a readable image"):
        io.load_mask(tmp_path / "text.png")
    with pytest.raises(FileNotFoundError, match="expected an image file"):
        io.load_mask(tmp_path / "none.png")


def test_nothing_is_half_written(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text("before")
    with pytest.raises(ValueError, match="Out of range"):
        io.save_camera(path, CAMERA, rms=float("nan"))
    assert path.read_text() == "before"
    assert [p.name for p in tmp_path.iterdir()] == ["camera.json"]
