"""Files in and out: meshes, masks, pictures, the project's own camera JSON."""

from ..formats.native import (
    CAMERA_SCHEMA as CAMERA_SCHEMA,
    camera_from_dict as camera_from_dict,
    camera_to_dict as camera_to_dict,
    load_camera as load_camera,
    save_camera as save_camera,
)
from .images import (
    MOST_PIXELS as MOST_PIXELS,
    load_image as load_image,
    photo_fov as photo_fov,
    save_image as save_image,
)
from .masks import load_mask as load_mask
from .meshes import load_mesh as load_mesh
