"""Ten shapes that no constant was tuned on, each near a unit in size, as closed parts.

Parts may overlap: a silhouette is a union. Sizes vary a little from draw to draw.
"""

from collections.abc import Callable

import numpy as np
import trimesh
from trimesh import Trimesh, creation

import pinhole_jax as pj

Random = np.random.Generator


def placed(part: Trimesh, at, angle: float = 0.0, axis=(0, 0, 1)) -> Trimesh:
    """The part, turned about an axis through its middle, then moved."""
    turn = trimesh.transformations.rotation_matrix(np.deg2rad(angle), axis)
    return part.apply_transform(turn).apply_translation(at)


def cuboid(size, at, angle: float = 0.0, axis=(0, 0, 1)) -> Trimesh:
    return placed(creation.box(size), at, angle, axis)


def rod(radius: float, height: float, at, angle: float = 0.0, axis=(1, 0, 0)) -> Trimesh:
    return placed(creation.cylinder(radius, height, sections=32), at, angle, axis)


def ball(radius: float, at, scale=(1, 1, 1)) -> Trimesh:
    part = creation.icosphere(subdivisions=3, radius=radius)
    part.vertices *= scale
    return placed(part, at)


def plate_with_holes(outline: np.ndarray, holes: list[np.ndarray], height: float) -> Trimesh:
    """A flat plate cut out along an outline, with holes."""
    from shapely.geometry import Polygon

    return creation.extrude_polygon(Polygon(outline, holes), height)


def circle(radius: float, at=(0, 0), points: int = 24) -> np.ndarray:
    angle = np.arange(points) * 2 * np.pi / points
    return np.asarray(at) + radius * np.column_stack([np.cos(angle), np.sin(angle)])


def chair(random: Random) -> list[Trimesh]:
    tall = random.uniform(0.9, 1.2)
    legs = [cuboid([0.1, 0.1, 0.8], [x, y, -0.45]) for x in (-0.4, 0.4) for y in (-0.4, 0.4)]
    seat = cuboid([0.95, 0.95, 0.1], [0, 0, 0])
    back = cuboid([0.95, 0.1, tall], [0, 0.42, tall / 2], -6, [1, 0, 0])
    return [*legs, seat, back]


def pliers(random: Random) -> list[Trimesh]:
    opening = random.uniform(8, 18)
    parts = [rod(0.16, 0.2, [0, 0, 0])]
    for side in (1, -1):
        handle = cuboid([0.9, 0.13, 0.14], [-0.45, 0, 0])
        jaw = cuboid([0.5, 0.15, 0.16], [0.3, 0, 0])
        parts.append(placed(handle + jaw, [0, 0, 0.05 * side], side * opening))
    return parts


def gear(random: Random) -> list[Trimesh]:
    teeth = int(random.integers(10, 17))
    angle = np.linspace(0, 2 * np.pi, 8 * teeth, endpoint=False)
    radius = 0.85 + 0.12 * np.clip(3 * np.sin(teeth * angle), -1, 1)
    outline = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    bore = circle(0.3, points=32)
    keyway = np.where((np.abs(bore[:, 1]) < 0.1) & (bore[:, 0] > 0), 0.42, bore[:, 0])
    return [plate_with_holes(outline, [np.column_stack([keyway, bore[:, 1]])], 0.3)]


def bust(random: Random) -> list[Trimesh]:
    turn = random.uniform(-25, 25)
    head = ball(0.38, [0, 0, 0.55], [0.85, 1, 1.2]) + ball(0.09, [0, 0.38, 0.5], [0.8, 1, 1.4])
    shoulders = ball(0.6, [0, 0, -0.35], [1.25, 0.6, 0.6])
    return [placed(head, [0, 0, 0], turn), rod(0.17, 0.5, [0, 0, 0.05]), shoulders]


def bracket_with_three_holes(random: Random) -> list[Trimesh]:
    corners = [(-0.45, -0.3), (0.45, -0.3), (-0.45, 0.3)]
    outline = np.array([(-0.7, -0.5), (0.7, -0.5), (0.7, 0.5), (-0.7, 0.5)])
    holes = [circle(random.uniform(0.1, 0.14), corner) for corner in corners]
    wall = cuboid([0.12, 1.0, 0.7], [-0.64, 0, 0.35])
    return [plate_with_holes(outline, holes, 0.12), wall]


def wing_nut(random: Random) -> list[Trimesh]:
    tilt = random.uniform(20, 40)
    hub = creation.annulus(r_min=0.16, r_max=0.36, height=0.4)
    wings = [
        placed(ball(0.3, [0, 0, 0], [1.1, 0.25, 0.8]), [0.55 * s, 0, 0.2], -s * tilt, [0, 1, 0])
        for s in (1, -1)
    ]
    return [hub, *wings]


def plug(random: Random) -> list[Trimesh]:
    pins = [rod(0.06, 0.5, [0.2 * s, 0, 0.6]) for s in (1, -1)]
    body = rod(0.45, random.uniform(0.5, 0.7), [0, 0, 0.1])
    cable = rod(0.1, 0.7, [0, 0.3, -0.25], 90)
    return [*pins, body, cable]


def shoe(random: Random) -> list[Trimesh]:
    sole = ball(0.5, [0, 0, 0], [1.9, 0.65, 0.16])
    heel = cuboid([0.4, 0.5, random.uniform(0.12, 0.25)], [-0.65, 0, -0.12])
    toe = ball(0.35, [0.5, 0, 0.08], [1.25, 0.85, 0.7])
    ankle = rod(0.3, 0.6, [-0.5, 0, 0.35], 8, [0, 1, 0])
    return [sole, heel, toe, ankle]


def toy_car(random: Random) -> list[Trimesh]:
    wheels = [rod(0.2, 0.15, [x, y, -0.2], 90) for x in (-0.5, 0.5) for y in (-0.42, 0.42)]
    body = cuboid([1.7, 0.8, 0.3], [0, 0, 0])
    cabin = cuboid([0.8, 0.7, 0.32], [random.uniform(-0.25, -0.1), 0, 0.3])
    return [body, cabin, *wheels]


SHAPES: dict[str, Callable[[Random], list[Trimesh]]] = {
    "chair": chair,
    "pliers": pliers,
    "gear with keyway": gear,
    "bust": bust,
    "bracket, a hole missing": bracket_with_three_holes,
    "wing nut": wing_nut,
    "plug": plug,
    "shoe": shoe,
    "toy car": toy_car,
}


def molecule(random: Random) -> pj.Scene:
    """Spheres of three sizes along a bent chain."""
    step = random.normal(size=(7, 3))
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    place = np.cumsum(0.35 * step, axis=0)
    place -= place.mean(axis=0)
    radii = random.choice([0.17, 0.22, 0.3], size=len(place))
    return pj.Scene(spheres=pj.Spheres(np.float32(place), np.float32(radii)))


def scene(name: str, random: Random) -> pj.Scene:
    """A draw of a shape by its name."""
    if name == "molecule":
        return molecule(random)
    parts = trimesh.util.concatenate(SHAPES[name](random))
    return pj.Scene(mesh=pj.Mesh(np.float32(parts.vertices), np.asarray(parts.faces)))


NAMES = (*SHAPES, "molecule")
