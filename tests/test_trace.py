"""Hits against Embree (an independent tracer, in float32) and by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from chosen import full
from oracles import central_difference

import pinhole_jax as pj
from pinhole_jax import shapes

CAMERA = pj.Camera([0.3, 1.0, 5.0], [0.1, 0, 0], [0.2, 1, 0.1], 0.6, 1.0, 24, 20)


@pytest.fixture(scope="module")
def rays():
    """A few thousand rays: some from a camera, some from anywhere to anywhere."""
    random = np.random.default_rng(0)
    eye, target = random.normal(size=(2, 1500, 3))
    eye *= 3 / np.linalg.norm(eye, axis=1, keepdims=True)
    direction = target * 0.6 - eye
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return pj.Rays(jnp.asarray(eye), jnp.asarray(direction))


def edge_distance(vertices, faces, origin, direction, face):
    """Return how far each ray passes from the edges of a face, over the face's size."""
    corners = vertices[faces[face]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    t = np.sum(normal * (corners[:, 0] - origin), axis=1) / np.sum(normal * direction, axis=1)
    point = origin + t[:, None] * direction
    distances = []
    for k in range(3):
        a, b = corners[:, k], corners[:, (k + 1) % 3]
        distances.append(
            np.linalg.norm(np.cross(point - a, b - a), axis=1) / np.linalg.norm(b - a, axis=1)
        )
    return np.min(distances, axis=0), t


@pytest.mark.parametrize("name", ["spot.obj", full("bob.obj"), "bumpy"])
def test_same_hits_as_embree(name, rays, request):
    pytest.importorskip("embreex")
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    if name == "bumpy":
        mesh = shapes.bumpy(4)
    else:
        mesh = pj.load_mesh(request.getfixturevalue("shared") / "meshes" / name)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    hit = pj.trace(pj.Scene(mesh=mesh), rays)
    origin, direction = (np.asarray(x) for x in rays)
    peer = RayMeshIntersector(trimesh.Trimesh(vertices, faces, process=False))
    theirs = peer.intersects_first(origin, direction)
    ours = np.asarray(hit.primitive)
    assert (ours >= 0).mean() > 0.2

    clear = np.ones(len(ours), bool)
    for found in (ours, theirs):
        on = found >= 0
        distance, _ = edge_distance(vertices, faces, origin[on], direction[on], found[on])
        clear[on] &= distance > 1e-6
    assert clear.mean() > 0.99
    np.testing.assert_array_equal((ours >= 0)[clear], (theirs >= 0)[clear])
    # Embree's t is float32's: compare with the plane of the face that Embree found, in float64.
    both = clear & (ours >= 0)
    _, t = edge_distance(vertices, faces, origin[both], direction[both], theirs[both])
    np.testing.assert_allclose(np.asarray(hit.t)[both], t, rtol=1e-6)


def brute_force(mesh, rays):
    """Return t and face of each ray by testing every face (Moller and Trumbore, in long double)."""
    vertices, origin, direction = (np.asarray(x, np.longdouble) for x in (mesh.vertices, *rays))
    a, b, c = (vertices[np.asarray(mesh.faces)[:, k]] for k in range(3))
    across, offset = np.cross(direction[:, None], c - a), origin[:, None] - a
    det = np.sum(across * (b - a), axis=-1)
    beside = np.cross(offset, b - a)
    u = np.sum(across * offset, axis=-1) / det
    v = np.sum(beside * direction[:, None], axis=-1) / det
    t = np.sum(beside * (c - a), axis=-1) / det
    t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
    best = np.min(t, axis=1)
    return best.astype(float), np.where(np.isfinite(best), np.argmin(t, axis=1), -1)


@pytest.mark.long
@pytest.mark.parametrize("faces", [1, 4, 5, 64, 65, *(full(n) for n in (2, 3, 63))])
def test_tree_matches_brute_force(faces, rays):
    whole = shapes.bumpy(1)
    mesh = pj.Mesh(whole.vertices, np.asarray(whole.faces)[:faces])
    some = pj.Rays(rays.origin[:500], rays.direction[:500])
    hit = pj.trace(pj.Scene(mesh=mesh), some)
    t, face = brute_force(mesh, some)
    np.testing.assert_array_equal(hit.primitive, face)
    np.testing.assert_allclose(hit.t, t, rtol=1e-14)
    np.testing.assert_array_equal(pj.occluded(pj.Scene(mesh=mesh), some), face >= 0)


@pytest.mark.parametrize(
    ("dtype", "offset"), [("float32", 0.0), ("float32", 1.0), ("float64", 1.0)]
)
def test_no_ray_leaks_through_edges_or_vertices(dtype, offset):
    """Rays from within a closed mesh, aimed at vertices and points of edges; also far away."""
    mesh = shapes.bumpy(2)
    random = np.random.default_rng(0)
    away = offset * np.array([148376.0, 1234.0, -223423.0])
    vertices = (np.asarray(mesh.vertices) + away).astype(dtype)
    a, b = vertices[np.asarray(mesh.edge_vertices)].transpose(1, 0, 2)
    along = random.random((4, len(a), 1)).astype(dtype)
    aims = np.concatenate([vertices, (a + along * (b - a)).reshape(-1, 3)])
    origin = np.broadcast_to(away.astype(dtype), aims.shape)
    direction = aims - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    scene = pj.Scene(mesh=pj.Mesh(vertices, np.asarray(mesh.faces)))
    blocked = pj.occluded(scene, pj.Rays(jnp.asarray(origin), jnp.asarray(direction)))
    assert int(jnp.sum(~blocked)) == 0


@pytest.mark.long
@pytest.mark.parametrize("offset", [0.0, 1.0])
@pytest.mark.parametrize("tile", [1, 40])
def test_many_rays_do_not_leak(exhaustive, offset, tile):
    """Rays aimed at vertices and edges, each apart from the next, and near together."""
    count = 100_000 if exhaustive else 6_000
    mesh = shapes.bumpy(3)
    random = np.random.default_rng(1)
    away = (offset * np.array([148376.0, 1234.0, -223423.0])).astype("float32")
    vertices = np.asarray(mesh.vertices, "float32") + away
    ends = vertices[np.asarray(mesh.edge_vertices)[random.integers(0, 1920, count // tile)]]
    along = np.sort(random.integers(0, 5, (count // tile, tile, 1)) / np.float32(4), axis=1)
    along = along.astype("float32")
    aims = (ends[:, :1] + along * (ends[:, 1:] - ends[:, :1])).reshape(-1, 3)
    direction = aims - away
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    scene = pj.Scene(mesh=pj.Mesh(vertices, np.asarray(mesh.faces)))
    blocked = pj.occluded(scene, pj.Rays(jnp.asarray(away), jnp.asarray(direction)))
    assert int(jnp.sum(~blocked)) == 0


def test_program_can_hold_the_scene_as_a_constant(rays):
    scene = pj.Scene(mesh=shapes.bumpy(2))
    inside = jax.jit(lambda rays: pj.trace(scene, rays).primitive)
    np.testing.assert_array_equal(inside(rays), pj.trace(scene, rays).primitive)


@pytest.mark.long
def test_batches_of_rays_and_of_vertices(rays):
    mesh = shapes.bumpy(1)
    some = pj.Rays(rays.origin[:6], rays.direction[:6])

    def first(vertices, origin, direction):
        moved = eqx.tree_at(lambda m: m.vertices, mesh, vertices)
        return pj.trace(pj.Scene(mesh=moved), pj.Rays(origin, direction)).t

    whole = first(mesh.vertices, *some)
    one_by_one = jax.vmap(first, in_axes=(None, 0, 0))(mesh.vertices, *some)
    np.testing.assert_allclose(one_by_one, whole, rtol=1e-13)
    sizes = jnp.array([1.0, 0.5])[:, None, None] * mesh.vertices[None]
    both = jax.vmap(first, in_axes=(0, None, None))(sizes, *some)
    np.testing.assert_allclose(both[0], whole, rtol=1e-13)
    np.testing.assert_allclose(both[1], first(sizes[1], *some), rtol=1e-13)


def test_hit_matches_numbers_worked_out_by_hand():
    mesh = pj.Mesh([[0, 0, 0], [2, 0, 0], [0, 2, 0.0]], [[0, 1, 2]])
    rays = pj.Rays(jnp.array([0.5, 0.25, 3.0]), jnp.array([[0.0, 0, -1], [0, 0, 1], [0.6, 0.8, 0]]))
    hit = pj.trace(pj.Scene(mesh=mesh), rays)
    np.testing.assert_allclose(hit.t, [3, np.inf, np.inf])
    assert hit.primitive.tolist() == [0, -1, -1]
    # (0.5, 0.25) = 0.625 a + 0.25 b + 0.125 c
    np.testing.assert_allclose(
        hit.barycentric, [[0.625, 0.25, 0.125], [0] * 3, [0] * 3], atol=1e-15
    )
    np.testing.assert_allclose(hit.normal, [[0, 0, 1], [0] * 3, [0] * 3], atol=1e-15)


def test_triangles_are_hit_from_both_sides_and_keep_their_normal():
    mesh = pj.Mesh([[0, 0, 0], [2, 0, 0], [0, 2, 0.0]], [[0, 1, 2]])
    below = pj.Rays(jnp.array([0.5, 0.25, -3.0]), jnp.array([0.0, 0, 1]))
    hit = pj.trace(pj.Scene(mesh=mesh), below)
    np.testing.assert_allclose(hit.t, 3)
    np.testing.assert_allclose(hit.normal, [0, 0, 1], atol=1e-15)


def test_spheres_by_hand():
    scene = pj.Scene(spheres=pj.Spheres([[0.0, 0, 0], [0, 0, -5]], [1.0, 1.0]))
    down = jnp.array([0.0, 0, -1])
    origins = jnp.array([[0.0, 0, 4], [0, 0, 0], [0, 0.6, 4], [0, 1, 4], [0, 1.1, 4], [0, 0, -2]])
    hit = pj.trace(scene, pj.Rays(origins, jnp.broadcast_to(down, (6, 3))))
    # From outside; from within (far wall); off centre; grazing; past it; from between the two.
    np.testing.assert_allclose(hit.t, [3, 1, 3.2, 4, np.inf, 2], rtol=1e-12)
    assert hit.primitive.tolist() == [0, 0, 0, 0, -1, 1]
    np.testing.assert_allclose(hit.normal[2], [0, 0.6, 0.8], atol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("distance", [1e2, 1e4, 1e6])
def test_small_spheres_far_away_keep_their_digits_in_float32(distance):
    # The textbook discriminant b^2 - 4ac loses them all from a distance of some 1e3 radii.
    origin = jnp.array([0.3, 0.4, distance], jnp.float32)
    rays = pj.Rays(origin, jnp.array([0, 0, -1], jnp.float32))
    scene = pj.Scene(spheres=pj.Spheres(np.zeros((1, 3), np.float32), np.ones(1, np.float32)))
    exact = distance - np.sqrt(0.75)
    np.testing.assert_allclose(pj.trace(scene, rays).t, exact, rtol=2e-7)


@pytest.mark.long
def test_t_counts_in_lengths_of_the_direction():
    scene = pj.Scene(mesh=shapes.bumpy(1), spheres=pj.Spheres([[3.0, 0, 0]], [0.5]))
    origin = jnp.array([[0.1, 0.2, 5], [3, 0, 5]])
    along = jnp.array([[0.0, 0, -1], [0, 0, -1]])
    one, three = (pj.trace(scene, pj.Rays(origin, k * along)) for k in (1.0, 3.0))
    np.testing.assert_allclose(one.t, 3 * three.t, rtol=1e-14)
    np.testing.assert_allclose(one.barycentric, three.barycentric, atol=1e-14)


def test_nearer_of_mesh_and_sphere_is_hit():
    mesh = pj.Mesh([[-2, -2, 0], [2, -2, 0], [0, 2, 0.0]], [[0, 1, 2]])
    scene = pj.Scene(mesh=mesh, spheres=pj.Spheres([[0.0, 0, 0]], [0.5]))
    rays = pj.Rays(jnp.array([[0.0, 0, 4], [1, -1, 4]]), jnp.tile(jnp.array([0.0, 0, -1]), (2, 1)))
    assert pj.trace(scene, rays).primitive.tolist() == [1, 0]


@pytest.mark.long
def test_derivatives_of_hits_equal_central_differences():
    mesh = shapes.bumpy(1)
    scene = pj.Scene(mesh=mesh, spheres=pj.Spheres([[1.3, 0.9, 0]], [0.4]))
    rays = pj.camera_rays(CAMERA)
    hit = pj.trace(scene, rays)
    on = np.asarray(hit.primitive) >= 0
    random = np.random.default_rng(0)
    weights = [jnp.asarray(random.normal(size=s)) for s in ((20, 24), (20, 24, 3), (20, 24, 3))]

    def loss(origin, direction, vertices, centers, radii):
        moved = eqx.tree_at(
            lambda s: (s.mesh.vertices, s.spheres.centers, s.spheres.radii),
            scene,
            (vertices, centers, radii),
        )
        found = pj.trace(moved, pj.Rays(origin, direction))
        same = jnp.asarray(on) & (found.primitive == hit.primitive)
        parts = (jnp.where(same, found.t, 0), found.barycentric, found.normal)
        masks = (same, same[..., None], same[..., None])
        return sum(
            jnp.sum(jnp.where(m, w * p, 0)) for m, w, p in zip(masks, weights, parts, strict=True)
        )

    at = [rays.origin, rays.direction, mesh.vertices, scene.spheres.centers, scene.spheres.radii]
    compiled = jax.jit(loss)
    slopes = jax.jit(jax.grad(loss, argnums=(0, 1, 2, 3, 4)))(*at)
    for k, slope in enumerate(slopes):
        direction = jnp.asarray(random.normal(size=at[k].shape))
        along = lambda s, k=k, d=direction: compiled(
            *(x + s * d if n == k else x for n, x in enumerate(at))
        )
        expected = central_difference(along, 0.0, 1e-7)
        assert np.all(np.isfinite(slope))
        np.testing.assert_allclose(jnp.sum(slope * direction), expected, rtol=2e-5, atol=2e-5)


@pytest.mark.long
def test_grazing_rays_have_finite_derivatives():
    spheres = pj.Spheres([[0.0, 0, 0]], [1.0])
    slope = jax.grad(
        lambda o: pj.trace(pj.Scene(spheres=spheres), pj.Rays(o, jnp.array([0.0, 0, -1]))).t
    )(jnp.array([0.0, 1.0, 4.0]))
    assert np.all(np.isfinite(slope))


@pytest.mark.long
def test_shapes_follow_the_rays_and_no_rays_give_no_hits():
    scene = pj.Scene(mesh=shapes.bumpy(1))
    hit = pj.trace(scene, pj.Rays(jnp.zeros(3), jnp.zeros((2, 0, 3))))
    assert hit.t.shape == (2, 0)
    batched = jax.vmap(lambda o: pj.trace(scene, pj.Rays(o, jnp.array([0.0, 0, -1]))).t)
    assert np.all(np.isfinite(batched(jnp.array([[0.0, 0, 4], [0.1, 0, 5]]))))
    assert (
        pj.trace(pj.Scene(), pj.Rays(jnp.zeros(3), jnp.ones((4, 3)))).primitive.tolist() == [-1] * 4
    )


@pytest.mark.long
def test_camera_stands_for_its_rays():
    scene = pj.Scene(mesh=shapes.bumpy(1), spheres=pj.Spheres([[1.1, 0.9, 0.2]], [0.4]))
    lens = pj.Lens([11.0, 7.0], aspect=1.1)
    for given in (None, lens, pj.Lens([11.0, 7.0], distortion=pj.BrownConrady(k1=-0.1))):
        camera = pj.Camera([0.3, 1, 5], [0.1, 0, 0], [0.2, 1, 0.1], 0.6, 1.0, 22, 18, given)
        seen, traced = pj.trace(scene, camera), pj.trace(scene, pj.camera_rays(camera))
        assert seen.t.shape == (18, 22)
        assert {int(k) for k in np.unique(seen.primitive)} > {-1, 80}
        np.testing.assert_array_equal(seen.primitive, traced.primitive)
        np.testing.assert_allclose(seen.t, traced.t, rtol=1e-13)
        np.testing.assert_array_equal(pj.occluded(scene, camera), np.isfinite(seen.t))


@pytest.mark.long
def test_many_cameras_and_many_shapes_by_vmap():
    mesh = shapes.bumpy(1)
    eyes = jnp.array([[0.3, 1.0, 5.0], [2.0, 1.0, 3.0], [0.1, 0.1, 0.2]])
    sizes = jnp.array([1.0, 0.7, 1.2])

    def image(eye, size):
        scene = pj.Scene(mesh=eqx.tree_at(lambda m: m.vertices, mesh, size * mesh.vertices))
        camera = pj.Camera(eye, [0.1, 0, 0], [0.2, 1, 0.1], 0.6, 1.0, 22, 18)
        return pj.depth(camera, scene)

    alone = jax.jit(image)
    one_by_one = jnp.stack([alone(e, s) for e, s in zip(eyes, sizes, strict=True)])
    np.testing.assert_allclose(jax.jit(jax.vmap(image))(eyes, sizes), one_by_one, rtol=1e-12)
    of_one = jax.jit(jax.vmap(image, in_axes=(0, None)))(eyes, sizes[0])
    np.testing.assert_allclose(of_one[0], one_by_one[0], rtol=1e-12)


@pytest.mark.long
def test_traced_camera_that_is_none_hits_nothing():
    """While it is traced nobody can refuse it: no endless work, no hit, no NaN."""
    scene = pj.Scene(mesh=shapes.bumpy(1))
    e = jnp.array([0.3, 1.0, 5.0])

    def image(p, u):
        return pj.depth(pj.Camera(e, p, u, 0.6, 1.0, 22, 18), scene)

    p, u = jnp.stack([e, jnp.zeros(3)]), jnp.stack([jnp.array([0.0, 1, 0]), e])
    assert np.all(np.isposinf(jax.jit(jax.vmap(image))(p, u)))


def test_unknown_search_is_refused():
    scene, rays = pj.Scene(mesh=shapes.bumpy(1)), pj.Rays(jnp.zeros(3), jnp.ones(3))
    for function in (pj.trace, pj.occluded):
        with pytest.raises(ValueError, match=r"`search`: expected 'tree', got 'embree'; .*removed"):
            function(scene, rays, search="embree")
