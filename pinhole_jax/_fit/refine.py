"""Each camera proposed is refined on what its own account believes of the mask; one likelihood
says which of them are kept, the likeliest first.

Of pixels that err independently least squares make the likeliest camera. A drawn edge errs along
whole stretches: there the likelihood's generalised least squares (Aitken 1936) on offsets of the
edge go on from where those of pixels end.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .._camera.axes import angle, one_of_each
from .._camera.camera import Camera
from .._mask.mask import Mask
from .._outline.outline_errors import OutlineErrors, is_computed, is_drawn
from .._outline.statistics import mask_errors, quantisation
from .._rules import RULES
from .._solver.looks import View
from .._solver.problem import FINE_PX
from .._solver.solver import Solution, Solver, onward
from .edge import Edge, edge_of, outline_seen
from .likelihood import Account, Likelihood, believed
from .places import is_alike

#: Steps by generalised least squares at most, and those before which no camera is given up; a step
#: of fewer standard errors is the last.
STEPS, EARLY, STILL = 16, 2, 0.2


@dataclass(frozen=True, eq=False)
class Candidate:
    """A camera that may be right: what was `found` on the pixels that count, the `whole` view, the
    account of the mask's edge, and how that errs where it is believed. `near` solves on the pixels
    that count. `covariance` (n, n) is by moves: the likelihood's, if the mask is not surely
    computed."""

    found: Solution
    whole: View
    account: Account | None
    near: Solver
    errors: OutlineErrors | None
    covariance: np.ndarray | None = None

    @classmethod
    def by_squares(cls, solver: Solver, found: Solution, whole: View | None = None) -> "Candidate":
        """The candidate that squares alone lead to, whose mask `whole` shows."""
        return cls(found, whole or found.view, None, solver, mask_errors(solver, found.view))

    @property
    def log(self) -> float:
        """The logarithm of the likelihood."""
        return -np.inf if self.account is None else self.account.log

    def overlaps(self) -> bool:
        """Whether the camera's silhouette is about where the mask is."""
        sums = self.whole.sums
        return float(sums.overlap) > RULES.overlap * float(sums.union)

    def is_explained(self) -> bool:
        """Whether nearly all of the camera's outline has an edge beside it, or is hidden."""
        return self.account is not None and self.account.missing < RULES.little


