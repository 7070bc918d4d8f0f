"""The command `hand-eye`, its robots' files, and a real robot."""

import re
from pathlib import Path

import numpy as np
import pytest
import real
import trimesh
from arm import BAR, START, TRUTH, apart
from folders import in_trimesh
from numpy.testing import assert_allclose
from oracles import drawn
from refusals import refusal

import pinhole_jax as pj
from pinhole_jax import __main__ as command, shapes

URDF = """<robot name="two">
  <link name="base"><visual><geometry><box size="0.5 0.5 0.2"/></geometry></visual></link>
  <link name="arm"><visual><origin xyz="0 0 0.5"/><geometry><mesh filename="arm.stl" scale="2 2 2"/>
  </geometry></visual></link>
  <link name="tip"/>
  <joint name="turn" type="revolute"><parent link="base"/><child link="arm"/>
  <origin xyz="0 0 0.1"/><axis xyz="0 1 0"/>
  <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="held" type="fixed"><parent link="arm"/><child link="tip"/>
  <origin xyz="0 0 1"/></joint>
</robot>"""


def test_urdf_becomes_a_scene(tmp_path):
    trimesh.creation.box((0.1, 0.1, 0.5)).export(tmp_path / "arm.stl")
    (file := tmp_path / "two.urdf").write_text(URDF)
    load = pj.robots.load_urdf
    robot = load(file)
    assert (robot.joints, robot.links) == (("turn",), ("base", "arm"))
    vertices = np.asarray(robot.scene({"turn": np.pi / 2}).mesh.vertices)
    assert_allclose(vertices.min(axis=0), [-0.25, -0.25, -0.1], atol=1e-6)
    assert_allclose(vertices.max(axis=0), [1, 0.25, 0.2], atol=1e-6)
    for call, words in (
        (lambda: robot.poses({}), "`angles`: expected one of each joint, got none of turn"),
        (lambda: robot.poses({"turn": 0, "bend": 1}), "`angles`: expected joints among turn, got"),
        (lambda: robot.scene([0, 1]), r"`angles`: expected 1 numbers \(turn\), got shape"),
        (lambda: load(file, leave_out=["hand"]), "`leave_out`: expected links among base"),
        (lambda: robot.scene_at({"base": np.eye(4)}), "`poses`: expected one of each link, got"),
    ):
        with refusal(words):
            call()


MASKS = "mask_0.png mask_1.png mask_2.png"


def main(words):
    """Run the command on the robot; MASKS stands for all of its masks."""
    words = f"hand-eye arm.urdf {words} --camera start.json".replace("MASKS", MASKS)
    return command.main(words.split())


@pytest.fixture
def robot_files(tmp_path, monkeypatch):
    """A robot of two links, angles and masks of three postures, a camera to start from."""
    # What the command sets for its own process would change those of the other tests.
    monkeypatch.setattr(command, "_set_up_jax", lambda *_, **__: None)
    monkeypatch.chdir(tmp_path)
    in_trimesh(shapes.bumpy(2)).export("body.stl")
    BAR.export("arm.stl")
    base = '<box size="0.5 0.5 0.2"/>', '<mesh filename="body.stl"/>'
    text = URDF.replace(*base).replace(' scale="2 2 2"', "").replace('xyz="0 0 0.1"', 'xyz="1 0 0"')
    Path("arm.urdf").write_text(text)
    Path("joints.csv").write_text("turn\n-0.6\n0.3\n1.1\n")
    robot = pj.robots.load_urdf("arm.urdf")
    for k, angle in enumerate((-0.6, 0.3, 1.1)):
        pj.io.save_image(f"mask_{k}.png", drawn(TRUTH, robot.scene([angle])))
    pj.io.save_camera("start.json", START)


@pytest.mark.long
@pytest.mark.usefixtures("robot_files")
def test_command_finds_joint_zeros_and_writes_a_page(capsys):
    Path("joints.csv").write_text("turn\n-0.61\n0.29\n1.09\n")
    Path("more.csv").write_text("turn\n0.31\n-1.9\n")
    words = "--propose more.csv --holdout --report page.html -o found"
    assert main(f"joints.csv MASKS --joint-zeros 1 {words}") == 0
    out = capsys.readouterr().out
    assert max(apart(pj.io.load_fit("found/camera.json").camera, TRUTH)) < 0.02
    found = float(re.search(r"^turn +([-+0-9.]+) ", out, re.M)[1])
    assert abs(found - np.rad2deg(0.01)) < 0.05
    page = Path("page.html").read_text()
    for words in ("95 % interval", "sigma off", "mask only", "the error bars hold", "mask_2.png"):
        assert words in page
    printed = re.findall(r"^ +\d  0\.\d{4}  0\.\d{4} +(\d+\.\d)  \d", out, re.M)
    assert printed == re.findall(r"mask_\d\.png</th><td>0\.\d+</td><td>(\d+\.\d)<", page)
    assert len(printed) == 3
    more = re.search(r"^proposed +(one more mask .*)$", out, re.M)[1]
    assert more in page
    assert {"1", "2"} == set(re.findall(r"row (\d) 1\.\d\d", more))
    assert page.count("<img") == 3
    assert page.count("<section") == page.count("</section>") == 7
    headings = re.findall("<h2>(.*?)</h2>", page)
    assert headings[0] == "Outlines"
    assert {"Halves of the postures", "Other postures"} < {*headings}


