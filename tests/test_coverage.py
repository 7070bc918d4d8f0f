import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from oracles import area_per_pixel

from pinhole_jax._silhouette.coverage import monotone, piece_counts, split
from pinhole_jax._silhouette.curves import Arcs, Segments
from pinhole_jax._silhouette.marks import winding_jumps
from pinhole_jax._silhouette.spheres import _monotone_stretches

W, H = 7, 5


@jax.jit
def pieces_of(curves):
    m = monotone(curves)
    upto = jnp.cumsum(piece_counts(m, W, H))
    return split(m, upto, jnp.arange(128, dtype=jnp.int32), W, H, H)


def rasterise(curves) -> np.ndarray:
    """Sum the pieces as the library does, in plain numpy: (H, W), row 0 on top."""
    pieces = pieces_of(curves)
    image = np.zeros((H, W))
    for row, column, height, area, valid in zip(
        *(
            np.asarray(x)
            for x in (pieces.row, pieces.column, pieces.height, pieces.area, pieces.valid)
        ),
        strict=True,
    ):
        if valid:
            assert 0 <= row < H
            if 0 <= column < W:
                image[row, column] += area
            image[row, max(column + 1, 0) :] += height
    return image[::-1]


def polygon(points) -> Segments:
    points = jnp.asarray(points, float)
    return Segments(points, jnp.roll(points, -1, axis=0), jnp.ones(points.shape[0]))


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
    both = Segments(*(jnp.concatenate(x) for x in zip(polygon(outer), polygon(inner), strict=True)))
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
    start, end = (w[:, 0] for w in jax.jit(_monotone_stretches)(frame))
    arcs = Arcs(jnp.tile(frame, (6, 1, 1)), start, end, jnp.ones(6))
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

    @jax.jit
    def found(curves):
        m = monotone(curves)
        upto = jnp.cumsum(piece_counts(m, size, size))
        slots = jnp.arange(1 << 16, dtype=jnp.int32)
        pieces = split(m, upto, slots, size, size, size)
        return m, pieces, winding_jumps(pieces)

    m, pieces, turned = jax.tree.map(np.asarray, found(Segments(a, b, jnp.ones(512, jnp.float32))))
    assert not pieces.valid[-1]
    total = np.zeros((512, size))
    np.add.at(total, (pieces.curve[pieces.valid], pieces.row[pieces.valid]), turned[pieces.valid])
    row = np.arange(size)
    crossed = (m.low[:, 1:] <= row) & (row < m.high[:, 1:])
    np.testing.assert_array_equal(total, np.where(crossed, -m.rising[:, None], 0))
    # The case is there: pieces that are not the first begin on the bottom, too.
    assert np.any(pieces.valid & pieces.passes & ~pieces.first & (pieces.start[:, 1] == pieces.row))


def test_pieces_in_a_band_of_rows_match_the_whole_film():
    """To the last bit: winding numbers of the whole film are used with the pieces of a band."""
    random = np.random.default_rng(3)
    curves = Segments(
        *(jnp.asarray(random.uniform(-1, 9, (40, 2))) for _ in range(2)), jnp.ones(40)
    )
    bottom, top = 1, 4

    @jax.jit
    def pieces(low, high):
        m = monotone(curves)
        upto = jnp.cumsum(piece_counts(m, W, high, low))
        return split(m, upto, jnp.arange(512, dtype=jnp.int32), W, high, H, low)

    def rows(pieces, keep):
        fields = [np.asarray(x) for x in pieces]
        keep = keep & np.asarray(pieces.valid)
        order = np.lexsort((fields[2][keep], fields[1][keep], fields[0][keep]))
        return [x[keep][order] for x in fields]

    whole, band = pieces(0, H), pieces(bottom, top)
    row = np.asarray(whole.row)
    inside = rows(whole, (row >= bottom) & (row < top))
    assert len(inside[0]) > 50
    for a, b in zip(inside, rows(band, True), strict=True):
        np.testing.assert_array_equal(a, b)
