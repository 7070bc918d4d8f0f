"""The convergence of a fit, as numbers and as a diagram (SVG)."""

from itertools import groupby

import numpy as np

from .. import Fit, Progress, Scene, contour_points
from .outline import check_fit
from .page import Svg
from .space import places_of

#: The diagram's field, whose upper left corner is the origin; and all of it with its labels.
WIDTH, HEIGHT = 640, 260
BOX = f"-64 -24 {WIDTH + 80} {HEIGHT + 70}"
STYLE = (
    "text{font:12px sans-serif;fill:#456}.m{text-anchor:middle}.e{text-anchor:end}"
    "line{stroke:#fff}polyline{fill:none;stroke:#0a6b8a;stroke-width:2}circle{fill:#0a6b8a}"
)


def off_px(fit: Fit, scene: Scene) -> list[float]:
    """Return the distance (px) of the outline from its final place at each entry of `fit.history`:
    the root mean square over the points of the final contour.

    ```python
    pj.plot.off_px(fit, scene)[-1]
    ```
    """
    check_fit(fit)
    points = np.asarray(contour_points(fit.camera, scene))
    if not len(points):
        return [float("nan")] * len(fit.history)
    last = places_of(fit.camera, points)
    moves = (places_of(stop.camera, points) - last for stop in fit.history)
    return [float(np.linalg.norm(move)) / len(points) ** 0.5 for move in moves]


def levels(fit: Fit) -> list[tuple[Progress, int, int]]:
    """Return the end of each level with all its steps, and its first and last entry of
    `fit.history` (the first is the end of the level before).

    ```python
    [end.W for end, first, last in pj.plot.levels(fit)]
    ```
    """
    check_fit(fit)
    ends, last = [], 0
    for _, each in groupby(fit.history[1:], lambda stop: (stop.W, stop.H)):
        level, first = list(each), last
        last += len(level)
        end = level[-1]._replace(steps=sum(stop.steps for stop in level))
        ends.append((end, first, last))
    return ends


def _text(x: float | int, y: float | int, words: object, kind: str = "m") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" class="{kind}">{words}</text>'


def convergence(fit: Fit, scene: Scene) -> Svg:
    """Return a diagram of the outline's distance from its final place (px) over the steps, at each
    entry of `fit.history`. The levels are bands, labelled with their size in px.

    ```python
    diagram = pj.plot.convergence(fit, scene)  # SVG
    ```
    """
    off = np.maximum(off_px(fit, scene), 1e-12)
    if len(off) < 2 or not np.all(np.isfinite(off)):
        return Svg('<svg xmlns="http://www.w3.org/2000/svg" width="1" height="1"/>')
    steps = np.cumsum([stop.steps for stop in fit.history])
    shown = np.maximum(off, max(off[off > 1e-12].min(initial=1.0), 1e-9) / 10)
    low, high = np.floor(np.log10(shown.min())), np.ceil(np.log10(shown.max()) + 1e-9)
    across = lambda step: WIDTH * step / max(steps[-1], 1)
    down = lambda power: HEIGHT * (high - power) / (high - low)
    parts = [_text(WIDTH / 2, HEIGHT + 38, "steps"), _text(-8, -8, "px", "e")]
    x, y = across(steps), down(np.log10(shown))
    for k, (level, first, last) in enumerate(levels(fit)):
        a, b = x[first], x[last]
        parts.append(
            f'<rect x="{a:.1f}" y="0" width="{b - a:.1f}" height="{HEIGHT}"'
            f' fill="{("#eef2f6", "#dfe7ef")[k % 2]}"><title>{level}</title></rect>'
        )
        if b - a > 44:
            parts.append(_text((a + b) / 2, -8, f"{level.W} x {level.H}"))
    for power in range(int(low), int(high) + 1, max(int(high - low) // 7, 1)):
        at = down(power)
        parts.append(f'<line x1="0" x2="{WIDTH}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(_text(-8, at + 4, f"{10.0**power:g}", "e"))
    for step in np.unique(np.linspace(0, steps[-1], 8).round().astype(int)):
        parts.append(_text(across(step), HEIGHT + 18, step))
    line = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    parts.append(f'<polyline points="{line}"/>')
    parts += [
        f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3"><title>{o:.3g} px</title></circle>'
        for a, b, o in zip(x, y, off, strict=True)
    ]
    return Svg(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{BOX}" role="img"'
        f' aria-label="convergence"><style>{STYLE}</style>{"".join(parts)}</svg>'
    )
