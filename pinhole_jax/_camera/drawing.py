"""What notebooks show of a camera: HTML tables, its frustum as SVG, in the page's own colours."""

import html
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from jaxtyping import Float

#: Width and height of a frustum's picture, and the room about what is drawn (px).
W, H, ROOM = 240, 170, 16
#: How far above and behind its own line of sight a camera is looked at from (rad).
ABOVE, BEHIND = 0.44, 0.35
#: The film's corners, and the world's axes with their colours.
CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, 1))
WORLD = (("x", "#d9691e"), ("y", "#3a9a4b"), ("z", "#2f6fb0"))
TEAL, GREY = "#008573", "#8fa1ad"

Points = Float[np.ndarray, "n 3"]


def table(rows: Iterable[Sequence[str]], head: Sequence[str] = ()) -> str:
    """Return an HTML table; of each row the first cell is its head. All words are escaped."""
    cells = lambda tag, row: "".join(f"<{tag}>{html.escape(word)}</{tag}>" for word in row)
    first = f"<thead><tr>{cells('th', head)}</tr></thead>" if head else ""
    lines = (f"<tr>{cells('th', row[:1])}{cells('td', row[1:])}</tr>" for row in rows)
    return f"<table>{first}<tbody>{''.join(lines)}</tbody></table>"


def card(title: str, *parts: str) -> str:
    """Return HTML: a title, and below it parts beside one another where there is room."""
    style = "display:flex;flex-wrap:wrap;gap:20px;align-items:center"
    return f'<div><div>{title}</div><div style="{style}">{"".join(parts)}</div></div>'


def frustum(
    axes: Float[np.ndarray, "3 3"],
    eye: Float[np.ndarray, "3"],
    far: float,
    half: tuple[float, float],
    way: Float[np.ndarray, "steps 3"],
    others: Float[np.ndarray, "views 3"],
) -> str:
    """Return a parallel view of a camera as SVG: its pyramid up to the view point, a tick upwards,
    the world's axes at the view point. Nothing where numbers are not finite.

    - `axes`: rows b1, b2, v; `far`: from the eye to the view point.
    - `half`: tangents of half the field of view, sideways and upwards.
    - `way`: where the eye was before, a dotted line; `others`: other eyes, rings.
    """
    b1, b2, v = axes
    film = eye + far * np.array([v + x * half[0] * b1 + y * half[1] * b2 for x, y in CORNERS])
    middle = eye + far * v
    tick = middle + 1.3 * far * half[1] * b2
    world = middle + 0.6 * far * half[1] * np.eye(3)
    spread = np.concatenate([film, world, way, others, np.stack([eye, middle, tick])])
    if not np.all(np.isfinite(spread)):
        return ""
    place = _placed(spread, axes)

    line = lambda points, style: f'<polyline points="{_at(place(points))}" fill="none" {style}/>'
    dot = lambda point, style: "<circle cx='{:.1f}' cy='{:.1f}' r='3.5' {}/>".format(*point, style)
    edge = f'stroke="{TEAL}" stroke-width="1.6"'
    parts = [f'<polygon points="{_at(place(film))}" fill="{TEAL}" fill-opacity="0.13" {edge}/>']
    parts += [line(np.stack([eye, corner]), edge) for corner in film]
    parts.append(line(np.stack([film[3], tick, film[2]]), edge))
    for (name, colour), end in zip(WORLD, world, strict=True):
        parts.append(line(np.stack([middle, end]), f'stroke="{colour}" stroke-width="2"'))
        x, y = place(end[None])[0]
        parts.append(f'<text x="{x:.1f}" y="{y:.1f}" fill="{colour}" font-size="11">{name}</text>')
    if len(way):
        steps = np.concatenate([way, eye[None]])
        parts.append(line(steps, f'stroke="{GREY}" stroke-width="1.5" stroke-dasharray="2 3"'))
    parts += [dot(p, f'fill="none" stroke="{GREY}" stroke-width="1.5"') for p in place(others)]
    parts.append(dot(place(eye[None])[0], f'fill="{TEAL}"'))
    size = f'width="{W}" height="{H}" viewBox="0 0 {W} {H}"'
    words = 'role="img" aria-label="the camera in the world" font-family="sans-serif"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size} {words}>{"".join(parts)}</svg>'


def _placed(spread: Points, axes: Float[np.ndarray, "3 3"]) -> Callable[[Points], np.ndarray]:
    """Return a function from points in space to px of a picture that has room for all of them."""
    b1, b2, v = axes
    aside = np.cos(BEHIND) * b1 - np.sin(BEHIND) * v
    back = np.cos(ABOVE) * aside + np.sin(ABOVE) * b2
    right = np.cross(b2, back)
    right /= np.linalg.norm(right)
    onto = np.stack([right, -np.cross(back, right)], axis=1)  # y runs down
    low, high = (spread @ onto).min(axis=0), (spread @ onto).max(axis=0)
    scale = np.min(([W, H] - 2 * np.array(ROOM)) / np.maximum(high - low, 1e-30))
    return lambda points: (points @ onto - (low + high) / 2) * scale + [W / 2, H / 2]


def _at(points: np.ndarray) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
