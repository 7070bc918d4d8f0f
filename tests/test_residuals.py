"""The compact residuals against the image itself: same squares, same Jacobian, same overlap."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chosen import full, long
from oracles import drawn

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._mask.pyramid import cells_of, pyramid
from pinhole_jax._numerics.bitset import in_order
from pinhole_jax._numerics.thin_qr import triangle
from pinhole_jax._silhouette.curves import Segments
from pinhole_jax._silhouette.sweep import _turned
from pinhole_jax._solver import by_pixel, cutting, overlapping, runs
from pinhole_jax._solver.moves import Move, canonical, moved, on_film
from pinhole_jax._solver.overlapping import _by_number
from pinhole_jax._solver.residuals import Capacity, residuals as _residuals, touch

pytestmark = pytest.mark.altered

FREE = ("pose", "phi")
CAPACITY = Capacity(256, 1024, 1024, 512)
LENS = pj.BrownConrady(-0.3, 0.1, 2e-3, 1e-3, 0.02)
residuals = eqx.filter_jit(_residuals)


def setting(look_at=(0.0, 0, 0), W=30, H=24, spheres=False, phi=0.6, seed=0):
    random = np.random.default_rng(seed)
    look_at = np.array(look_at)
    camera = pj.Camera(np.add(look_at, [0.3, 1, 5]), look_at, [0.1, 1, 0], phi, 1.0, W, H)
    balls = pj.Spheres([[1.2, 0.9, 0], [-1.3, -0.8, 0.5]], [0.3, 0.2]) if spheres else None
    scene = pj.Scene(mesh=shapes.bumpy(2, bumps=0.006), spheres=balls)
    target = np.clip(random.random((H, W)) * 1.4 - 0.2, 0, 1)
    weight = random.random((H, W)) * (random.random((H, W)) > 0.2)
    return camera, scene, target, weight


@eqx.filter_jit
def compact_jacobian(y, start, scene, data, level):
    """Return the residuals' Jacobian, their sums, load and values."""

    def compact(y):
        (r, rest), sums, load, _ = _residuals(moved(start, y, FREE), scene, data, level, CAPACITY)
        return r, (sums, load, (r, rest))

    return jax.jacfwd(compact, has_aux=True)(y)


@eqx.filter_jit
def image_jacobian(y, start, camera, scene):
    """Return the image, and its Jacobian by the same parameters."""

    def image(y):
        image = pj.silhouette(on_film(moved(start, y, FREE), camera), scene)
        return image, image

    columns, value = jax.jacfwd(image, has_aux=True)(y)
    return value, columns


def pixels_kept(unit, scene, level) -> np.ndarray:
    """Return 0 for the pixels that the residuals leave out, else 1: (H, W)."""
    touched, _ = eqx.filter_jit(touch)(unit, scene, level, CAPACITY)
    W, H = int(level.W), int(level.H)
    kept = np.ones((H, W + 2))
    assert np.any(touched.inside)
    cells = np.asarray(touched.cell)[np.asarray(touched.inside & ~touched.known)]
    kept[np.divmod(cells, W + 2)] = 0
    assert np.mean(kept == 0) < 0.02
    return kept[::-1, 1:-1]


