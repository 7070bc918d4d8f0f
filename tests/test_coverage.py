import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from oracles import area_per_pixel

from pinhole_jax._silhouette.conics import arc_end, frame_of
from pinhole_jax._silhouette.contour import Contour
from pinhole_jax._silhouette.pieces import fold_pieces
from pinhole_jax._silhouette.pixels import drawn
from pinhole_jax._silhouette.spheres import shown_arcs

W, H = 7, 5


def contour(tail, head, frames=None) -> Contour:
    """Curves that are all seen; the last ones are arcs of frames, six to each."""
    upto = jnp.arange(1, len(tail) + 1, dtype=jnp.int32)
    return Contour(tail, head, jnp.ones(len(tail)), upto, None, None, frames, None, None)


@jax.jit
def image_of(curves):
    return drawn(curves, (W, H), jnp.int32(0), False).coverage


def rasterise(curves) -> np.ndarray:
    """Layers, clamped: (H, W), row 0 on top."""
    return np.asarray(image_of(curves)).reshape(H, W)[::-1]


def polygon(points) -> Contour:
    points = jnp.asarray(points, float)
    return contour(points, jnp.roll(points, -1, axis=0))


POLYGONS = {
    "within one pixel": [(2.2, 1.3), (2.8, 1.4), (2.5, 1.9)],
    "general": [(0.3, 0.2), (6.1, 1.7), (4.2, 4.9), (1.1, 3.3)],
    "on the grid": [(1, 1), (4, 1), (4, 3), (1, 3)],
    "diagonal through corners": [(1, 1), (4, 4), (1, 4)],
    "leaves left": [(-3.5, 1.2), (3.3, 0.4), (2.2, 4.4)],
    "leaves right": [(4.4, 1.2), (15.3, 2.4), (5.2, 4.4)],
    "leaves bottom": [(1.4, 2.2), (3.3, -7.4), (5.2, 3.4)],
    "leaves top": [(1.4, 2.2), (5.3, 2.4), (3.2, 13.4)],
    "holds the frame": [(-9, -9), (19, -8), (18, 21), (-7, 16)],
    "cuts the frame's corner": [(-4, 2), (2, -4), (-4, -4)],
    "left of the frame": [(-4, 1), (-1, 2), (-3, 4)],
    "right of the frame": [(8, 1), (9, 2), (8.5, 4)],
    "above the frame": [(1, 6), (3, 7), (2, 9)],
    "huge": [(-1e6, -3e5), (2e6, 1.1), (-1e6, 4e5)],
    "thin": [(0.5, 2.5), (6.5, 2.5 + 1e-9), (0.5, 2.5 + 2e-9)],
}


@pytest.mark.parametrize("name", POLYGONS)
def test_polygons_have_their_exact_area_in_each_pixel(name):
    points = POLYGONS[name]
    expected = area_per_pixel(shapely.Polygon(points), W, H)
    np.testing.assert_allclose(
        rasterise(polygon(points)), expected, atol=1e-9 if name == "huge" else 1e-13
    )


def test_hole_is_a_contour_that_runs_backwards():
    outer, inner = [(0.5, 0.5), (6.5, 0.5), (6.5, 4.5), (0.5, 4.5)], [(2, 1), (3, 4), (5, 2)]
    ends = zip(polygon(outer)[:2], polygon(inner)[:2], strict=True)
    both = contour(*(jnp.concatenate(x) for x in ends))
    expected = area_per_pixel(shapely.Polygon(outer, [inner]), W, H)
    np.testing.assert_allclose(rasterise(both), expected, atol=1e-13)


ELLIPSES = {
    "circle": ((3.3, 2.4), (1.7, 0.0, 1.7)),
    "sheared": ((3.1, 2.6), (2.4, 1.3, 0.8)),
    "sheared the other way": ((3.1, 2.6), (2.0, -1.5, 0.3)),
    "within one pixel": ((3.5, 2.5), (0.2, 0.1, 0.15)),
    "touches grid lines": ((3.0, 2.0), (2.0, 0.0, 1.0)),
    "leaves the frame": ((0.3, 4.6), (2.4, 0.3, 1.8)),
    "holds the frame": ((3, 2), (30, 5, 40)),
    "outside": ((-5, 2), (1, 0.5, 1)),
}


@pytest.mark.parametrize("name", ELLIPSES)
def test_ellipses_have_their_exact_area_in_each_pixel(name):
    centre, (l11, l21, l22) = ELLIPSES[name]
    frame = jnp.array([[*centre, 1], [l11, l21, 0], [0, l22, 0]], float)[None]
    start, end, weight = shown_arcs(frame, jnp.ones(1, bool))
    frames = frame_of(jnp.tile(frame, (6, 1, 1)))
    tail, head = (jnp.stack(arc_end(frames, *x), -1) for x in ((start, 1), (end, -1)))
    arcs = contour(tail, head, frame)._replace(weight=weight)
    n = 200_000
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    points = np.array([[l11, 0], [l21, l22]]) @ [np.cos(angle), np.sin(angle)]
    expected = area_per_pixel(shapely.Polygon(points.T + centre), W, H)
    # The oracle is a polygon within the ellipse: its sagitta bounds the difference.
    sagitta = max(l11, abs(l21) + l22) * (np.pi / n) ** 2
    np.testing.assert_allclose(rasterise(arcs), expected, atol=1e-12 + 2 * sagitta)


def test_curve_enters_a_row_once_next_to_a_pixel_corner():
    """In float32 rounding puts more of its pieces on the row's bottom than the first."""
    size, random = 1024, np.random.default_rng(0)
    corner = random.integers(100, size - 100, (512, 2)) - [1, 0] * random.choice(
        [0, 1e-4, 6e-5, 3e-5], (512, 1)
    )
    way = random.uniform(-1, 1, (512, 2)) * [1, 0.3]
    below, above = random.uniform(1, 40, (2, 512, 1))
    a, b = (jnp.asarray(x, jnp.float32) for x in (corner - below * way, corner + above * way))
    ids, room = jnp.arange(512, dtype=jnp.int32), 1 << 15

    @jax.jit
    def found(curves):
        m = curves.monotone(ids)

        def add(state, own, pieces):
            used, table = state
            slot = used + jnp.arange(len(pieces.row), dtype=jnp.int32)
            put = lambda x, new: x.at[slot].set(new, mode="drop")
            return used + len(slot), put(table, jnp.stack(some(pieces), axis=1))

        some = lambda p: (p.curve, p.row, *(x.astype(jnp.int32) for x in (p.bottom, p.valid)))
        start = jnp.int32(0), jnp.zeros((room, 4), jnp.int32)
        return m, fold_pieces(ids, m, (size, size), add, start)[1]

    m, table = jax.tree.map(
        np.asarray, found(contour(a, b)._replace(weight=jnp.ones(512, a.dtype)))
    )
    curve, row, bottom, valid = table.T
    assert not valid[-1]
    total = np.zeros((512, size))
    np.add.at(total, (curve, row), bottom * valid)
    rows = np.arange(size)
    crossed = (m.low[:, 1:] <= rows) & (rows < m.high[:, 1:])
    np.testing.assert_array_equal(total, crossed)
