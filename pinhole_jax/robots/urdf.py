"""A URDF's links, the joints between them and the shapes that are seen, from its XML."""

import xml.etree.ElementTree as ET
from collections.abc import Collection, Mapping
from graphlib import CycleError, TopologicalSorter
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .._camera.poses import Pose, rigid
from .._files.fields import Fields, attributes
from .._files.paths import as_fields

SHAPES = ("box", "cylinder", "mesh", "sphere")
#: Elements that xacro once had without a prefix, and those that describe no link or joint anew.
OLD_XACRO = ("macro", "include", "property", "if", "unless", "arg", "insert_block")
OTHERS = ("gazebo", "transmission", "ros2_control", "sensor")
MOVING = ("revolute", "continuous", "prismatic")


class Joint(NamedTuple):
    """A joint: its child is at `origin` in its parent, moved by a `twist` times its angle.

    The twist is a rotation vector and a translation, per rad or m. One that follows a `leader` has
    `factor` times its angle, and `offset` (rad, m).
    """

    parent: str
    child: str
    origin: Pose
    twist: Float[np.ndarray, "6"]
    limits: tuple[float, float] | None
    leader: str
    factor: float
    offset: float


def read_urdf(
    root: ET.Element, leave_out: Collection[str]
) -> tuple[list[str], dict[str, Joint], list[tuple[str, ET.Element]]]:
    """Return a URDF's links, its joints, and what is seen of links that are not left out.

    Raises ValueError, which names the link or joint; for xacro and other files, too.
    """
    _check_plain(root)
    links = _named(root, "link")
    if not links:
        raise ValueError("no <link> in <robot>, expected at least one")
    joints = {name: _joint(name, joint) for name, joint in _named(root, "joint").items()}
    shown = [name for name in links if name not in leave_out]
    visuals = [(name, visual) for name in shown for visual in links[name].findall("visual")]
    if not visuals:
        words = "; <collision> shapes are not drawn: copy them as <visual>"
        words *= root.find("link/collision") is not None
        raise ValueError(f"no link has a <visual> shape{words}")
    return [*links], joints, visuals


def _check_plain(root: ET.Element) -> None:
    """Check that it is a robot without xacro, and that links and joints lie where they are read.

    Tags lose their prefixes.
    """
    for element in root.iter():
        prefix, _, name = element.tag.rpartition(":")
        if "xacro" in prefix + root.get(f"xmlns:{prefix}", ""):
            raise _xacro(f"<xacro:{name}>")
        element.tag = name
    if root.tag != "robot":
        raise ValueError(f"<{root.tag}> in place of <robot>: export the robot as URDF")
    for group in root:
        if group.tag in OLD_XACRO:
            raise _xacro(f"<{group.tag}>")
        for part in group.iter() if group.tag not in ("link", "joint", *OTHERS) else ():
            if part.tag == "link" or (part.tag == "joint" and part.find("parent") is not None):
                raise ValueError(
                    f"{part.tag} {part.get('name')!r} is in <{group.tag}>, which no URDF has:"
                    " run `xacro robot.urdf.xacro > robot.urdf` if xacro makes it and load"
                    f" robot.urdf, else move what is in <{group.tag}> to <robot>"
                )


def _xacro(words: str) -> ValueError:
    return ValueError(
        f"xacro that is not expanded, {words}: run `xacro robot.urdf.xacro > robot.urdf` and load"
        " robot.urdf"
    )


def _fields(element: ET.Element, where: str, tag: str = ".") -> Fields:
    """Return the attributes of an element or of a part, none where there is no such part."""
    part = element.find(tag)
    part = ET.Element(tag) if part is None else part
    for name, text in part.items():
        if "${" in text or "$(" in text:
            raise _xacro(f"{name}={text!r} of {where}")
    return attributes(part, where)


def _named(root: ET.Element, kind: str) -> dict[str, ET.Element]:
    """Return the links or joints by name."""
    named = ((_fields(x, "<robot>").text("name"), x) for x in root.findall(kind))
    return as_fields(named, kind)


