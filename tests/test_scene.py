import gc
import weakref

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._camera.camera import check_camera
from pinhole_jax._scene.planes import planes_of
from pinhole_jax._scene.scene import (
    astype,
    at_rest,
    bounding_box,
    bounding_sphere,
    check_view,
    front_facing,
    morton_order,
    padded,
    planes_are_current,
    with_or_without_border,
)
from pinhole_jax._silhouette.contour import contour_weights

TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])  # counter-clockwise from outside


def test_edges_of_a_closed_mesh_have_two_faces_each_and_run_as_in_the_first():
    mesh = pj.Mesh(TETRAHEDRON, FACES)
    assert mesh.closed
    assert mesh.edge_vertices.shape == (6, 2)
    for (a, b), (first, second) in zip(
        mesh.edge_vertices.tolist(), mesh.edge_faces.tolist(), strict=True
    ):
        cycle = [FACES[f].tolist() * 2 for f in (first, second)]
        assert any(cycle[0][k : k + 2] == [a, b] for k in range(3))
        assert any(cycle[1][k : k + 2] == [b, a] for k in range(3))


def test_border_edges_have_one_face():
    mesh = pj.Mesh(TETRAHEDRON, FACES[:3])
    assert not mesh.closed
    assert int(jnp.sum(mesh.edge_faces[:, 1] < 0)) == 3


def test_opposite_windings_do_not_pair():
    flipped = FACES.copy()
    flipped[3] = flipped[3, ::-1]
    mesh = pj.Mesh(TETRAHEDRON, flipped)
    assert not mesh.closed
    assert mesh.edge_vertices.shape == (9, 2)  # 3 good pairs, 3 edges of 2 records each


def test_edge_shared_by_four_faces_has_two_records():
    # Two tetrahedra that share the edge 0-3 alone: each closed by itself, so the whole is closed.
    other = np.array([[0, 0, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1.0]])
    vertices = np.concatenate([TETRAHEDRON, other[1:3]])
    faces = np.concatenate([FACES, np.array([0, 4, 5, 3])[FACES]])
    mesh = pj.Mesh(vertices, faces)
    assert mesh.closed
    records = np.sort(np.asarray(mesh.edge_vertices), axis=1)
    assert np.sum(np.all(records == [0, 3], axis=1)) == 2


def test_front_faces_are_those_whose_outside_is_seen():
    mesh = pj.Mesh(TETRAHEDRON, FACES)
    assert front_facing(mesh, jnp.array([5.0, 5, 5])).tolist() == [False, False, False, True]
    assert front_facing(mesh, jnp.array([0.2, 0.2, -5])).tolist() == [True, False, False, False]


@pytest.mark.parametrize("kind", [np.float64, np.float32, list])
def test_vertices_far_from_the_origin_are_warned_of_in_float32(kind):
    """A cube of 1 m at UTM coordinates: float32 has steps of 0.5 m there."""
    cube = trimesh.creation.box()
    far = np.add(cube.vertices, [500000.3, 5400000.7, 300.2])
    given = far.tolist() if kind is list else far.astype(kind)
    near = pj.Mesh(cube.vertices.astype(np.float32) + 100, cube.faces)  # steps of 8e-6
    assert near.vertices.dtype == np.float32
    if kind is np.float64:
        pj.Mesh(given, cube.faces)
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.warns(UserWarning, match=r"`vertices`: float32 .*steps of 0.5, 1/\d of the"):
            mesh = pj.Mesh(given, cube.faces)
    finally:
        jax.config.update("jax_enable_x64", True)
    assert np.max(np.abs(np.asarray(mesh.vertices, float) - far)) > 0.1


def test_spheres_far_from_the_origin_are_warned_of_in_float32():
    far = np.array([[500000.3, 5400000.7, 300.2], [500001.3, 5400000.7, 300.2]], np.float32)
    pj.Spheres(far[:1], np.float32([4000]))  # steps of 0.5 are nothing to that
    for centers in (far, far[:1]):
        with pytest.warns(UserWarning, match=r"`centers`: float32 rounds .*steps of 0.5, 1/\d"):
            pj.Spheres(centers, np.full(len(centers), 0.5, np.float32))


def test_planes_are_never_stale():
    mesh = pj.Mesh(TETRAHEDRON, FACES)
    turned = eqx.tree_at(lambda m: m.vertices, mesh, -mesh.vertices[:, ::-1])
    fresh = pj.Mesh(turned.vertices, FACES)
    for e in jnp.array([[5.0, 5, 5], [-5, -4, -3], [0.2, -3, 0.1]]):
        assert front_facing(turned, e).tolist() == front_facing(fresh, e).tolist()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("size", [1.0, 1e-30, 1e30])
