"""Robots' files: where meshes are, what Collada's numbers mean, which joints move, messages."""

import re
import warnings
from itertools import pairwise

import numpy as np
import pytest
import trimesh
from folders import put, triangles_of
from numpy.testing import assert_allclose
from refusals import pairs, refusal

import pinhole_jax as pj
from pinhole_jax._command.joints import joint_angles


def cube(size):
    """A cube of this size, with a corner at the origin."""
    return trimesh.creation.box(bounds=[[0] * 3, [size] * 3])


def write_stl(path, size):
    path.parent.mkdir(parents=True, exist_ok=True)
    cube(size).export(path)


def write_urdf(folder, body):
    return put(folder, "a.urdf", f'<robot name="a">{body}</robot>')


def robot_of(folder, body, **more):
    return pj.robots.load_urdf(write_urdf(folder, body), **more)


def link(name, shape):
    return f'<link name="{name}"><visual><geometry>{shape}</geometry></visual></link>'


def mesh(filename, scale=""):
    return link("part", f'<mesh filename="{filename}" {scale}/>')


def extent(robot):
    vertices = np.asarray(robot.scene(()).mesh.vertices)
    return np.r_[vertices.min(axis=0), vertices.max(axis=0)]


def size_of(robot):
    return extent(robot)[3]


# --- packages ------------------------------------------------------------------------------------

HAND = "package://hand/meshes/base.stl"


@pytest.fixture
def workspace(tmp_path):
    """Two packages with a file of the same name: 1 m of an arm, 3 m of a hand."""
    write_stl(tmp_path / "src/arm/meshes/base.stl", 1)
    write_stl(tmp_path / "src/hand/meshes/base.stl", 3)
    return tmp_path


@pytest.mark.parametrize("kind", ["package", "model"])
def test_meshes_of_two_packages_are_each_package_s_own(workspace, kind):
    for name, size in (("arm", 1), ("hand", 3)):
        body = mesh(f"{kind}://{name}/meshes/base.stl")
        assert size_of(robot_of(workspace / "src/arm/urdf", body)) == size


def test_package_manifests_name_packages(workspace):
    hand = workspace / "src/hand"
    hand.rename(workspace / "src/hand-main")
    manifest = workspace / "src/hand-main/package.xml"
    manifest.write_text("<package><name> hand </name><depend>arm</depend></package>")
    file = write_urdf(workspace / "src/arm/urdf", mesh(HAND))
    assert size_of(pj.robots.load_urdf(file)) == 3
    # A folder of that name whose manifest says another is another package.
    manifest.write_text("<package><name>foot</name></package>")
    manifest.parent.rename(hand)
    with pytest.raises(FileNotFoundError, match="no such package above or beside"):
        pj.robots.load_urdf(file)


def test_folders_of_packages_may_be_given(workspace, monkeypatch):
    (workspace / "src/hand").rename(workspace / "elsewhere")
    file = write_urdf(workspace / "src/arm/urdf", mesh(HAND))
    packages = {"hand": workspace / "elsewhere"}
    assert size_of(pj.robots.load_urdf(file, packages=packages)) == 3
    words = rf"link 'part'.*'meshes/x.stl' of the package 'hand'.*looked in: {workspace}/src/arm\)"
    other = mesh(HAND.replace("base", "x"))
    with pytest.raises(FileNotFoundError, match=words):
        robot_of(workspace, other, packages={"hand": workspace / "src/arm"})
    (workspace / "elsewhere").rename(workspace / "hand_2")
    monkeypatch.setenv("ROS_PACKAGE_PATH", f"/none:{workspace / 'ros'}")
    (workspace / "ros").mkdir()
    (workspace / "hand_2").rename(workspace / "ros/hand")
    assert size_of(pj.robots.load_urdf(file)) == 3


