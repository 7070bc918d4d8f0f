"""A URDF's XML, checked and cut down to what yourdfpy reads right: shapes that are seen, joints.

yourdfpy moves only joints that follow a free one, and slides along an axis as long as it is
written. It leaves out macros that xacro did not expand, and stops at unknown shapes.
"""

import math
import re
from collections.abc import Collection
from typing import Any

#: The shapes, and the attributes that elements must have.
SHAPES: dict[str, tuple[str, ...]] = {
    "box": ("size",),
    "cylinder": ("radius", "length"),
    "mesh": ("filename",),
    "sphere": ("radius",),
}
NEEDED: dict[str, tuple[str, ...]] = {
    **SHAPES,
    "link": ("name",),
    "joint": ("name", "type"),
    "parent": ("link",),
    "child": ("link",),
    "mimic": ("joint",),
}
#: How many numbers attributes are; sizes are positive.
NUMBERS = {"xyz": 3, "rpy": 3, "size": 3, "scale": 3, "radius": 1, "length": 1}
NUMBERS |= {"multiplier": 1, "offset": 1, "lower": 1, "upper": 1}
SIZES = ("size", "radius", "length")
READ = {"robot", "visual", "geometry", "origin", "axis", "limit", *NEEDED}
#: Elements that xacro once had without a prefix, and those that describe no link or joint anew.
OLD_XACRO = ("macro", "include", "property", "if", "unless", "arg", "insert_block")
OTHERS = ("gazebo", "transmission", "ros2_control", "sensor")
MOVING = ("revolute", "continuous", "prismatic")


def plain_urdf(data: bytes, leave_out: Collection[str]) -> bytes:
    """Return the URDF without links' shapes that are left out, and without what is not seen.

    Raises ValueError, which names the link or joint.
    """
    from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

    root = _root(data)
    _check_groups(root)
    root.set("name", root.get("name") or "robot")  # which yourdfpy wants, and nobody reads
    collisions = root.find("link/collision") is not None
    for element in [*root.iter()]:
        shape = element.getparent() is not None and element.getparent().tag == "geometry"
        left_out = element.tag == "visual" and element.getparent().get("name") in leave_out
        if left_out or not (element.tag in READ or shape):
            element.getparent().remove(element)

    links, joints = _named(root, "link"), _named(root, "joint")
    if not links:
        raise ValueError("no <link> in <robot>, expected at least one")
    _check_tree(links, joints)
    _follow(joints)
    if root.find("link/visual") is None:
        words = "; <collision> shapes are not drawn: copy them as <visual>" if collisions else ""
        raise ValueError(f"no link has a <visual> shape{words}")
    return etree.tostring(root)


def _root(data: bytes) -> Any:
    """The file's <robot> element, tags without namespaces; ValueError for xacro and other files."""
    from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

    parser = etree.XMLParser(
        recover=True, resolve_entities=False, remove_comments=True, remove_pis=True
    )
    root = etree.fromstring(data, parser)
    # (Simulators' elements with prefixes that nobody declared are common, and not read.)
    faults = [fault for fault in parser.error_log if fault.domain_name != "NAMESPACE"]
    if root is None or faults:
        raise ValueError(f"no XML: {faults[0].message if faults else 'empty'}")
    for element in root.iter():
        name = re.split("[}:]", element.tag)[-1]
        if "xacro" in element.tag:
            _refuse_xacro(f"<xacro:{name}>")
        element.tag = name
    if root.tag != "robot":
        raise ValueError(f"<{root.tag}> in place of <robot>: export the robot as URDF")
    return root


def _check_groups(root: Any) -> None:
    """Check that links and joints lie in <robot> itself, where they are read."""
    for group in root:
        if group.tag in OLD_XACRO:
            _refuse_xacro(f"<{group.tag}>")
        if group.tag in ("link", "joint", *OTHERS):
            continue
        for part in group.iter("link", "joint"):
            if part.tag == "link" or part.find("parent") is not None:
                raise ValueError(
                    f"{part.tag} {part.get('name')!r} is in <{group.tag}>, which no URDF has:"
                    " run `xacro robot.urdf.xacro > robot.urdf` if xacro makes it and load"
                    f" robot.urdf, else move what is in <{group.tag}> to <robot>"
                )


def _refuse_xacro(words: str) -> None:
    raise ValueError(
        f"xacro that is not expanded, {words}: run `xacro robot.urdf.xacro > robot.urdf` and load"
        " robot.urdf"
    )


def _named(root: Any, kind: str) -> dict[str, Any]:
    """Return the links or joints by name, all that is in them checked."""
    named: dict[str, Any] = {}
    for element in root.findall(kind):
        name = element.get("name")
        for part in element.iter():
            _read_attributes(part, f"{kind} {name!r}")
        for visual in element.findall("visual"):
            _check_shape(visual, name)
        if name in named:
            raise ValueError(f"two of {kind} {name!r}")
        named[name] = element
    return named