@pytest.mark.parametrize("cut", [0, 57], ids=["closed", "border"])
def test_planes_at_hand_are_those_of_a_program(dtype, size, cut):
    ball = trimesh.creation.icosphere(2)
    vertices = np.random.default_rng(0).normal(1, 0.05, ball.vertices.shape) * ball.vertices
    mesh = pj.Mesh((size * vertices).astype(dtype), ball.faces[cut:])
    traced = planes_of(mesh.vertices, mesh.faces)
    for name in ("corner", "box", "fingerprint"):
        np.testing.assert_array_equal(getattr(mesh.planes, name), getattr(traced, name))
    np.testing.assert_allclose(mesh.planes.normal, traced.normal, rtol=1e-5, atol=1e-6)

    order = morton_order(jnp.mean(mesh.vertices[mesh.faces], axis=1))
    np.testing.assert_array_equal(mesh.order, order)


def test_mesh_compiles_nothing(compiled):
    ring = trimesh.creation.torus(1, 0.3, 11, 9)
    bounding_box(pj.Scene(mesh=pj.Mesh(ring.vertices, ring.faces)))
    compiled.clear()  # (to hold an array takes a program of JAX's own, once)
    sizes = []
    for sections in (11, 12, 17):
        ring = trimesh.creation.torus(1, 0.3, sections, 9)
        scene = pj.Scene(mesh=pj.Mesh(ring.vertices, ring.faces))
        sizes.append(len(padded(scene).mesh.faces))
        box = np.asarray(bounding_box(scene))
        np.testing.assert_array_equal(box, [ring.vertices.min(axis=0), ring.vertices.max(axis=0)])
    assert len({*sizes}) == 1
    assert not compiled


def test_vertices_may_be_traced_and_faces_may_not():
    made = jax.jit(lambda v: pj.Mesh(v, FACES).vertices)(jnp.asarray(TETRAHEDRON))
    np.testing.assert_array_equal(made, TETRAHEDRON)
    with pytest.raises(ValueError, match="`faces`: expected a concrete array"):
        jax.jit(lambda f: pj.Mesh(TETRAHEDRON, f).vertices)(jnp.asarray(FACES))


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (np.zeros((4, 2)), FACES, r"`vertices`: expected .* shape \(N, 3\), got shape \(4, 2\)"),
        (
            TETRAHEDRON * np.nan,
            FACES,
            r"`vertices`: expected finite values, got nan at index \(0, 0\)",
        ),
        (TETRAHEDRON, FACES[:, :2], r"`faces`: expected shape \(F, 3\), got \(4, 2\)"),
        (TETRAHEDRON, FACES * 1.0, r"`faces`: expected integers, got dtype float64"),
        (TETRAHEDRON, FACES + 1, r"`faces`: expected indices from 0 to 3, got 1 to 4"),
        (TETRAHEDRON, FACES - 1, r"`faces`: expected indices from 0 to 3, got -1 to 2"),
    ],
)
def test_bad_meshes_are_refused(vertices, faces, message):
    with pytest.raises(ValueError, match=message):
        pj.Mesh(vertices, faces)


@pytest.mark.parametrize(
    ("centers", "radii", "message"),
    [
        ([[0, 0]], [1.0], r"`centers`: expected .* got shape \(1, 2\)"),
        ([[0, 0, 0]], [1.0, 2.0], r"`radii`: expected .* shape \(1,\), got shape \(2,\)"),
        ([[0, 0, 0]], [0.0], r"`radii`: expected positive radii, got 0.0"),
        ([[0, np.inf, 0]], [1.0], r"`centers`: expected finite values, got inf"),
    ],
)
def test_bad_spheres_are_refused(centers, radii, message):
    with pytest.raises(ValueError, match=message):
        pj.Spheres(centers, radii)


def test_bad_scenes_are_refused():
    with pytest.raises(ValueError, match="`mesh`: expected a Mesh or None, got str"):
        pj.Scene(mesh="bunny.obj")
    with pytest.raises(ValueError, match="`spheres`: expected Spheres or None, got list"):
        pj.Scene(spheres=[1, 2])


def test_bounding_sphere_holds_everything():
    scene = pj.Scene(mesh=pj.Mesh(TETRAHEDRON, FACES), spheres=pj.Spheres([[3.0, 0, 0]], [1.0]))
    centre, radius = bounding_sphere(scene)
    np.testing.assert_allclose(centre, [2, 0, 0])
    np.testing.assert_allclose(radius, np.sqrt(4**2 + 2**2 + 2**2) / 2)