def test_files_of_other_packages_and_of_the_working_folder_are_not_taken(workspace, monkeypatch):
    monkeypatch.chdir(workspace / "src")
    write_stl(workspace / "src/meshes/base.stl", 9)
    write_stl(workspace / "src/other/meshes/base.stl", 9)
    for name in (HAND.replace("hand", "foot"), "package://foot/base.stl", "meshes/base.stl"):
        with pytest.raises(FileNotFoundError, match=r"link 'part'.*base.stl"):
            robot_of(workspace / "robots/urdf", mesh(name))
    with pytest.raises(FileNotFoundError, match=r"give `packages=\{'foot': FOLDER\}`"):
        robot_of(workspace, mesh("package://foot/base.stl"))
    with refusal("expected a path, file:// or package://, got 'http://"):
        robot_of(workspace, mesh("http://foot/base.stl"))


def test_mesh_names_are_paths_or_uris_of_files(tmp_path):
    write_stl(tmp_path / "my meshes/base.stl", 2)
    folder = tmp_path / "urdf"
    uri = (tmp_path / "my meshes/base.stl").as_uri()
    for name in ("../my meshes/base.stl", "..\\my meshes\\base.stl", uri, uri[len("file://") :]):
        own = name if "://" in name else name.replace("%20", " ")
        assert size_of(robot_of(folder, mesh(own))) == 2


def test_mirroring_scales_turn_faces_outwards(tmp_path):
    write_stl(tmp_path / "a.stl", 1)
    for scale, low in (("1 1 1", 0), ("-2 1 1", -2), ("0.5", 0)):
        robot = robot_of(tmp_path, mesh("a.stl", f'scale="{scale}"'))
        assert extent(robot)[0] == low
        assert np.sum(np.linalg.det(triangles_of(robot.scene(()).mesh))) > 0


# --- Collada -------------------------------------------------------------------------------------


def collada(unit="1", node="", up="Z_UP", shape="", extra=""):
    """A cube of a hundred units."""
    corners, triangles = (
        " ".join(map(str, x.ravel())) for x in (cube(100).vertices, cube(100).faces)
    )
    shape = shape or f'<triangles count="12">{{}}<p>{triangles}</p></triangles>'
    shape = shape.format('<input semantic="VERTEX" source="#v" offset="0"/>')
    names = "".join(f'<param name="{x}" type="float"/>' for x in "XYZ")
    return (
        '<?xml version="1.0"?>'
        '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset>'
        f'<unit name="u" meter="{unit}"/><up_axis>{up}</up_axis></asset>{extra}'
        f'<library_geometries><geometry id="g"><mesh><source id="p"><float_array id="a" count="24">'
        f'{corners}</float_array><technique_common><accessor source="#a" count="8" stride="3">'
        f'{names}</accessor></technique_common></source><vertices id="v"><input '
        f'semantic="POSITION" source="#p"/></vertices>{shape}</mesh></geometry>'
        '</library_geometries><library_visual_scenes><visual_scene id="s"><node id="n">'
        f'{node}<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>'
        '<scene><instance_visual_scene url="#s"/></scene></COLLADA>'
    )


def test_collada_is_read_though_its_reader_uses_what_is_deprecated(tmp_path, monkeypatch):
    """As pycollada does with NumPy 2.5."""
    import collada as reader

    def outdated(data, collada=reader.Collada):
        warnings.warn("Setting the shape on a NumPy array", DeprecationWarning, stacklevel=1)
        return collada(data)

    monkeypatch.setattr(reader, "Collada", outdated)
    path = put(tmp_path, "a.dae", collada())
    with pytest.warns(DeprecationWarning, match="Setting the shape"):
        assert len(pj.load_mesh(path).faces) == 12


