"""Words for files that are not read: which program's they are, and what to do instead."""

import re
from collections.abc import Mapping
from typing import Any

COLMAP = "export its cameras as COLMAP"
INTRINSICS = "it holds no pose; --K FILE takes its intrinsics (`read_intrinsics`)"
#: The cameras in Kalibr's camchain.
CAMCHAIN = re.compile(r"cam\d+")
#: By a field's name, or the root of XML: whose file it is, what to do.
PROGRAMS = {
    "sensor_type": ("EuRoC's sensor.yaml", INTRINSICS),
    "T_imu_cam": ("Basalt's calibration", INTRINSICS),
    "Camera.fx": ("ORB-SLAM's settings", INTRINSICS),
    "Camera1.fx": ("ORB-SLAM's settings", INTRINSICS),
    "projection_parameters": ("camodocal's calibration", INTRINSICS),
    "img_name": ("Gaussian splatting's cameras", "give the COLMAP model that it was trained on"),
    "cameraTransform": ("fSpy's camera", "open it in Blender (fSpy's add-on), and export glTF"),
    "shots": ("OpenSfM's reconstruction", f"{COLMAP} (opensfm export_colmap)"),
    "sfm_data_version": ("OpenMVG's scene", f"{COLMAP} (openMVG_main_openMVG2Colmap)"),
    "featuresFolders": ("Meshroom's scene", f"{COLMAP} (its node ConvertSfMFormat, ExportColmap)"),
    "cam_K": ("BOP's scene_camera.json", "`pinhole-jax batch` reads its whole data set"),
    "annotations": ("COCO's annotations", "they hold masks and no cameras"),
    "camera_path": ("nerfstudio's camera path", "give its transforms.json"),
    "document": ("Metashape's cameras", f"{COLMAP} (File, Export, Export Cameras)"),
    "BlocksExchange": ("ContextCapture's blocks", COLMAP),
    "xmpmeta": ("RealityCapture's XMP", COLMAP),
    "COLLADA": ("a Collada scene", "export it as glTF"),
    "robot": ("a URDF", "a robot is what `pinhole-jax hand-eye` takes as ROBOT"),
}


def unknown(data: Any) -> str | None:
    """Return words on whose file this is: JSON or YAML, or the root of XML; None: nobody's."""
    names = {data.rpartition(":")[2]} if isinstance(data, str) else _names(data)
    for name in sorted(filter(CAMCHAIN.fullmatch, names)):
        if isinstance(data, Mapping) and name in data:
            return f"Kalibr's camchain (by its {name!r}): {INTRINSICS}"
    for name, (whose, advice) in PROGRAMS.items():
        if name in names:
            return f"{whose} (by its {name!r}): {advice}"
    return None


def _names(data: Any) -> set[str]:
    """Return the names of fields, and of those of the first part."""
    parts = list(data.values()) if isinstance(data, Mapping) else data
    first = parts[0] if isinstance(parts, list) and parts else None
    return {str(x) for part in (data, first) if isinstance(part, Mapping) for x in part}