@pytest.mark.long
def test_padding_and_casting_keep_the_silhouette():
    scene = pj.Scene(mesh=shapes.bumpy(2))
    camera = pj.Camera([0.3, 1, 5], [0, 0, 0], [0, 1, 0], 0.6, W=24, H=20)
    image = pj.silhouette(camera, scene)
    full = padded(scene)
    assert full.mesh.faces.shape[0] % 64 == 0
    # Other sizes are another program: its sums may be rounded elsewhere.
    np.testing.assert_allclose(pj.silhouette(camera, full), image, atol=1e-14)
    single = astype(scene, jnp.dtype(jnp.float32))
    assert single.mesh.planes.normal.dtype == jnp.float32
    np.testing.assert_allclose(pj.silhouette(camera, single), image, atol=1e-5)


def test_padding_stale_planes_makes_them_anew():
    scene = pj.Scene(mesh=shapes.bumpy(1))
    stretched = eqx.tree_at(
        lambda s: s.mesh.vertices, scene, scene.mesh.vertices * jnp.array([[2.0, 1, 1]])
    )
    fresh = pj.Scene(mesh=pj.Mesh(stretched.mesh.vertices, scene.mesh.faces))
    e = jnp.array([1.0, 2, 3])
    F = scene.mesh.faces.shape[0]
    assert (
        front_facing(padded(stretched).mesh, e)[:F].tolist() == front_facing(fresh.mesh, e).tolist()
    )


def test_planes_at_rest_are_not_checked_again():
    scene = at_rest(pj.Scene(mesh=shapes.bumpy(1)))
    assert bool(planes_are_current(scene.mesh))
    program = jax.jit(contour_weights).lower(scene.mesh, jnp.array([1.0, 2, 3])).compile()
    assert "conditional(" not in program.as_text()
    assert at_rest(pj.Scene()).mesh is None


def test_faces_are_ordered_alike_where_the_mesh_is_traced():
    mesh = shapes.bumpy(2)
    traced = jax.jit(lambda x: pj.Mesh(x, mesh.faces).order)(mesh.vertices)
    np.testing.assert_array_equal(mesh.order, traced)


def test_trimesh_mesh_is_accepted():
    theirs = trimesh.creation.box()
    ours = pj.Mesh(theirs)
    np.testing.assert_array_equal(ours.vertices, theirs.vertices)
    np.testing.assert_array_equal(ours.faces, theirs.faces)
    with pytest.raises(TypeError, match="missing 1 required argument: 'faces'"):
        pj.Mesh(theirs.vertices)
    with pytest.raises(ValueError, match=r"`mesh`: expected a Mesh .* got Trimesh; give `Mesh"):
        pj.Scene(mesh=theirs)


def test_swapped_or_stacked_camera_and_scene_are_refused():
    scene = pj.Scene(spheres=pj.Spheres([[0.0, 0, 0]], [0.5]))
    camera = pj.Camera([0.0, 0, 5], [0, 0, 0], [0, 1, 0], 0.6, 1.0, 8, 6)
    check_view(camera, scene)
    for arguments, got in (
        ((scene, camera), "got Scene, Camera"),
        ((camera, scene.spheres), "got Camera, Spheres"),
    ):
        with pytest.raises(ValueError, match=f"expected a Camera and a Scene, {got}"):
            check_view(*arguments)
    with pytest.raises(ValueError, match="`camera_b`: expected a Camera, got Scene"):
        check_camera(scene, "camera_b")
    stacked = jax.tree.map(lambda x: jnp.stack([x, x]), camera)
    with pytest.raises(ValueError, match=r"got several \(e of shape \(2, 3\)\): `jax.vmap` takes"):
        check_view(stacked, scene)
    with pytest.raises(ValueError, match="`camera`: expected one camera, got several"):
        pj.project(stacked, jnp.zeros(3))
    with pytest.raises(ValueError, match="`camera`: expected one camera, got several"):
        pj.formats.to_opencv(stacked, pixel_centres="half")


def test_memory_of_a_fit_is_freed():
    """A loop over many masks holds no more at its end: 2 MB a fit stayed, as equinox keeps what is
    made of a module by `copy`."""
    gone = weakref.ref(with_or_without_border(padded(pj.Scene(mesh=shapes.bumpy(1)))).mesh)
    gc.collect()
    assert gone() is None
