"""Something stands before the object, and nobody said so: which part of the mask's outline is its?

An occluder only takes away from a mask. Where it ends, the mask has an edge that is no edge of the
object's, and lies inside the object's outline; the outline that it hides lies outside the mask. So
points of the mask's edge are brought to the outline that a camera sees (iterative closest points,
Besl and McKay 1992), in and out by stretches: what lies inside the outline, and far from it, loses
its weight, and the more so the nearer the fit has come (graduated non-convexity, Blake and
Zisserman 1987); what lies outside keeps its weight, since nothing that hides can put it there.
Outline beside which the mask has none costs nothing at first. Several hypotheses about which part
is hidden are followed; the one that explains most of the mask's edge is told.
"""

from collections.abc import Iterable
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from .._camera.axes import angle
from .._camera.camera import Camera
from .._files.progress import say
from .._mask.mask import Mask
from .._mask.search import partly_hidden
from .._mask.target import as_coverage, inside_of
from .._solver.moves import canonical
from .._solver.solver import Solver
from .._solver.stretches import coverage_of, outline_pixels, smoothed_about

#: The mask's edge is taken by stretches of this share of the object's size.
STRETCH = 0.08
#: This many points of the mask's edge are brought to the outline; at most this many tell what is
#: hidden (a mask of noise has millions).
POINTS, MOST_POINTS = 400, 20_000
#: Its normals are those of a mask that is smoothed over this many px.
SMOOTH_PX = 2
#: How far away an edge still counts: in the first step this share of the object's size, in the last
#: this many px; in this many steps, the first few to sort out the likely ones.
FIRST, LAST_PX, STEPS, SORTED_IN = 0.12, 1.0, 20, 6
#: This many of the likeliest are followed to the end.
FOLLOWED = 12
#: A step moves no part of the outline by more than this share of the object's size.
LONGEST = 0.3
#: Directions in which something may stand, and which share of the edge it may take there.
SECTORS, TAKEN = 8, 0.35
#: Guesses that a search tries for each of them.
GUESSES = 20
#: Edge and outline are one if they are so near (px), or this many times the mask's errors, and turn
#: by less than an angle with this cosine.
NEAR_PX, NEAR_SIZES, TURNED = 2.0, 3.0, 0.5
#: Of the mask's edge so much is told by no camera, and at most so much lies outside of it, or may
#: outline that is hidden lie where nothing hides it.
LEAST_HIDDEN, MOST_BEYOND = 0.05, 0.05
#: So much about what is hidden (a share of the object's size) is not told either.
ROOM = 0.1
#: Which edge is the nearest is asked of this many blocks each way (pixels of a photo this large).
BLOCKS = 256
#: Of guesses that were brought near the likely ones are those whose edge is close: within this
#: share of the object's size. (As far as these steps let an edge count, everything is near: of 136
#: guesses at a bracket, a third of whose edge was an occluder's, the right ones were 55th and 56th;
#: so they are first.)
NEAR_SHARE = 0.02
#: A camera that explains less of the mask's edge than this is not believed.
LEAST_EXPLAINED = 0.5
#: ... and one that explains less than this, or has more beyond, not without a doubt; nor
#: one from whose outline the rest of the edge lies so far across it (px, root mean square). Pixels
#: of a hard mask leave 0.16 to 0.35 of it behind real occluders (144 masks; median 0.24), other
#: views of a bracket, that explain as much of its edge, 0.39 to 0.55 (but for twins of the right
#: one). So masks that err by more and are covered are never told without a doubt.
SURE, SURE_BEYOND, SURE_PX = 0.6, 0.02, 0.35
#: Another camera, so far away (rad), that explains as much but for this share is a rival.
RIVAL, ELSEWHERE = 0.06, np.deg2rad(3)