@pytest.mark.parametrize(
    ("look_at", "spheres", "W", "phi", "model"),
    [
        long((-1.2, 0, 0), False, 30, 0.6, LENS),
        full((0, 0, 0), False, 150, 0.6, None),  # (as wide as the next: one program)
        full((-8, 0, 0), False, 150, 0.6, None),  # more film heights away than a 1 x 1 film has
        full((1.7, 0, 0), False, 30, 0.6, None),
        full((-1.7, 0, 0), True, 30, 0.6, None),
        full((0, 1.3, 0), True, 30, 0.6, None),
        full((0, -1.3, 0), False, 30, 0.6, None),
        full((-1, 0, 0), True, 30, 0.05, None),  # the object goes on far right of the film
        full((1, 0, 0), True, 30, 0.05, None),
        full((-1, 0, 0), True, 30, 0.05, LENS),
        full((-1.2, 0, 0), True, 30, 0.6, LENS),
    ],
)
def test_squares_sums_and_jacobian_are_those_of_the_image(look_at, spheres, W, phi, model):
    camera, scene, target, weight = setting(look_at, W=W, spheres=spheres, phi=phi)
    if model is not None:
        lens = pj.Lens([14.0, 13.0], 1.02, model)
        camera = pj.Camera(camera.e, camera.p, camera.u, camera.phi, camera.d, W, camera.H, lens)
    data, levels = pyramid(target, weight, float)
    unit = canonical(camera)
    start = Move(unit, jnp.zeros(3), jnp.full(7, 0.01))
    zero = jnp.zeros(7)
    J, (sums, load, (r, rest)) = compact_jacobian(zero, start, scene, data, levels[-1])
    image, columns = image_jacobian(zero, start, camera, scene)
    weight = weight * pixels_kept(unit, scene, levels[-1])
    covered, dense = np.asarray(image), np.asarray(columns).reshape(-1, 7)
    difference = np.sqrt(weight) * (covered - target)
    dense = np.sqrt(weight).reshape(-1, 1) * dense
    assert bool(load.fits(CAPACITY))
    np.testing.assert_allclose(jnp.sum(r**2) + rest**2, np.sum(difference**2), rtol=1e-12)
    np.testing.assert_allclose(sums.squares, np.sum(difference**2), rtol=1e-12)
    np.testing.assert_allclose(
        sums.overlap, np.sum(weight * np.minimum(covered, target)), rtol=1e-12
    )
    np.testing.assert_allclose(sums.union, np.sum(weight * np.maximum(covered, target)), rtol=1e-12)
    np.testing.assert_allclose(J.T @ J, dense.T @ dense, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(J.T @ r, dense.T @ difference.ravel(), rtol=1e-9, atol=1e-9)


@pytest.mark.long
def test_coverage_of_a_rough_mesh_is_the_image():
    """Most pixels with several pieces are covered."""
    mesh, (camera, _, target, weight) = shapes.bumpy(3), setting(W=60, H=50)
    off = np.random.default_rng(1).normal(0, 0.02, mesh.vertices.shape)
    scene = pj.Scene(mesh=pj.Mesh(np.asarray(mesh.vertices) + off, mesh.faces))
    level = jax.tree.map(jnp.asarray, pyramid(target, weight, float)[1][-1])
    capacity = Capacity(1024, 4096, 1, 1)
    start = Move(canonical(camera), jnp.zeros(3), jnp.full(7, 0.01))
    way = jnp.asarray([0.3, -0.5, 0.2, 0.7, 0.1, -0.4, 0.6])

    def seen(s):
        unit = moved(start, s * way, FREE)
        return touch(unit, scene, level, capacity), pj.silhouette(on_film(unit, camera), scene)

    ((touched, load), image), (slopes, columns) = jax.jit(lambda: jax.jvp(seen, (0.0,), (1.0,)))()
    assert bool(load.fits(capacity))
    known = np.asarray(touched.inside & touched.known)
    row, column = np.divmod(np.asarray(touched.cell)[known], 62)
    told = lambda image: np.asarray(image)[49 - row, column - 1]
    change = slopes[0].coverage[known]
    error = np.abs(touched.coverage[known] - told(image))
    slope_error = np.abs(change - told(columns)) / np.max(np.abs(change))
    assert np.max(error) < 1e-12
    assert np.max(slope_error) < 1e-10
    assert not np.any(touched.inside & ~touched.known)
    assert np.sum(np.abs(change) > 1e-6) > 50 < np.sum(np.abs(change) == 0)


@pytest.mark.long
def test_coarse_levels_are_means_of_blocks():
    camera, scene, _, _ = setting(W=33, H=50)
    target = drawn(camera, scene)
    data, levels = pyramid(target, np.ones_like(target), float, coarsest_px=8)
    assert [(int(v.W), int(v.H)) for v in levels] == [(9, 13), (17, 25), (33, 50)]
    for level in levels:  # the target is the scene's own image: nothing is left at any level
        (r, rest), sums, *_ = residuals(canonical(camera), scene, data, level, CAPACITY)
        np.testing.assert_allclose(r, 0, atol=1e-12)
        np.testing.assert_allclose(rest, 0, atol=1e-6)
        assert float(sums.overlap) > 0


@pytest.mark.long
def test_exact_runs_cost_exactly_nothing_in_float32():
    camera, scene, _, _ = setting()
    target = (drawn(camera, scene) > 0.5).astype(float)
    data, levels = pyramid(target, np.ones_like(target), np.float32)
    camera = jax.tree.map(lambda x: x.astype(jnp.float32), camera)
    scene = pj.Scene(mesh=pj.Mesh(scene.mesh.vertices.astype(jnp.float32), scene.mesh.faces))
    (_, rest), *_ = residuals(canonical(camera), scene, data, levels[-1], CAPACITY)
    assert float(rest) == 0


def test_small_capacity_is_never_silent():
    short = Capacity(256, 16, 0)
    camera, scene, target, weight = setting()
    data, levels = pyramid(target, weight, float)
    (r, rest), _, load, _ = residuals(canonical(camera), scene, data, levels[-1], short)
    assert not bool(load.fits(short))
    assert np.all(np.isnan(r))
    assert np.isnan(rest)


def test_finest_level_alone_equals_that_of_the_pyramid():
    """Hard and soft masks; weights that count nowhere, in a band, everywhere."""
    rng = np.random.default_rng(7)
    hard = np.zeros((203, 330))
    hard[40:150, 60:220] = 1.0
    soft = np.clip(hard + rng.normal(0, 0.1, hard.shape), 0, 1)
    band = np.where(np.abs(np.arange(203) - 40)[:, None] < 9, 0.7, 0.0) * np.ones((1, 330))
    for target in (hard, soft):
        for weight in (band, rng.random(hard.shape)):
            whole, (*_, finest) = pyramid(target, weight, float)
            alone, (level,) = pyramid(target, weight, float, only_finest=True)
            assert jax.tree.map(np.shape, whole) == jax.tree.map(np.shape, alone)
            H, W = target.shape
            cell = jnp.arange(H * (W + 2) + 1, dtype=jnp.int32)
            for a, b in zip(
                cells_of(whole, finest, cell), cells_of(alone, level, cell), strict=True
            ):
                np.testing.assert_array_equal(a, b)
            assert int(level.start) == 0
            assert level.window() == finest.window()
            t, w = (np.pad(x[::-1], ((0, 0), (1, 1))).ravel() for x in (target, weight))
            sums = (w * t**2, w * (1 - t) ** 2, w, w * t)
            for own, cost in zip(cells_of(alone, level, cell)[2:], sums, strict=True):
                np.testing.assert_allclose(own, np.append(0.0, np.cumsum(cost)), atol=1e-9)


@pytest.mark.parametrize("wide", [True, False])
def test_pieces_are_put_in_order_with_64_bits_and_with_32(wide):
    key = np.random.default_rng(0).integers(0, 50, 300).astype(np.int32)
    key[:3] = 1 << 30
    with jax.enable_x64(wide):
        orders = both_ways(in_order, (jnp.asarray(key),))
    for order in orders:
        assert np.array_equal(order, np.argsort(key, kind="stable"))


@pytest.mark.parametrize("number", [1, 2, 3, 8])
def test_pieces_meet_in_all_pairs(number):
    beside = np.asarray(_turned(jnp.arange(number)[:, None]))[..., 0]
    met = {frozenset(pair) for row in beside for pair in enumerate(row.tolist())}
    assert met == {frozenset(pair) for pair in itertools.combinations(range(number), 2)}


def test_pixels_with_few_pieces_come_first():
    number = np.array([3, 9, 2, 5, 1])
    chosen = np.array([True, True, False, True, False])
    pixels, count = _by_number(jnp.asarray(chosen), jnp.asarray(number))
    assert pixels[:count].tolist() == [0, 3, 1]


@pytest.mark.parametrize("filled", [0, 700, 2500, 3000])
def test_empty_rows_do_not_change_the_triangle(filled):
    table = np.random.default_rng(filled).normal(size=(3000, 4))
    table[filled:] = 0
    found = np.asarray(jax.jit(triangle)(table))
    assert np.all(np.tril(found, -1) == 0)
    assert np.allclose(found.T @ found, table.T @ table, rtol=1e-12, atol=1e-9)


def test_nan_rows_make_the_triangle_nan():
    table = np.zeros((3000, 4))
    table[2000, 1] = np.nan
    assert np.isnan(np.asarray(jax.jit(triangle)(table))).any()


def test_pyramid_is_not_copied():
    data = jax.device_put(pyramid(np.eye(32), np.ones((32, 32)), float)[0])
    at = [x.unsafe_buffer_pointer() for x in data[2:]]
    assert {*np.diff(at)} == {data.target.nbytes}  # side by side, as they were written


def test_pieces_and_runs_in_turn_are_those_side_by_side():
    """On a CPU one after the other, on other machines side by side."""
    random, P, W, H = np.random.default_rng(5), 200, 12, 9
    end, width = jnp.int32(H * (W + 2)), jnp.int32(W + 2)
    cell = jnp.asarray(np.where(random.random(P) < 0.8, random.integers(0, H * (W + 2), P), end))
    cell = cell.astype(jnp.int32)
    sizes = [jnp.asarray(random.integers(-2, 3, P) / 4.0) for _ in range(4)]
    counters = jnp.asarray(random.integers(0, 9, P), jnp.int32)
    steps, order = by_pixel.Steps(cell, *sizes, counters), jax.jit(in_order)(cell)
    given = steps, order, jnp.array(2.0), width, end
    for one, other in zip(*both_ways(by_pixel.by_pixel, given), strict=True):
        np.testing.assert_array_equal(one, other)

    totals = eqx.filter_jit(by_pixel.by_pixel)(*given)
    some = lambda share: jnp.asarray(random.random(P) < share)
    seen = runs.Seen(totals.cell, some(0.9), some(0.8), jnp.asarray(random.random(P)), some(0.5))
    target, weight = random.random((2, H, W))
    data, levels = pyramid(target, weight, np.float64, only_finest=True)
    given = *jax.tree.map(jnp.asarray, (data, levels[-1])), seen, jnp.array(True)
    for one, other in zip(*map(jax.tree.leaves, both_ways(runs.summed, given)), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-13)


def test_pieces_are_cut_and_pixels_swept_in_turn_as_side_by_side():
    """Random polygons, with sides that are level, upright or on pixels' sides, or of no weight."""
    random, K, P, W, H = np.random.default_rng(3), 60, 400, 5, 4
    corners = random.uniform(-1, 6, (12, 5, 2))
    corners[:3] = np.round(corners[:3])
    corners[3:6, 1, 0], corners[6:9, 1, 1] = corners[3:6, 0, 0], corners[6:9, 0, 1]
    a, b = (x.reshape(K, 2) for x in (corners, np.roll(corners, -1, axis=1)))
    weight = np.repeat(random.choice([0.0, 1.0, 2.0], 12, p=[0.1, 0.5, 0.4]), 5)
    size = jnp.int32(W), jnp.int32(H)
    given = Segments(*map(jnp.asarray, (a, b, weight))), jnp.int32(K), P, *size
    (one, number), (other, same) = both_ways(cutting.cut, given)
    there = np.asarray(one.steps.cell) < H * (W + 2)
    assert there.sum() == int(number) == int(same)
    for x, y in zip(*map(jax.tree.leaves, (one, other)), strict=True):
        np.testing.assert_allclose(x[there], y[there], atol=1e-12)

    order, width, end = jax.jit(in_order)(one.steps.cell), size[0] + 2, size[1] * (size[0] + 2)
    totals = eqx.filter_jit(by_pixel.by_pixel)(one.steps, order, jnp.array(0.0), width, end)
    column, row = totals.cell % width - 1, totals.cell // width
    chosen = (totals.cell < end) & (column >= 0) & (column < W)
    chosen &= totals.number <= overlapping.MOST
    assert np.sum(chosen) > 10
    assert np.max(totals.number) >= 10
    origin = jnp.stack([column, row], axis=-1).astype(float)
    pixels = overlapping.Overlapping(chosen, totals.first, totals.number, origin, totals.corner)
    visible = overlapping.whole(jnp.stack(one.ends, axis=-1), one.steps.jump)
    part = overlapping.Part(visible, jnp.zeros((P, 2, 3)))
    given = pixels, one.swept, order, [part]
    (areas, (seen,)), (others, (also,)) = both_ways(overlapping.resolved, given)
    np.testing.assert_allclose(areas[chosen], others[chosen], atol=1e-12)
    assert np.ptp(np.asarray(areas)[chosen]) > 0.9
    of_chosen = np.asarray(chosen)[np.minimum(totals.slot, P - 1)] & there
    np.testing.assert_allclose(seen[of_chosen], also[of_chosen], atol=1e-12)
    hidden = np.asarray(seen)[of_chosen, overlapping.LENGTH] == 0
    assert 0.05 < np.mean(hidden) < 0.95


def both_ways(function, given):
    """Return what a function makes of what it is given on a CPU, and elsewhere."""
    # (A program of each call: step by step they are a hundred.)
    made = lambda: eqx.filter_jit(lambda given: function(*given))(given)
    on_cpu = made()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax.lax, "platform_dependent", lambda *given, cpu, default: default(*given))
        return on_cpu, made()
