"""A mask's edge and a camera's outline as points, and how far the one lies from the other."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from .._camera.camera import Camera
from .._mask.mask import Mask
from .._mask.target import Window, as_coverage, inside_of
from .._outline.stretches import Blocks, OutlineMeans
from .._solver.solver import Solver

#: The normals of a mask's edge are those of a mask that is smoothed over this many px.
SMOOTH_PX = 2
#: At most this many points stand for an edge (a mask of noise has millions).
MOST_POINTS = 20_000
#: How exactly points lie on an edge, and the nearest of an outline on that (px).
EXACT_PX = 0.1
#: A turn of the normal by a rad is as far as this many px, and normals face one another if the
#: angle between them has at least this cosine.
TURN_PX, FACES = 8.0, 0.5


@dataclass(frozen=True, eq=False)
class Edge:
    """The points of a mask's edge, curve by curve.

    - `at` (n, 2): where they are (px, film coordinates); `out` (n, 2): the normals outwards.
    - `step` (n,): the length of edge that each stands for (px).
    - `curve` (n,): the number of its curve.
    - `size`: the object's size (px), the root of its area.
    """

    at: np.ndarray
    out: np.ndarray
    step: np.ndarray
    curve: np.ndarray
    size: float

    @property
    def length(self) -> float:
        """Its length (px)."""
        return max(float(np.sum(self.step)), 1e-9)

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far (k,) points (k, 2) are from the nearest of its points (px), and which (k,) these
        are."""
        return self._tree.query(points)

    def blocks(self, number: int, shortest: float) -> Blocks:
        """The edge cut into about `number` blocks, each at least `shortest` px long."""
        length = max(float(np.sum(self.step)) / number, shortest)
        before = np.cumsum(self.step) - self.step
        return Blocks.alike(np.column_stack([self.curve, before // length]), self.step)

    def thinned(self, most: int) -> "Edge":
        """`most` of the points, evenly."""
        every = max(-(-len(self.at) // most), 1)
        return replace(self.where(np.s_[::every]), step=every * self.step[::every])

    def where(self, chosen: Any) -> "Edge":
        """The edge with these points alone: a mask or indices."""
        return replace(
            self,
            at=self.at[chosen],
            out=self.out[chosen],
            step=self.step[chosen],
            curve=self.curve[chosen],
        )

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import KDTree

        return KDTree(self.at)


@dataclass(frozen=True, eq=False)
class OutlinePoints:
    """Points of the outline that a camera sees: `at` (n, 2) px, normals `out` (n, 2) outwards, and
    how far these go outwards `by_move` (n, k) of the solver; its `length`, and how far apart they
    are at most, their `gap` (px)."""

    at: np.ndarray
    out: np.ndarray
    by_move: np.ndarray
    length: float
    gap: float

    @cached_property
    def tree(self) -> Any:
        from scipy.spatial import KDTree

        return KDTree(np.column_stack([self.at, TURN_PX * self.out]))


@dataclass(frozen=True, eq=False)
class Pairs:
    """An edge's points beside the nearest of an outline: how far they lie outside it, `off` (n,)
    px; `by_move` (n, k); whether the normals `faces` (n,) one another."""

    off: np.ndarray
    by_move: np.ndarray
    faces: np.ndarray


def edge_of(mask: Mask) -> Edge:
    """The edge of a mask: where it passes 1/2 between pixels that count."""
    from scipy.ndimage import gaussian_filter
    from skimage.measure import find_contours

    window = Window.about(inside_of(mask.target), SMOOTH_PX * 5)
    image, weighs = as_coverage(window.crop(mask.target)), window.crop(mask.weight) > 0
    smooth: Any = gaussian_filter(image, SMOOTH_PX)
    down, right = np.gradient(smooth)
    curves = find_contours(image, 0.5) if min(image.shape) > 1 else []
    if not curves:
        empty = np.zeros((0, 2))
        return Edge(empty, empty, empty[:, 0], np.zeros(0, int), 0.0)
    points = np.concatenate(curves)
    number = np.repeat(np.arange(len(curves)), [len(curve) for curve in curves])
    middle, along = (points[1:] + points[:-1]) / 2, np.diff(points, axis=0)
    known = number[1:] == number[:-1]
    for corner in (np.floor, np.ceil):
        known &= weighs[tuple(corner(middle).astype(int).T)]
    middle, along, number = middle[known], along[known], number[1:][known]
    nearest = tuple(np.round(middle).astype(int).T)
    row, column = middle.T
    edge = Edge(
        at=np.column_stack([window.left + column + 0.5, window.bottom + window.H - 0.5 - row]),
        out=units(np.column_stack([-right[nearest], down[nearest]])),
        step=np.linalg.norm(along, axis=1),
        curve=number,
        size=float(np.sqrt(np.count_nonzero(image > 0.5))),
    )
    return edge.thinned(MOST_POINTS)


def outline_seen(solver: Solver, camera: Camera, number: int) -> OutlinePoints | None:
    """The outline that a camera sees on a level, None where it sees none."""
    seen = solver.outline(camera, number)
    around = OutlineMeans.from_origin(seen)
    if len(around.place) < 8 or not np.all(np.isfinite(around.by_move)):
        return None
    level, px = seen.level, len(solver.target) / float(seen.level.scale)
    out = units(-around.slope)
    by_move = around.by_move / np.maximum(around.steepness, 1e-3)[:, None]
    at = around.place[:, ::-1] + 0.5 + np.asarray(level.origin, float)
    points = px * (at + out * _beyond_centre(out, around.coverage)[:, None])
    # An edge touches as many pixels for each px of its length as its normal's sum of |x| and |y|.
    length = float(np.sum(1 / np.maximum(np.abs(out).sum(axis=1), 1)))
    return OutlinePoints(points, out, px * by_move, px * length, px)


def _beyond_centre(out: np.ndarray, share: np.ndarray) -> np.ndarray:
    """How far (k,) beyond a pixel's centre a straight edge lies that covers a share (k,) of it, by
    its normals (k, 2) outwards: it cuts off a corner, or two sides."""
    less, more = np.sort(np.maximum(np.abs(out), 1e-9), axis=1).T
    smaller = np.minimum(share, 1 - share)
    corner = np.sqrt(2 * less * more * smaller) - (less + more) / 2
    depth = np.where(smaller < less / (2 * more), corner, more * (smaller - 0.5))
    return np.where(share < 0.5, depth, -depth)


def matched(edge: Edge, outline: OutlinePoints) -> Pairs:
    """The points of an edge beside the nearest of an outline, whose normals count, too.

    Along the outline they lie off only by what exceeds the gap between its points.
    """
    nearest = outline.tree.query(np.column_stack([edge.at, TURN_PX * edge.out]))[1]
    at, out = outline.at[nearest], outline.out[nearest]
    away = edge.at - at
    across = np.sum(away * out, axis=1)
    along = np.abs(away[:, 0] * out[:, 1] - away[:, 1] * out[:, 0])
    off = np.copysign(np.hypot(across, np.maximum(along - outline.gap, 0)), across)
    return Pairs(off, outline.by_move[nearest], np.sum(edge.out * out, axis=1) > FACES)


def units(vectors: np.ndarray) -> np.ndarray:
    """Vectors (n, 2) of length 1."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-9)[:, None]