@pytest.mark.parametrize("up", ["Z_UP", "Y_UP", "X_UP"])
@pytest.mark.parametrize(
    "unit, node, scale, expected",
    [
        ("1", "", "", [0, 0, 0, 100, 100, 100]),
        ("0.0254", "", "", [0, 0, 0, 2.54, 2.54, 2.54]),
        ("0.01", "<scale>2 1 1</scale>", 'scale="3 1 1"', [0, 0, 0, 6, 1, 1]),
        ("0.1", "<matrix>.01 0 0 5 0 .01 0 6 0 0 .01 7 0 0 0 1</matrix>", "",
         [0.5, 0.6, 0.7, 0.6, 0.7, 0.8]),
        ("0.01", "<translate>50 0 0</translate><rotate>0 0 1 90</rotate>", "",
         [-0.5, 0, 0, 0.5, 1, 1]),
    ],
)  # fmt: skip
def test_collada_units_count_once(tmp_path, up, unit, node, scale, expected):
    (tmp_path / "a.dae").write_text(collada(unit, node, up))
    robot = robot_of(tmp_path, mesh("a.dae", scale))
    assert_allclose(extent(robot), expected, atol=1e-5)


def test_collada_polygons_are_cut(tmp_path):
    """An L of six corners: a fan from its first covers more than it does."""
    numbers = "2 0 0 2 1 0 1 1 0 1 2 0 0 2 0 0 0 0 " + "0 0 0 " * 2
    text = collada(shape='<polylist count="1">{}<vcount>6</vcount><p>0 1 2 3 4 5</p></polylist>')
    text = re.sub(r'(count="24">)[^<]*', rf"\g<1>{numbers}", text)
    mesh = pj.load_mesh(put(tmp_path, "a.dae", text))
    sides = np.diff(triangles_of(mesh)[..., :2], axis=1)
    areas = np.linalg.det(sides) / 2
    assert_allclose(areas.sum(), 3)
    assert np.all(areas > 0)


def test_collada_that_is_not_read_is_refused(tmp_path):
    for words, text in (
        ("instance_controller", collada(node='<instance_controller url="#c"/>')),
        ("<ph> is not read", collada(shape="<polygons count='1'>{}<ph/></polygons>")),
        ("positive <unit meter>", collada(unit="0")),
        ("could not convert", collada(unit="cm")),
        ("`path`: expected a readable mesh", collada().replace("100", "1.#QNAN", 1)),
        ("`path`: expected a readable mesh", collada()[:900]),
        ("#h", collada().replace('url="#g"', 'url="#h"')),
        ("at most 65536 nodes", collada(extra=doubled(40), node=instance(40))),
        ("`path`: expected a readable mesh", entities(collada())),
    ):
        path = put(tmp_path, "a.dae", text)
        with refusal(words):
            pj.load_mesh(path)


def instance(k):
    return f'<instance_node url="#n{k}"/>'


def doubled(levels):
    """Nodes that each stand for the one before twice."""
    nodes = [f'<node id="n{k}">{2 * instance(k - 1)}</node>' for k in range(1, levels + 1)]
    return f'<library_nodes><node id="n0"/>{"".join(nodes)}</library_nodes>'


def entities(text):
    """The same with a number that stands for more than memory holds."""
    names = "abcdefghij"
    rest = "".join(f'<!ENTITY {b} "{10 * f"&{a};"}">' for a, b in pairwise(names))
    head = f'<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "1 1 1 1 1 1 1 1 1">{rest}]>'
    return text.replace('<?xml version="1.0"?>', head).replace("100", "&j;", 1)


# --- joints --------------------------------------------------------------------------------------

BOX = '<box size="0.1 0.1 0.1"/>'


def joint(name, parent, child, extra="", kind="prismatic", axis="1 0 0"):
    """A joint one metre along y of the one before."""
    ends = f'<parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}<origin xyz="0 1 0"/>{extra}</joint>'


def chain(*joints):
    return "".join(link(name, BOX) for name in "abcd") + "".join(joints)


def mimic(leader, extra=""):
    return f'<mimic joint="{leader}" {extra}/>'


FREE = joint("j1", "a", "b")
DOUBLE = joint("j2", "b", "c", mimic("j1", 'multiplier="2" offset="0.5"'))


