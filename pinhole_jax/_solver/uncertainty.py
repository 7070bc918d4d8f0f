"""What a fit knows: covariance, and the directions in which the image does not change, as
sentences."""

from collections.abc import Callable, Sequence

import numpy as np

from .._rules import RULES
from .heading import carried
from .parameters import COMPONENTS

#: Singular values under this share of the largest count as no information at all ...
BLIND = {np.dtype(np.float32): 1e-5, np.dtype(np.float64): 1e-9}
#: ... under this one as so little that a turn by it gives no other view ...
UNSEEN = 1e-3
#: A parameter's part in a direction is named if it is larger.
CHIEF = 0.35


def covariance(
    triangle: np.ndarray, to_reported: np.ndarray, gradient: np.ndarray, blind: float
) -> np.ndarray:
    """Return the covariance (n, n) of the reported parameters.

    `triangle` is R of J = QR for the residuals, `to_reported` the derivative of the reported
    parameters with respect to the moves, `gradient` (n, n) the covariance of J^T r: variance times
    R^T R where residuals are independent and of one variance, and where they are not what makes it
    the sandwich (Huber 1967). A parameter that moves along a direction which changes no pixel has
    infinite variance, and no covariance (NaN).
    """
    values, share, directions = shown(triangle)
    seen = share > blind
    back = directions[seen] / values[seen][:, None] ** 2
    of_directions = np.diag(np.full(len(values), np.inf))
    of_directions[np.ix_(seen, seen)] = back @ gradient @ back.T
    return carried(of_directions, to_reported @ directions.T)


def shown(triangle: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How much each direction of moves shows, the best-seen one first; its share of that;
    and the directions (n, n)."""
    _, values, directions = np.linalg.svd(triangle)
    return values, values / max(values[0], np.finfo(values.dtype).tiny), directions


def weak_directions(
    triangle: np.ndarray,
    words: Callable[[np.ndarray], list[str]],
    blind: float,
    named: Sequence[np.ndarray] = (),
) -> tuple[bool, tuple[str, ...]]:
    """True if a direction is not seen at all, and each weak direction as a sentence, but for
    those that are `named` already. `words` has phrases for the chief parts of a direction."""
    _, share, directions = shown(triangle)
    sentences = tuple(
        sentence(words(direction), s, bool(s <= blind))
        for s, direction in zip(share[::-1], directions[::-1], strict=True)
        if s < RULES.weak and all(abs(direction @ m) < 0.7 * np.linalg.norm(m) for m in named)
    )
    return bool(share[-1] <= blind), sentences


def weak_moves(
    triangle: np.ndarray, components: list[str], weak: float | None = None
) -> list[tuple[float, np.ndarray]]:
    """Return the singular values and directions (n,) of turns and shifts that show less than a
    share of the best-seen move, the least last."""
    pose = np.array([c.split("_")[0] in ("turn", "spin", "shift") for c in components])
    values, share, directions = shown(triangle)
    some = (share < (weak or RULES.weak)) & (np.linalg.norm(directions[:, pose], axis=1) > 0.7)
    return [*zip(values[some], directions[some], strict=True)]


def free_turns(triangle: np.ndarray, components: list[str], axes: np.ndarray) -> np.ndarray:
    """Return the axes (k, 3), in the world, of turns about the object that hardly show."""
    turns = [k for k, c in enumerate(components) if c.startswith("turn")]
    _, share, directions = shown(triangle)
    hidden = directions[share < UNSEEN]
    _, size, vectors = np.linalg.svd(hidden[:, turns] @ axes if turns else np.zeros((0, 3)))
    return vectors[: np.sum(size > 0.3)]


def sentence(moves: list[str], share: float, hidden: bool) -> str:
    """A sentence on moves that hardly show together: a `share` of the best-seen move."""
    if hidden:
        return f"{' against '.join(moves)} is not visible"
    what = "is hardly visible" if len(moves) == 1 else "are hard to tell apart"
    return f"{' and '.join(moves)} {what} ({share:.1%} as visible as the best-seen move)"


def moves_in_words(components: Sequence[str], axes: np.ndarray, direction: np.ndarray) -> list[str]:
    """Phrases for the chief parts of a direction of moves (in pixels) of these names: their effects
    on a camera of these axes (3, 3), in the world."""
    words = [COMPONENTS[name].words for name in components]
    named = []
    for chief in chief_words(words, direction):
        group = [k for k, word in enumerate(words) if word == chief]
        if COMPONENTS[components[group[0]]].is_turn:
            chief += " about the axis " + in_words(direction[group] @ axes)
        named.append(chief)
    return named or ["a mixture of all parameters"]


def chief_words(words: Sequence[str], direction: np.ndarray) -> list[str]:
    """Those of the words of each number (n,) that have the chief parts of a direction, the largest
    first; the parts of a vector share their words."""
    size = {
        chief: float(np.linalg.norm(direction[[word == chief for word in words]]))
        for chief in dict.fromkeys(words)
    }
    return sorted((word for word in size if size[word] > CHIEF), key=lambda word: -size[word])


def in_words(vector: np.ndarray) -> str:
    """Return the direction of an axis, its largest component positive."""
    unit = vector / max(float(np.linalg.norm(vector)), 1e-300)
    unit = unit * np.sign(unit[np.argmax(np.abs(unit))] or 1)
    return "(" + ", ".join(f"{x:.2f}" for x in np.round(unit, 2) + 0.0) + ")"
