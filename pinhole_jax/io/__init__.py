"""Files in and out: meshes, masks, pictures, the project's own JSON of cameras and fits."""

from ..formats.native import (
    CAMERA_SCHEMA as CAMERA_SCHEMA,
    camera_from_dict as camera_from_dict,
    camera_to_dict as camera_to_dict,
    load_camera as load_camera,
    save_camera as save_camera,
)
from .fits import (
    FIT_SCHEMA as FIT_SCHEMA,
    fit_from_dict as fit_from_dict,
    fit_to_dict as fit_to_dict,
    load_fit as load_fit,
    save_fit as save_fit,
)
from .images import (
    MOST_PIXELS as MOST_PIXELS,
    load_image as load_image,
    photo_fov as photo_fov,
    save_image as save_image,
)
from .masks import as_coverage as as_coverage, load_mask as load_mask
from .meshes import load_mesh as load_mesh
from .rle import mask_of_rle as mask_of_rle
from .text import load_json as load_json, load_text as load_text, save_text as save_text
from .tidy import TidyMask as TidyMask, tidy_mask as tidy_mask
