"""Pictures of a fit, as arrays (uint8 RGB) and SVG text: the outline with its uncertainty over the
photo, differences of mask and camera, where the camera's error shows, convergence, the object and
the camera in space.
"""

from . import contour_points as contour_points, outline as outline
from .show.convergence import convergence as convergence, levels as levels, off_px as off_px
from .show.outline import (
    LESS as LESS,
    MORE as MORE,
    disagreement as disagreement,
    error_map as error_map,
    object_window as object_window,
    outline_sigma as outline_sigma,
    overlay as overlay,
)
from .show.page import Svg as Svg
from .show.space import scene_view as scene_view
from .show.trust import Trust as Trust, trust as trust