@pytest.mark.parametrize(
    "joints, expected",
    [
        # j1 = 0.3 throughout: what the others add is arithmetic.
        ((FREE, DOUBLE, joint("j3", "c", "d", mimic("j1"))), [0.3 + 1.1 + 0.3, 3]),
        ((FREE, DOUBLE, joint("j3", "c", "d", mimic("j2", 'multiplier="-3" offset="0.1"'))),
         [0.3 + 1.1 - 3.3 + 0.1, 3]),
        ((joint("j1", "a", "b", axis="2 0 0"), joint("j2", "b", "c", kind="fixed"),
          joint("j3", "c", "d", kind="fixed", extra=mimic("none"))), [0.3, 3]),
        ((joint("j1", "a", "b", axis="0 0 3", kind="continuous"),
          joint("j2", "b", "c", mimic("j1", 'multiplier="-1"'), "revolute", "0 0 0.5"),
          joint("j3", "c", "d", mimic("j2"), axis="0 -4 0")), [-np.sin(0.3), 2.3 + np.cos(0.3)]),
    ],
)  # fmt: skip
def test_joints_that_follow_others_and_long_axes(tmp_path, joints, expected):
    robot = robot_of(tmp_path, chain(*joints))
    assert robot.joints == ("j1",)
    assert_allclose(robot.poses([0.3])["d"][:2, 3], expected)


