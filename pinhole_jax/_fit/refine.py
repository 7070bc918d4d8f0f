"""Each camera proposed is refined on what its own account believes of the mask; one likelihood
says which of them are kept, the likeliest first.

Of pixels that err independently least squares make the likeliest camera. A drawn edge errs along
whole stretches: there the likelihood's generalised least squares (Aitken 1936) on offsets of the
edge go on from where those of pixels end.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from .._camera.axes import angle, distinct
from .._camera.camera import Camera
from .._mask.edges import NearWeights
from .._mask.mask import Mask
from .._outline.outline_errors import OutlineErrors, is_drawn
from .._outline.statistics import mask_errors, quantisation
from .._rules import RULES
from .._solver.looks import View
from .._solver.problem import COARSE_PX, FINE_PX
from .._solver.solver import Solution, Solver, onward
from .edge import Edge, edge_of, outline_seen
from .likelihood import Account, account, believed


#: Steps by generalised least squares at most; which shift of the outline is none: in px, and by
#: the size of the edge's errors.
STEPS, STILL_PX, STILL = 8, 0.02, 0.05


@dataclass(frozen=True, eq=False)
class Candidate:
    """A camera that may be right: what was `found`, the end of `least` squares on the pixels that
    count (the same unless the edge is drawn), the `whole` view, the account of the mask's edge, and
    the solver of the pixels that count."""

    found: Solution
    least: Solution
    whole: View
    account: Account | None
    near: Solver
    wide: Solver

    @property
    def log(self) -> float:
        """The logarithm of the likelihood."""
        return -np.inf if self.account is None else self.account.log

    def is_explained(self) -> bool:
        """Whether nearly all of the camera's outline has an edge beside it, or is hidden."""
        return self.account is not None and self.account.missing < RULES.little

    @property
    def errors(self) -> OutlineErrors | None:
        """How the mask's outline errs where it is believed."""
        return mask_errors(self.wide, self.found.view)


@dataclass(frozen=True, eq=False)
class Refiner:
    """A mask whose pixels count near its edge, within `outlier_px`."""

    solver: Solver
    mask: Mask
    edge: Edge
    outlier_px: float
    plainly: bool

    @classmethod
    def on(cls, solver: Solver, mask: Mask, outlier_px: float, plainly: bool) -> "Refiner":
        """The refiner on a mask's edge; `plainly`: by least squares alone."""
        return cls(solver, mask, edge_of(mask), outlier_px, plainly)

    def candidates(
        self, cameras: Iterable[Solution], start: Camera | None = None, best: float | None = None
    ) -> list[Candidate]:
        """The candidates that cameras become, but for those that others rule out: the first ones,
        or where these are proposals beside a `best` likelihood (its logarithm) the likeliest."""
        begun = [(found, self.account(found.camera, roughly=True)) for found in cameras]
        if best is not None:
            begun.sort(key=lambda pair: -np.inf if pair[1] is None else -pair[1].log)
        done: list[Candidate] = []
        for found, said in begun:
            log = max((c.log for c in done), default=-np.inf if best is None else best)
            made = self._refined(found, said, start, log - RULES.hopeless)
            done += [] if made is None else [made]
        return done

    def _refined(
        self, found: Solution, said: Account | None, start: Camera | None, least: float
    ) -> Candidate | None:
        begin, gross = found.camera, np.zeros(len(self.edge.at), bool)
        if said is not None:
            gross = said.gross
            # (The account allows for an error of the camera; for what is left to descend, too.)
            if said.log < least - RULES.hopeless:
                return None
        alone = said is not None and not np.any(gross) and said.missing == 0
        if not alone:
            wide = self.solver.weighed(self._weights(RULES.times, gross), only_finest=True)
            found = onward(found, wide.solve(found.camera, [wide.finest], fine_px=COARSE_PX))
            said = self.account(found.camera, roughly=True)
            if said is not None:
                gross = said.gross
                if said.log < least:
                    return None
        reach = 1.0 if said is None else RULES.within * said.size / self.outlier_px
        near = self.solver.weighed(
            self._weights(float(np.clip(reach, 1, RULES.times)), gross), only_finest=True
        )
        px = FINE_PX[near.dtype]
        found = onward(found, near.solve(found.camera, [near.finest], fine_px=px))
        said = self.account(found.camera)
        # (A descent that began there, with these weights, does not end higher.)
        for camera in [] if alone else [begin] if start is None else [begin, start]:
            if not near.look(camera, near.finest).squares >= found.view.squares:
                found = onward(found, near.solve(camera, [near.finest], fine_px=px))
                said = self.account(found.camera)
        least = found
        if said is not None and said.is_drawn and not self.plainly:
            found, said = self._likelier(near, found, said)
            if not said.is_drawn:  # what errs is less than it seemed from afar
                least = found = onward(found, near.solve(found.camera, [near.finest], fine_px=px))
        wide = self.solver
        if np.any(gross):
            wide = self.solver.weighed(self._weights(RULES.times, gross))
        whole = self.solver.look(found.camera, self.solver.finest)
        return Candidate(found, least, whole, said, near, wide)

    def _likelier(
        self, near: Solver, least: Solution, said: Account
    ) -> tuple[Solution, Account]:
        """The end of generalised least squares, and its account: a likelier one, or those given."""
        camera, now, still = least.camera, said, False
        for _ in range(min(STEPS, near.max_steps)):
            far = now.shift / (RULES.smooth * self.edge.size)
            camera = near.step(camera, near.finest, now.move / max(far, 1.0))
            after = self.account(camera)
            if after is None or after.log < said.log - RULES.times**2 / 2:
                return least, said
            still = now.shift < max(STILL_PX, STILL * now.size)
            now = after
            if still or not now.is_drawn:
                break
        view = near.look(camera, near.finest)
        return least._replace(camera=camera, view=view, ended=still), now

    def account(self, camera: Camera, roughly: bool = False) -> Account | None:
        """The account of the mask's edge by a camera."""
        noise = quantisation(self.solver.kind.variance, self.mask.usual_weight)
        outline = outline_seen(self.solver, camera, self.solver.finest)
        return account(self.edge, outline, noise, roughly)

    def _weights(self, reach: float, gross: np.ndarray) -> NearWeights:
        return believed(self.mask.near_edge(reach * self.outlier_px), self.edge, gross)

    def is_hidden(self, candidate: Candidate) -> bool:
        """Whether something may stand before the object that a camera sees."""
        said = candidate.account
        if said is None:
            return False
        astray = max(said.hidden(self.edge, RULES.small), said.missing)
        return astray > RULES.little or said.size > self.outlier_px


def likeliest(candidates: Sequence[Candidate], alike: int, start: Camera | None) -> list[Candidate]:
    """The candidates that a mask does not tell apart, the likeliest first.

    The first `alike` of them leave equal squares: they stay together unless a person or a network
    drew the mask, whose errors are among those squares. A start is another measurement.
    """
    far = [0.0 if start is None else angle(c.found.camera, start) for c in candidates]
    logs = [c.log - (x / RULES.start) ** 2 / 2 for c, x in zip(candidates, far, strict=True)]
    order = sorted(range(len(logs)), key=lambda k: -logs[k])
    least = logs[order[0]] - RULES.times**2 / 2
    together = order[0] < alike and not is_drawn(candidates[order[0]].errors)
    likely = [candidates[k] for k in order if logs[k] >= least or (together and k < alike)]
    return list(distinct(likely, RULES.same, lambda candidate: candidate.found.camera))
