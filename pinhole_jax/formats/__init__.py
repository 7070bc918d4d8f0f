"""Cameras of other programs: each with its axes, its pixel centres and its field of view.

| format | camera axes | transform | pixel centres | field of view, focal length |
|---|---|---|---|---|
| opencv | x right, y down, z forward | camera_from_world | integers | focal, px |
| colmap | x right, y down, z forward | camera_from_world | halves | focal, px |
| nerf | x right, y up, z backward | world_from_camera | halves | focal, px, or horizontal, rad |
| blender | x right, y up, z backward | world_from_camera | - | lens, mm, of the side `sensor_fit` |
| gltf | x right, y up, z backward | world_from_camera | - | vertical, rad |
| pytorch3d | x left, y up, z forward | camera_from_world, rows | halves | focal, px or NDC |
| mitsuba | x left, y up, z forward | world_from_camera | halves | degrees, of the side `fov_axis` |
| json | the note's e, p, u | - | halves | vertical, rad |

`read` and `write` take any of them; `detect` tells which convention a camera of unknown origin has.
"""

from ._blender import read_blender as read_blender
from ._blender import to_blender as to_blender
from ._blender import to_blender_script as to_blender_script
from ._blender import write_blender as write_blender
from ._blender import write_blender_script as write_blender_script
from ._colmap import read_colmap as read_colmap
from ._colmap import write_colmap as write_colmap
from ._detective import Detection as Detection
from ._detective import Hypothesis as Hypothesis
from ._detective import detect as detect
from ._files import FORMATS as FORMATS
from ._files import guess_write as guess_write
from ._files import read as read
from ._files import read_json as read_json
from ._files import write as write
from ._files import write_json as write_json
from ._gltf import read_gltf as read_gltf
from ._gltf import write_gltf as write_gltf
from ._matrices import from_opencv as from_opencv
from ._matrices import to_opencv as to_opencv
from ._mitsuba import read_mitsuba as read_mitsuba
from ._mitsuba import write_mitsuba as write_mitsuba
from ._nerf import read_nerf as read_nerf
from ._nerf import write_nerf as write_nerf
from ._opencv import read_opencv as read_opencv
from ._opencv import write_opencv as write_opencv
from ._pytorch3d import from_pytorch3d as from_pytorch3d
from ._pytorch3d import read_pytorch3d as read_pytorch3d
from ._pytorch3d import to_pytorch3d as to_pytorch3d
from ._pytorch3d import write_pytorch3d as write_pytorch3d
from ._window import cropped as cropped
from ._window import resized as resized
