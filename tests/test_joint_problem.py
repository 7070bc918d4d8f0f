"""The rows of a joint fit, their elimination, and arguments that are refused."""

import numpy as np
import pytest
import trimesh
from arm import BAR, TRUTH, posture, views as arm_views
from numpy.testing import assert_allclose
from oracles import drawn
from refusals import refusal, refuses

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._camera.poses import exponential
from pinhole_jax._joint.agreement import Sandwich
from pinhole_jax._joint.door import MANY_VIEWS, joint_problem
from pinhole_jax._solver.least_squares import Rows, blocks_of, solve


def test_elimination_and_its_covariances_equal_the_dense_ones():
    """Two views have a camera in common, all have the last numbers; of one, something is known."""
    random, size, parts = np.random.default_rng(0), 9, []
    owner = np.array([0, 0, 1, 1, 2, 2, -1, -1, -1])
    for own, number in (([0, 1], 7), ([0, 1], 4), ([2, 3], 7), ([2], 1), ([4, 5], 7)):
        columns = np.array([6, *own, 7, 8] if number > 1 else own)
        rows, left = random.normal(size=(number, len(columns))), random.normal(size=number)
        parts.append(Rows(rows, left, columns))
    dense = [part.rows @ np.eye(size)[part.columns] for part in parts]
    matrix, left = np.concatenate(dense), np.concatenate([part.left for part in parts])
    for damping in (np.linspace(0.1, 2, size), np.zeros(size)):
        found, normal = solve(parts, owner, damping), matrix.T @ matrix + np.diag(damping**2)
        assert (found.shared.tolist(), len(found.own)) == ([6, 7, 8], 3)
        assert_allclose(normal @ found.x, -matrix.T @ left, atol=1e-11)
        for place in map(np.array, ([0, 1, 6, 7, 8], [8, 5, 4, 7, 6])):
            known = np.linalg.inv(found.triangle_by(place))
            expected = np.linalg.inv(normal)[np.ix_(place, place)]
            assert_allclose(known @ known.T, expected)
    # Gradients err as they do: each part's by a covariance of its own.
    errors = [random.normal(size=2 * [len(part.columns)]) for part in parts]
    errors = [x @ x.T for x in errors]
    ways = [np.linalg.solve(normal, np.eye(size)[:, part.columns]) for part in parts]
    expected = sum(way @ x @ way.T for way, x in zip(ways, errors, strict=True))
    known = Sandwich(found, zip((part.columns for part in parts), errors, strict=True))
    for place in map(np.array, (range(size), [0, 1, 7], [4, 2], [8])):
        assert_allclose(known.covariance(place), expected[np.ix_(place, place)])


def test_many_views_hold_little_memory(scenes):
    """Views of one scene share its arrays, and each has room for its own mask alone."""
    mask, names, least = drawn(TRUTH, scenes[0]), [*map(str, range(MANY_VIEWS))], []
    for some in (names[:2], names):
        views = [pj.JointView(scenes[0], mask, camera=name) for name in some]
        problems = [
            e.solver.problem for e in joint_problem(views, dict.fromkeys(some, TRUTH), "pose").eyes
        ]
        least.append(min(problem.pyramid.cells.size for problem in problems))
        assert len({id(problem.scene.mesh.vertices) for problem in problems}) == 1
    assert least[0] > 10 * least[1]


def test_assembly_is_the_union_of_its_parts(arm):
    scene = arm.scene_at(posture(1))
    moved = BAR.vertices @ posture(1)[1][:3, :3].T + posture(1)[1][:3, 3]
    assert np.allclose(np.asarray(scene.mesh.vertices)[-8:], moved)
    assert scene.mesh.closed
    assert scene.mesh.faces is arm.scene_at(posture(2)).mesh.faces
    with refusal(r"`poses`: expected finite numbers \(2, 4, 4\)"):
        arm.scene_at(np.eye(4))


def hinged():
    """Return the posture of one body that turns about z."""
    turned_by = lambda x: [exponential(np.array([0, 0, x[0], 0, 0, 0]))]
    return pj.Posture(pj.Assembly([shapes.bumpy(1)]), turned_by, {"hinge": "rad"})


BOTH, NOWHERE, HERE = {"camera": TRUTH, "other": TRUTH}, {"part": np.eye(4)}, np.eye(4)

BENT = TRUTH.replace(lens=pj.Lens([48, 48], distortion=pj.Fisheye()))


def joint(views=({},), cameras=TRUTH, **more):
    """Fit views of the arm, these fields of them changed."""
    changed = [view._replace(**change) for view, change in zip(arm_views(), views, strict=False)]
    return pj.fit_joint(changed, cameras, **more)


