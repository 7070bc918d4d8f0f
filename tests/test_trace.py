"""Hits against Embree (an independent tracer, in float32) and by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from chosen import full, long, on_cpu
from oracles import central_difference

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._trace import bvh, cores, packets, together, walk
from pinhole_jax._trace.components import parts
from pinhole_jax._trace.order import near_order
from pinhole_jax._trace.turned import turned

CAMERA = pj.Camera([0.3, 1.0, 5.0], [0.1, 0, 0], [0.2, 1, 0.1], 0.6, 1.0, 24, 20)
#: One program each: step by step they are some fifty.
mesh_tree, sphere_tree, packed = map(jax.jit, (bvh.mesh_tree, bvh.sphere_tree, bvh.packed))


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


@pytest.mark.parametrize("faces", [1, 5, 9, 33, 65, 320])
def test_tree_holds_each_face_once_in_its_boxes(faces):
    whole = shapes.bumpy(2)
    tree = mesh_tree(pj.Mesh(whole.vertices, np.asarray(whole.faces)[:faces]))
    nodes, leaves = tree.planes.shape[0], tree.primitive.shape[0]
    assert set(np.unique(tree.primitive)) == set(range(faces))
    planes, reached = np.asarray(tree.planes), set()

    def look(node, low, high):
        if node < nodes:
            first = 8 * node + nodes + leaves - 8 * nodes
            for k in np.flatnonzero(np.all(planes[node, :3] <= planes[node, 3:], axis=0)):
                here = np.maximum(low, planes[node, :3, k]), np.minimum(high, planes[node, 3:, k])
                look(first + k, *here)  # a box is inside all those above it
            return
        reached.add(node - nodes)
        corners = np.asarray(tree.data[node - nodes]).reshape(3, 3, -1)
        assert np.all(corners.min(axis=(1, 2)) >= low)
        assert np.all(corners.max(axis=(1, 2)) <= high)

    look(0, np.full(3, -np.inf), np.full(3, np.inf))
    assert reached == set(range(leaves))


@pytest.mark.parametrize("share", [0.0, 0.1, 0.9, 1.0])
def test_packed_keeps_what_is_wanted_in_order(share):
    mask = np.random.default_rng(0).random(256) < share
    values, number = packed(jnp.asarray(mask), jnp.arange(256, dtype=jnp.int32))
    assert int(number) == mask.sum()
    np.testing.assert_array_equal(values[: mask.sum()], np.flatnonzero(mask))


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


@pytest.mark.long
@pytest.mark.parametrize("kind", ["faces", "spheres"])
def test_rays_side_by_side_hit_the_same_as_in_turn(kind, rays, monkeypatch):
    """Where XLA makes no loop of the walk, as on a GPU; and not all rays are asked about."""
    monkeypatch.setattr(walk, "BESIDE", 64)
    random = np.random.default_rng(0)
    if kind == "faces":
        tree = mesh_tree(shapes.bumpy(1))
    else:
        centers, radii = random.uniform(-1, 1, (50, 3)), random.uniform(0.05, 0.3, 50)
        tree = sphere_tree(pj.Spheres(centers, radii))
    some = pj.Rays(rays.origin[:300], rays.direction[:300])
    axis = jax.jit(packets.axes_of)(parts(some.direction))
    order = random.permutation(300).astype(np.int32)
    order[250:] = -1
    walked = lambda: jax.jit(lambda *given: walk.walk(*given))(tree, *some, axis, order)
    in_turn = walked()
    elsewhere = lambda *arguments, cpu, default: default(*arguments)
    monkeypatch.setattr(jax.lax, "platform_dependent", elsewhere)
    beside = walked()
    np.testing.assert_array_equal(in_turn, beside)
    asked = np.isin(np.arange(300), order)
    assert np.all(np.asarray(in_turn)[~asked] == -1)
    whole = jax.jit(packets.first_met)(tree, *some)  # in the order in which they come
    np.testing.assert_array_equal(np.asarray(in_turn)[asked], np.asarray(whole)[asked])
    assert np.mean(np.asarray(whole) >= 0) > 0.3


def hostile_packets(mesh, dtype):
    """Return rays by packets that stay together: along the axes, through corners and edges, from on
    the surface; of some packets one ray is none, and one of a packet's comes from elsewhere."""
    random = np.random.default_rng(0)
    vertices = np.asarray(mesh.vertices)
    a, b = vertices[np.asarray(mesh.edge_vertices)[random.integers(0, 400, 60)]].transpose(1, 0, 2)
    along = np.linspace(0, 1, 16)[:, None, None]
    edges = np.swapaxes(a + along * (b - a), 0, 1)  # each packet along one edge, ends included
    from_afar = np.broadcast_to([0.3, 1.0, 3.0], edges.shape)
    grid = np.stack(np.meshgrid(np.arange(4), np.arange(4)), -1).reshape(16, 2) / 16
    corners = random.uniform(-0.8, 0.8, (60, 1, 2)) + grid
    corners[:10] = vertices[:10, None, :2]  # all sixteen through one vertex
    down = np.concatenate([corners, np.full((60, 16, 1), 3.0)], axis=2)
    axis = np.broadcast_to([0.0, 0, -1], down.shape)
    turn = [np.roll(x, k, axis=2) for k in range(3) for x in (down, axis)]
    outward = edges / np.linalg.norm(edges, axis=2, keepdims=True)
    origin = np.concatenate([from_afar, *turn[::2], edges, edges])
    direction = np.concatenate([edges - from_afar, *turn[1::2], outward, -outward])
    direction[3::17, 5] = [np.nan, 0, 1]
    direction[4::17, 6] = 0
    origin[5::17, 7] = np.inf
    origin[6::17, 8] += 5
    direction /= np.maximum(np.abs(direction).max(axis=2, keepdims=True), 1e-3)
    return jnp.asarray(origin.reshape(-1, 3), dtype), jnp.asarray(direction.reshape(-1, 3), dtype)


