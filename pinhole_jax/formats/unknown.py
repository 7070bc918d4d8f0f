"""Words for files that are not read: which program's they are, and what to do instead."""

from collections.abc import Mapping
from typing import Any

from .fields import clipped

COLMAP = "export its cameras as COLMAP"
INTRINSICS = "it holds no pose; give its numbers as --K FX FY CX CY --dist K1 K2 P1 P2"
#: By a field's name, or the root of XML: whose file it is, what to do.
PROGRAMS = {
    "cam0": ("Kalibr's camchain", INTRINSICS),
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
    names = {data.rpartition("}")[2]} if isinstance(data, str) else _names(data)
    for name, (whose, advice) in PROGRAMS.items():
        if name in names:
            return f"{whose} (by its {name!r}): {_kalibr(data) if name == 'cam0' else advice}"
    return None


def _names(data: Any) -> set[str]:
    """Return the names of fields, and of those of the first part."""
    parts = list(data.values()) if isinstance(data, Mapping) else data
    first = parts[0] if isinstance(parts, list) and parts else None
    return {str(x) for part in (data, first) if isinstance(part, Mapping) for x in part}


def _kalibr(data: Any) -> str:
    """Return advice with the first camera's numbers."""
    part = data["cam0"] if isinstance(data["cam0"], Mapping) else {}
    words = lambda name: " ".join(map(str, part[name])) if isinstance(part[name], list) else ""
    if part.get("camera_model") != "pinhole" or "intrinsics" not in part:
        return INTRINSICS
    text = f"it holds no pose; give cam0's numbers as --K {words('intrinsics')}"
    if part.get("distortion_model") == "radtan" and "distortion_coeffs" in part:
        text += f" --dist {words('distortion_coeffs')}"
    return clipped(text, 300)