test_wrong_arguments_are_named = refuses(
    joint,
    {},
    {
        "`views`: expected at least one JointView": {"views": []},
        "`cameras`: expected left among them, got camera": {"views": [{"camera": "left"}]},
        "`cameras`: expected names that a view uses, got other": {"cameras": BOTH},
        "`objects`: expected part among them, got none": {"views": [{"object": "part"}]},
        r"`views\[0\].mount`: expected a real array of shape \(4, 4\)": {
            "views": [{"mount": np.eye(3)}]
        },
        r"`views\[0\].placed`: expected a rotation and a": {"views": [{"placed": 2 * HERE}]},
        r"`rig\['left'\]`: expected a real array": {"rig": {"left": "here"}},
        r"`views\[0\]`: `target`: expected the camera's": {"views": [{"target": np.ones((2, 3))}]},
        "`free`: expected something to fit, got none": {"free": ()},
        "`search`: expected one unknown pose": {"free": "phi", "search": True},
        r"`views\[1\]`: expected a view of something unknown": {
            "views": [{"object": "part"}, {}],
            "free": (),
            "objects": NOWHERE,
        },
        "`cameras`: expected names other than 'rig'": {
            "views": [{"camera": "rig"}, {"camera": "left"}],
            "cameras": {"rig": TRUTH, "left": TRUTH},
            "rig": {"left": HERE},
        },
        "`views`: expected names of scales that no camera has": {"views": [{"scale": "camera"}]},
        "`prior`: expected a positive scale of 'size', got -1.0": {
            "views": [{"scale": "size"}],
            "prior": {"size": {"scale": (-1, 0.1)}},
        },
        "`prior`: expected free parameters among scale, got 'x'": {
            "views": [{"scale": "size"}],
            "prior": {"size": {"x": (0, 0.1)}},
        },
        "`shared`: expected names among phi, .* got 'pose'": {"shared": "pose"},
        "`shared`: expected groups of cameras among camera, got 'left'": {
            "shared": {"phi": [("camera", "left")]}
        },
        "`shared`: expected each camera in one group of phi, got more": {
            "shared": {"phi": [("camera",), ("camera",)]}
        },
        "`bounds`: expected the same of phi for camera and other, which share it": {
            "views": [{}, {"camera": "other"}],
            "cameras": BOTH,
            "shared": "phi",
            "bounds": {"other": {"phi": (0.5, 0.7)}},
        },
        "`prior`: expected free parameters among e_x, e_y, e_z, got 'phi'": {
            "prior": {"phi": (0.6, 0.1)}
        },
        "`prior`: expected names among camera, got 'left'": {"prior": {"left": {"e_x": (0, 1)}}},
        "`prior`: expected a positive deviation of 'x', got 0.0": {
            "views": [{"object": "part"}],
            "objects": NOWHERE,
            "free": (),
            "prior": {"part": {"x": (0, 0)}},
        },
        "`cameras`: expected distortions of one kind to share, got Brown": {
            "views": [{}, {"camera": "other"}],
            "cameras": {**BOTH, "other": BENT},
            "shared": "k1",
        },
        "`joint_zeros`: expected views with a `posture`": {"joint_zeros": 0.01},
        r"`joint_zeros`: expected no `mount` with a `posture`.*views\[0\]": {
            "views": [{"posture": hinged(), "mount": HERE}],
            "joint_zeros": 0.01,
        },
        r"`views\[0\].posture`: expected a Posture or None, got list": {
            "views": [{"posture": [0.1]}]
        },
    },
)


def test_mesh_with_unshared_vertices_warns():
    sphere = trimesh.creation.icosphere(2)
    loose = np.asarray(sphere.vertices)[sphere.faces].reshape(-1, 3)
    with pytest.warns(UserWarning, match="`vertices`: 960 stand at 162 places"):
        pj.Mesh(loose, np.arange(len(loose)).reshape(-1, 3))
    pj.Mesh(sphere.vertices, sphere.faces)  # (a warning here is an error)


def test_elimination_order_makes_the_least_work():
    """Cameras that share a lens; pictures of one part each, by both eyes of a head."""
    cameras = [[k, 50] for k in range(50)]
    blocks = blocks_of(cameras, [6] * 50 + [1])
    assert (np.flatnonzero(blocks < 0).tolist(), len({*blocks})) == ([50], 51)
    frames = [[eye, 2 + k] for k in range(50) for eye in (0, 1)]
    assert np.flatnonzero(blocks_of(frames, [6] * 52) < 0).tolist() == [0, 1]
    assert np.all(blocks_of([[0, 1], [0, 1]], [6, 1]) < 0)