def _origin(element: ET.Element, where: str) -> Pose:
    """Return the pose of an element's <origin>."""
    from scipy.spatial.transform import Rotation

    origin = _fields(element, where, "origin")
    xyz, rpy = (origin.array(name, (3,), default=0) for name in ("xyz", "rpy"))
    return rigid(Rotation.from_euler("xyz", rpy).as_matrix(), xyz)


def read_visual(visual: ET.Element, link: str) -> tuple[Pose, str, Fields]:
    """Return the pose of a <visual> in its link's frame, its kind of shape, and that's sizes."""
    where, shapes = f"link {link!r}", visual.findall("geometry/*")
    if len(shapes) != 1 or shapes[0].tag not in SHAPES:
        known, got = ", ".join(SHAPES), ", ".join(f"<{x.tag}>" for x in shapes) or "none"
        raise ValueError(
            f"{where}: expected one shape in the <geometry> of <visual> ({known}), got {got};"
            f" change it, or load the robot with `leave_out=[{link!r}]`"
        )
    return _origin(visual, where), shapes[0].tag, _fields(shapes[0], where)


def _joint(name: str, joint: ET.Element) -> Joint:
    where, kind = f"joint {name!r}", joint.get("type")
    if kind in ("floating", "planar"):
        raise ValueError(
            f"{where} is {kind}, which no angle describes: make it fixed in the file, with its"
            " place as <origin>"
        )
    kind = _fields(joint, where).text("type", (*MOVING, "fixed"))
    tags = ("parent", "child", "axis", "limit", "mimic")
    parent, child, axis, limit, mimic = (_fields(joint, where, tag) for tag in tags)
    along = axis.array("xyz", (3,), default=[1, 0, 0])
    length = float(np.linalg.norm(along))
    if kind in MOVING and not length:
        raise axis.wrong("xyz", "an axis", "one of length 0")
    turn, slide = kind in ("revolute", "continuous"), kind == "prismatic"
    least, most = (limit.number(end, np.nan) for end in ("lower", "upper"))
    follows = kind in MOVING and joint.find("mimic") is not None
    return Joint(
        parent.text("link"),
        child.text("link"),
        _origin(joint, where),
        np.r_[turn * along, slide * along] / (length or 1),
        (least, most) if least < most else None,
        mimic.text("joint") if follows else "",
        mimic.number("multiplier", 1),
        mimic.number("offset", 0),
    )


def from_root(links: Collection[str], joints: Mapping[str, Joint]) -> list[str]:
    """Return the joints from the root on; ValueError where they make no tree of all links."""
    above: dict[str, str] = {}
    for name, (parent, child, *_) in joints.items():
        if unknown := [link for link in (parent, child) if link not in links]:
            raise ValueError(f"joint {name!r}: no link {unknown[0]!r}")
        if child in above:
            words = f"link {child!r} has a joint to {joints[above[child]].parent!r}"
            raise ValueError(f"joint {name!r}: {words}")
        above[child] = name
    roots = [link for link in links if link not in above]
    if len(roots) > 1:
        got = f"{', '.join(roots)}: join them by fixed joints"
        raise ValueError(f"expected one link that is no joint's child, got {got}")
    order = _sorted("links", {joint.child: joint.parent for joint in joints.values()})
    return [above[link] for link in order]


def following(joints: Mapping[str, Joint]) -> list[str]:
    """Return the joints that follow others, each behind its leader."""
    leaders = {name: joint.leader for name, joint in joints.items() if joint.leader}
    for name, leader in leaders.items():
        if leader not in joints or not np.any(joints[leader].twist):
            words = "is fixed" if leader in joints else "does not exist"
            raise ValueError(f"joint {name!r} follows {leader!r}, which {words}")
    return _sorted("joints", leaders)


def _sorted(kind: str, before: Mapping[str, str]) -> list[str]:
    """Return names, each behind the one before it; raise ValueError for circles."""
    graph = TopologicalSorter({name: [other] for name, other in before.items()})
    try:
        return [name for name in graph.static_order() if name in before]
    except CycleError as error:
        names = ", ".join(sorted({*error.args[1]}))
        raise ValueError(f"{kind} {names} follow each other in a circle") from None
