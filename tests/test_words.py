import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import camera_ahead, central_difference, normal, usual_camera
from results import NAMES, fit_at

import pinhole_jax as pj
from pinhole_jax._solver.heading import heading


def test_fit_prints_as_a_table():
    camera = pj.Camera([1, 2, 5], [0, 0, 0], [0, 1, 0], 0.6, 1.0, 64, 48)
    names = ("rotation_b1", "e_x", "phi")
    other = fit_at(camera, [1e-3, 1e-4, 1e-5], names)
    fit = other._replace(status="ambiguous", weak=("the distance",), modes=(other,))
    lines = str(fit).splitlines()
    assert [line.split() for line in lines[1:4]] == [
        ["pitch", "-21.417", "0.057", "deg", *["up", "from", "level,", "where", "+y", "is", "up"]],
        ["e_x", "1.00000", "0.0001", "world", *["eye,", "units", "of", "the", "mesh"]],
        ["phi", "34.37747", "0.00057", "deg", "vertical", "field", "of", "view"],
    ]
    assert lines[4].startswith("status     ambiguous   (pick one of its views: others")
    assert (
        lines[5]
        == "accuracy   rotation +-0.057 degrees, position +-0.0001 units of the mesh (1 sigma)"
    )
    assert lines[-2:] == [
        "note       the distance",
        "note       another view fits the mask equally well",
    ]
    assert repr(fit) == "<Fit: ambiguous, IoU 0.9900, rotation_b1, e_x, phi>"


#: Forward, up, pitch, yaw and roll, the axes up and ahead.
LOOKS = """
    0 0 -1   0  1    0    0                 180   0                 +y+z
    0 1  0   0  0    1    0                  90   0                 +z+x  # anticlockwise from above
    2 0  1   0  0    1   26.56505117707799    0   0                 +z+x  # up, by atan(1/2)
    1 0  0   0 -0.5  1    0                   0  26.56505117707799  +z+x
    1 0  0   0  0.1 -1    0                   0   5.710593137499643 -z+x  # by atan(1/10)
    0 0 -1   1  0    0    0                 -90   0                 +x+y
"""


@pytest.mark.parametrize("row", LOOKS.strip().splitlines())
def test_pitch_yaw_and_roll(row):
    *numbers, axes = row.partition("#")[0].split()
    forward, up, angles = np.array(numbers, float).reshape(3, 3)
    looks = heading(camera_ahead().replace(e=0 * up, p=forward, u=up))
    assert_allclose(np.rad2deg(looks.angles), angles, atol=1e-9)
    assert looks.up + looks.ahead == axes


def test_rotations_have_values_and_sigmas():
    root = 1e-3 * normal((4, 4))
    fit = fit_at(usual_camera(64, 48), root @ root.T, NAMES[:4])
    rows = fit.parameters.rows
    assert [row.name for row in rows] == ["pitch", "yaw", "roll", "e_x"]
    angles = lambda step: np.rad2deg(heading(fit.displaced(step)).angles)
    spread = central_difference(angles, np.zeros(4)) @ root
    assert_allclose([row.std for row in rows[:3]], np.linalg.norm(spread, axis=1), rtol=1e-5)
    assert_allclose([row.value for row in rows[:3]], angles(np.zeros(4)))


def test_displaced_camera_is_a_step_of_each_parameter_away():
    lens = pj.Lens([40, 30], 1.1)
    camera = camera_ahead().replace(lens=lens)
    names = ("rotation_b2", "e_x", "phi", "principal_x", "principal_y", "aspect")
    fit = fit_at(camera, [0.01, 0.2, 0.03, 1, 1, 0.01], names)
    moved = fit.displaced([0.01, 0.2, 0.03, 0.5, 0.25, 0.1])
    off = [*pj.pose_error(moved, camera), moved.phi, *moved.lens.principal_point, moved.lens.aspect]
    assert [*map(float, off)] == pytest.approx([0.01, 0.2, 0.63, 40.5, 30.25, 1.2])
    rows = fit.parameters.rows
    assert [row.name for row in rows][:3] == ["yaw", "e_x", "phi"]
    assert [row.std for row in rows][:3] == pytest.approx([np.rad2deg(0.01), 0.2, np.rad2deg(0.03)])
    assert rows[1].cells() == ("e_x", "0.00", "0.2", "world", "eye, units of the mesh")
    assert fit.notes == ()
