import numpy as np
import pytest
import shapely
import trimesh
from oracles import mesh_polygons, sphere_union

import pinhole_jax as pj
from pinhole_jax import plot, shapes
from pinhole_jax._outline import STEP_PX

CAMERA = pj.Camera([0.3, 1.0, 5.0], [0.1, 0, 0], [0.2, 1, 0.1], 0.6, 1.0, 96, 80)


@pytest.mark.parametrize("name", ["bumpy", "torus", "box"])
def test_the_outline_is_that_of_the_polygon_union(name):
    if name == "bumpy":
        mesh = shapes.bumpy(3)
    else:
        made = trimesh.creation.torus(1.0, 0.4) if name == "torus" else trimesh.creation.box()
        mesh = pj.Mesh(made.vertices, made.faces)
    union = shapely.union_all(mesh_polygons(CAMERA, mesh.vertices, mesh.faces))
    outline = plot.outline(CAMERA, pj.Scene(mesh=mesh))
    lines = shapely.linestrings(outline)
    np.testing.assert_allclose(np.sum(shapely.length(lines)), union.boundary.length, rtol=0.02)
    assert np.max(shapely.distance(lines, union.boundary)) < 0.1
    np.testing.assert_array_equal(np.max(shapely.length(lines)) <= STEP_PX + 1e-9, True)


def test_the_outline_of_spheres():
    spheres = pj.Spheres([[0.0, 0, 0], [0.6, 0.2, 0.3]], [0.5, 0.4])
    union = sphere_union(CAMERA, spheres.centers, spheres.radii)
    lines = shapely.linestrings(plot.outline(CAMERA, pj.Scene(spheres=spheres)))
    np.testing.assert_allclose(np.sum(shapely.length(lines)), union.boundary.length, rtol=0.02)
    assert np.max(shapely.distance(lines, union.boundary)) < 0.1


@pytest.mark.parametrize("shape", [(80, 96), (80, 96, 3), (80, 96, 4)])
def test_the_overlay_draws_on_the_outline_and_nowhere_else(shape):
    scene = pj.Scene(mesh=shapes.bumpy(2))
    image = np.full(shape, 200, np.uint8)
    drawn = plot.overlay(image, CAMERA, scene)
    factor = drawn.shape[0] // 80
    assert drawn.shape == (80 * factor, 96 * factor, 3)
    assert max(drawn.shape) >= 800
    changed = np.any(drawn != 200, axis=2)
    union = shapely.union_all(mesh_polygons(CAMERA, scene.mesh.vertices, scene.mesh.faces))
    rows, columns = np.nonzero(changed)
    points = shapely.points((columns + 0.5) / factor, 80 - (rows + 0.5) / factor)
    assert np.max(shapely.distance(points, union.boundary)) < 4 / factor
    assert changed.sum() > 3 * factor * union.boundary.length * 0.5


def test_an_image_of_another_size_is_refused_in_words():
    with pytest.raises(ValueError, match=r"`image`: expected the camera's size .* got \(9, 9\)"):
        plot.overlay(np.zeros((9, 9), np.uint8), CAMERA, pj.Scene(mesh=shapes.bumpy(1)))
