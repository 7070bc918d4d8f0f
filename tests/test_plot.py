import re
from xml.etree import ElementTree

import numpy as np
import pytest
import shapely
import trimesh
from chosen import long
from numpy.testing import assert_allclose
from oracles import (
    CORNERS,
    QUAD,
    balls,
    body,
    camera_ahead,
    central_difference,
    drawn,
    lump,
    normal,
    scene_polygons,
    usual_camera,
)
from refusals import refusal
from results import fit_at

import pinhole_jax as pj
from pinhole_jax import plot
from pinhole_jax._silhouette.visible import STEP_PX

CAMERA = usual_camera()


BODIES = {
    "bumpy": lump(3),
    "torus": body(trimesh.creation.torus(1.0, 0.4)),
    "box": body(trimesh.creation.box()),
    "ball": balls([[0.1, 0.2, 0]], [1.0]),
    "spheres": balls([[0.0, 0, 0], [0.6, 0.2, 0.3]], [0.5, 0.4]),
}


@pytest.mark.parametrize("name", ["bumpy", "torus", "box", long("spheres")])
def test_outline_is_that_of_the_union(name):
    boundary = shapely.union_all(scene_polygons(CAMERA, BODIES[name])).boundary
    lines = shapely.linestrings(plot.outline(CAMERA, BODIES[name]))
    assert_allclose(np.sum(shapely.length(lines)), boundary.length, rtol=0.02)
    assert np.max(shapely.distance(lines, boundary)) < 0.1
    assert np.max(shapely.length(lines)) <= STEP_PX + 1e-9


@pytest.mark.long
@pytest.mark.parametrize("name", ["bumpy", "ball"])
def test_outline_under_distortion_passes_through_contour_points(name):
    lens, scene = pj.Lens([46.0, 41.0], 1.02), BODIES[name]
    distortion = pj.BrownConrady(-0.3, 0.1, 2e-3, 1e-3, 0.02)
    bent = CAMERA.replace(lens=pj.Lens([46.0, 41.0], 1.02, distortion))
    outline, plain = (plot.outline(view, scene) for view in (bent, CAMERA.replace(lens=lens)))
    seen = np.asarray(pj.project(bent, pj.contour_points(bent, scene)))
    middles = lambda lines: shapely.points(lines.mean(axis=1))
    off = shapely.distance(middles(outline), shapely.multipoints(seen))
    assert np.max(off) < STEP_PX / 2 + 0.05  # between two of the points
    moved = shapely.distance(middles(plain), shapely.multilinestrings(outline))
    assert 0.3 < np.max(moved) < 3


@pytest.mark.long
@pytest.mark.parametrize("shape", [(80, 96), (80, 96, 3), (80, 96, 4)])
def test_overlay_draws_on_the_outline_and_nowhere_else(shape):
    scene, image = BODIES["bumpy"], np.full(shape, 200, np.uint8)
    drawn = plot.overlay(image, CAMERA, scene)
    factor = drawn.shape[0] // 80
    assert drawn.shape == (80 * factor, 96 * factor, 3)
    assert max(drawn.shape) >= 800
    changed = np.any(drawn != 200, axis=2)
    union = shapely.union_all(scene_polygons(CAMERA, scene))
    rows, columns = np.nonzero(changed)
    points = shapely.points((columns + 0.5) / factor, 80 - (rows + 0.5) / factor)
    assert np.max(shapely.distance(points, union.boundary)) < 4 / factor
    assert changed.sum() > 3 * factor * union.boundary.length * 0.5


# A square in the plane z = 0, seen from straight ahead at distance 5: f = 80 / (2 tan 0.3) px.
SQUARE = body(CORNERS, QUAD)
AHEAD = camera_ahead()
FOCAL = 40 / np.tan(0.3)


@pytest.mark.long
@pytest.mark.parametrize(
    "name, std, across_sides, across_foot",
    [
        ("e_x", 0.01, FOCAL * 0.01 / 5, 0.0),
        ("e_z", 0.01, FOCAL * 0.01 / 25, FOCAL * 0.01 / 25),
        ("rotation_b1", 1e-3, None, FOCAL * (1 + 1 / 25) * 1e-3),
        ("phi", 1e-3, FOCAL / 5 * 1e-3 / np.sin(0.6), FOCAL / 5 * 1e-3 / np.sin(0.6)),
        ("d", 1e-3, FOCAL / 5 * 1e-3, FOCAL / 5 * 1e-3),
        ("e_x", np.inf, 0.0, 0.0),
    ],
)
def test_outline_sigma_is_measured_across_the_outline(name, std, across_sides, across_foot):
    segments = plot.outline(AHEAD, SQUARE)
    sigma = plot.outline_sigma(fit_at(AHEAD, [std], (name,)), SQUARE)
    upright = np.abs(np.diff(segments[..., 1], axis=1)[:, 0]) > 1e-6
    assert 0 < upright.sum() < len(upright) == len(sigma)
    if across_sides is not None:
        assert_allclose(sigma[upright], across_sides, rtol=0.01, atol=1e-12)
    assert_allclose(sigma[~upright], across_foot, rtol=0.01, atol=1e-12)


