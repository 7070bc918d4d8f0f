"""A camera's faces are drawn, not searched for: in each pixel the face that the tree finds."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chosen import full, long
from emitters import NEWER

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._trace.raster import _shared_out
from pinhole_jax._trace.trace import _find

V, F, W, H = 60, 40, 22, 18
program = partial(jax.jit, compiler_options=NEWER)
AWAY = np.array([148376.0, 1234.0, -223423.0])


def soup(random, kind):
    """Return vertices and faces that are unkind to who draws them."""
    vertices, faces = random.normal(size=(V, 3)), random.integers(0, V, (F, 3))
    match kind:
        case "scales":
            vertices *= 10.0 ** random.uniform(-3, 3, (V, 1))
        case "lattice":  # coplanar, edge-on, many vertices at one place
            vertices = np.round(2 * vertices) / 2
        case "plane":
            vertices = np.round(vertices) * [1, 0, 1]
        case "twice":
            faces[::2] = faces[1::2][:, [1, 2, 0]]
        case "slivers":
            vertices[:20] = vertices[20:40] + 1e-7 * random.normal(size=(20, 3))
            faces[:, 2] = (faces[:, 1] + 20) % V
        case "film-covering":
            vertices *= [1e3, 1e3, 1]
    return vertices, faces


def view(random, vertices, faces):
    """Return e, p, u, phi of a camera that may be in a face, on a lattice, or see next to all."""
    e = random.normal(size=3) * 10.0 ** random.uniform(-2, 1.5)
    p, u = random.normal(size=3) / 2, random.normal(size=3)
    if random.random() < 0.4:
        e, p, u = np.round(2 * e) / 2, np.round(p), np.array([0, 1.0, 0])
    if random.random() < 0.1:
        e = vertices[faces[0]].mean(axis=0)
    if np.all(p == e) or np.all(np.cross(p - e, u) == 0):
        p = p + np.array([0.3, 0.2, 1.1])
    return e, p, u, random.choice([0.6, 2.0, 3.1, 1e-3, 1e-6])


def both(scene, camera):
    """Return the face in each pixel, drawn and searched for, of the same rays."""
    rays = pj.camera_rays(camera)
    return (np.asarray(_find(scene, None, rays, given).face) for given in (camera, None))


def differ(scene, camera, drawn, searched):
    """Return in which pixels two faces differ by more than rounding may let them.

    It may where the ray meets both, give or take their corners' rounding, and as deep or where the
    eye is in one of them; where one pixel shows nothing, where the ray meets the other's face at
    its edge. In long numbers.
    """
    rays, corners = pj.camera_rays(camera), np.asarray(scene.mesh.vertices)[scene.mesh.faces]
    eps = 16 * np.finfo(corners.dtype).eps
    at = drawn != searched
    origin, direction = (
        np.broadcast_to(x, (*drawn.shape, 3))[at].astype(np.longdouble) for x in rays[:2]
    )
    least, most, aside = [], [], []
    for face in (drawn[at], searched[at]):
        seen = corners[face].astype(np.longdouble) - origin[:, None]
        size = np.abs(seen).max(axis=(1, 2))
        low, high, beyond = met_within(seen, direction, eps * size)
        none = face < 0
        least.append(np.where(none, -np.inf, low))
        most.append(np.where(none, np.inf, high))
        aside.append(np.where(none, False, beyond))
    wrong = np.zeros(drawn.shape, bool)
    apart = (np.maximum(*least) > np.minimum(*most)) & (least[0] > 0) & (least[1] > 0)
    wrong[at] = apart | aside[0] | aside[1]
    return wrong


def met_within(seen, direction, rounding):
    """Return between which depths rays meet triangles, whose corners (n, 3, 3) are seen from the
    rays' origins and moved by as much as rounding moves them, and which rays meet none of these."""
    ends = np.roll(seen, -1, axis=1)
    normal = np.cross(seen, ends)
    edge = np.einsum("nki,ni->nk", np.roll(normal, -1, axis=1), direction)
    slack = rounding[:, None] * 2 * np.abs(seen).max(axis=(1, 2))[:, None]
    aside = (edge < -slack).any(axis=1) & (edge > slack).any(axis=1)
    along = np.einsum("nki,ni->nk", seen, direction)
    total, error = np.abs(edge.sum(axis=1)), 3 * slack[:, 0]
    depth = np.einsum("nk,nk->n", edge, along) / np.where(total > 0, edge.sum(axis=1), 1)
    spread = np.where(total > 2 * error, error / np.maximum(total - error, 1e-300), 1)
    spread = 4 * spread * np.abs(seen).max(axis=(1, 2)) + rounding
    flat = spread > np.ptp(along, axis=1)
    low = np.where(flat, along.min(axis=1) - rounding, depth - spread)
    return low, np.where(flat, along.max(axis=1) + rounding, depth + spread), aside