@pytest.mark.long
@pytest.mark.usefixtures("robot_files")
def test_command_finds_the_camera_of_a_robot(capsys):
    assert main("joints.csv MASKS --holdout --images MASKS --refine -o found") == 0
    out = capsys.readouterr().out
    assert len(re.findall(r"view \d: fitted to the mask", out)) == 3
    found = pj.io.load_fit("found/camera.json")
    assert max(apart(found.camera, TRUTH)) < 2e-3
    assert re.search(r"^halves +the error bars hold: .* sigma apart", out, re.M)
    written = re.search(r"^written +(.*)$", out, re.M)[1].split(", ")
    assert len(written) == 4
    assert all(Path(path).exists() for path in written)


#: A command's words, by the error.
WRONG = {
    "`MASK`: expected one for each of 3 rows of 'joints.csv'": "joints.csv mask_0.png mask_1.png",
    "`--joint-zeros`: expected a positive": "joints.csv MASKS --joint-zeros -1",
    "expected none with `--in-hand`": "joints.csv MASKS --joint-zeros 1 --in-hand arm",
    "`postures`: expected 1 angles in each row": "joints.csv MASKS --propose short.json",
    "expected `pose` in --free": "joints.csv MASKS --free phi --propose joints.csv",
    "`--refine`: expected photos, --images": "joints.csv MASKS --refine",
    "`--images`: expected one for each of 3": "joints.csv MASKS --images mask_0.png",
    "`--images`: expected the mask's size 96 x 96, got 40 x 30 (small.png)": (
        "joints.csv MASKS --images mask_0.png mask_1.png small.png"
    ),
    "`--in-hand`: expected a link among base": "joints.csv MASKS --in-hand tool",
    "`--leave-out`: expected links among base": "joints.csv MASKS --leave-out tool",
    "-34 in row 2 of 'far.csv': degrees?": "far.csv MASKS",
    "`JOINTS`: expected -3 to 3 rad of joint": "deg.json MASKS",
    "`unit`: expected one of rad, deg, got 'gon' (in 'gon.json')": "gon.json MASKS",
    "`JOINTS`: expected one of each joint, got none": "other.csv MASKS",
    "`postures`: expected 1 angles in": "short.json mask_0.png",
}


@pytest.mark.usefixtures("robot_files")
def test_command_names_the_wrong_robot_argument(capsys):
    Path("short.json").write_text('{"names": ["turn"], "postures": [[1, 2]]}')
    Path("other.csv").write_text("bend\n0\n0\n0\n")
    Path("far.csv").write_text("turn\n0.1\n-34\n0.2\n")
    for unit in ("deg", "gon"):
        text = f'{{"unit": "{unit}", "names": ["turn"], "postures": [[400]]}}'
        Path(f"{unit}.json").write_text(text)
    pj.io.save_image("small.png", np.zeros((30, 40, 3), np.uint8))
    for message, words in WRONG.items():
        assert main(words) == 2
        assert message in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.usefixtures("shared")
def test_stereo_camera_before_a_real_robot_is_recovered(exhaustive):
    """The left from nearby (of all tests: with no start), the right from where the left is: that
    they are 120.09 mm apart and parallel no fit knew. (With no start it takes three times as long.)
    """
    unknown, fits = real.given_camera(real.K, np.eye(3), np.zeros(3), 960, 540), {}
    near = {} if exhaustive else {"e": [0.8, -1, 1.1], "p": [0, -0.4, 0.7], "u": [-0.5, 0, 0.9]}
    for side in ("left", "right"):
        found = pj.fit_joint(real.postures(side), unknown.replace(**near), search=not near)
        fits[side] = found.cameras["camera"]
        assert fits[side].status == "converged"
        near = {name: getattr(found.camera, name) for name in "epu"}
    apart = real.stereo(fits)
    assert abs(apart["baseline, mm"] - real.BASELINE) < 1.5
    assert apart["degrees from parallel"] < 0.2  # (0.1 was asked)
    assert apart["intervals that hold"] == 6