@dataclass(frozen=True, eq=False)
class Refiner:
    """A mask whose pixels count near its edge, within `outlier_px`."""

    solver: Solver
    mask: Mask
    start: Camera | None
    likelihood: Likelihood
    outlier_px: float
    plainly: bool

    @classmethod
    def on(
        cls, solver: Solver, mask: Mask, start: Camera | None, outlier_px: float, plainly: bool
    ) -> "Refiner":
        """The refiner on a mask's edge, from a start or anywhere; `plainly`: by least squares
        alone."""
        noise = quantisation(solver.kind.variance, mask.usual_weight)
        return cls(solver, mask, start, Likelihood(edge_of(mask), noise), outlier_px, plainly)

    @property
    def edge(self) -> Edge:
        """The mask's edge."""
        return self.likelihood.edge

    def candidates(
        self,
        cameras: Iterable[Solution],
        beside: Sequence[Candidate] = (),
        most: int = RULES.turns,
    ) -> list[Candidate]:
        """The candidates that the likeliest cameras become, but for those that others rule out: the
        first ones, or where these are proposals `beside` others the likeliest, `most` of them."""
        begun = [(found, self.account(found.camera, roughly=True)) for found in cameras]
        logs = [np.inf if said is None else said.log for _, said in begun]
        likely = sorted(range(len(begun)), key=lambda k: -logs[k])[:most]
        known, told = [*beside], len(beside) > 0
        for k in likely if told else sorted(likely):
            made = self._refined(*begun[k], known, told)
            known += [] if made is None else [made]
        return known[len(beside) :]

    def proposals(
        self, cameras: Iterable[Camera], beside: Sequence[Candidate], most: int = RULES.turns
    ) -> list[Candidate]:
        """The candidates that the likeliest cameras become, beside others."""
        look = lambda camera: Solution(camera, self.solver.look(camera, self.solver.finest), ())
        return self.candidates(map(look, cameras), beside, most)

    def _refined(
        self, found: Solution, said: Account | None, known: list[Candidate], told: bool
    ) -> Candidate | None:
        """The candidate that a camera becomes; None if others are so much likelier, or the same.
        `told`: by the likelihood alone."""
        begin = found.camera
        if said is None:  # the mask's edge tells nothing yet
            found, said = self._least_squares(self._near(RULES.times), found)
        # (The account allows for an error of the camera; for what is left to descend, too.)
        elif said.log < max((c.log for c in known), default=-np.inf) - 3 * RULES.hopeless:
            return None
        if said is not None:
            # (Of a mask that is not drawn what leaves equal squares stays, however likely.)
            short = told or (bool(known) and is_drawn(known[0].errors))
            least = max((c.log - self.cost(c.found.camera) for c in known), default=-np.inf)
            least -= RULES.as_likely if short else RULES.hopeless
            likelier = self._likelier(found, said, least, [c.found.camera for c in known])
            if likelier is None:
                return None
            found, said = likelier
        near, before = self._near(1.0, said), found
        ended = said if found.ended and not self.plainly else None
        drawn, believed_first = ended is not None and ended.is_drawn, near
        if not drawn:
            found, said = self._least_squares(near, found)
            again = [] if self.start is None or told else [self.start]
            for camera in [begin, *again]:
                if not near.look(camera, near.finest).squares >= found.view.squares:
                    found, said = self._least_squares(near, found._replace(camera=camera))
            near = self._near(1.0, said)
            if not all(map(np.array_equal, near.weights, believed_first.weights)):
                found, said = self._least_squares(near, found)  # (Other pixels are believed.)
        if ended is not None and (said is None or said.log < ended.log - RULES.as_likely or drawn):
            near, said = believed_first, ended
            found = before._replace(view=near.look(before.camera, near.finest))
        covariance = said.errors.spread if drawn and said is not None else None
        some = said is not None and bool(np.any(said.gross))
        wide = self._near(RULES.times, said) if some else self.solver
        errors = mask_errors(wide, found.view, not some)
        if not (said is None or errors is None or self.plainly or is_computed(errors)):
            if self.solver.kind.hard and not said.is_drawn:
                likely = 0.0 if some else errors.computed  # (by all of the edge, or not at all)
                found, said = self._perhaps_drawn(found, near, likely, is_drawn(errors))
                errors = mask_errors(wide, found.view, not some)
            covariance = said.errors.spread
        whole = self.solver.look(found.camera, self.solver.finest)
        return Candidate(found, whole, said, near, errors, covariance)

    def _perhaps_drawn(
        self, found: Solution, near: Solver, computed: float, surely: bool
    ) -> tuple[Solution, Account]:
        """A camera, and its account if the mask may be drawn though its edge does not show it: so
        likely it is `computed`. If it is drawn `surely`, by its pixels: the end of generalised
        least squares, where these come to rest."""
        drawn = replace(self, likelihood=self.likelihood.knowing(computed))
        said = drawn.account(found.camera)
        assert said is not None
        likelier = drawn._likelier(found, said, -np.inf, []) if surely else None
        if likelier is None or not likelier[0].ended:
            return found, said
        ended, said = likelier
        return ended._replace(view=near.look(ended.camera, near.finest)), said

    def _likelier(
        self, begin: Solution, said: Account, least: float, known: list[Camera]
    ) -> tuple[Solution, Account] | None:
        """The end of generalised least squares, and its account; where they do not come to rest, or
        at an unlikelier camera, those given, not `ended`; None if they will hardly lead above the
        logarithm `least`, a start's cost taken off, or lead to a camera that is `known`."""
        camera, now, share, solver = begin.camera, said, 1.0, self.solver
        for n in range(min(STEPS, solver.max_steps)):
            part = min(share, RULES.smooth * self.edge.size / max(now.shift, 1e-9))
            camera = solver.step(camera, solver.finest, part * now.errors.move)
            if any(is_alike(solver, camera, other) for other in known):
                return None
            after = self.account(camera)
            if after is None or after.log < said.log - RULES.as_likely:
                break
            # (A normal distribution's top is higher by half of `far`^2; others' by a few times it.)
            if after.log + 2 * after.far**2 - self.cost(camera) < least and n >= EARLY:
                return None
            if min(after.far, 2 * part * now.far) < STILL:
                return begin._replace(camera=camera, ended=True), after
            worse = after.far > (1 - part / 2) * now.far
            share, now = share / 2 if worse else share, after
        return begin._replace(ended=False), said

    def _least_squares(self, near: Solver, begin: Solution) -> tuple[Solution, Account | None]:
        """The end of least squares on pixels, and its account."""
        px = FINE_PX[near.dtype]
        found = onward(begin, near.solve(begin.camera, [near.finest], fine_px=px))
        return found, self.account(found.camera)

    def _near(self, reach: float, said: Account | None = None) -> Solver:
        """The solver of the pixels near the mask's edge, as far as it is believed: within a reach
        (in `outlier_px`), or farther if the edge errs by more."""
        gross = np.zeros(len(self.edge.at), bool)
        if said is not None:
            gross = said.gross
            reach = np.clip(RULES.within * said.errors.size / self.outlier_px, reach, RULES.times)
        weights = believed(self.mask.near_edge(float(reach) * self.outlier_px), self.edge, gross)
        return self.solver.weighed(weights, only_finest=True)

    def account(self, camera: Camera, roughly: bool = False) -> Account | None:
        """The account of the mask's edge by a camera."""
        outline = outline_seen(self.solver, camera, self.solver.finest)
        said = self.likelihood.account(outline, roughly)
        if said is None or not self.solver.weighs_prior:
            return said
        return said.knowing(*self.solver.known(camera))

    def cost(self, camera: Camera, overlaps: bool = True) -> float:
        """What a start, another measurement, takes off the logarithm of a camera's likelihood. It
        may be a twin's: a camera that overlaps the mask loses no more than twice what rules out a
        mode."""
        if self.start is None:
            return 0.0
        most = 2 * RULES.as_likely if overlaps else np.inf
        return min((angle(camera, self.start) / RULES.start) ** 2 / 2, most)

    def likeliest(self, candidates: Sequence[Candidate], alike: int = 0) -> list[Candidate]:
        """The candidates that mask and start do not tell apart, the likeliest first.

        The first `alike` of them leave equal squares: they stay together unless a person or a
        network drew the mask, whose errors are among those squares, or a start rules them out.
        """
        cost = [self.cost(c.found.camera, c.overlaps()) for c in candidates]
        logs = [c.log - x for c, x in zip(candidates, cost, strict=True)]
        order = sorted(range(len(logs)), key=lambda k: -logs[k])
        least, first = logs[order[0]] - RULES.as_likely, candidates[order[0]]
        together = order[0] < alike and not is_drawn(first.errors)
        from_start = lambda c: 0 if self.start is None else angle(c.found.camera, self.start)
        reach = max(RULES.too_far, from_start(first))
        stays = lambda k: together and k < alike and from_start(candidates[k]) <= reach
        likely = [candidates[k] for k in order if logs[k] >= least or stays(k)]
        is_one = lambda a, b: is_alike(self.solver, a.found.camera, b.found.camera)
        return [*one_of_each(likely, is_one)]

    def is_hidden(self, candidate: Candidate) -> bool:
        """Whether something may stand before the object that a camera sees."""
        said = candidate.account
        if said is None:
            return False
        sums = candidate.whole.sums
        astray = float(sums.overlap) < (1 - RULES.astray) * float(sums.union)
        hidden = max(said.hidden(self.edge, RULES.small), said.missing) > RULES.little
        return hidden or (astray and said.errors.size > self.outlier_px)