class Edge(NamedTuple):
    """The points of a mask's edge: where they are (n, 2) (px, film coordinates), the normals (n, 2)
    outwards, which of them make stretches (a sparse mean (n, n)), and the object's size (px)."""

    at: np.ndarray
    out: np.ndarray
    stretch: Any
    size: float


class Covered(NamedTuple):
    """A camera that explains a mask but for what stands before the object.

    - `explained`: which share of the mask's edge lies on the outline.
    - `agreed`: the same, but that a point counts for less the farther it is from the outline.
    - `beyond`: which share of edge and outline nothing that hides the object explains.
    - `off`: how far (px, root mean square) what is explained lies from the outline.
    - `hidden` (H, W): what the mask does not tell; `edge` (n, 2): the points (px, film coordinates)
      of the mask's edge that are no edge of the object's.
    - `rivals`: other cameras that explain as much.
    """

    camera: Camera
    explained: float
    agreed: float
    beyond: float
    off: float
    hidden: np.ndarray
    edge: np.ndarray
    rivals: tuple[Camera, ...] = ()

    def __str__(self) -> str:
        """Return it as a sentence."""
        x, y = self.edge[np.argmin(np.linalg.norm(self.edge - np.median(self.edge, 0), axis=1))]
        row = len(self.hidden) - 1 - int(y)
        return (
            f"{1 - self.explained:.0%} of the mask's edge, about column {int(x)}, row {row}, was"
            " not believed: something stands before the object there"
        )


class _Outline(NamedTuple):
    """Points of the outline that a camera sees (n, 2), px, normals (n, 2) outwards, and how far
    these go outwards by the solver's moves (n, k)."""

    at: np.ndarray
    out: np.ndarray
    by_move: np.ndarray


class _Matched(NamedTuple):
    """How far (px) points of an edge lie outside the outline, and how far across it (an outline is
    known at points that are a pixel apart), by moves, whether they turn alike."""

    off: np.ndarray
    across: np.ndarray
    by_move: np.ndarray
    alike: np.ndarray


def edge_of(mask: Mask, most: int = MOST_POINTS) -> Edge:
    """Return a mask's edge: where it passes 1/2 between two pixels that count; some points of it
    where there are more than `most`."""
    from scipy.ndimage import gaussian_filter
    from scipy.sparse import csr_matrix
    from scipy.spatial import KDTree

    box, H = _about(inside_of(mask.target), SMOOTH_PX * 5), len(mask.target)
    image, weighs = as_coverage(mask.target[box]), mask.weight[box] > 0
    smooth: Any = gaussian_filter(image, SMOOTH_PX)
    down, right = np.gradient(smooth)
    places, normals = [], []
    for axis in (0, 1):
        low, high = (np.moveaxis(image, axis, 0)[s] for s in (slice(None, -1), slice(1, None)))
        there = np.moveaxis(np.argwhere((low > 0.5) != (high > 0.5)), 1, 0)
        share = (0.5 - low[tuple(there)]) / (high - low)[tuple(there)]
        one = there[::-1] if axis else there
        step = np.array([[axis == 0], [axis == 1]])
        known = weighs[tuple(one)] & weighs[tuple(one + step)]
        row, column = (one + step * share)[:, known] + [[box[0].start], [box[1].start]]
        places.append(np.column_stack([column + 0.5, H - 0.5 - row]))
        y, x = (z[tuple(one[:, known])] for z in (down, right))
        normals.append(np.column_stack([-x, y]))
    at, out = np.concatenate(places), _units(np.concatenate(normals))
    size = float(np.sqrt(np.count_nonzero(image > 0.5)))
    if len(at) > most:
        some = np.random.default_rng(0).permutation(len(at))[:most]
        at, out = at[some], out[some]
    radius = max(STRETCH * size, 3.0)
    pairs = KDTree(np.column_stack([at, radius * out])).query_pairs(radius, output_type="ndarray")
    own = np.arange(len(at))
    a, b = (np.concatenate([*x, own]) for x in (pairs.T, pairs.T[::-1]))
    beside = csr_matrix((np.ones(len(a)), (a, b)), shape=(len(at), len(at)))
    counts = beside @ np.ones(len(at))
    return Edge(at, out, csr_matrix(beside.multiply(1 / counts[:, None])), size)


