"""The numbers by which a fit decides: which cameras it tries and keeps, and its status.

No theorem gives these, and no mask tells them. Each says what it decides and what shows it;
`experiments/rent.py` halves and doubles each, and counts the answers that change. What is physics
(1/12 of a step), rounding, or a format stands where it is used.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Rules:
    """Angles in rad, lengths in px; shares are of one."""

    # What kind of mask it is

    #: A mask with fewer greys beside its edge is one bit. (Exact coverage: half and more; 2 x 2
    #: samples: a quarter; a matted picture without soft edges: 0.07.)
    grey_share: float = 0.12
    #: Edges are wide if this share of the pixels between 0 and 1 lies in runs of 3 and more both
    #: ways. (Exact coverage: 0 to 0.01, blurs of 0.3 and 0.5 px: 0.01 to 0.18 and 0.98.)
    wide_share: float = 0.3
    #: A hard edge leaves at most this mean square in a pixel of the outline (1/12 on average).
    hard: float = 0.1
    #: A right camera leaves at most this many times the variance, or standard errors more than
    #: that on average; a proposal that leaves more, beside another one, is followed no further. At
    #: first pixels count within this many times `outlier_px`: what was pulled away comes back. A
    #: camera is a mode if it is as likely as one this many standard errors from the likeliest.
    times: float = 4.0

    # Which cameras are proposed

    #: Views all over the sphere that a search compares with the mask (11 degrees apart).
    views: int = 400
    #: How many likely views are descended from, and how many of their ends are followed to finer
    #: levels.
    tried: int = 16
    followed: int = 8
    #: Steps from a proposal, before it is compared with others.
    steps: int = 10
    #: Cameras closer than this are one.
    same: float = np.deg2rad(0.5)
    #: Where the focal length is free a search tries this much more and less of it, too.
    focal_factor: float = 1.5
    #: Below this intersection over union a camera sees something else than the mask.
    overlap: float = 0.5
    #: The standard error of a start. Cameras farther apart are different proposals; four of these
    #: away, a start rules a camera out.
    start: float = np.deg2rad(15)
    #: A mask that leaves less than this mean square in a pixel of the outline has no outliers.
    exact: float = 0.01

    # Where else the mask fits as well

    #: A turn or shift that shows less than this share of the best-seen one is walked along.
    weak: float = 0.03
    #: Places there are others if they leave less than this share of the squares foretold there.
    foretold: float = 0.5
    #: Squares that differ by less than this many variances are equal: 5.5 standard errors.
    equal_times: float = 30.0
    #: As many equal places along a walk are no list of modes but a direction that is free.
    many: int = 4
    #: A body is near its mirror image if it reaches as far to within this share of its radius.
    mirrored: float = 0.15
    #: A turn known no better (one sigma) is no camera. (Of 124 fits to masks of photographs, this
    #: was said of 26 of 28 that were off by more than 10 degrees.)
    uncertain: float = np.deg2rad(4)

    # How a mask's edge errs, and what of it is believed

    #: An edge is taken by about this many stretches. (Of 95 % intervals 94 % held with 48 or 60,
    #: 91 % with 80 or 100.)
    stretches: int = 60
    #: Hypotheses on its errors: sizes and lengths (px), and their shapes: by which power of the
    #: distance they fall off, roughly or smoothly, and how many times as much (in variance) errs
    #: over as far as the object reaches. (Of 95 % ellipsoids for errors of a circle that are smooth
    #: over 40 px 92 % hold, 4 % without smooth ones. Halves of masks of a bottle and of implants by
    #: a network differ by 0.9 to 1.2 sigma; by 1.3 where each block errs by itself, too.)
    sizes: tuple[float, ...] = (0.08, 0.2, 0.5, 1.2, 3.0)
    lengths: tuple[float, ...] = (6.0, 16.0, 40.0, 100.0)
    shapes: tuple[tuple[int, int], ...] = ((1, 3), (2, 3), (1, 0), (2, 0))
    #: The bias's standard deviation, in sizes of the other errors and in px beside that, and how
    #: likely it is: segmenters are off by as much as they waver, grown or shrunk masks by more.
    biases: tuple[tuple[float, float, float], ...] = ((1.0, 0.5, 0.8), (2.0, 2.5, 0.2))
    #: So likely, a mask is called computed; as unlikely, drawn. Between, error bars are the mean of
    #: both, each as likely as it is.
    sure: float = 0.99
    #: The share of a computed mask's pixels beside the outline on its wrong side: those whose
    #: coverage differs by more than `wrong_side`. (Of 416 masks 378 had none of some 280, 29 one. A
    #: shrunk one had 3 of 379: with 0.003, as likely computed, it is 12 sigma off.)
    strays: float = 0.0005
    wrong_side: float = 0.6
    #: If a part of a mask is not believed, its pixels add at most so much to the logarithm of the
    #: odds that it is computed. (All of a plug but its prongs may have grown: 18 sigma off with 4.)
    partly: float = 1.5
    #: Quantisation's variance, beside that of pixels which err independently: straight edges that
    #: nearly follow the rows err alike. (Of 48 masks of one bit all are told with 2, 40 with 1.)
    alike: float = 2.0
    #: The standard deviation of a gross error, and over which length it is smooth (shares of
    #: the size of the object), to a pixel.
    gross: float = 0.4
    smooth: float = 0.25
    #: Pixels count within this many sizes of the errors; outline has an edge beside it there.
    within: float = 2.5
    #: Beside an edge that is not believed this much does not count (in sizes of the object).
    room: float = 0.1
    #: Less of an edge, of a curve or of the usual weight is too little to tell anything; more of an
    #: outline that something hides leaves room for other views, if no start rules them out. (Of 200
    #: wrong masks one: a bracket with a fifth cut off, seen from 120 degrees away: 0.46; bites hide
    #: 0.06 to 0.13.)
    small: float = 0.25
    #: Less of an edge, outline or sum of squares is no matter; more that is missing may be hidden.
    little: float = 0.05
    #: More of an edge or outline that no occluder explains is a misfit. If a mask and a camera's
    #: silhouette do not share as much of their union, wavering may be an occluder's. (A shoe, 30 %
    #: hidden: with 0.25 for this 107 degrees off, with 0.1 found.)
    astray: float = 0.1
    #: While cameras are refined, those are left whose logarithm is less by this.
    hopeless: float = 30.0

    # What stands in front of the object

    #: Directions in which something may stand, and the share of the edge that it may take there.
    sectors: int = 8
    taken: float = 0.35
    #: An edge is close to an outline within this share of the object's size. (As far as first steps
    #: let it count everything is near: of 136 guesses the right ones would be 55th and 56th.)
    close: float = 0.02

    @property
    def as_likely(self) -> float:
        """By how much a mode's likelihood may be less (logarithms)."""
        return self.times**2 / 2

    @property
    def too_far(self) -> float:
        """How far (rad) from a start a camera is ruled out: four standard errors."""
        return self.times * self.start

    @property
    def strides(self) -> np.ndarray:
        """How far walks go to either side (rad, at the object's radius)."""
        return 3 * self.same * 2.0 ** np.arange(7)

    @property
    def stretch(self) -> float:
        """The length (px) of the shortest stretch: a third of the shortest length of errors."""
        return self.lengths[0] / 3

    @property
    def beside(self) -> float:
        """How near an edge (px) errors are its own: half of their shortest length."""
        return self.lengths[0] / 2

    @property
    def turns(self) -> int:
        """How many turns that look alike, and how many likely cameras, are tried."""
        return 3 * self.followed

    @property
    def rounds(self) -> tuple[int, int, int]:
        """How many proposals of an occluded object go on, after each two steps."""
        return 2 * self.tried, self.tried, self.followed

    @property
    def drawn_times(self) -> float:
        """`equal_times` of a mask that a person or a network drew, whose errors are counted."""
        return self.times**2


RULES = Rules()
