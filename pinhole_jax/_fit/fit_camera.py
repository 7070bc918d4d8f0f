"""`fit_camera`: the camera from a mask, by Levenberg-Marquardt on exact coverage."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from .._camera.axes import angle, axes_of
from .._camera.camera import Camera, check_camera
from .._camera.lens import Lens
from .._camera.rays import project
from .._files.progress import say, shown
from .._mask.edges import SparseImage
from .._mask.mask import Mask
from .._mask.target import (
    MOST_BORDER,
    as_image,
    border_of,
    check_target,
    inside_of,
    levelled,
)
from .._numerics.arrays import (
    ArrayLike,
    Input,
    as_count,
    check_positive,
    float_dtype,
    is_concrete,
    is_number,
)
from .._outline.outline_errors import is_computed
from .._outline.statistics import err_alike, is_explained, mask_errors
from .._rules import RULES
from .._scene.scene import Scene, check_scene
from .._solver.looks import View
from .._solver.moves import Bounds, canonical
from .._solver.parameters import check_free, focal_is_free, in_one, labels_of, with_lens
from .._solver.priors import Pair, Prior, bounds_of, contradictions, prior_of
from .._solver.solver import Solver, Stop
from .._solver.subject import Subject, reach_of
from .drift import other_places
from .edge import Edge
from .implicit import camera_velocity, check_plain, through
from .likelihood import Account
from .occluders import from_all_sides, near_starts
from .photo import (
    COLOURS,
    OF_ANOTHER,
    Judgement,
    check_photo,
    contradicts,
    on_photo,
)
from .places import Free, is_alike, settled, shelf, tilted, transported, turned_about
from .refine import Candidate, Refiner
from .result import Context, Fit, Progress, progress_at, report, with_modes
from .strategy import everywhere, free_about, from_start, to_the_end, turns_freely

ALIKE = (
    "pixels err alike along the outline, unlike a renderer's samples: mesh, lens, or what is not"
    " free is slightly wrong"
)


def fit_camera(
    scene: Scene,
    target: Input[ArrayLike, "H W"],
    camera: Camera | None,
    free: str | Sequence[str] = ("pose",),
    *,
    phi: Input[ArrayLike | None, "rad"] = None,
    lens: Lens | None = None,
    weight: Input[ArrayLike | None, "H W"] = None,
    outlier_px: float | None = 2.0,
    prior: Input[Mapping[str, Pair] | None, "mean, sigma"] = None,
    bounds: Input[Mapping[str, Pair] | None, "low, high"] = None,
    max_steps: int = 64,
    progress: bool | Callable[[Progress], None] | None = None,
    record: bool = False,
    photo: Input[ArrayLike | None, "H W 3"] = None,
) -> Fit:
    """Return the camera whose silhouette of the scene is closest to a mask, with error bars.

    - `target`: mask (H, W), row 0 on top: bool, uint8 (0..255) or float (0..1, soft edges welcome,
      noise about that range too).
    - `camera`: where to start; also all that is not free. Starts some 20 degrees off are pulled in.
      If they lead to a bad match, and for masks that people or networks drew, the fit searches the
      whole sphere of views; the start decides between equals. None: search at once; then `phi`
      (rad) is the field of view, or if it is free a first guess (0.7), and `lens` the principal
      point, aspect and distortion (None: centred, square pixels). Those of a known K are
      `Camera.from_K(K, I, 0, W, H, ...)`'s.
    - `free`: any of pose (or position, orientation: both are pose), phi, d, principal_point, aspect
      and of the lens's distortion k1, k2, p1, p2, k3 (of a fisheye k1 to k4), or `distortion` for
      all of them. Several stand in a tuple, or in a text with commas: "pose,phi".
    - `weight`: (H, W), at least 0: how much each pixel counts (1 / variance, up to a factor), 0 at
      an occluder. Without it, the fit looks for an occluder where model and mask disagree;
      `Fit.unbelieved` has its edge.
    - `outlier_px`: how far, in px, an outline that is right may lie from the mask's edge (farther,
      where all of the edge wavers by more). Pixels farther away, at holes, missing and extra parts,
      lose their weight: at the end of a fit to a mask that is not exact, so that the rest decides.
      None: plain least squares.
    - `prior`: mean and standard deviation of free parameters, in their units, by the names of
      `Fit.names` (not of rotations). The mask's weight against it follows from its residuals.
    - `bounds`: (low, high) of a free phi, aspect or coefficient of distortion. One that starts
      outside begins at the nearer bound. One that ends at a bound is no longer determined: the
      status is "rank_deficient" at best.
    - `max_steps`: a limit for each level.
    - `progress`: True shows a line on stderr, None only in notebooks; a function is called with a
      `Progress` after each level, or with `record` after each step.
    - `record`: keep each step in `history` (some ms more).
    - `photo`: (H, W, 3), sRGB, uint8 or float (0..1), that the mask was made from. The fit refines
      the mask's camera on it: colours beside the outline show the object's share of each pixel. The
      last sentence of `Fit.weak` says by how many px photo and mask disagree, and whether the
      camera is still the mask's: if colours show too little, or the mask's edge fits the scene
      better. `rms` and `iou` are always the mask's. Of `modes` those are left that the photo does
      not rule out. If it rules out the camera of a mask that errs by no pixel: "misfit".

    Levenberg-Marquardt (optimistix) minimises the weighted squared difference of exact coverage and
    target over the camera's pose and log focal length. Images grow from about 16 pixels across the
    object to the full size. The fit works in the float type of `camera` (or of the scene). The
    first call compiles (seconds); later ones with scenes and images of similar size do not.

    Runs outside `jit` and `vmap`. The camera of the result is differentiable (once, forward and
    reverse) with respect to scene, target and weight, by the implicit function theorem.

    Raises ValueError for arguments that make no fit; the solver's troubles are in `Fit.status`.

    ```python
    fit = pj.fit_camera(scene, mask, start, free=("pose", "phi"))
    print(fit)
    ```
    """
    check_scene(scene)
    as_count("max_steps", max_steps)
    check_px(outlier_px=outlier_px)
    if camera is not None:
        check_camera(camera)
        check_alone("camera", phi=phi, lens=lens)
    freed = in_one(check_free(free, camera, lens))
    start = anywhere(scene, target, freed, phi, lens) if camera is None else camera
    base = with_lens(start, freed)
    begin = None if camera is None else canonical(base)

    def run(inputs: Any) -> tuple[Fit, Callable[[], np.ndarray]]:
        scene, target, weight = inputs
        image, weights = check_target(target, weight, base.W, base.H)
        check_border(image, weights, scene, camera)
        # (A derivative is one by the target as it is.)
        image = levelled(image, weights) if concrete else image
        mask = Mask(image, weights, base)
        return _fit(scene, mask, begin, freed, settings)

    known = prior_of(prior, base, freed), bounds_of(bounds, base, freed)
    picture = None if photo is None else check_photo(photo, base.W, base.H)
    inputs = (scene, target, weight)
    concrete = is_concrete(*jax.tree.leaves(inputs))
    with shown(progress, "fitting") as tell:
        settings = Settings(
            outlier_px, max_steps, tell, *known, record, picture, differentiable=not concrete
        )
        if concrete:
            return run(inputs)[0]
        check_plain(prior=prior, bounds=bounds, photo=photo is not None)
        answer = lambda fit: fit.camera
        velocity = lambda fit, trust, *given: camera_velocity(
            fit.camera, freed, given[0], trust(), given[1]
        )
        return through(run, inputs, answer, velocity)


def check_px(**lengths: Any) -> None:
    """Raise ValueError unless these are lengths in px, or None."""
    for name, value in lengths.items():
        if value is not None:
            check_positive(name, value, "a positive number of px")


def check_alone(given: str, **others: Any) -> None:
    """Raise ValueError for what cameras to start from have of their own."""
    for name, value in others.items():
        if value is not None:
            raise ValueError(f"`{name}`: expected None with `{given}`, which brings its own")


def check_border(
    image: np.ndarray, weights: np.ndarray, scene: Scene, start: Camera | None
) -> None:
    """Raise ValueError for a mask that covers its border, where that counts, though the start sees
    the object within it, or there is no start: what it covers is the background."""
    covered = inside_of(border_of(image)) & (border_of(weights) > 0)
    if (share := float(np.mean(covered))) <= MOST_BORDER:
        return
    if start is not None and not _is_within(scene, start):
        return
    raise ValueError(
        f"`target`: expected a mask of the object, got one that covers {share:.0%} of its border,"
        " like an inverted one; invert it, or if it is right give a starting `camera` in which the"
        " object reaches past the picture"
    )


def _is_within(scene: Scene, camera: Camera) -> bool:
    """True if all corners of a scene (of its spheres' boxes) are seen within the picture."""
    points, mesh = [], scene.mesh
    if mesh is not None:
        points.append(np.asarray(mesh.vertices)[np.unique(np.asarray(mesh.faces))])
    if scene.spheres is not None:
        corners = 2 * np.indices((2, 2, 2)).reshape(3, 8).T - 1
        around = np.asarray(scene.spheres.radii)[:, None, None] * corners
        points.append((np.asarray(scene.spheres.centers)[:, None] + around).reshape(-1, 3))
    corners = np.concatenate(points).astype(camera.e.dtype)
    seen = np.asarray(project(camera, corners))
    before = (corners - np.asarray(camera.e, float)) @ axes_of(camera)[2] > 0
    return bool(np.all(before) and np.all((seen > 0) & (seen < [camera.W, camera.H])))


class Settings(NamedTuple):
    """What `fit_camera` is asked for, beside what is fitted."""

    outlier_px: float | None
    max_steps: int
    progress: Callable[[Progress], None] | None = None
    prior: Prior | None = None
    bounds: Bounds | None = None
    record: bool = False
    photo: np.ndarray | None = None
    differentiable: bool = False


def _fit(
    scene: Scene, mask: Mask, start: Camera | None, freed: tuple[str, ...], settings: Settings
) -> tuple[Fit, Callable[[], np.ndarray]]:
    """The fit from a start (canonical) or from anywhere, and a function that gives the weights of
    the pixels that decided."""
    solver = _solver(scene, mask, freed, settings)
    reach = settings.outlier_px

    def on_stop(stop: Stop) -> None:
        if settings.progress is not None:
            settings.progress(progress_at(stop, mask.camera))

    # 1. Propose cameras, and descend from each: the start, views that rank high, places along
    # turns and shifts that hardly show, views that look alike.
    say("searching all views" if start is None else "fitting from the start")
    if start is None:
        places = everywhere(solver, mask, on_stop)
    else:
        places = from_start(solver, mask, start, on_stop)
    say("last level: looking for other views that fit")
    if reach is None or _leaves_nothing(solver, places.best.view, mask):
        ended = to_the_end(solver, [places.best, *places.others])
        modes = [Candidate.by_squares(solver, f) for f in ended]
        free, near, edge = free_about(solver, ended[0], places), solver, None
    else:
        # 2. Refine each on the part of the mask's edge that it believes.
        explained = solver.kind.exact and is_explained(solver, places.best.view)
        refiner = Refiner.on(solver, mask, start, reach, settings.differentiable or explained)
        alike = [places.best, *places.others]
        found = refiner.candidates([*alike, *places.rivals])
        best, *_ = kept = refiner.likeliest(found, min(len(alike), len(found)))

        # 3. Where the likeliest believes too little, propose cameras behind an occluder.
        if turns_freely(freed) and refiner.is_hidden(best):
            say("model and mask disagree: looking for something in front of the object")
            found += behind_something(refiner, best)
            kept = refiner.likeliest(found)

        # Of a drawn mask the likeliest is not where descents on pixels end: begin again, and look
        # round it.
        if kept[0].covariance is not None:
            found += looked_about(refiner, kept[0])
            kept = refiner.likeliest(found)

        # 4. Keep the modes.
        best, near, edge, modes = kept[0], kept[0].near, refiner.edge, kept
        if best.account is not None and np.any(best.account.gross) and turns_freely(freed):
            free = settled(near, best.found).free  # of the part that is believed
        else:  # (Places along what a drawn mask hardly shows are candidates.)
            free = [] if best.covariance is not None else free_about(solver, best.found, places)

    # 5. Status, covariance, words.
    fit = _fit_of(solver, mask, modes, free, edge, start, settings)
    weights = near.weights
    return fit, lambda: weights.image() if isinstance(weights, SparseImage) else weights


def _leaves_nothing(solver: Solver, view: View, mask: Mask) -> bool:
    """True if a view leaves so little of a mask, surely computed, that it has no outliers."""
    if view.touched_misfit > RULES.exact * mask.usual_weight:
        return False
    return solver.kind.exact or is_computed(mask_errors(solver, view))


def looked_about(refiner: Refiner, best: Candidate) -> list[Candidate]:
    """Candidates round about one: from the start, what looks alike, and what is tilted. (An outline
    that is all too far out or in tilts what is flat, and steps that know it do not lead back.)"""
    solver, again = refiner.solver, [] if refiner.start is None else [refiner.start]
    if not turns_freely(solver.freed):
        return refiner.proposals(again, [best])
    found = [best]
    best = add_proposals(refiner, found, [*again, *lookalikes(solver, best.found.camera)])
    tilts = tilted(best.found.camera, solver.subject.ball.centre)
    add_proposals(refiner, found, tilts, RULES.followed)
    return found[1:]


def add_proposals(
    refiner: Refiner, found: list[Candidate], cameras: list[Camera], most: int = RULES.turns
) -> Candidate:
    """Add the candidates that the likeliest of some cameras become, and what looks like the best
    of all if that is a new one; return the best."""
    before, *_ = refiner.likeliest(found)
    found += refiner.proposals(cameras, found, most)
    best, *_ = refiner.likeliest(found)
    if best is not before:
        found += refiner.proposals(lookalikes(refiner.solver, best.found.camera), found)
        best, *_ = refiner.likeliest(found)
    return best


def lookalikes(solver: Solver, camera: Camera) -> list[Camera]:
    """Cameras that the body looks alike from, and all round the lines that it is round about."""
    cameras = [*solver.subject.alike.views(camera)]
    for line in solver.subject.alike.lines:
        count = min(round(2 * np.pi / (line.pitch or RULES.start)), RULES.turns)
        cameras += turned_about(camera, line, count)[1:]
    return cameras


def behind_something(refiner: Refiner, plain: Candidate) -> list[Candidate]:
    """Candidates that see the object behind something: from what is known, then from all sides."""
    solver, mask, edge, start = refiner.solver, refiner.mask, refiner.edge, refiner.start
    known = [plain.found.camera] if start is None else [start, plain.found.camera]
    found = [plain]
    best = add_proposals(refiner, found, near_starts(solver, edge, known))
    explained = best.account if start is not None and best.is_explained() else None
    # (Where an edge wavers, another view that the start allows may explain more of it.)
    if explained is None or explained.is_drawn:
        begin = start if explained else None
        add_proposals(refiner, found, from_all_sides(solver, mask, edge, begin))
    return found[1:]


def _solver(scene: Scene, mask: Mask, freed: tuple[str, ...], settings: Settings) -> Solver:
    return Solver.on(
        Subject.from_scene(scene, mask.camera.e.dtype),
        mask,
        freed,
        settings.max_steps,
        settings.bounds,
        settings.prior,
        settings.record,
        continued=settings.outlier_px is not None,
    )


def _fit_of(
    solver: Solver,
    mask: Mask,
    modes: list[Candidate],
    free: list[Free],
    edge: Edge | None,
    start: Camera | None,
    settings: Settings,
) -> Fit:
    """The modes as a user reads them, from a start or anywhere."""
    photo = settings.photo

    def reported(mode: Candidate, free: list[Free]) -> Fit:
        about = [transported(solver, mode.found, x) for x in free]
        said, kind = mode.account, mode.near.kind
        astray = None if said is None or edge is None else said.astray(edge)
        hidden = said is not None and bool(np.any(said.gross))
        is_open = mode.covariance is None and not free and kind is not COLOURS
        flat = shelf(mode.near, mode.found) if is_open else None
        against = *_lacking(mode, mask.usual_weight), *_contradictions(mode)
        known = mode.covariance, flat, against
        context = Context(kind, settings.bounds, about, mode.errors, astray, hidden, *known)
        return report(mask.camera, mode.found, mode.whole.sums, solver.freed, context)

    best, seen = modes[0], None
    if photo is None:
        fit, *others = (reported(mode, free) for mode in modes)
    else:
        shown = _shown(solver, mask, photo, modes)
        best, seen, said = shown[0]
        open_still = [f for f in free if np.isinf(f.ahead)]
        fit, *others = (
            reported(mode, free) if seen is None else reported(seen, open_still)
            for mode, seen, _ in shown
        )
        if seen is not None and _errs_nowhere(solver, best):
            fit = fit._replace(status="misfit", weak=(*fit.weak, OF_ANOTHER))
        fit = fit._replace(weak=(*fit.weak, said.words))
    if edge is not None and best.account is not None:
        points, words = best.account.words(edge, mask.camera.H)
        doubts = _doubts(best, best.account, edge, start)
        status = "uncertain" if doubts and fit.status == "converged" else fit.status
        unbelieved = points if len(points) else None
        fit = fit._replace(unbelieved=unbelieved, status=status, weak=(*fit.weak, *words, *doubts))
    turns = [f.axis for f in free if f.axis is not None and np.isinf(f.ahead)]
    minima = best.covariance is None and seen is None
    return with_modes(fit, other_places(fit, others, turns, minima, partial(is_alike, solver)))


def _shown(
    solver: Solver, mask: Mask, photo: np.ndarray, modes: list[Candidate]
) -> list[tuple[Candidate, Candidate | None, Judgement]]:
    """The modes with what a photo gives, and says, there. Where it is better founded than the mask
    at the likeliest, those alone that it does not contradict."""
    first = on_photo(solver, mask, photo, modes[0].found)
    if first[0] is None:
        return [(mode, *first) for mode in modes]
    others = [(mode, *on_photo(solver, mask, photo, mode.found)) for mode in modes[1:]]
    shown = [(modes[0], *first), *others]
    least = min(said.off for *_, said in shown)
    return [x for x in shown if not contradicts(x[-1].off, least)]


def _errs_nowhere(solver: Solver, mode: Candidate) -> bool:
    """True if a program made the mask, as this camera sees it."""
    if solver.kind.exact:
        return is_explained(solver, mode.found.view)
    return mode.errors is not None and is_computed(mode.errors)


def _doubts(best: Candidate, said: Account, edge: Edge, start: Camera | None) -> list[str]:
    """Sentences on why a camera that fits is not sure: a part of the edge is all that speaks for
    it; the edge is off by more than masks err, or by so much that it overrules no start; the
    likelihood's steps did not come to rest."""
    doubts, off = [], said.errors.size + abs(said.errors.bias)
    away = 0.0 if start is None else angle(best.found.camera, start)
    alone = start is None and said.unbelieved(edge) >= RULES.little
    if alone and said.covered > RULES.small:
        words = "other views may fit so little of the edge as well: give a `camera` to start from"
        doubts.append(words)
    if off > RULES.astray * edge.size:
        far = f"the mask's edge is {off:.1f} px off, {off / edge.size:.0%} of the object's size"
        doubts.append(f"{far}: is it another object, or a wrong mesh?")
    if away > RULES.too_far and off > RULES.little * edge.size:
        far = f"the likeliest camera is {np.rad2deg(away):.0f} degrees from the start"
        doubts.append(f"{far}, and the mask's edge is {off:.1f} px off")
    if best.covariance is not None and said.is_drawn and said.far > RULES.times:
        far = f"{said.far:.0f} standard errors"
        doubts.append(f"the likeliest camera may be {far} away, but steps do not end there")
    return doubts


def _lacking(mode: Candidate, weight: float) -> tuple[str, ...]:
    """A sentence on outline that nothing hides, and that a mask lacks which errs nowhere else. (One
    bit, and people, leave thin parts out.)"""
    said, whole = mode.account, mode.whole
    if said is None or mode.near.kind.hard or not is_computed(mode.errors):
        return ()
    beyond = RULES.exact * float(whole.sums.touched) * weight
    if said.missing <= RULES.exact or whole.squares - mode.found.view.squares <= beyond:
        return ()
    return (f"{said.missing:.0%} of the outline is not in the mask, which errs nowhere else",)


def _contradictions(mode: Candidate) -> tuple[str, ...]:
    """Sentences on priors that the mask contradicts, and on what is not free."""
    solver, view = mode.near, mode.found.view
    alike = (ALIKE,) if err_alike(solver, view) else ()
    if not solver.weighs_prior:
        return alike
    off, rows = solver.known(mode.found.camera)
    if mode.covariance is not None and mode.account is not None:
        known = mode.account.errors.covariance
        off = off + rows @ mode.account.errors.move
    else:  # (as residuals, a prior counts as the mask does)
        rows, triangle = view.known, view.triangle
        known = np.linalg.pinv(triangle.T @ triangle)
    share = np.einsum("ki,ij,kj->k", rows, known, rows)
    return *alike, *contradictions(labels_of(solver.freed), off, share, "the mask says")


def anywhere(
    scene: Scene,
    target: ArrayLike,
    freed: tuple[str, ...],
    phi: ArrayLike | None,
    lens: Lens | None,
) -> Camera:
    """Return a camera of the target's size to begin a search with."""
    if not turns_freely(freed):
        raise ValueError(
            "`camera`: expected a camera to start from, as the pose is not free, got none with"
            f" `free` {','.join(freed)}"
        )
    shape = as_image("target", target).shape
    if 0 in shape:
        raise ValueError(f"`target`: expected shape (H, W), got shape {shape}")
    if phi is None:
        if not focal_is_free(freed):
            raise ValueError(
                "`phi`: expected the field of view (rad), a `camera`, or phi in `free`, got none"
            )
        phi = 0.7
    if not is_number(phi):
        raise ValueError(f"`phi`: expected an angle (rad), got {type(phi).__name__}")
    parts = jax.tree.leaves(scene)
    # (In the scene's units: beside an eye 10^6 away a view point at 1 would be rounded off.)
    near = reach_of(scene) if is_concrete(*parts) else 1.0
    dtype = float_dtype(*parts)
    e, p, u = (np.array(x, dtype) for x in ([0, 0, near], [0, 0, 0], [0, 1, 0]))
    return Camera(e, p, u, np.asarray(phi, dtype), 1.0, shape[1], shape[0], lens)