def uncovered(
    solver: Solver,
    mask: Mask,
    plain: Camera,
    cameras: Iterable[Camera],
    anywhere: bool,
    error_px: float,
) -> Covered | None:
    """Return the camera that explains most of a mask's edge if something that nobody told of stands
    before the object, None if nothing does or none is to be believed.

    Something does if a stretch of the mask's edge lies far from the outline that the `plain` fit's
    camera sees. It is looked for from some cameras (canonical); with `anywhere`, or where none of
    these leads to one that is sure, from all sides. The mask's edge errs by `error_px` (one
    standard deviation).
    """
    edge = edge_of(mask, POINTS)
    few = len(edge.at) < 4 * len(solver.freed) + 16
    if few or not _is_covered(solver, edge, plain, _near(error_px)):
        return None
    whole = edge_of(mask)
    explained = lambda begins: _explained(solver, mask, edge, whole, begins, error_px)
    begins = [(c, w) for c in cameras for w in (None, *_sectors(edge))]
    found = [] if anywhere else explained(begins)
    if not found or not is_sure(found[0]):
        begins = _guessed(solver, mask, edge) + (begins if anywhere else [])
        found += explained(begins)
        found.sort(key=_worth, reverse=True)
    if not found or not is_trusted(found[0]):
        return None
    best, *others = found
    rivals: list[Camera] = []
    for other in others:
        as_much = _worth(other) > _worth(best) - RIVAL
        if as_much and all(angle(other.camera, c) > ELSEWHERE for c in (best.camera, *rivals)):
            rivals.append(other.camera)
    return best._replace(rivals=tuple(rivals))


def _explained(
    solver: Solver,
    mask: Mask,
    edge: Edge,
    whole: Edge,
    begins: list[tuple[Camera, np.ndarray | None]],
    error_px: float,
) -> list[Covered]:
    """Return what the cameras explain that others lead to, the one that explains most first."""
    ended = _followed(solver, edge, begins)
    reported = [covered_at(solver, mask, whole, camera, error_px) for camera in ended]
    return sorted((t for t in reported if t is not None), key=_worth, reverse=True)


def _near(error_px: float) -> float:
    """Return how near (px) edge and outline are one, of a mask that errs by so much."""
    return max(NEAR_PX, NEAR_SIZES * error_px)


def _is_covered(solver: Solver, edge: Edge, camera: Camera, near: float) -> bool:
    """Return whether a stretch of a mask's edge lies far from the outline that a camera sees."""
    outline = _seen(solver, camera, solver.finest)
    if outline is None:
        return False
    on = _on(_matched(edge, outline, 8.0), near)
    return bool(np.mean(edge.stretch @ on < 0.5) > LEAST_HIDDEN)


def _worth(covered: Covered) -> float:
    return covered.agreed - 2 * covered.beyond


def is_sure(covered: Covered) -> bool:
    """Return whether a camera explains so much that it is told without a doubt."""
    much = covered.explained >= SURE and covered.beyond < SURE_BEYOND
    return much and covered.off < SURE_PX


def is_trusted(covered: Covered) -> bool:
    """Return whether a camera explains a mask but for what an occluder hides."""
    hidden = 1 - covered.explained
    enough = covered.explained >= LEAST_EXPLAINED and hidden > LEAST_HIDDEN
    return enough and covered.beyond < MOST_BEYOND


def _sectors(edge: Edge) -> list[np.ndarray]:
    """Return weights (n,) of the mask's edge, each without the part on one side."""
    away = edge.at - edge.at.mean(axis=0)
    turns = 2 * np.pi * np.arange(SECTORS) / SECTORS
    along = [away @ [np.cos(turn), np.sin(turn)] for turn in turns]
    return [(far < np.quantile(far, 1 - TAKEN)) * 1.0 for far in along]