def test_poses_are_those_of_another_program(tmp_path):
    yourdfpy = pytest.importorskip("yourdfpy", reason="no yourdfpy here: poses are not compared")
    kinds, random = ("revolute", "prismatic", "continuous", "fixed"), np.random.default_rng(4)
    words = lambda numbers: " ".join(map(str, numbers))
    body = "".join(f'<link name="{k}"/>' for k in range(8)) + link("seen", BOX)
    for k, kind in enumerate(2 * kinds):
        xyz, rpy, axis = random.normal(size=(3, 3))
        axis = words(axis / np.linalg.norm(axis))
        body += (
            joint(f"j{k}", k // 2, "seen" if k == 7 else k + 1, "", kind, axis)
            .replace('xyz="0 1 0"', f'xyz="{words(xyz)}" rpy="{words(rpy)}"')
            .replace(
                "</joint>", f'{mimic("j1") * (k == 4)}<limit effort="1" velocity="1"/></joint>'
            )
        )
    robot, angles = robot_of(tmp_path, body), random.normal(size=5)
    theirs = yourdfpy.URDF.load(str(tmp_path / "a.urdf"), load_meshes=False)
    theirs.update_cfg(angles)
    for name, pose in robot.poses(angles).items():
        assert_allclose(pose, theirs.get_transform(name), atol=1e-12)
    assert len(robot.poses(angles)) == 9


SHUT = joint("j3", "c", "d", kind="fixed")


def second(*extra, **more):
    """Three joints, the second as it is given."""
    return chain(FREE, joint("j2", "b", "c", *extra, **more), SHUT)


SHAPE = "link 'l': expected one shape .* got"
#: What a robot has, by the error.
REFUSED = {
    "joint 'j2' is floating.*fixed": second(kind="floating"),
    "`type`: expected one of revolute, .* got 'ball' .in joint 'j2'": second(kind="ball"),
    "'j2' follows 'j9', which does not exist": second(mimic("j9")),
    "'j2' follows 'j3', which is fixed": second(mimic("j3")),
    "joints j2 follow each other": second(mimic("j2")),
    "joints j2, j3 follow each other": chain(
        FREE, joint("j2", "b", "c", mimic("j3")), joint("j3", "c", "d", mimic("j2"))
    ),
    "`xyz`: expected an axis, got one of length 0 .in joint 'j2', <axis>": second(axis="0 0 0"),
    r"`xyz`: expected finite numbers of shape .3,., got .1.0, 0.0. .in joint 'j2', <axis>": second(
        axis="1 0"
    ),
    "`offset`: expected a finite number, got 'x' .in joint 'j2', <mimic>": second(
        mimic("j1", 'offset="x"')
    ),
    "the joint 'j1' twice": chain(FREE, joint("j1", "b", "c"), SHUT),
    "joint 'j2': no link 'e'": chain(FREE, joint("j2", "b", "e"), SHUT),
    "no joint's child, got a, c: join them": chain(FREE, SHUT),
    "joint 'j4': link 'd' has a joint to 'c'": second() + joint("j4", "a", "d"),
    "links b, c follow each other in a circle": chain(
        joint("j1", "c", "b"), DOUBLE, joint("j3", "b", "d")
    ),
    "`link`: expected a text, got no such field .in joint 'j2', <child>": chain(FREE, SHUT)
    + '<joint name="j2" type="fixed"><parent link="b"/></joint>',
    f"{SHAPE} <capsule>.*leave_out": link("l", '<capsule radius="1" length="2"/>'),
    f"{SHAPE} none": link("l", ""),
    "no link has a <visual> shape; <collision> shapes are not drawn": link("l", BOX).replace(
        "visual", "collision"
    ),
    "no link has a <visual> shape$": '<link name="l"/>',
    "no <link> in <robot>, expected at least one": "",
    "`radius`: expected a positive number, got no such field .in link 'l', <sphere>": link(
        "l", "<sphere/>"
    ),
    r"`size`: expected finite numbers of shape \(3,\), .* .in link 'l', <box>": link(
        "l", '<box size="1 2"/>'
    ),
    "`radius`: expected a positive number, got nan .in link 'l', <sphere>": link(
        "l", '<sphere radius="nan"/>'
    ),
    "`size`: expected positive numbers, got .1.0, -1.0, 1.0. .in link 'l', <box>": link(
        "l", '<box size="1 -1 1"/>'
    ),
    "the link 'l' twice": 2 * link("l", BOX),
    "link 'b' is in <group>.* run `xacro .*move what is": f"<group>{link('b', BOX)}</group>",
    **{
        f"not expanded, {part}.*: run `xacro robot.urdf.xacro > robot.urdf`": body
        for part, body in {
            "<xacro:include>": '<xacro:include filename="b.xacro"/>',
            "<xacro:macro>": '<xacro:macro name="m"><link name="b"/></xacro:macro>',
            "size=": link("a", '<box size="1 1 ${height}"/>'),
            "filename=": mesh("$(find a)/a.stl"),
            "name=": link("${prefix}a", BOX),
            "<macro>": '<macro name="m"><link name="b"/></macro>',
            "<include>": '<include filename="b.xacro"/>',
            "<property>": '<property name="height" value="1"/>',
        }.items()
    },
}


@pairs("words, body", REFUSED)
def test_robots_that_are_not_read_are_refused_with_the_reason(tmp_path, words, body):
    with refusal(rf"`path`: expected a URDF file, .*a.urdf.*{words}"):
        robot_of(tmp_path, body)


@pytest.mark.parametrize("text", ['<sdf version="1.6"><model name="a"/></sdf>', "", "<robot", "{}"])
def test_files_that_are_no_urdf_are_refused(tmp_path, text):
    path = put(tmp_path, "a.urdf", text)
    words = (
        "<sdf> in place of <robot>: export"
        if "sdf" in text
        else "no[a-z -]+.*: line 1, column|unclosed token: line 1"
    )
    with refusal(f"`path`: expected a URDF file, got .*: {words}"):
        pj.robots.load_urdf(path)


@pytest.mark.parametrize("packages", ["/ws/deep", {"deep": None}])
def test_packages_that_are_no_mapping_to_folders_are_refused(tmp_path, packages):
    words = "`packages`: expected a mapping of package name to folder, got"
    with refusal(words):
        robot_of(tmp_path, link("a", BOX), packages=packages)


def test_links_left_out_may_have_any_shape(tmp_path):
    capsule = link("b", '<capsule radius="1" length="2"/>')
    body = link("a", BOX) + capsule + joint("j", "a", "b")
    robot = robot_of(tmp_path, body, leave_out=["b"])
    assert (robot.links, robot.joints) == (("a",), ("j",))


def test_elements_that_are_not_seen_may_be_anything(tmp_path):
    """Collisions, comments, simulators' groups, undeclared namespaces; and no name of the robot."""
    unseen = "<collision><geometry><capsule/></geometry></collision>"
    unseen += '<inertial><mass value="?"/></inertial>'
    body = link("a", f"<!-- one -->{BOX}").replace("</link>", f"{unseen}</link>")
    body += f'<gazebo>{link("x", BOX)}<sensor:ray angle="$(x)"/></gazebo>'
    body += '<transmission><joint name="j"/></transmission>'
    file = write_urdf(tmp_path, body)
    head = '<robot xmlns:xacro="http://ros.org/xacro">'
    file.write_text(file.read_text().replace('<robot name="a">', head))
    robot = pj.robots.load_urdf(file)
    assert robot.links == ("a",)
    assert_allclose(extent(robot), [-0.05] * 3 + [0.05] * 3)


# --- files of angles -----------------------------------------------------------------------------


@pytest.fixture
def arm(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    body = link("a", '<box size="1 1 1"/>') + "".join(f'<link name="{x}"/>' for x in "bcd")
    for name, ends, kind, limit in (
        ("turn", "ab", "revolute", 'lower="-2" upper="3" effort="x"'),
        ("slide", "bc", "prismatic", 'lower="0" upper="0.4"'),
        ("wheel", "cd", "continuous", 'effort="1" velocity="2"'),
    ):
        body += joint(name, *ends, f"<limit {limit}/>", kind)
    return robot_of(tmp_path, body)


def test_limits_of_joints_are_the_files(arm):
    assert arm.limits == {"turn": (-2, 3), "slide": (0, 0.4)}
    assert arm.sliding == ("slide",)


NAMES = '"names": ["turn", "slide", "wheel"], "postures": [[{}]]'


@pytest.mark.parametrize(
    "more, row, turn",
    [
        ("", "1.5, 0.3, -6", 1.5),
        ('"unit": "rad", ', "1.5, 0.3, -6", 1.5),
        ('"unit": "deg", ', "90, 0.3, -340", np.pi / 2),
        ('"unit": "deg", ', "171.9, 0.3, 0", np.deg2rad(171.9)),
        ("", "3.05, 0.45, 6.3", 3.05),  # a zero that is a little off
    ],
)
def test_joint_angles_have_the_unit_that_their_file_names(arm, tmp_path, more, row, turn):
    (tmp_path / "j.json").write_text("{" + more + NAMES.format(row) + "}")
    (posture,) = joint_angles("j.json", arm)
    assert posture["turn"] == pytest.approx(turn, rel=1e-15)
    assert posture["slide"] == float(row.split(",")[1])


@pytest.mark.parametrize(
    "more, row, message",
    [
        ("", "90, 0, 0", "-2 to 3 rad of joint 'turn', .* limits, got 90 in row 1 .*: degrees?"),
        ("", "0, 0, -69", "'wheel', a turn to either side, got -69 in row 1 of 'j.json': degrees?"),
        ("", "0, 300, 0", "0 to 0.4 m of joint 'slide', .* got 300 in row 1 .*: other units?"),
        ('"unit": "deg", ', "300, 0, 0", "'turn', the URDF's limits, got 5.236 in"),
        ('"unit": "grad", ', "0, 0, 0", "`unit`: expected one of rad, deg, got 'grad'"),
        ('"joint_units": ["rad"], ', "0, 0, 0", "`joint_units`: expected names, postures and unit"),
    ],
)
def test_joint_angles_that_no_joint_reaches_are_refused(arm, tmp_path, more, row, message):
    (tmp_path / "j.json").write_text("{" + more + NAMES.format(row) + "}")
    with refusal(message.replace("?", r"\?")):
        joint_angles("j.json", arm)
