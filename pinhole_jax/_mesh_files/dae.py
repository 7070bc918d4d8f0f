"""Collada (.dae), by pycollada: polygons where the scene's nodes place them, in metres.

Lengths are multiplied by the file's `<unit>`. Axes are the file's: `<up_axis>` turns nothing, as in
the programs that robots' meshes are made for.
"""

import io
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np

from .polygons import NOTHING, Polygons, merge

#: What makes no shape and may be broken, and shapes that are not read.
NO_SHAPE = ("animations", "cameras", "effects", "images", "lights", "materials")
LEFT_OUT = ("bind_material", "instance_camera", "instance_light")
UNREAD = ("instance_controller", "ph", "spline", "convex_mesh")
#: A small file can stand for more nodes than these: instances of instances.
MOST_NODES = 1 << 16


def read_dae(data: bytes) -> Polygons:
    """Return the polygons of a Collada file's scene.

    Raises ValueError for skins and morphs, polygons with holes, and what pycollada refuses.
    """
    try:
        from collada import Collada
        from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]
    except ModuleNotFoundError as error:
        raise ValueError(
            f"Collada is read by pycollada and lxml ({error}): pip install 'pinhole-jax[robots]'"
        ) from None

    parser = etree.XMLParser(resolve_entities=False, huge_tree=True)
    root = etree.fromstring(data, parser)
    libraries = (f"library_{name}" for name in NO_SHAPE)
    etree.strip_elements(root, *(f"{{*}}{name}" for name in (*libraries, *LEFT_OUT)))
    unread = next(root.iter(*(f"{{*}}{name}" for name in UNREAD)), None)
    if unread is not None:
        raise ValueError(f"<{etree.QName(unread).localname}> is not read: skins, holes or curves")

    unit = next(root.iterfind("{*}asset/{*}unit"), None)
    metres = 1.0 if unit is None else float(unit.get("meter", 1))
    if not 0 < metres < np.inf:
        raise ValueError(f"expected a positive <unit meter>, got {metres}")
    # (It reads numbers up to the first that is none, and says so by this warning of NumPy.)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "string or file could not be read", DeprecationWarning)
        document = Collada(io.BytesIO(etree.tostring(root)))
    if document.scene is None:
        raise ValueError("no <scene>")

    scale = np.diag([metres, metres, metres, 1])
    return merge(
        (_polygons(primitive), scale @ place)
        for geometry, place in _instances(document.scene.nodes)
        for primitive in geometry.primitives
    )


def _instances(nodes: list[Any]) -> Iterator[tuple[Any, np.ndarray]]:
    """Yield the scene's geometries and their places (4, 4)."""
    waiting, number = [(node, np.eye(4)) for node in reversed(nodes)], 0
    while waiting:
        node, place = waiting.pop()
        number += 1
        if number > MOST_NODES:
            raise ValueError(f"expected at most {MOST_NODES} nodes, got more")
        if hasattr(node, "geometry"):
            yield node.geometry, place
        elif hasattr(node, "children"):
            within = place @ node.matrix
            waiting += [(child, within) for child in reversed(node.children)]


def _polygons(primitive: Any) -> Polygons:
    """Return the polygons of one element; lines have none."""
    from collada.lineset import LineSet

    corners = primitive.vertex_index
    if corners is None or isinstance(primitive, LineSet):
        return NOTHING
    counts = getattr(primitive, "vcounts", np.full(len(corners), 3))
    if np.sum(counts) != corners.size:
        raise ValueError("expected as many indices as polygons have corners")
    points = np.asarray(primitive.vertex, float)
    return Polygons(points, corners.ravel().astype(int), counts.astype(int))