def _guessed(solver: Solver, mask: Mask, edge: Edge) -> list[tuple[Camera, np.ndarray | None]]:
    """Return cameras from all sides, with what of the mask's edge they take for the object's."""
    directions = [None, *(2 * np.pi * np.arange(SECTORS) / SECTORS)]
    windows = [None, *_sectors(edge)]
    views = partly_hidden(mask, solver.subject.from_afar, solver.subject.ball, directions)
    return [
        (canonical(guess), window)
        for guesses, window in zip(views, windows, strict=True)
        for guess in islice(guesses, GUESSES)
    ]


def _followed(
    solver: Solver, edge: Edge, begins: list[tuple[Camera, np.ndarray | None]]
) -> list[Camera]:
    """Return where the likeliest cameras lead to."""
    level = min(solver.far, max(solver.finest - 1, 0))
    scales = np.maximum(np.geomspace(FIRST * edge.size, LAST_PX, STEPS), LAST_PX)
    first, rest = scales[:SORTED_IN], scales[SORTED_IN:]
    begun = []
    for k, (camera, window) in enumerate(begins, 1):
        say(f"looking for something in front of the object: guess {k} of {len(begins)}")
        begun.append(_brought(solver, edge, camera, level, first, window))
    begun = sorted((b for b in begun if b is not None), key=lambda b: -b[1])
    apart = _apart([camera for camera, _ in begun], np.deg2rad(2))[:FOLLOWED]
    ended = [_brought(solver, edge, camera, level, rest) for camera in apart]
    ended = sorted((b for b in ended if b is not None), key=lambda b: -b[1])
    finest = _apart([camera for camera, _ in ended], np.deg2rad(0.5))[: FOLLOWED // 2]
    last = [_brought(solver, edge, camera, solver.finest, scales[-4:]) for camera in finest]
    return [b[0] for b in last if b is not None]


def _apart(cameras: list[Camera], far: float) -> list[Camera]:
    distinct: list[Camera] = []
    for camera in cameras:
        if all(angle(camera, other) > far for other in distinct):
            distinct.append(camera)
    return distinct


def _brought(
    solver: Solver,
    edge: Edge,
    camera: Camera,
    level: int,
    scales: np.ndarray,
    window: np.ndarray | None = None,
) -> tuple[Camera, float] | None:
    """Return a camera whose outline the mask's edge was brought to, counting as far as `scales`
    (px) say step by step, and how close the edge is to it; None where no outline is seen."""
    for scale in scales:
        outline = _seen(solver, camera, level)
        if outline is None:
            return None
        matched = _matched(edge, outline, 4 * scale + 4)
        weight = _weights(edge, matched, scale)
        weight = weight if window is None else weight * window
        rows = matched.by_move * np.sqrt(weight)[:, None]
        normal = rows.T @ rows
        damping = 1e-3 * np.trace(normal) / len(normal) + 1e-12
        step = np.linalg.solve(
            normal + damping * np.eye(len(normal)), rows.T @ (np.sqrt(weight) * matched.off)
        )
        if not np.all(np.isfinite(step)):
            return None
        far = float(np.max(np.abs(matched.by_move @ step)))
        camera = solver.step(camera, level, step * min(1.0, LONGEST * edge.size / max(far, 1e-9)))
    outline = _seen(solver, camera, level)
    if outline is None:
        return None
    matched, near = _matched(edge, outline, 8.0), max(NEAR_SHARE * edge.size, NEAR_PX)
    close = _closeness(matched.off, near) * (matched.alike > TURNED)
    beyond = float(np.mean(matched.off > 2 * near))
    return camera, float(np.mean((edge.stretch @ close) * close)) - 0.5 * beyond


def _closeness(off: np.ndarray, near: float) -> np.ndarray:
    """Return how close points so far away are: 1 on an outline, 0 from `near` on."""
    return np.clip(1 - (off / near) ** 2, 0, 1)


def _on(matched: _Matched, near: float) -> np.ndarray:
    return (np.abs(matched.off) < near) & (matched.alike > TURNED)


def _weights(edge: Edge, matched: _Matched, scale: float) -> np.ndarray:
    """Return what points of an edge count for: by stretches, and those outside in any case."""
    off = matched.off / scale
    weight = (1 + off**2) ** -2 * np.where(matched.alike > TURNED, 1, 0.1)
    weight = (edge.stretch @ weight) / (1 + off**2 / 9)
    return np.where(off > 0, np.maximum(weight, 1 / (1 + np.abs(off))), weight)


def _matched(edge: Edge, outline: _Outline, turn_px: float) -> _Matched:
    """Return the edge's points with the nearest of an outline, a turn by a rad being as far as
    `turn_px`."""
    from scipy.spatial import KDTree

    place = lambda x: np.column_stack([x.at, turn_px * x.out])
    nearest: Any = KDTree(place(outline)).query(place(edge))[1]
    at, out = outline.at[nearest], outline.out[nearest]
    away = edge.at - at
    across = np.sum(away * out, axis=1)
    off = np.copysign(np.maximum(np.abs(across), np.linalg.norm(away, axis=1)), across)
    return _Matched(off, across, outline.by_move[nearest], np.sum(edge.out * out, axis=1))


def _seen(solver: Solver, camera: Camera, number: int) -> _Outline | None:
    """Return the outline that a camera sees on a level, None where it sees none."""
    view = solver.look(camera, number)
    place, rows, share = outline_pixels(view)
    if len(place) < 8 or not np.all(np.isfinite(rows)):
        return None
    level, about = view.level, smoothed_about(view, place, rows)
    px = len(solver.target) / float(level.scale)
    out = _units(-about.slope)
    by_move = about.rows / np.maximum(about.steepness, 1e-3)[:, None]
    at = place[:, ::-1] + 0.5 + np.asarray(level.origin, float)
    return _Outline(px * (at + out * (share - 0.5)[:, None]), out, px * by_move)


def _units(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-9)[:, None]


def covered_at(
    solver: Solver, mask: Mask, edge: Edge, camera: Camera, error_px: float
) -> Covered | None:
    """Return what a camera explains of a mask, whose edge (all of it) errs by `error_px`; None
    where it sees no outline."""
    near = _near(error_px)
    outline = _seen(solver, camera, solver.finest)
    if outline is None:
        return None
    matched = _matched(edge, outline, 8.0)
    on = _on(matched, near)
    trusted = edge.stretch @ on >= 0.5
    # Where a stretch that is not believed ends, its points tell more exactly.
    ends = _distances(edge.at[~trusted], edge.at) < max(STRETCH * edge.size, 3.0)
    trusted &= on | ~ends
    agreed = float(np.mean(_closeness(matched.across, near / 3) * (on & trusted)))

    view = solver.look(camera, solver.finest)
    seen = np.zeros(mask.target.shape, bool)
    view.level.window().of(seen)[:] = coverage_of(view)[::-1] > 0.5
    hidden = _hidden(mask, edge, trusted, seen, near)
    # Outline with no edge beside it has to be hidden.
    astray = _distances(edge.at, outline.at) > 2 * near
    astray &= ~hidden[_pixels_of(outline.at, hidden.shape)]
    beyond = float(np.mean((matched.off > near) & ~trusted)) + float(np.mean(astray))
    explained = float(np.mean(trusted))
    lies = matched.across[on & trusted]
    off = float(np.sqrt(np.mean(lies**2))) if lies.size else np.inf
    return Covered(camera, explained, agreed, beyond, off, hidden, edge.at[~trusted])


def _hidden(
    mask: Mask, edge: Edge, trusted: np.ndarray, seen: np.ndarray, near: float
) -> np.ndarray:
    """Return what an occluder may hide (H, W): what an edge that is not believed is the nearest
    to, and what is seen (H, W), and not in the mask, behind it.

    Some room about that is not told either, else the camera that it was taken from is confirmed.
    """
    from scipy.ndimage import binary_dilation, label

    room = max(int(ROOM * edge.size), 3)
    whole = inside_of(mask.target)
    box = _about(whole | seen, 2 * room)
    inside, seen = whole[box], seen[box]
    corner = np.array([box[1].start + 0.5, len(whole) - box[0].start - 0.5])
    beside, by_trusted, by_other = _nearness(edge, trusted, near, corner, inside.shape)
    missing = seen & ~inside & ~by_trusted
    parts: Any = label(missing, np.ones((3, 3)))
    grown: Any = binary_dilation(beside & by_other)
    touching = missing & grown
    behind = np.isin(parts[0], np.unique(parts[0][touching])) & missing
    about: Any = binary_dilation(behind, iterations=room)
    result = np.zeros(whole.shape, bool)
    result[box] = (about | beside) & ~by_trusted & ~inside
    # (The last of an occluder's edge is so near to the outline that it looks like it.)
    result[box] |= by_other
    return result


def _nearness(
    edge: Edge, trusted: np.ndarray, near: float, corner: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which pixels (h, w) are nearer to an edge that is not believed than to one that is,
    which are within `near` (px) of the one that is, and within twice that and 1 of the other.

    `corner` (2,) is the middle (px) of the first pixel, on the film. Of a large photo blocks are
    asked, and pixels near an edge.
    """
    points, (h, w) = (edge.at[trusted], edge.at[~trusted]), shape
    limits = np.array([near, 2 * near + 1])
    side = -(-max(h, w) // BLOCKS)
    tall, wide = -(-h // side), -(-w // side)

    def asked(row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        at = corner + np.column_stack([column, -row])
        away = np.array([_distances(x, at) for x in points])
        return np.concatenate([away[1:] < away[:1], away <= limits[:, None]]), away

    row, column = side * np.indices((tall, wide)).reshape(2, -1)
    reported, away = asked(row + (side - 1) / 2, column + (side - 1) / 2)
    close = np.any(away <= limits[:, None] + (side - 1) / 2**0.5, axis=0)
    blocks = np.repeat(reported[..., None], side**2, axis=-1)
    if side > 1 and np.any(close):
        down, right = np.indices((side, side)).reshape(2, -1)
        inner = (row[close, None] + down).ravel(), (column[close, None] + right).ravel()
        blocks[:, close] = asked(*inner)[0].reshape(3, -1, side**2)
    images = blocks.reshape(3, tall, wide, side, side).swapaxes(2, 3)
    beside, by_trusted, by_other = images.reshape(3, tall * side, wide * side)[:, :h, :w]
    return beside, by_trusted, by_other


def _about(shown: np.ndarray, margin: int) -> tuple[slice, slice]:
    """Return the rows and columns about what is shown: a photo is much larger."""
    found = (np.flatnonzero(np.any(shown, axis=axis)) for axis in (1, 0))
    rows, columns = (
        slice(max(int(x[0]) - margin, 0), int(x[-1]) + 1 + margin) if x.size else slice(0, size)
        for x, size in zip(found, shown.shape, strict=True)
    )
    return rows, columns


def _distances(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return how far (n,) others (n, 2) are from the nearest point, infinite if there is none."""
    from scipy.spatial import KDTree

    nearest: Any = KDTree(points).query(others) if len(points) else (np.full(len(others), np.inf),)
    return nearest[0]


def _pixels_of(points: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of film points (n, 2), the film's border for those beside it."""
    column, up = np.floor(points).astype(int).T
    row = np.clip(shape[0] - 1 - up, 0, shape[0] - 1)
    return row, np.clip(column, 0, shape[1] - 1)