@pytest.mark.parametrize(
    ("dtype", "kind", "leaves"),
    [("float32", "faces", 256), long("float64", "spheres", 256), long("float32", "faces", 3)],
)
def test_packets_hit_the_same_as_single_rays(dtype, kind, leaves, monkeypatch):
    monkeypatch.setattr(packets, "FEW", 0)
    monkeypatch.setattr(together, "LEAVES", leaves)  # few: most packets give up
    mesh = shapes.bumpy(2)
    origin, direction = hostile_packets(mesh, dtype)
    origin, direction = origin[:-5], direction[:-5]  # the last packet is not full
    mesh = pj.Mesh(np.asarray(mesh.vertices, dtype), np.asarray(mesh.faces))
    radii = np.full(len(mesh.vertices), 0.1, dtype)
    tree = mesh_tree(mesh) if kind == "faces" else sphere_tree(pj.Spheres(mesh.vertices, radii))

    @jax.jit  # a function of this test: none is taken that was compiled with other numbers
    def both_ways(tree, origin, direction):
        axis = packets.axes_of(parts(direction))
        order = jnp.arange(len(axis), dtype=jnp.int32)
        whole = together.beams(turned(parts(origin), parts(direction), axis)).whole
        one_by_one = walk.walk(tree, origin, direction, axis, order)
        return packets.first_met(tree, origin, direction), one_by_one, whole

    by_packets, one_by_one, whole = both_ways(tree, origin, direction)
    np.testing.assert_array_equal(by_packets, one_by_one)
    assert 0.3 < np.mean(np.asarray(by_packets) >= 0) < 0.95
    assert np.sum(whole) > 100  # of some 360


def test_rays_that_enter_at_one_place_follow_one_another():
    tree = mesh_tree(shapes.bumpy(1))
    random = np.random.default_rng(0)
    ends = random.normal(size=(40, 3))
    origin = 4 * np.repeat(ends / np.linalg.norm(ends, axis=1, keepdims=True), 50, axis=0)
    mixed = random.permutation(2000)
    direction = -origin / 4
    direction[::50] = [[np.nan, 0, 1]]  # one of each end is no ray
    order = jax.jit(near_order)(tree, origin[mixed], direction[mixed])
    assert sorted(np.asarray(order)) == list(range(2000))
    number = mixed[np.asarray(order)]
    end = number[number % 50 > 0] // 50
    assert np.sum(np.diff(end) != 0) < 200  # (two ends may be in one cell); else some 1900


@on_cpu
@pytest.mark.parametrize("shape", [(640,), (40, 24), (12, 8, 5)], ids=str)
def test_rays_shared_out_to_cores_find_the_same(shape, rays, monkeypatch):
    """Whose packets are the same: shares begin where packets do."""
    monkeypatch.setattr(cores, "LEAST", 64)
    monkeypatch.setattr(cores, "usable_cores", lambda: 2)
    number = int(np.prod(shape))
    some = pj.Rays(rays.origin[0], rays.direction[:number].reshape(*shape, 3))
    asked = []

    @jax.jit
    def axis(direction):
        found = packets.axes_of([packets.in_packets(direction[..., k]) for k in range(3)])
        return packets.out_of_packets(found, direction.shape[:-1])

    def find(where, part):
        asked.append(part.direction.shape)
        return where + axis(part.direction)

    shared = cores.by_cores(find, jnp.int32(1), some)
    assert len(asked) > 1
    np.testing.assert_array_equal(shared, find(jnp.int32(1), some))
    assert cores._shares(pj.Rays(some.origin, some.direction[:-1])) == 1  # (does not divide)


@pytest.mark.long
def test_traces_on_all_cores_are_those_on_one(rays, monkeypatch):
    scene = pj.Scene(mesh=shapes.bumpy(1), spheres=pj.Spheres([[0.9, 0, 0]], [0.4]))
    some = pj.Rays(rays.origin[:512], rays.direction[:512])
    monkeypatch.setattr(cores, "LEAST", 64)
    monkeypatch.setattr(cores, "usable_cores", lambda: 1)
    alone = pj.trace(scene, some)
    monkeypatch.setattr(cores, "usable_cores", lambda: 3)
    for _ in range(2):  # the first compiles
        for one, other in zip(alone, pj.trace(scene, some), strict=True):
            np.testing.assert_array_equal(one, other)


@on_cpu
def test_walk_is_one_kernel():
    """XLA leaves the call alone, whose loop it makes one kernel of; else rays take 100 times as
    long."""
    tree, ray = mesh_tree(shapes.bumpy(1)), jnp.ones((40, 3))
    order = jnp.arange(40, dtype=jnp.int32)
    program = jax.jit(walk.walk).lower(tree, ray, ray, order % 3, order).compile().as_text()
    assert program is not None
    entry = program[program.index("\nENTRY") :]
    assert 'xla_cpu_small_call="true"' in entry
    assert " while(" not in entry


def test_program_can_hold_the_scene_as_a_constant(rays):
    """Of which XLA moved the tree into the walk, and then ended the process."""
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
