"""Cameras refined on their photos: a mask is a first guess, its photo is exact.

Beside the outline that a view's camera gives, colours of the object and of its background are
learned; the matte that they make is a soft mask with weights, which the same solver fits the exact
coverage to. Then they are learned again, closer to the outline. A photo decides where its edge fits
an outline of the scene better than the mask's edge does; where it does not, or colours tell too
little, the view keeps its mask, and the fit says so. Views of one problem are refined together.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias, TypeVar

import numpy as np

from .._mask.kinds import Kind
from .._mask.mask import Mask
from .._mask.matte import Band, Matte, light, matte, tiles
from .._mask.target import NOISE, Window, edge_distance
from .._numerics.arrays import array_of
from .._outline.stretches import coverage_of
from .._solver.looks import View
from .._solver.problem import FINE_PX
from .._solver.solver import Solution, Solver, onward
from .refine import Candidate

#: Where colours are learned and asked for, round by round: masks are off by some px at first. (A
#: fourth round changes nothing; the last one's tiles hold what is seen within 10 px.)
ROUNDS = (Band(3.0, 14.0, 8.0), Band(2.0, 12.0, 5.0), Band(1.5, 10.0, 3.5))
#: What is farther than this from any outline is not looked at.
MARGIN_PX = 16
#: The first round begins on the level that is this many from the finest (1: that one itself), some
#: px being less there.
FIRST_DEPTH = 3
#: Steps on a level, the last round's more: it is to come to rest.
STEPS, LAST_STEPS = 8, 16
#: A step that is negligible before the last round, in px.
ROUGH_PX = 0.02
#: The mask counts this much where colours tell all, and alone where they tell nothing: it errs by
#: some px, they by some tenths. (Spoiled masks: 0.05 lets 1.2 times as much of it in.)
OF_MASK = 0.01
#: Colours tell of a stretch of the outline where their weight is above this ...
TELLING = 0.25
#: ... and of the camera where they do so along this share of it. (Grey objects before grey clutter
#: begin with 0.16 and end 4 to 10 times as exact as their masks; photos of something else: 0 to
#: 0.17.)
LEAST_RESOLVED = 0.1
#: Beside a photo that tells as much as one alone has to, others tell of the camera where they do so
#: along this share of the outline: of something else they would not fit the other's camera.
LEAST_BESIDE = LEAST_RESOLVED / 2
#: The mask's edge does not fit the scene if it is off by more than this many px (rms): one bit and
#: the scene's own mask leave 0.09 to 0.14.
MASK_PX = 0.2
#: The photo contradicts a mask that does if its edge is off the mask's outline by this many times
#: what it is off at best, or than this many px, which blur and noise leave. (At most 1.7 times for
#: right masks, at least 3.2 times for those off by 1 px and more.)
SURE, PHOTO_PX = 2.5, 0.15
#: A photo whose edge is farther than this from every outline (rms) shows another edge. (At most
#: 0.5 px in right photos, 1 px and more in those of something else.)
STRANGE_PX = 0.8
#: What a mask says that a program made, whose camera is not the photo's: one of both is wrong.
OF_ANOTHER = "mask and photo are not of one camera: the mask errs by no pixel, the photo elsewhere"
#: How far beside an outline, in px, an edge is looked for.
NEAR_PX = 3.0


#: What colours make: a mask whose residuals are never too large.
COLOURS = Kind("photo", 0.0, np.inf, 0.0, False)


#: By the numbers of views: photos; weights and targets (H, W).
Photos: TypeAlias = Mapping[int, np.ndarray]
Images: TypeAlias = Mapping[int, tuple[np.ndarray, np.ndarray]]
#: Where cameras are, of one view or of many.
V = TypeVar("V")


class Judgement(NamedTuple):
    """How far a photo's edge is `off` the outline at best (rms, px), whether the photo is better
    founded than the mask, and `words` on it."""

    off: float
    is_better: bool
    words: str


def check_photo(photo: Any, W: int, H: int) -> np.ndarray:
    """A photo (H, W, 3) of type uint8 or float, or raise ValueError."""
    expected = f"the mask's size and three colours, shape (H, W, 3) = ({H}, {W}, 3)"
    array = np.asarray(array_of("photo", photo, expected))
    if array.shape != (H, W, 3):
        hint = ""
        if array.shape == (H, W, 4):
            hint = "; give `photo[..., :3]`, without its transparency"
        elif array.shape == (H, W):
            hint = "; stack a grey photo three times"
        raise ValueError(f"`photo`: expected {expected}, got shape {array.shape}{hint}")
    if array.dtype != np.uint8 and not np.issubdtype(array.dtype, np.floating):
        raise ValueError(f"`photo`: expected dtype uint8 or float, got {array.dtype}")
    if array.dtype == np.uint8:
        return array
    low, high = array.min(), array.max()
    if not (np.isfinite(low) and np.isfinite(high)):
        at = tuple(np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"`photo`: expected finite values, got {array[at]} at {[*map(int, at)]}")
    if low < -NOISE or high > 1 + NOISE:
        raise ValueError(
            f"`photo`: expected floats in [0, 1], got {low:g} to {high:g}"
            " (convert photos of 0..255 to uint8)"
        )
    return array


def on_photo(
    solver: Solver, mask: Mask, photo: np.ndarray, found: Solution
) -> tuple[Candidate | None, Judgement]:
    """The camera that was found for a mask, refined on a photo; None where the mask's stays. What
    is to be said of the photo."""
    begin, px = solver.look(found.camera, solver.finest), FINE_PX[solver.dtype]

    def outline(there: tuple[Solver, Solution], k: int) -> Outline:
        del k
        return Outline.from_view(there[1].view)

    def descended(
        there: tuple[Solver, Solution], images: Images, depths: Sequence[int], px: float, steps: int
    ) -> tuple[Solver, Solution]:
        colours = replace(solver, kind=COLOURS, max_steps=steps)
        own = colours.weighed(*images[0], only_finest=max(depths) == 1)
        levels = range(max(own.finest + 1 - max(depths), 0), own.finest + 1)
        return own, onward(there[1], own.solve(there[1].camera, levels, fine_px=px))

    (own, refined), trusted, notes = refine_on_photos(
        (solver, found._replace(view=begin)), outline, descended, {0: mask}, {0: photo}, px
    )
    if not trusted:
        return None, notes[0]
    whole = solver.look(refined.camera, solver.finest)
    sums = whole.sums._replace(touched=refined.view.sums.touched)
    return Candidate.by_squares(own, refined, replace(whole, sums=sums)), notes[0]


def refine_on_photos(
    begin: V,
    outline: Callable[[V, int], "Outline"],
    descended: Callable[[V, Images, Sequence[int], float, int], V],
    masks: Mapping[int, Mask],
    photos: Photos,
    px: float,
    tell: Callable[[str], None] = lambda line: None,
) -> tuple[V, Photos, dict[int, Judgement]]:
    """Where those photos lead that are better founded than their masks, these photos, and what is
    to be said of each of all. Steps of `px` are negligible at last.

    - `begin`: where cameras are; `outline`: of a view there, on the finest level.
    - `descended`: where views lead that are fitted to images, over levels that are numbered from
      the finest (1), with this many steps on each at most; those of this many px are negligible.
    """
    first = {k: outline(begin, k) for k in photos}
    shares = {
        k: first[k].resolved(first[k].read(photo, masks[k], ROUNDS[0]))
        for k, photo in photos.items()
    }
    together = len(photos) > 1 and max(shares.values()) >= LEAST_RESOLVED
    least = LEAST_BESIDE if together else LEAST_RESOLVED
    notes = {k: _unresolved(share, np.inf) for k, share in shares.items() if not share >= least}
    photos = {k: photo for k, photo in photos.items() if k not in notes}
    while photos:
        there, now = begin, first
        for number, band in enumerate(ROUNDS):
            last = number == len(ROUNDS) - 1
            images = {k: now[k].image(photo, masks[k], band) for k, photo in photos.items()}
            depths = (1,) if number else range(FIRST_DEPTH, 0, -1)
            ends = (px, LAST_STEPS) if last else (max(px, ROUGH_PX), STEPS)
            there = descended(there, images, depths, *ends)
            now = {k: outline(there, k) for k in photos}
            tell(f"{len(photos)} photos: round {number + 1} of {len(ROUNDS)}")
        notes |= {k: _judged(masks[k], x, first[k], now[k], least) for k, x in photos.items()}
        wrong = {k: notes[k].off for k in photos if not notes[k].is_better}
        if not wrong:
            return there, photos, notes
        # (Photos of something else pull at the others: these may be right without them.)
        strange = sorted((k for k in wrong if wrong[k] >= STRANGE_PX), key=wrong.__getitem__)
        out = strange[len(strange) // 2 :] or wrong
        photos = {k: photo for k, photo in photos.items() if k not in out}
    return begin, photos, notes


class Outline(NamedTuple):
    """What is seen at a camera near its outline, in a window of the film: coverage (h, w), the
    distance from the outline, positive inside (px), and how much of it each pixel holds (px)."""

    window: Window
    coverage: np.ndarray
    distance: np.ndarray
    length: np.ndarray

    @classmethod
    def from_view(cls, view: View) -> "Outline":
        """Return it from a view on the finest level."""
        seen, coverage = view.level.window(), coverage_of(view)[::-1]
        part = Window.about(np.abs(coverage - 0.5) < 0.5, MARGIN_PX)
        coverage = part.crop(coverage)
        window = part._replace(left=seen.left + part.left, bottom=seen.bottom + part.bottom)
        inside = coverage > 0.5
        # Pixels beside the edge, which are 0 px away from one another, are half a px from it.
        distance = np.where(inside, 1, -1) * (edge_distance(coverage) + 0.5)
        return cls(window, coverage, distance, np.hypot(*np.gradient(coverage)))

    def read(self, photo: np.ndarray, mask: Mask, band: Band) -> Matte:
        """The photo's matte about the outline."""
        weight = self.window.crop(mask.weight)
        read = matte(light(self.window.crop(photo)), self.distance, band, weight > 0)
        return read._replace(weight=np.where(weight > 0, read.weight, 0))

    def image(self, photo: np.ndarray, mask: Mask, band: Band) -> tuple[np.ndarray, np.ndarray]:
        """Weights and target (H, W): the photo's matte, and a little of the mask."""
        weight, target = np.zeros(mask.target.shape), mask.image + 0.0
        read, part = self.read(photo, mask, band), self.window.crop(target)
        total = read.weight + OF_MASK
        part[:] = (read.weight * read.share + OF_MASK * part) / total
        self.window.crop(weight)[:] = total * self.window.crop(mask.weight)
        return weight, target

    def resolved(self, read: Matte) -> float:
        """The share of the outline that colours show."""
        clear = np.sum(self.length[read.weight > TELLING])
        return float(clear / max(np.sum(self.length), 1.0))

    def off(self, read: Matte) -> float:
        """The distance of a matte's edge from the outline (rms, px)."""
        return self.offsets(read.share, read.weight)[1]

    def of_mask(self, mask: Mask) -> tuple[float, float]:
        """The offsets of a mask's edge."""
        return self.offsets(self.window.crop(mask.image), self.window.crop(mask.weight))

    def offsets(self, image: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
        """The offset (px) of an image's edge to the outside of the outline: the mean, and the root
        mean square over stretches of it."""
        tile, (rows, columns) = tiles(self.coverage.shape)
        add = lambda x: np.bincount(tile.ravel(), np.ravel(x), minlength=rows * columns)
        near = np.minimum(weight, 1) * (np.abs(self.distance) < NEAR_PX)
        area, length = add(near * (image - self.coverage)), add(near * self.length)
        there = length > 0.5 * TELLING
        offset = np.clip(area[there] / length[there], -NEAR_PX, NEAR_PX)
        mean = lambda x: float(np.average(x, weights=length[there])) if len(x) else np.nan
        return mean(offset), mean(offset**2) ** 0.5


def contradicts(off: float, least: float) -> bool:
    """True if a photo's edge is so far off an outline (px) that it rules that out, being off by
    this at `least` elsewhere."""
    return off > SURE * max(least, PHOTO_PX)


def _judged(
    mask: Mask, photo: np.ndarray, before: Outline, now: Outline, least: float
) -> Judgement:
    """What is to be said of a photo by the outline before, and where it leads. Colours are to show
    a share `least` of that."""
    read, first = (x.read(photo, mask, ROUNDS[-1]) for x in (now, before))
    own, resolved = now.off(read), now.resolved(read)
    if not resolved >= least:
        return _unresolved(resolved, own)
    bias, apart = now.of_mask(mask)
    of_mask, at_first = before.of_mask(mask)[1], before.off(first)
    better = of_mask > MASK_PX and own < of_mask
    if own < STRANGE_PX and (better or contradicts(at_first, own)):
        size = "large" if bias > 0 else "small"
        words = (
            f"fitted to the photo: its edge lies within {own:.2f} px (rms) of the outline; the mask"
            f" is {apart:.2f} px off, on average {abs(bias):.2f} px too {size}"
        )
        return Judgement(own, True, words)
    words = (
        f"fitted to the mask: its edge lies within {of_mask:.2f} px (rms) of the outline; the"
        f" photo's is {at_first:.2f} px off, at best {own:.2f} px, which is no better"
    )
    return Judgement(own, False, words)


def _unresolved(share: float, off: float) -> Judgement:
    words = (
        f"fitted to the mask: the photo shows the object's edge along only {share:.0%} of the"
        " outline"
    )
    return Judgement(off, False, words)
