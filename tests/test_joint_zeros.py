"""Joint fits of the zeros of a robot's joints."""

import numpy as np
import pytest
from arm import BOTH_EYES, RIG, SIZE, START, TRUTH, apart, grown, information_of, posture
from folders import in_trimesh
from oracles import drawn

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._camera.poses import at_pose, exponential, pose_of


@pytest.mark.full
def test_size_of_one_body_among_several_is_found(arm):
    """A rig before two bodies; the second is 5 % larger than its mesh."""

    def shown(k):
        return lambda x: [posture(k)[0], posture(k)[1] @ grown(1 + x[0])]

    postures = [pj.Posture(arm, shown(k), {"bar": "scale"}) for k in range(2)]
    views = [
        pj.JointView(p.scene(), drawn(camera, p.scene([0.05])), name, posture=p)
        for p in postures
        for name, camera in BOTH_EYES.items()
    ]
    right = at_pose(TRUTH, pose_of(START) @ RIG["right"])
    fit = pj.fit_joint(views, {"left": START, "right": right}, rig=RIG, joint_zeros={"bar": 0.1})
    assert fit.status == "converged"
    assert abs(fit.joint_zeros.values[0] - 0.05) < 1e-5
    assert fit.joint_zeros.units == ("scale",)
    assert max(apart(fit.cameras["left"].camera, TRUTH)) < 1e-4


#: A lump and three links, their joints' axes this way and that.
THREE = """<robot name="three">
  <link name="base"><visual><geometry><mesh filename="body.stl"/></geometry></visual></link>
  <link name="upper"><visual><origin xyz="0 0 0.6"/><geometry><box size="0.3 0.4 1.2"/></geometry>
  </visual></link>
  <link name="fore"><visual><origin xyz="0.1 0 0.5"/><geometry><box size="0.35 0.2 1.0"/></geometry>
  </visual></link>
  <link name="hand"><visual><origin xyz="0.15 0 0.2"/><geometry><box size="0.5 0.2 0.3"/></geometry>
  </visual></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
  <origin xyz="0 0 0.2"/><axis xyz="0 1 0"/>
  <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/>
  <origin xyz="0 0 1.2"/><axis xyz="0 1 0.3"/>
  <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="wrist" type="revolute"><parent link="fore"/><child link="hand"/>
  <origin xyz="0.1 0 1.0"/><axis xyz="1 0 0"/>
  <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
</robot>"""


#: What its joints' readings lack (rad), the camera before it, and where a fit starts.
LACK = np.deg2rad([0.7, -1.3, 2.0])


BEFORE = pj.Camera([3, -5.5, 3], [0, 0, 0.8], [0, 0, 1], 0.6, 1.0, SIZE, SIZE)


NEAR = at_pose(
    BEFORE, pose_of(BEFORE) @ exponential(np.array([0.05, -0.06, 0.04, 0.1, 0.05, -0.2]))
)


@pytest.fixture(scope="module")
def misread(tmp_path_factory):
    """Views of five postures of a robot whose joints' zeros are off."""
    folder = tmp_path_factory.mktemp("three")
    in_trimesh(shapes.bumpy(2)).apply_scale(0.5).export(folder / "body.stl")
    (folder / "three.urdf").write_text(THREE)
    robot = pj.robots.load_urdf(folder / "three.urdf")
    postures = np.random.default_rng(3).uniform(-1, 1, (3, 3))
    return [
        pj.JointView(
            robot.scene(read),
            drawn(BEFORE, robot.scene(read + LACK)),
            posture=robot.posture(read),
        )
        for read in postures
    ]


def test_joint_zeros_are_found_with_the_camera(misread):
    fit = pj.fit_joint(misread, NEAR, joint_zeros=np.deg2rad(1.5))
    assert fit.status == "converged"
    assert fit.joint_zeros.names == ("shoulder", "elbow", "wrist")
    assert np.rad2deg(np.max(np.abs(fit.joint_zeros.values - LACK))) < 1e-4  # (0.01 was asked)
    assert max(apart(fit.camera, BEFORE)) < 1e-5
    assert np.all(fit.joint_zeros.std < 1e-5)
    assert all(view.iou > 1 - 1e-6 for view in fit.views)


@pytest.mark.long
def test_zeros_that_are_not_sought_move_the_camera(misread):
    fit = pj.fit_joint(misread, NEAR)
    angle, _ = apart(fit.camera, BEFORE)
    assert fit.status == "misfit"
    assert angle > 0.1


@pytest.mark.long
def test_joint_that_masks_do_not_show_keeps_its_prior(misread):
    """Two sigma from its readings at most; what is not named stays."""
    known = {"wrist": 1e-5}
    fit = pj.fit_joint(misread[:2], NEAR, joint_zeros=known)
    assert fit.joint_zeros.names == ("wrist",)
    assert abs(fit.joint_zeros.std[0] / 1e-5 - 1) < 0.1


def test_observability_of_joint_zeros_equals_polygon_differences(misread):
    """Where several links end in a pixel as well: a small picture has some."""
    told = pj.joint_observability(
        misread[:1], BEFORE, "phi", joint_zeros=1.0, prior={"phi": (0.6, 1e-9)}, noise=0.1
    )
    shown = lambda x: drawn(BEFORE, misread[0].posture.scene(x))
    information = np.eye(3) + information_of(shown, 3)
    assert [name.split()[0] for name in told.names] == ["camera", "shoulder", "elbow", "wrist"]
    np.testing.assert_allclose(told.std[1:] ** 2, np.diag(np.linalg.inv(information)), rtol=2e-3)
