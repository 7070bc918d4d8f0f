"""Where a glTF mesh's vertices are: moved by morph targets, then by the joints of a skin."""

from typing import Any

import numpy as np

from .accessors import Accessors
from .json import at, integer, items, wrong


def deformed(
    primitive: dict[str, Any],
    used: np.ndarray,
    weights: list[float],
    accessors: Accessors,
    where: str,
) -> np.ndarray:
    """Return the used vertices (V, 3) of a primitive with its morph targets at their weights."""
    position = integer(primitive["attributes"], "POSITION", f"{where}.attributes")
    points = accessors.floats(position, "VEC3")[used]
    targets = items(primitive, "targets", where)
    if weights and len(weights) != len(targets):
        raise wrong(f"{where}.targets", f"{len(weights)}, as there are weights", len(targets))
    for k, weight in enumerate(weights):
        if not isinstance(targets[k], dict):
            raise wrong(f"{where}.targets[{k}]", "an object", targets[k])
        if weight == 0 or "POSITION" not in targets[k]:
            continue
        index = integer(targets[k], "POSITION", f"{where}.targets[{k}]")
        _check_count(accessors, index, accessors.count(position))
        accessors.spend(points.size, f"{where}.targets[{k}]")
        points = points + weight * accessors.floats(index, "VEC3")[used]
    return points


def skinned(
    points: np.ndarray,
    primitive: dict[str, Any],
    used: np.ndarray,
    top: dict[str, Any],
    node: int,
    worlds: dict[int, np.ndarray],
    accessors: Accessors,
    where: str,
) -> np.ndarray:
    """Return a primitive's used vertices (V, 3) in the world, as the joints of a node's skin have
    them; the node's own transform does not count.
    """
    joints = _joint_matrices(top, node, worlds, accessors)
    attributes = primitive["attributes"]
    count = accessors.count(integer(attributes, "POSITION", f"{where}.attributes"))
    moved, total = np.zeros_like(points), np.zeros(len(points))
    sets = [k for k in range(len(attributes)) if f"JOINTS_{k}" in attributes]
    for k in sets:
        names = [integer(attributes, f"{name}_{k}", where) for name in ("JOINTS", "WEIGHTS")]
        for index in names:
            _check_count(accessors, index, count)
        weights = accessors.floats(names[1], "VEC4")[used]
        numbers = np.where(weights == 0, 0, accessors.vectors(names[0])[used])
        if numbers.size and np.max(numbers) >= len(joints):
            name = f"{where}.attributes.JOINTS_{k}"
            raise wrong(name, f"numbers below {len(joints)}", np.max(numbers))
        for joint, weight in zip(numbers.T, weights.T, strict=True):
            matrix = joints[joint]
            placed = np.einsum("vij,vj->vi", matrix[:, :3, :3], points) + matrix[:, :3, 3]
            moved += weight[:, None] * placed
            total += weight
    if not np.all(total > 0):
        raise wrong(
            f"{where}.attributes", "JOINTS_0 and WEIGHTS_0 for all vertices", "some without"
        )
    return moved / total[:, None]


def _joint_matrices(
    top: dict[str, Any], node: int, worlds: dict[int, np.ndarray], accessors: Accessors
) -> np.ndarray:
    """Return (J, 4, 4): where each joint is, times the inverse of where it was when bound."""
    index = integer(top["nodes"][node], "skin", f"nodes[{node}]")
    if (index, "joints") not in accessors.read:
        found = _joints_of(at(top, "skins", index), f"skins[{index}]", worlds, accessors)
        accessors.read[index, "joints"] = found
    return accessors.read[index, "joints"]


def _joints_of(
    skin: dict[str, Any], where: str, worlds: dict[int, np.ndarray], accessors: Accessors
) -> np.ndarray:
    joints = items(skin, "joints", where)
    for joint in joints:
        if type(joint) is not int or joint not in worlds:
            raise wrong(f"{where}.joints", "nodes of the scene", joint)
    matrices = np.array([worlds[joint] for joint in joints]).reshape(-1, 4, 4)
    if "inverseBindMatrices" not in skin:
        return matrices
    inverse = accessors.floats(integer(skin, "inverseBindMatrices", where), "MAT4")
    if len(inverse) < len(joints):
        raise wrong(f"{where}.inverseBindMatrices", f"{len(joints)} matrices", len(inverse))
    return matrices @ np.swapaxes(inverse[: len(joints)].reshape(-1, 4, 4), -1, -2)


def _check_count(accessors: Accessors, index: int, count: int) -> None:
    if accessors.count(index) != count:
        raise wrong(f"accessors[{index}].count", f"{count}, as POSITION", accessors.count(index))
