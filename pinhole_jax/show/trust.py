"""Where a camera's error shows: over the film (px), on the outline, and at the object."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .. import Camera, Fit, Scene, outline
from .outline import check_fit, outline_sigma, sigma_moves
from .page import Svg
from .space import axes_of, from_top, places_of, points_at, points_of

#: The film is divided into about this many fields across, and drawn this wide.
FIELDS, WIDTH = 48, 560.0
#: Bands of px, each up to 2 to 2.5 times the last, from dark (well known) to light.
STEPS = (1.0, 2.0, 5.0)
COLOURS = ("#123f5a", "#1d6a80", "#3f9487", "#85b86b", "#d3ce5a", "#f4a14a", "#d9542f")


class Trust(NamedTuple):
    """Where a camera's error shows, at one standard error in the worst direction.

    - `film` (n,): px, at `places` (n, 2) on the film (px, y up), for points at the object's depth.
    - `outline` (m,): px, each segment of the outline across itself, as `outline_sigma`.
    - `object`: world units, that point of the object before the camera that errs most; `point` (3,)
      is where it is in the world.
    - `picture`: the film by bands of px, with the outline.

    Parameters that the mask does not determine are left out.

    ```python
    trust = pj.plot.trust(fit, scene)
    print(trust.object, trust.point)
    ```
    """

    places: Float[np.ndarray, "n 2"]
    film: Float[np.ndarray, "n"]
    outline: Float[np.ndarray, "m"]
    object: float
    point: Float[np.ndarray, "3"]
    picture: Svg

    def __str__(self) -> str:
        """Return it as a sentence."""
        place = ", ".join(f"{x:.3g}" for x in self.point)
        edge = f", the outline by up to {self.outline.max():.2g} px" if self.outline.size else ""
        return (
            "An error of one sigma moves points at the object's depth by"
            f" {self.film.min():.2g} to {self.film.max():.2g} px{edge}, and the object by up to"
            f" {self.object:.2g} units of the mesh, at ({place})."
        )

    def _repr_svg_(self) -> str:
        return str(self.picture)


def trust(fit: Fit, scene: Scene) -> Trust:
    """Return the places where a camera's error shows: a map of the film, and numbers.

    To first order, from the fit's covariance. Notebooks show the map.

    ```python
    trust = pj.plot.trust(fit, scene)
    print(trust)  # "An error of one sigma moves points ..."
    ```
    """
    check_fit(fit)
    camera, points = fit.camera, points_of(scene)
    before = lambda c: (points - np.asarray(c.e, float)) @ axes_of(c).T
    depth = float(np.mean(before(camera)[:, 2]))
    shape = max(round(FIELDS * camera.H / camera.W), 1), FIELDS
    middles = np.argwhere(np.ones(shape)) + 0.5  # row, column
    places = (middles / shape)[:, ::-1] * [camera.W, camera.H]
    on_plane = points_at(camera, places, depth)
    shown = lambda c: places_of(c, on_plane)
    # One sigma of each value (n, k), in the direction where it is largest.
    film, spread = (
        np.linalg.norm(sigma_moves(fit, value, abs(depth)), ord=2, axis=(0, 2))
        for value in (shown, before)
    )
    farthest = int(np.argmax(spread))
    across = outline_sigma(fit, scene)
    picture = _picture(camera, film.reshape(shape), outline(camera, scene))
    return Trust(places, film, across, float(spread[farthest]), points[farthest], picture)


def _picture(camera: Camera, sigma: np.ndarray, lines: np.ndarray) -> Svg:
    """The film in bands, the outline upon it, and a legend."""
    rows, columns = sigma.shape
    ends = np.outer(10.0 ** np.arange(-9, 12), STEPS).ravel()  # of the bands, px
    first, last = np.searchsorted(ends, [sigma.min(), sigma.max()])
    ends = ends[max(first, last + 1 - len(COLOURS)) : last + 1]
    scale = WIDTH / camera.W
    side, height = WIDTH / columns, camera.H * scale
    high = height / rows
    band = np.minimum(np.searchsorted(ends, sigma), len(ends) - 1)
    film = [
        f'<rect x="{j * side:.1f}" y="{height - (i + 1) * high:.1f}" width="{side + 0.5:.1f}"'
        f' height="{high + 0.5:.1f}" fill="{COLOURS[band[i, j]]}"/>'
        for i, j in np.ndindex(rows, columns)
    ]
    shown = scale * from_top(camera, lines)
    ways = " ".join(f"M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}" for (a, b), (c, d) in shown.tolist())
    for colour, width in (("#fff", 3), ("#000", 1.2)):
        film.append(f'<path d="{ways}" stroke="{colour}" stroke-width="{width}" fill="none"/>')
    wide, legend = WIDTH / len(ends), ""
    for k, end in enumerate(ends):
        box = f'x="{k * wide:.1f}" y="{height + 10:.1f}" width="14" height="14"'
        words = f'<text x="{k * wide + 19:.1f}" y="{height + 22:.1f}">'
        legend += f'<rect {box} fill="{COLOURS[k]}"/>{words}&lt; {end:.3g} px</text>'
    return Svg(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH:g} {height + 30:.0f}"'
        ' role="img" aria-label="one sigma over the film, px" font-family="sans-serif"'
        f' font-size="12"><clipPath id="film"><rect width="{WIDTH:g}" height="{height:.1f}"/>'
        f'</clipPath><g clip-path="url(#film)">{"".join(film)}</g>{legend}</svg>'
    )
