"""Write the drawings of the documentation to docs/pictures: `python docs/drawings.py`.

What they show is computed by the library (cameras, contours, coverage); lines are SVG.
"""

from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

import pinhole_jax as pj

PICTURES = Path(__file__).parent / "pictures"
INK, GREY, PALE, TEAL, ORANGE, BLUE = (
    "#1c2b36",
    "#8fa1ad",
    "#dfe7ec",
    "#00796b",
    "#d9691e",
    "#2f6fb0",
)

#: Words stand clear of the lines behind them.
HALO = 'paint-order="stroke" stroke="#fff" stroke-width="4" stroke-linejoin="round"'

Point = Sequence[float]


class Drawing:
    """An SVG picture in px, x right, y down."""

    def __init__(self, W: float, H: float):
        self.size, self.parts = (W, H), []

    def line(
        self, points: Iterable[Point], colour: str = INK, width: float = 1.5, **more: str
    ) -> None:
        """Draw a line through points."""
        at = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        self._add("polyline", points=at, fill="none", stroke=colour, stroke_width=width, **more)

    def area(
        self, points: Iterable[Point], fill: str, edge: str = "none", width: float = 1, **more: str
    ) -> None:
        """Draw a polygon."""
        at = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        self._add("polygon", points=at, fill=fill, stroke=edge, stroke_width=width, **more)

    def dot(self, at: Point, colour: str = INK, radius: float = 4) -> None:
        """Draw a dot."""
        self._add("circle", cx=f"{at[0]:.1f}", cy=f"{at[1]:.1f}", r=radius, fill=colour)

    def arrow(
        self, start: Point, end: Point, colour: str = INK, width: float = 2, **more: str
    ) -> None:
        """Draw a line with a head at its end."""
        a, b = np.asarray(start, float), np.asarray(end, float)
        along = (b - a) / np.linalg.norm(b - a)
        across = np.array([-along[1], along[0]])
        neck = b - 9 * along
        self.line([a, neck], colour, width, **more)
        self.area([b, neck + 4 * across, neck - 4 * across], colour)

    def words(
        self, at: Point, text: str, colour: str = INK, anchor: str = "start", size: int = 15
    ) -> None:
        """Draw words, from a point on."""
        place = f'x="{at[0]:.1f}" y="{at[1]:.1f}" font-size="{size}"'
        self.parts.append(
            f'<text {place} fill="{colour}" text-anchor="{anchor}" {HALO}>{text}</text>'
        )

    def write(self, name: str, title: str) -> None:
        """Write the drawing to a file."""
        W, H = self.size
        size = f'viewBox="0 0 {W} {H}" width="{W}" height="{H}"'
        head = f'<svg xmlns="http://www.w3.org/2000/svg" {size}'
        body = "\n".join(self.parts)
        text = f'{head} font-family="sans-serif" role="img" aria-label="{title}">\n{body}\n</svg>\n'
        (PICTURES / f"{name}.svg").write_text(text, encoding="utf-8")

    def _add(self, tag: str, **attributes: object) -> None:
        told = " ".join(f'{k.replace("_", "-")}="{v}"' for k, v in attributes.items())
        self.parts.append(f"<{tag} {told}/>")


def seen_by(camera: pj.Camera):
    """Return a function from points in space to places in a drawing of the camera's size."""

    def place(*points: Point) -> np.ndarray:
        xy = np.asarray(pj.project(camera, np.asarray(points, np.float32)), float)
        return xy * [1, -1] + [0, camera.H]

    return place