KINDS = ["scales", "lattice", "plane", "twice", "slivers", "film-covering"]


@pytest.mark.parametrize("dtype", ["float32", full("float64")])
@pytest.mark.usefixtures("optimised")
def test_raster_and_tree_find_the_same_face(dtype, exhaustive):
    """Ties too: of faces that are equally deep, to the last bit, both take the first.

    Which faces of one plane are equally deep to the last bit is the compiler's to say, by the
    products that it contracts: XLA did it alike in both programs until JAX 0.11.
    """
    random = np.random.default_rng(0)
    base = pj.Scene(mesh=pj.Mesh(*(x[:V] for x in soup(random, "scales"))))
    met = 0
    for trial in range(2000 if exhaustive else 120):
        vertices, faces = soup(random, KINDS[trial % len(KINDS)])
        e, p, u, phi = view(random, vertices, faces)
        unit, away = random.choice([1, 1, 1, 1e-25, 1e25]), random.choice([0, 0, 0, 1])
        vertices, e, p = ((unit * (x + away * AWAY)).astype(dtype) for x in (vertices, e, p))
        if np.all(e == p):
            continue
        order = random.permutation(F).astype("int32")
        # One mesh's arrays are replaced: what is compiled serves all trials.
        scene = eqx.tree_at(
            lambda s: (s.mesh.vertices, s.mesh.faces, s.mesh.order),
            base,
            tuple(jnp.asarray(x) for x in (vertices, faces.astype("int32"), order)),
        )
        camera = pj.Camera(e, p, u.astype(dtype), np.dtype(dtype).type(phi), 1.0, W, H)
        drawn, searched = both(scene, camera)
        wrong = differ(scene, camera, drawn, searched)
        np.testing.assert_array_equal(drawn[wrong], searched[wrong], err_msg=f"trial {trial}")
        met += np.sum(drawn >= 0)
    assert met > 5000


@pytest.mark.parametrize("size", [full((1, 1)), full((3, 7)), (61, 50)])
@pytest.mark.parametrize("kind", ["before", long("within")])
def test_films_of_any_size_from_before_and_within(size, kind):
    """More blocks than are drawn at a time where the film is large; axes that change within it."""
    scene = pj.Scene(mesh=shapes.bumpy(2))
    e, phi = ([0.3, 1.0, 5.0], 0.6) if kind == "before" else ([0.1, 0.2, -0.1], 2.9)
    drawn, searched = both(scene, pj.Camera(e, [0.1, 0, 0], [0.2, 1, 0.1], phi, 1.0, *size))
    np.testing.assert_array_equal(drawn, searched)
    assert np.any(drawn >= 0)


def test_tile_with_rays_of_two_axes_is_drawn():
    """Rays of one tile run along x and along z: each is tested along its own axis."""
    scene = pj.Scene(mesh=shapes.bumpy(2))
    camera = pj.Camera([0.05, 0.02, 0.1], [1.0, 0.3, 1.02], [0, 1.0, 0], 2.7, 1.0, 12, 9)
    drawn, searched = both(scene, camera)
    np.testing.assert_array_equal(drawn, searched)
    assert np.all(drawn >= 0)