def test_band_is_drawn_and_a_window_shows_a_part():
    image = np.zeros((80, 96, 3), np.uint8)
    n = len(plot.outline(AHEAD, SQUARE))
    drawn = plot.overlay(image, AHEAD, SQUARE, band_px=np.full(n, 4.0))
    yellow = (drawn[..., 0] > 30) & (drawn[..., 2] < 60)
    border = (drawn[..., 0] > 200) & (drawn[..., 2] < 60)
    assert 0.02 < np.sum(border) / np.sum(yellow) < 0.2  # the picture is seen through the rest
    factor = drawn.shape[0] // 80
    side = 2 * FOCAL / 5
    assert np.sum(yellow) / factor**2 == pytest.approx(4 * side * 8, rel=0.2)
    left, top, right, bottom = window = plot.object_window(AHEAD, SQUARE)
    assert 0 <= left < 48 - side / 2 < 48 + side / 2 < right <= 96
    assert (right - left) < 1.4 * side
    part = plot.overlay(image, AHEAD, SQUARE, window=window)
    lit = np.any(part > 100, axis=2)
    assert part.shape[:2] == ((bottom - top) * lit.shape[1] // (right - left), lit.shape[1])
    assert np.mean(lit) > 0.005


@pytest.mark.long
def test_error_map_colours_extra_and_missing_pixels():
    mask = np.zeros((80, 96), bool)
    mask[20:60, 40:90] = True  # too far right
    drawn = plot.error_map(AHEAD, SQUARE, mask).astype(int)
    f = drawn.shape[0] // 80
    assert tuple(drawn[40 * f, 32 * f]) == plot.MORE
    assert tuple(drawn[40 * f, 85 * f]) == plot.LESS
    assert tuple(drawn[40 * f, 48 * f]) == (210, 210, 210)
    assert tuple(drawn[2, 2]) == (255, 255, 255)
    with refusal("`target`: expected the camera's size"):
        plot.error_map(AHEAD, SQUARE, mask[:9])


def way_to(camera):
    """Return a history that ends at the camera: eyes 1, 0.3 and 0.1 to the right of it before."""
    at = lambda x: AHEAD.replace(e=[x, 0.0, 5], p=[x, 0, 0])
    way = ((at(1), 24, 20, 0), (at(0.3), 48, 40, 3), (at(0.1), 48, 40, 4), (camera, 96, 80, 3))
    return tuple(pj.Progress(*stop) for stop in way)


def test_convergence_in_px_by_steps_and_levels():
    fit = fit_at(AHEAD, [0.01], ("e_x",), history=way_to(AHEAD))
    off = np.array([1, 0.3, 0.1, 0]) * FOCAL / 5
    assert_allclose(plot.off_px(fit, SQUARE), off, atol=1e-9)
    assert [(last - first, last) for _, first, last in plot.levels(fit)] == [(2, 2), (1, 3)]
    svg = plot.convergence(fit, SQUARE)
    tree = ElementTree.fromstring(svg)
    found = lambda tag: tree.findall(f"{{http://www.w3.org/2000/svg}}{tag}")
    x, y = np.array([p.split(",") for p in found("polyline")[0].get("points").split()], float).T
    assert np.all(np.diff(y) > 0)
    assert_allclose(np.diff(x) / np.ptp(x), [0.3, 0.4, 0.3], atol=1e-3)
    bands = [rect[0].text for rect in found("rect")]
    assert bands == ["48 x 40 pixels: 7 steps", "96 x 80 pixels: 3 steps"]
    assert svg.count("<circle") == 4
    assert svg._repr_svg_() == svg


def test_frustum_is_bent_by_the_lens():
    ball = balls([[0.0, 0, 0]], [0.1])
    plain, straight, bent = (
        plot.scene_view(
            CAMERA.replace(phi=1.2, lens=pj.Lens([48.0, 40.0], 1.0, model)), ball, 200
        ).astype(int)
        for model in (None, pj.BrownConrady(0.0), pj.BrownConrady(-0.08))
    )
    assert np.max(np.abs(straight - plain)) <= 2
    assert np.any(np.abs(bent - plain) > 60, axis=2).sum() > 100


@pytest.mark.parametrize("name", ["bumpy", "ball"])
def test_scene_view_shows_object_and_camera(name):
    view = plot.scene_view(CAMERA, BODIES[name], 200)
    assert view.shape == (150, 200, 3)
    r, g, b = np.moveaxis(view.astype(int), -1, 0)
    camera, thing = (np.nonzero(x)[1] for x in ((b > r + 60) & (b > g), (r > b + 20) & (r > g)))
    assert (len(camera) > 200) & (len(thing) > 100)
    assert camera.min() < thing.min()  # it looks from the left


# --- where mask and camera differ -----------------------------------------------------------------


def square_mask():
    """SQUARE's hard mask as AHEAD sees it."""
    return drawn(AHEAD, SQUARE) > 0.5


def column_in(words):
    return int(re.search(r"\(near column (\d+)", words)[1])


def test_perfect_mask_gets_no_remark():
    assert plot.disagreement(AHEAD, SQUARE, square_mask()) == ()
    assert plot.disagreement(AHEAD, SQUARE, np.zeros((80, 96), bool)) == ()


def test_cut_mask_is_located():
    mask = square_mask()
    first = np.flatnonzero(mask.any(axis=0))[0]
    mask[:, : first + 10] = False
    lost, added = plot.disagreement(AHEAD, SQUARE, mask)
    assert "of the model's outline (near column" in lost
    assert "is the mask cut off or covered there" in lost
    assert abs(column_in(lost) - first) < 10
    assert "of the mask's edge (near column" in added
    assert abs(column_in(added) - first - 10) <= 1


def test_object_cut_by_the_film_is_not_blamed_on_the_mask():
    camera = AHEAD.replace(p=[AHEAD.p[0] + 1.2, *AHEAD.p[1:]])
    mask = drawn(camera, SQUARE) > 0.5
    (words,) = plot.disagreement(camera, SQUARE, mask)
    assert words.startswith("the picture's border cuts off ")


@pytest.mark.parametrize("extra", [True, False])
def test_extra_and_missing_parts_are_told_apart(extra):
    mask = square_mask()
    rows, columns = np.nonzero(mask)
    middle, last = round(np.mean(rows)), columns.max()
    begin = last if extra else last - 12
    mask[middle - 8 : middle + 8, begin : begin + 13] = extra
    _, added = plot.disagreement(AHEAD, SQUARE, mask)
    assert (column_in(added) > last) == extra


# --- where a camera's error shows -----------------------------------------------------------------


LUMP = lump(2)


def test_errors_together_equal_those_of_differences():
    """Of points at the object's mean depth on the film, and of its vertices before the camera."""
    mix = 1e-3 * normal((7, 7))
    fit, vertices = fit_at(AHEAD, mix @ mix.T), np.asarray(LUMP.mesh.vertices)
    trust = plot.trust(fit, LUMP)
    way = np.asarray(pj.rays_through(AHEAD, trust.places).direction)
    plane = [0, 0, 5] + way * ((vertices[:, 2].mean() - 5) / way[:, 2:])

    def before(camera):
        return (vertices - np.asarray(camera.e)) @ np.stack(pj.camera_basis(camera)).T

    def worst(value):
        slopes = central_difference(lambda step: value(fit.displaced(step)), np.zeros(7))
        return np.linalg.norm(slopes @ mix, ord=2, axis=(1, 2))

    assert_allclose(trust.film, worst(lambda camera: pj.project(camera, plane)), rtol=1e-4)
    spread = worst(before)
    assert trust.object == pytest.approx(spread.max(), rel=1e-4)
    assert_allclose(trust.point, vertices[spread.argmax()])


def test_picture_names_its_bands_and_stays_with_what_is_determined():
    trust = plot.trust(fit_at(AHEAD, [np.inf, 1e-3], ("rotation_b1", "rotation_v")), LUMP)
    assert np.all(np.isfinite(trust.film))
    bands = [float(x) for x in re.findall(r">&lt; ([\d.e-]+) px</text>", trust._repr_svg_())]
    assert bands == sorted(bands)
    assert bands[-1] >= trust.film.max()
    assert "units of the mesh" in str(trust)
    nothing = plot.trust(fit_at(AHEAD, [np.inf], ("rotation_b1",)), LUMP)
    assert nothing.object == 0