def conventions() -> None:
    """Draw a camera, as another one sees it: eye, view point, film, axes."""
    W, H, d, phi = 6, 4, 2.2, 0.62
    camera = pj.Camera([0, 0.35, 5.4], [0, 0, 0], [0.25, 1, 0.2], phi, d, W, H)
    beside = [6.6, 3.2, 9.2]
    place = seen_by(pj.Camera(beside, [0.1, 0.05, 2.75], [0, 1, 0], 0.36, W=760, H=380))
    e, p, u = (np.asarray(x, float) for x in (camera.e, camera.p, camera.u))
    b1, b2, v = (np.asarray(x, float) for x in pj.camera_basis(camera))
    h = 2 * d * np.tan(phi / 2)
    w = h * W / H
    film = lambda x, y: e + d * v + (x / W - 0.5) * w * b1 + (y / H - 0.5) * h * b2
    picture = Drawing(760, 380)

    mesh = pj.shapes.bumpy(2)
    corners = 0.62 * np.asarray(mesh.vertices)[np.asarray(mesh.faces)] * [1.2, 1, 0.9]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    towards = beside - corners.mean(axis=1)
    facing = np.einsum("nk,nk->n", normal, towards) > 0
    for triangle in corners[facing]:
        picture.area(place(*triangle), "#eee3d0", "#cdbb9b", 0.6)

    for corner in (film(0, 0), film(W, 0), film(W, H), film(0, H)):
        picture.line(place(e, corner), GREY, 1)
    picture.area(
        place(film(0, 0), film(W, 0), film(W, H), film(0, H)),
        "#00796b",
        TEAL,
        2,
        fill_opacity="0.13",
    )
    for i in range(1, W):
        picture.line(place(film(i, 0), film(i, H)), TEAL, 0.7)
    for j in range(1, H):
        picture.line(place(film(0, j), film(W, j)), TEAL, 0.7)
    picture.area(place(film(0, 0), film(1, 0), film(1, 1), film(0, 1)), ORANGE, fill_opacity="0.75")

    picture.line(place(e, p), INK, 1.2, stroke_dasharray="6 5")
    middle = film(W / 2, H / 2)
    top, bottom = film(W / 2, H), film(W / 2, 0)
    picture.line(place(e, top), BLUE, 1.2)
    picture.line(place(e, bottom), BLUE, 1.2)
    rim = [e + 0.8 * (np.cos(t) * v + np.sin(t) * b2) for t in np.linspace(-phi / 2, phi / 2, 20)]
    picture.line(place(*rim), BLUE, 2)
    x, y = place(e + 1.0 * v + 0.02 * b2)[0]
    picture.words((x - 26, y + 6), "φ", BLUE, "middle", 19)
    for axis, name, shift in ((b1, "b1", (6, 4)), (b2, "b2", (-26, -2)), (v, "v", (-4, -12))):
        start, end = place(e, e + 0.95 * axis)
        picture.arrow(start, end, TEAL, 2.5)
        picture.words(end + shift, name, TEAL, size=16)
    start, end = place(e, e + 1.15 * u)
    picture.arrow(start, end, GREY, 2, stroke_dasharray="5 4")
    picture.words(end + np.array([8, 2]), "u", GREY, size=16)

    for at, name, shift in ((e, "e  eye", (-24, 24)), (p, "p  view point", (-20, -10))):
        (spot,) = place(at)
        picture.dot(spot)
        picture.words(spot + shift, name, size=16)
    a, b = place(film(W + 0.35, 0), film(W + 0.35, H))
    picture.line([a, b], INK, 1)
    picture.words((a + b) / 2 + [8, 14], "h = 2 d tan(φ/2)")
    a, b = place(film(0, -0.45), film(W, -0.45))
    picture.line([a, b], INK, 1)
    picture.words((a + b) / 2 + [-10, 18], "w = h W/H", anchor="end")
    (spot,) = place(film(0, 0))
    picture.words(spot + np.array([-12, -48]), "pixel (0, 0)", ORANGE, "end")
    a, b = place(e, middle)
    picture.words(a + 0.72 * (b - a) + [4, -6], "d", INK, size=16)
    picture.write("conventions", "Eye, view point, film and axes of the camera")