def _read_attributes(element: Any, where: str) -> None:
    """Check an element's attributes, write its numbers in Python's form, drop those not read."""
    for name in NEEDED.get(element.tag, ()):
        if not element.get(name):
            raise ValueError(f"{where}: <{element.tag}> without `{name}`")
    for name in {"effort", "velocity"} & {*element.attrib}:  # of a limit: not read
        del element.attrib[name]
    for name, text in element.attrib.items():
        if "${" in text or "$(" in text:
            _refuse_xacro(f"{name}={text!r} of {where}")
        if name in NUMBERS:
            element.set(name, " ".join(map(repr, _numbers(element, name, where))))


def _numbers(element: Any, name: str, where: str = "", default: str = "0") -> list[float]:
    text, count = element.get(name, default), NUMBERS[name]
    try:
        numbers = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    right = len(numbers) == count or (name == "scale" and len(numbers) == 1)
    positive = all(x > 0 for x in numbers) or name not in SIZES
    if not (right and all(map(math.isfinite, numbers)) and positive):
        kind = "positive" if name in SIZES else "finite"
        words = f"{count} {kind} number{'s' * (count > 1)}"
        raise ValueError(f"{where}: expected {words} in {name} of <{element.tag}>, got {text!r}")
    return numbers


def _check_shape(visual: Any, link: str) -> None:
    shapes = [shape.tag for shape in visual.iterfind("geometry/*")]
    if len(shapes) != 1 or shapes[0] not in SHAPES:
        known, got = ", ".join(SHAPES), ", ".join(f"<{tag}>" for tag in shapes) or "none"
        raise ValueError(
            f"link {link!r}: expected one shape in the <geometry> of <visual> ({known}), got {got};"
            f" change it, or load the robot with `leave_out=[{link!r}]`"
        )


def _check_tree(links: dict[str, Any], joints: dict[str, Any]) -> None:
    """Check that joints are of kinds that an angle moves, and that they make one tree."""
    parents: dict[str, str] = {}
    for name, joint in joints.items():
        _check_joint(joint, name)
        parent, child = (joint.find(end).get("link") for end in ("parent", "child"))
        if unknown := [link for link in (parent, child) if link not in links]:
            raise ValueError(f"joint {name!r}: no link {unknown[0]!r}")
        if child in parents:
            raise ValueError(f"joint {name!r}: link {child!r} has a joint to {parents[child]!r}")
        parents[child] = parent
    roots = [link for link in links if link not in parents]
    if len(roots) != 1:
        got = f"{', '.join(roots)}: join them by fixed joints" if roots else "a circle of joints"
        raise ValueError(f"expected one link that is no joint's child, got {got}")
    reached = set(roots)
    for _ in joints:
        reached |= {child for child, parent in parents.items() if parent in reached}
    if circle := [link for link in links if link not in reached]:
        raise ValueError(f"link {circle[0]!r} is in a circle of joints")


def _check_joint(joint: Any, name: str) -> None:
    kind = joint.get("type")
    if kind in ("floating", "planar"):
        raise ValueError(
            f"joint {name!r} is {kind}, which no angle describes: make it fixed in the file, with"
            " its place as <origin>"
        )
    if kind not in (*MOVING, "fixed"):
        raise ValueError(f"joint {name!r}: expected {', '.join(MOVING)} or fixed, got {kind!r}")
    if missing := [end for end in ("parent", "child") if joint.find(end) is None]:
        raise ValueError(f"joint {name!r}: expected a parent and a child, got no {missing[0]}")
    axis = joint.find("axis")
    if kind in MOVING and axis is not None:
        own = _numbers(axis, "xyz", default="1 0 0")
        if not any(own):
            raise ValueError(f"joint {name!r}: expected an axis, got one of length 0")
        axis.set("xyz", " ".join(repr(x / math.hypot(*own)) for x in own))


def _follow(joints: dict[str, Any]) -> None:
    """Let each joint that follows another name the free joint that it follows in the end."""
    for name, joint in joints.items():
        mimic = joint.find("mimic")
        if mimic is None:
            continue
        if joint.get("type") == "fixed":
            joint.remove(mimic)
            continue
        leader, chain, factor, offset = name, [], 1.0, 0.0
        while (step := joints[leader].find("mimic")) is not None:
            chain.append(leader)
            offset += factor * _numbers(step, "offset")[0]
            factor *= _numbers(step, "multiplier", default="1")[0]
            leader = step.get("joint")
            if leader not in joints or joints[leader].get("type") == "fixed":
                kind = "is fixed" if leader in joints else "does not exist"
                raise ValueError(f"joint {chain[-1]!r} follows {leader!r}, which {kind}")
            if leader in chain:
                raise ValueError(f"joints {', '.join(chain)} follow each other in a circle")
        mimic.set("joint", leader)
        mimic.set("multiplier", repr(factor))
        mimic.set("offset", repr(offset))
