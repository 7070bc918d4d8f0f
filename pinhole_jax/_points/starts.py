"""Where views of points begin, and where else their points would look much the same."""

import numpy as np

from .._camera.axes import axes_of
from .._camera.camera import Camera
from .reprojection import PointView
from .resection import plane_of, resect, resect_three, shift, turn

#: Draws of few points. Where 40 % are outliers 1 draw of 6 points in 21 has none, so 95 % of
#: searches meet one; with draws of 4, or fewer outliers, all do.
DRAWS = 64
#: Points of a draw that are not of a plane, and that are.
FEW, FEW_OF_PLANE = 6, 4
#: Up to this many points are few: direct solutions by all of them may fail, and solutions by three
#: are added, from this many triangles at most.
SCANT, TRIANGLES = 8, 6
#: What finds a part of the pose, the rest being known.
PARTS = {"position": shift, "orientation": turn}


def begin(view: PointView, robust: bool) -> PointView:
    """The view from its own camera, or from where direct solutions say, what is nearer; if
    `robust` by half of the points (least median of squares, Rousseeuw 1984), else by all."""
    if view.bounds is not None:
        view = view.stepped(np.zeros(view.moves))
    places = [view, *map(view.posed, _direct(view, robust))]
    return min(places, key=lambda place: _distance(place, robust))


def _distance(view: PointView, robust: bool) -> float:
    """The distance of points (px) from where they are seen: of the middle one, or all together."""
    off = view.distances()[view.counts]
    return float(np.median(off) if robust else np.sum(off**2))


def _direct(view: PointView, robust: bool) -> list[Camera]:
    """Cameras that direct solutions find, of all points, and of few drawn at random."""
    points, seen_at = view.in_heights(view.counts)
    by_part = [way for name, way in PARTS.items() if name in view.freed]
    if by_part or "pose" not in view.freed:
        return [way(view.start, points, seen_at) for way in by_part]
    draws = [np.arange(len(points))]
    if robust:
        few = FEW if plane_of(points) is None else FEW_OF_PLANE
        random = np.random.default_rng(0)
        draws += [random.permutation(len(points))[:few] for _ in range(DRAWS)]
    found = [resect(view.start, points[some], seen_at[some]) for some in draws]
    if is_few(view):
        found += three_point_cameras(view, view.start)
    return [camera for camera in found if camera is not None]


def is_few(view: PointView) -> bool:
    """Whether few different points count, so that poses of three of them are starts, too."""
    return len(view.different(view.counts, and_seen=False)) <= SCANT


def three_point_starts(view: PointView) -> list[PointView]:
    """The view from where three of its points are met, its lens as it is, the best first."""
    places = map(view.posed, three_point_cameras(view, view.camera))
    return sorted(places, key=lambda place: _distance(place, False))


def three_point_cameras(view: PointView, camera: Camera) -> list[Camera]:
    """A camera in all poses that three of the points have, of large triangles; of many
    points, some that are spread evenly among them."""
    counts = view.different(view.counts, and_seen=False)
    some = counts[np.unique(np.linspace(0, len(counts) - 1, SCANT).round().astype(int))]
    return resect_three(camera, *view.in_heights(some), TRIANGLES) if len(some) > 2 else []


def reversed_depths(view: PointView) -> PointView | None:
    """The view from where a plane's points look the same but for their perspective, their
    depths reversed (Necker's cube); None where points are of no plane.

    Half a turn about the plane's normal, then half a turn about the line of sight, leave each point
    where it is seen from far away.
    """
    plane = plane_of(view.in_heights(view.counts)[0])
    if plane is None:
        return None
    middle, normal = plane
    away = np.asarray(view.camera.e, float) - middle
    sight = away / np.linalg.norm(away)
    about_normal, about_sight = (2 * np.outer(x, x) - np.eye(3) for x in (normal, sight))
    turned = about_normal @ about_sight
    axes = axes_of(view.camera) @ turned.T
    return view._replace(camera=view.camera.with_pose(middle + turned @ away, axes))