def pixels() -> None:
    """Draw a film of 6 by 4 pixels with both ways to count."""
    W, H, cell, left, top = 6, 4, 64, 150, 60
    at = lambda x, y: (left + cell * x, top + cell * (H - y))
    picture = Drawing(720, 380)
    picture.area([at(0, 0), at(1, 0), at(1, 1), at(0, 1)], ORANGE, fill_opacity="0.6")
    picture.area([at(4, 2), at(5, 2), at(5, 3), at(4, 3)], BLUE, fill_opacity="0.35")
    for i in range(W + 1):
        picture.line([at(i, 0), at(i, H)], GREY, 1)
        picture.words((at(i, 0)[0], at(0, 0)[1] + 22), str(i), anchor="middle", size=13)
    for j in range(H + 1):
        picture.line([at(0, j), at(W, j)], GREY, 1)
        picture.words((left - 12, at(0, j)[1] + 5), str(j), anchor="end", size=13)
    picture.arrow(at(0, 0), at(W + 0.6, 0), TEAL)
    picture.arrow(at(0, 0), at(0, H + 0.5), TEAL)
    picture.words(at(W + 0.7, -0.08), "x", TEAL, size=17)
    picture.words(at(-0.28, H + 0.45), "y", TEAL, size=17)
    for x, y in ((0.5, 0.5), (4.5, 2.5)):
        picture.dot(at(x, y), INK, 3)
    picture.words(at(0.08, 0.12), "(0.5, 0.5)", size=11)
    picture.words(at(4.08, 2.12), "(4.5, 2.5)", size=11)
    right = left + cell * W + 26
    picture.words((right, top + 26), "row 0 of the array", size=14)
    picture.words((right, top + 26 + cell), "row 1", size=14)
    picture.words((right, top + 46 + cell), "image[1, 4] is pixel (4, 2)", BLUE, size=14)
    picture.words((right, top + 26 + 3 * cell), "row 3 = H-1-0", size=14)
    picture.words((right, top + 46 + 3 * cell), "image[3, 0] is pixel (0, 0)", ORANGE, size=14)
    picture.write("pixels", "A film of 6 by 4 pixels")