@pytest.mark.long
def test_camera_stands_for_its_rays():
    scene = pj.Scene(mesh=shapes.bumpy(1), spheres=pj.Spheres([[1.1, 0.9, 0.2]], [0.4]))
    lens = pj.Lens([11.0, 7.0], aspect=1.1)
    for given in (None, lens, pj.Lens([11.0, 7.0], distortion=pj.BrownConrady(k1=-0.1))):
        camera = pj.Camera([0.3, 1, 5], [0.1, 0, 0], [0.2, 1, 0.1], 0.6, 1.0, W, H, given)
        seen, traced = pj.trace(scene, camera), pj.trace(scene, pj.camera_rays(camera))
        assert seen.t.shape == (H, W)
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
        camera = pj.Camera(eye, [0.1, 0, 0], [0.2, 1, 0.1], 0.6, 1.0, W, H)
        return pj.depth(camera, scene)

    alone = program(image)
    one_by_one = jnp.stack([alone(e, s) for e, s in zip(eyes, sizes, strict=True)])
    np.testing.assert_allclose(program(jax.vmap(image))(eyes, sizes), one_by_one, rtol=1e-12)
    of_one = program(jax.vmap(image, in_axes=(0, None)))(eyes, sizes[0])
    np.testing.assert_allclose(of_one[0], one_by_one[0], rtol=1e-12)


@pytest.mark.long
def test_derivatives_are_those_of_the_rays():
    """Of a camera by drawing, and of its rays by the tree; forwards and backwards."""
    mesh = shapes.bumpy(1)

    def loss(traced, e, vertices):
        camera = pj.Camera(e, [0.1, 0, 0], [0.2, 1, 0.1], 0.6, 1.0, W, H)
        scene = pj.Scene(mesh=eqx.tree_at(lambda m: m.vertices, mesh, vertices))
        hit = pj.trace(scene, pj.camera_rays(camera) if traced else camera)
        weight = jnp.cos(jnp.arange(H * W, dtype=e.dtype)).reshape(H, W)
        return jnp.sum(jnp.where(hit.primitive >= 0, hit.t * weight, 0)) + jnp.sum(hit.normal**3)

    at = jnp.array([0.3, 1.0, 5.0]), mesh.vertices
    slopes = jax.jit(jax.grad(loss, argnums=(1, 2)), static_argnums=0)
    drawn, searched = slopes(False, *at), slopes(True, *at)
    along = jax.tree.map(lambda x: jnp.sin(jnp.arange(x.size, dtype=x.dtype)).reshape(x.shape), at)
    _, forward = jax.jit(lambda x, d: jax.jvp(lambda *x: loss(False, *x), x, d))(at, along)
    for a, b in zip(drawn, searched, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(
        forward, sum(jnp.sum(a * d) for a, d in zip(drawn, along, strict=True))
    )
    assert np.abs(drawn[0]).max() > 1e-3


@pytest.mark.long
def test_traced_camera_that_is_none_hits_nothing():
    """While it is traced nobody can refuse it: no endless work, no hit, no NaN."""
    scene = pj.Scene(mesh=shapes.bumpy(1))
    e = jnp.array([0.3, 1.0, 5.0])

    def image(p, u):
        return pj.depth(pj.Camera(e, p, u, 0.6, 1.0, W, H), scene)

    p, u = jnp.stack([e, jnp.zeros(3)]), jnp.stack([jnp.array([0.0, 1, 0]), e])
    assert np.all(np.isposinf(program(jax.vmap(image))(p, u)))


@pytest.mark.parametrize("done", [0, 2, 5])
def test_blocks_are_shared_out_in_order_and_go_on_where_they_stopped(done):
    """Against a plain list of all blocks."""
    count = np.random.default_rng(done).integers(0, 4, 16)
    count[0] = 6
    plain = [(f, k) for f, c in enumerate(count) for k in range(c)][done:]
    owner, block, through, of_next = _shared_out(jnp.asarray(count, jnp.int32), jnp.int32(done))
    given = [(int(f), int(k)) for f, k in zip(owner, block, strict=True) if k >= 0]
    assert given == plain[:16]
    left = plain[16:]
    if left:
        assert left[0] == (int(through), int(of_next))


def test_faces_of_one_block_each_leave_nothing_half_done():
    owner, block, through, of_next = _shared_out(jnp.ones(16, jnp.int32), jnp.int32(0))
    np.testing.assert_array_equal(owner, np.arange(16))
    np.testing.assert_array_equal(block, np.zeros(16))
    assert (int(through), int(of_next)) == (16, 0)
