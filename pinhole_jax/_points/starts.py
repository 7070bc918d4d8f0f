"""Where views of points begin, and where else a plane's points would look much the same."""

import numpy as np

from .._camera.axes import axes_of
from .._camera.camera import Camera
from .._solver.moves import canonical
from .._solver.parameters import components
from .resection import plane_of, resected
from .views import PointView

#: Draws of few points. Where 40 % are outliers 1 draw of 6 points in 21 has none, so 95 % of
#: searches meet one; with draws of 4, or fewer outliers, all do.
DRAWS = 64
#: Points of a draw that are not of a plane, and that are.
FEW, FEW_OF_PLANE = 6, 4


def begun(view: PointView, robust: bool) -> PointView:
    """Return the view from its own camera, or from where direct solutions say, what is nearer; if
    `robust` by half of the points (least median of squares, Rousseeuw 1984), else by all."""
    view = inside(view)
    cameras = _direct(view, robust) if "pose" in view.freed else []
    places = [view, *(inside(view._replace(camera=canonical(c))) for c in cameras)]
    return min(places, key=lambda place: _distance(place, robust))


def _distance(view: PointView, robust: bool) -> float:
    """Return how far off points are (px): their middle one, or all together."""
    off = view.distances()[view.weight > 0]
    return float(np.median(off) if robust else np.sum(off**2))


def _direct(view: PointView, robust: bool) -> list[Camera]:
    """Return cameras that direct solutions find, of all points, and of few drawn at random."""
    counts = np.flatnonzero(view.weight > 0)
    draws = [counts]
    if robust:
        few = FEW if plane_of(view.points[counts]) is None else FEW_OF_PLANE
        random = np.random.default_rng(0)
        draws += [random.permutation(counts)[:few] for _ in range(DRAWS)]
    found = [resected(view.film, view.points[some], view.seen_at[some]) for some in draws]
    return [camera for camera in found if camera is not None]


def inside(view: PointView) -> PointView:
    """Return the view from within its bounds."""
    return view if view.bounds is None else view.stepped(np.zeros(len(components(view.freed))))


def seen_from_behind(view: PointView) -> PointView | None:
    """Return the view from where a plane's points look the same but for their perspective, their
    depths reversed (Necker's cube); None where points are of no plane.

    Half a turn about the plane's normal, then half a turn about the line of sight, leave each point
    where it is seen from far away.
    """
    plane = plane_of(view.points[view.weight > 0])
    if plane is None:
        return None
    middle, normal = plane
    eye, axes = np.asarray(view.camera.e, float), axes_of(view.camera)
    sight = (eye - middle) / np.linalg.norm(eye - middle)
    turned = _half_turn(normal) @ _half_turn(sight)
    camera = view.camera.with_pose(middle + turned @ (eye - middle), axes @ turned.T)
    return view._replace(camera=camera)


def _half_turn(axis: np.ndarray) -> np.ndarray:
    return 2 * np.outer(axis, axis) - np.eye(3)
