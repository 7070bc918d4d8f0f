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

from .blender import (
    read_blender as read_blender,
    to_blender as to_blender,
    to_blender_script as to_blender_script,
    write_blender as write_blender,
    write_blender_script as write_blender_script,
)
from .colmap import read_colmap as read_colmap, write_colmap as write_colmap
from .detection import Detection as Detection, Hypothesis as Hypothesis, detect as detect
from .files import (
    FORMATS as FORMATS,
    guess_write as guess_write,
    read as read,
    read_one as read_one,
    write as write,
)
from .gltf import read_gltf as read_gltf, write_gltf as write_gltf
from .intrinsics import read_intrinsics as read_intrinsics
from .mitsuba import read_mitsuba as read_mitsuba, write_mitsuba as write_mitsuba
from .native import read_json as read_json, write_json as write_json
from .nerf import read_nerf as read_nerf, write_nerf as write_nerf
from .object_pose import ObjectPose as ObjectPose, object_pose as object_pose
from .opencv import read_opencv as read_opencv, write_opencv as write_opencv
from .pinhole import from_opencv as from_opencv, to_opencv as to_opencv
from .pytorch3d import (
    from_pytorch3d as from_pytorch3d,
    read_pytorch3d as read_pytorch3d,
    to_pytorch3d as to_pytorch3d,
    write_pytorch3d as write_pytorch3d,
)
from .window import cropped as cropped, resized as resized
