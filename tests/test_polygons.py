"""Faces of many corners: the triangles cover what shapely says that the polygon covers."""

import time

import numpy as np
import pytest
import shapely
import trimesh
from numpy.random import default_rng
from numpy.testing import assert_array_equal
from refusals import refusal
from scipy.spatial.transform import Rotation

from pinhole_jax._mesh_files import Polygons, triangulate


def blob(n, seed=0, spread=0.5):
    """Return the corners of a star-shaped polygon that its first corner does not see whole."""
    angle = 2 * np.pi * np.arange(n) / n
    radius = 1 + spread * default_rng(seed).uniform(-1, 1, n)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def comb(teeth):
    x = np.arange(2 * teeth) / (2 * teeth)
    top = np.stack([x, np.where(np.arange(2 * teeth) % 2, 1, 0.1)], axis=-1)
    return np.concatenate([[[1, 0], [1, 0.5]], top[::-1], [[0, 0]]])


def in_space(corners, place=((1, 0, 0), (0, 1, 0), (0, 0, 1))):
    """Return corners (n, 2) as points in space, turned."""
    return np.pad(np.asarray(corners, float), ((0, 0), (0, 1))) @ np.transpose(place)


def cut(space):
    """Return the triangles of one polygon."""
    return triangulate(Polygons(space, np.arange(len(space)), np.array([len(space)])))


def corners_of(text):
    """Return corners (n, 2) in shapely's text (WKT)."""
    return shapely.get_coordinates(shapely.from_wkt(f"LINESTRING ({text})"))


#: Polygons, some of them of curves.
SHAPES = {
    name: corners_of(text)
    for name, text in {
        "chevron": "0 0, 1 0.8, 2 0, 1 2",
        "L": "0 0, 2 0, 2 1, 1 1, 1 2, 0 2",
        "arrow": "0 1, 2 1, 2 0, 4 1.5, 2 3, 2 2, 0 2",
        "square": "0 0, 1 0, 1 1, 0 1",
        "corners in line": "0 0, 1 0, 2 0, 2 1, 1 1, 1 1.5, 1 2, 0 2, 0 1",
        "all but one in line": "0 0, 1 0, 2 0, 3 0, 1.5 1",
        "corners twice": "0 0, 0 0, 2 0, 1 0.5, 1 0.5, 1 0.5, 0 2, 0 0",
        "a spike": "0 0, 1 0, 3 0, 1 0, 1 1, 0.6 0.2",
        # A square with a square hole, joined by a bridge that is walked twice.
        "bridge": "0 0, 3 0, 3 3, 0 3, 0 0, 1 1, 1 2, 2 2, 2 1, 1 1",
        "a corner on a side": "0 0, 2 0, 2 2, 1 0, 0 2",
    }.items()
} | {
    "star": np.array(
        [[(1 + k % 2) * f(k * np.pi / 5) for f in (np.cos, np.sin)] for k in range(10)]
    ),
    "comb": comb(20),
    "blob": blob(57),
    "circle": blob(100, spread=0),
}


def covered(corners):
    """Return the area that a polygon covers, self-touching ones too (shapely, float64)."""
    return shapely.area(shapely.make_valid(shapely.Polygon(corners)))


def check(corners, space, triangles, closed=True):
    """Assert that triangles cover a polygon once, run its way, and meet its sides and each other.

    `corners` (n, 2) is the polygon and `space` its place in space (n, 3), a similar image.
    """
    flat = np.asarray(corners, float)
    assert len(triangles) <= len(flat) - 2
    whole = shapely.unary_union(shapely.polygons(flat[triangles]))
    assert shapely.area(whole) == pytest.approx(covered(flat), rel=1e-9)
    way = 1 if shapely.LinearRing(flat).is_ccw else -1
    areas = way / 2 * np.linalg.det(np.diff(flat[triangles], axis=1))
    assert np.sum(areas) == pytest.approx(covered(flat), rel=1e-9)
    assert np.min(areas) > -1e-9 * np.ptp(flat) ** 2
    if closed:
        # Sides and triangles' edges cancel: no crack beside a corner that lies in line.
        place = np.unique(space, axis=0, return_inverse=True)[1].reshape(-1)
        runs = np.zeros((len(flat), len(flat)), int)
        np.add.at(runs, (place[triangles], place[np.roll(triangles, -1, axis=1)]), 1)
        np.add.at(runs, (place, np.roll(place, -1)), -1)
        assert_array_equal(runs, runs.T)


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("turned", [0, 1, 3])
@pytest.mark.parametrize("way", [1, -1])
def test_face_covers_its_polygon(name, turned, way):
    corners = np.roll(SHAPES[name], turned, axis=0)[::way]
    for place in (np.eye(3), *Rotation.random(3, turned).as_matrix()):
        space = in_space(corners, place)
        for scale, offset in ((1, 0), (1e-6, 0), (1e-6, 1.0), (1e6, 0), (1e-30, 0), (1, 1e5)):
            check(corners, space, cut(scale * space + offset), closed=offset == 0)


def test_random_simple_polygons():
    random = default_rng(0)
    for seed in range(200):
        corners = blob(random.integers(4, 40), seed, random.uniform(0.1, 0.99))
        space = in_space(corners, Rotation.random(None, seed).as_matrix())
        check(corners, space, cut(space))


def test_faces_are_cut_one_after_the_other():
    names = [*SHAPES] * 3
    faces = [in_space(SHAPES[name]) for name in names] + [np.zeros((2, 3)), np.zeros((0, 3))]
    points, counts = np.concatenate(faces), np.array([*map(len, faces)])
    order = default_rng(0).permutation(len(points))  # a face's corners lie anywhere
    found = order[triangulate(Polygons(points[order], np.argsort(order), counts))]
    own = [cut(x) + first for x, first in zip(faces, np.cumsum(counts) - counts, strict=True)]
    assert_array_equal(found, np.concatenate(own))


def test_quads_that_are_not_flat_are_cut_so_that_both_halves_face_their_way():
    random = default_rng(0)
    for _ in range(200):
        space = in_space(np.roll(SHAPES["chevron"], random.integers(4), axis=0))
        space[:, 2] = random.uniform(-0.2, 0.2, 4)
        space = space @ Rotation.random(None, random).as_matrix().T
        newell = np.cross(space[2] - space[0], space[3] - space[1])
        assert np.all(trimesh.triangles.cross(space[cut(space)]) @ newell > 0)


@pytest.mark.parametrize(
    "text",
    [
        "0 0, 1 1, 1 0, 0 1",  # lobes of one size: no normal
        "0 0, 2 1, 2 0, 0 2",
        "0 0, 3 0, 3 2, 1 -1, 0 2",
    ],
)
def test_sides_that_cross_are_refused(text):
    space = in_space(corners_of(text))
    with refusal("face 2: its sides cross"):
        triangulate(Polygons(space, np.r_[:3, : len(space)], np.array([3, len(space)])))


def test_two_million_corners_are_cut_in_seconds_or_refused():
    n = 2_000_000
    start = time.process_time()
    space = in_space(blob(n, spread=0))
    doubled = trimesh.triangles.cross(space[cut(space)])[:, 2]
    assert np.sum(doubled) / 2 == pytest.approx(np.pi)
    with refusal(r"face 1: 2000000 corners, not all seen"):
        cut(in_space(blob(n)))
    assert time.process_time() - start < 60
    assert len(cut(in_space(blob(20_000)))) == 19_998