def contour() -> None:
    """Draw a mesh's front faces, its contour, and the outline."""
    camera = pj.Camera([0.3, 1, 5], [0, 0, 0], [0.2, 1, 0.1], 0.5, W=520, H=420)
    mesh = pj.shapes.bumpy(2, seed=3, bumps=0.15)
    place, eye = seen_by(camera), np.asarray(camera.e, float)
    points, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    corners = points[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    front = np.einsum("nk,nk->n", normal, eye - corners[:, 0]) > 0
    picture = Drawing(760, 420)
    far = np.argsort(-np.linalg.norm(corners.mean(axis=1) - eye, axis=1))
    light = normal @ [0.3, 0.8, 0.5] / np.linalg.norm(normal, axis=1)
    for k in far[front[far]]:
        grey = int(215 + 30 * light[k])
        picture.area(place(*corners[k]), f"rgb({grey},{grey},{grey - 8})", "#b9c4cb", 0.6)
    outline = pj.plot.outline(camera, pj.Scene(mesh=mesh)) * [1, -1] + [0, camera.H]
    ends, beside = np.asarray(mesh.edge_vertices), np.asarray(mesh.edge_faces)
    for edge in ends[front[beside[:, 0]] != front[beside[:, 1]]]:
        picture.line(place(*points[edge]), INK, 2.6)
    for segment in outline:
        picture.line(segment, ORANGE, 3.2, stroke_linecap="round")
    for n, (colour, name) in enumerate(
        (
            (ORANGE, "outline: the background is beside it"),
            (INK, "contour, hidden or within"),
            ("#b9c4cb", "other edges"),
        )
    ):
        picture.line([(510, 60 + 28 * n), (536, 60 + 28 * n)], colour, 3)
        picture.words((544, 65 + 28 * n), name, size=13)
    count = int(np.sum(front[beside[:, 0]] != front[beside[:, 1]]))
    picture.words((510, 160), f"{len(faces)} faces, {len(ends)} edges,", size=13)
    picture.words((510, 180), f"{count} of them contour", size=13)
    picture.write("contour", "A mesh and its occluding contour")


def grid(picture: Drawing, left: float, top: float, columns: int, rows: int, cell: float) -> None:
    """Draw a grid of pixels."""
    for i in range(columns + 1):
        picture.line([(left + cell * i, top), (left + cell * i, top + cell * rows)], GREY, 1)
    for j in range(rows + 1):
        picture.line([(left, top + cell * j), (left + cell * columns, top + cell * j)], GREY, 1)


def green() -> None:
    """Draw what a piece of contour adds to its row."""
    cell, left, top = 110, 40, 40
    picture = Drawing(720, 240)
    at = lambda x, y: (left + cell * x, top + cell * (1 - y))
    a, b = (1.25, 0.2), (1.7, 0.85)
    picture.area([at(*a), at(2, a[1]), at(2, b[1]), at(*b)], ORANGE, fill_opacity="0.55")
    picture.area([at(2, a[1]), at(6, a[1]), at(6, b[1]), at(2, b[1])], BLUE, fill_opacity="0.3")
    grid(picture, left, top, 6, 1, cell)
    picture.arrow(at(*b), at(*a), INK, 3)
    picture.words((left + 1.02 * cell, top + cell + 26), "its own pixel:", ORANGE, size=14)
    picture.words((left + 1.02 * cell, top + cell + 46), "the area on its right", ORANGE, size=14)
    picture.words(
        (left + 3.0 * cell, top + cell + 26),
        "every pixel to the right: its height",
        BLUE,
        "start",
        14,
    )
    picture.words(
        (left, top - 14),
        "One piece of contour, the object on its left as it runs; a closed contour's pieces"
        " add up to coverage.",
        size=13,
    )
    picture.write("green", "Area and height of a piece of contour")


def velocity() -> None:
    """Draw the strip that an outline sweeps in a pixel."""
    cell, left, top = 220, 40, 30
    picture = Drawing(720, 290)
    at = lambda x, y: (left + cell * x, top + cell * (1 - y))
    line = lambda shift: [(0.18 + shift, 0.0), (0.62 + shift * 0.7, 1.0)]
    before, after = line(0), line(0.14)
    picture.area([at(0, 0), at(*before[0]), at(*before[1]), at(0, 1)], PALE)
    picture.area(
        [at(*before[0]), at(*after[0]), at(*after[1]), at(*before[1])], ORANGE, fill_opacity="0.6"
    )
    grid(picture, left, top, 1, 1, cell)
    picture.line([at(*x) for x in before], INK, 3)
    picture.line([at(*x) for x in after], INK, 1.5, stroke_dasharray="6 4")
    for t in (0.2, 0.5, 0.8):
        a, b = (np.array(x[0]) + t * (np.array(x[1]) - x[0]) for x in (before, after))
        along = np.array(before[1]) - before[0]
        normal = np.array([along[1], -along[0]]) / np.linalg.norm(along)
        picture.arrow(at(*a), at(*(a + normal * max((b - a) @ normal, 0))), TEAL, 2)
    for n, words in enumerate(
        (
            "a parameter moves the outline (dashed)",
            "the pixel gains the strip: its length times",
            "how far the outline moves across itself",
            "",
            "dI/dθ = ∫ (dx/dθ · n) ds  over the outline in the pixel",
        )
    ):
        picture.words(
            (left + cell + 40, 90 + 26 * n), words, TEAL if "∫" in words else INK, size=16
        )
    picture.write("velocity", "The strip that an outline sweeps")


def sweep() -> None:
    """Draw two triangles in a pixel, the sweep's halts and the trapezoids of their union."""
    import shapely

    cell, left, top = 320, 40, 30
    at = lambda x, y: (left + cell * x, top + cell * (1 - y))
    triangles = [
        [(-0.3, 0.1), (0.75, 0.22), (0.3, 0.95)],
        [(0.35, 0.35), (1.3, 0.12), (0.95, 0.82)],
    ]
    pixel = shapely.box(0, 0, 1, 1)
    shapes = [shapely.Polygon(t) for t in triangles]
    union = shapely.union_all(shapes).intersection(pixel)
    borders = [s.boundary.intersection(pixel) for s in shapes]
    halts = {0.0, 1.0}
    for border in borders:
        halts |= {y for part in shapely.get_parts(border) for _, y in part.coords}
    halts |= {p.y for p in shapely.get_parts(borders[0].intersection(borders[1]))}
    picture = Drawing(720, 380)
    stops = sorted(halts)
    for n, (low, high) in enumerate(pairwise(stops)):
        strip = union.intersection(shapely.box(0, low, 1, high))
        for part in shapely.get_parts(strip):
            if part.geom_type == "Polygon" and part.area > 1e-9:
                corners = [at(*c) for c in part.exterior.coords]
                picture.area(corners, (TEAL, BLUE)[n % 2], fill_opacity="0.3")
    for y in stops[1:-1]:
        picture.line([at(-0.06, y), at(1.06, y)], GREY, 1, stroke_dasharray="5 4")
    grid(picture, left, top, 1, 1, cell)
    for border, colour in zip(borders, (INK, ORANGE), strict=True):
        for part in shapely.get_parts(border):
            picture.line([at(*c) for c in part.coords], colour, 2.6)
    picture.arrow(at(1.12, 0.05), at(1.12, 0.95), TEAL, 2)
    for n, words in enumerate(
        (
            "one pixel, two layers (black, orange)",
            "the sweep halts where a piece begins,",
            "ends, or meets another",
            "between halts: trapezoids",
            "",
            f"covered: {union.area:.3f} of the pixel",
            f"layers added up: {sum(s.intersection(pixel).area for s in shapes):.3f}",
        )
    ):
        picture.words((left + cell + 80, 90 + 26 * n), words, size=15)
    picture.write("sweep", "A sweep through a pixel with overlaps")


def kinds() -> None:
    """Draw four masks of one outline."""
    camera = pj.Camera([0.3, 1, 5], [0, 0, 0], [0.2, 1, 0.1], 0.6, W=32, H=32)
    scene, cell, size = pj.Scene(mesh=pj.shapes.bumpy(3)), 15, 11
    exact = np.asarray(pj.silhouette(camera, scene), float)
    larger = np.asarray(pj.silhouette(camera.replace(phi=0.555), scene), float)
    random = np.random.default_rng(0)
    masks = {
        "exact": exact,
        "hard": np.round(exact),
        "noisy": np.clip(exact + 0.12 * random.normal(size=exact.shape), 0, 1),
        "drawn: outwards": np.round(larger),
    }
    words = {
        "exact": "leaves rounding",
        "hard": "half a pixel",
        "noisy": "the noise",
        "drawn: outwards": "whole stretches",
    }
    row, column = 3, 3
    outline = pj.plot.outline(camera, scene)
    picture = Drawing(760, 250)
    for n, (name, mask) in enumerate(masks.items()):
        left, top = 16 + n * 186, 40
        for j in range(size):
            for i in range(size):
                grey = int(255 - 165 * mask[row + j, column + i])
                x, y = left + cell * i, top + cell * j
                box = [(x, y), (x + cell, y), (x + cell, y + cell), (x, y + cell)]
                picture.area(box, f"rgb({grey},{grey},{grey})", "#e8ecef", 0.5)
        for a, b in outline:
            middle = (np.array(a) + b) / 2 - [column, 32 - row - size]
            if np.all((middle > 0) & (middle < size)):
                ends = [
                    (left + cell * (x - column), top + cell * (32 - y - row)) for x, y in (a, b)
                ]
                picture.line(ends, ORANGE, 2.4)
        picture.words((left, top - 14), name, size=15)
        picture.words((left, top + cell * size + 24), words[name], GREY, size=14)
    picture.write("kinds", "Four masks of one outline")


if __name__ == "__main__":
    PICTURES.mkdir(exist_ok=True)
    for draw in (conventions, pixels, contour, green, velocity, sweep, kinds):
        draw()
        print(PICTURES / f"{draw.__name__}.svg")
