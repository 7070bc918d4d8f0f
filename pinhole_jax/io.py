"""Files in and out: meshes, masks, pictures, the project's own camera JSON."""

import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ._camera import Camera, camera_basis, focal_px, principal_point
from ._lens import Lens
from ._scene import Mesh

MESH_ENDINGS = (".obj", ".ply", ".stl", ".glb", ".gltf", ".off")


def load_mesh(path: str | os.PathLike) -> Mesh:
    """Return the triangles of a mesh file (obj, ply, stl, glb, gltf, off), as one mesh.

    Scenes of several geometries are put together with their node transforms, polygons are
    triangulated, and vertices at exactly the same place are merged so that faces share edges.

    Raises FileNotFoundError, or ValueError where the file is no mesh, has no faces, has vertices
    that are not finite, or faces that name vertices it does not have.
    """
    import trimesh

    file = Path(path)
    if not file.exists():
        raise FileNotFoundError(f"`path`: expected a mesh file, got {str(path)!r}: no such file")
    if file.is_dir():
        raise ValueError(f"`path`: expected a mesh file, got {str(path)!r}: a folder")
    if file.suffix.lower() not in MESH_ENDINGS:
        raise ValueError(f"`path`: expected one of {', '.join(MESH_ENDINGS)}, got {file.name!r}")
    if file.stat().st_size == 0:
        raise ValueError(f"`path`: expected a mesh file, got {str(path)!r}: empty")
    try:
        scene = trimesh.load_scene(file, process=False, maintain_order=True)
        parts = [g for g in scene.dump() if isinstance(g, trimesh.Trimesh)]
    except Exception as error:  # the readers raise whatever they meet
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(
            f"`path`: expected a readable mesh, got {str(path)!r}: {reason}"
        ) from error
    vertices = [np.asarray(g.vertices, float).reshape(-1, 3) for g in parts]
    faces = [np.asarray(g.faces).reshape(-1, 3) for g in parts]
    offsets = np.cumsum([0, *(len(v) for v in vertices)])
    if sum(len(f) for f in faces) == 0:
        raise ValueError(f"`path`: expected a mesh with faces, got {str(path)!r}: none")
    for own, face in zip(vertices, faces, strict=True):
        if face.size and not (face.min() >= 0 and face.max() < len(own)):
            raise ValueError(
                f"`path`: expected faces with vertices 0 to {len(own) - 1}, got {str(path)!r}:"
                f" {face.min()} to {face.max()}"
            )
    joined = np.concatenate([f + o for f, o in zip(faces, offsets, strict=False)])
    points = np.concatenate(vertices)
    used = points[joined]
    if not np.all(np.isfinite(used)):
        raise ValueError(f"`path`: expected finite vertices, got {str(path)!r}: NaN or infinity")
    merged, place = np.unique(used.reshape(-1, 3), axis=0, return_inverse=True)
    return Mesh(merged, place.reshape(-1, 3))


def load_image(path: str | os.PathLike) -> np.ndarray:
    """Return an image file as uint8: (H, W) if it is grey, else (H, W, 3) or (H, W, 4).

    Raises FileNotFoundError, or ValueError where the file is no image that can be read.
    """
    from PIL import Image, UnidentifiedImageError

    file = Path(path)
    if not file.exists():
        raise FileNotFoundError(f"`path`: expected an image file, got {str(path)!r}: no such file")
    try:
        with Image.open(file) as image:
            mode = "L" if image.mode in ("1", "L", "I", "I;16", "F") else "RGB"
            if image.mode in ("I", "I;16", "F"):
                values = np.asarray(image, float)
                return (255 * (values / max(float(values.max()), 1))).round().astype(np.uint8)
            if image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info:
                mode = "RGBA"
            return np.array(image.convert(mode))
    except (UnidentifiedImageError, OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(
            f"`path`: expected a readable image, got {str(path)!r}: {error}"
        ) from error


def load_mask(path: str | os.PathLike) -> np.ndarray:
    """Return a mask file as uint8 (H, W), 255 where the object is.

    Grey images are taken as they are; of an image with transparency its alpha counts. A colour
    image is accepted only if it is grey in fact.

    Raises FileNotFoundError or ValueError like `load_image`, and ValueError for colour photos.
    """
    image = load_image(path)
    if image.ndim == 2:
        return image
    if image.shape[2] == 4 and image[..., 3].min() < 255:
        return image[..., 3]
    colours = image[..., :3].astype(int)
    if np.max(np.ptp(colours, axis=2)) > 8:
        raise ValueError(
            f"`path`: expected a mask (grey, or with transparency), got {str(path)!r}: a colour"
            " picture"
        )
    return image[..., 0]


def save_image(path: str | os.PathLike, image: np.ndarray) -> None:
    """Write a uint8 image, or floats in [0, 1] as 8 bits; (H, W) or (H, W, 3), by file ending."""
    from PIL import Image

    array = np.asarray(image)
    if array.dtype != np.uint8:
        array = np.round(np.clip(array, 0, 1) * 255).astype(np.uint8)
    suffix = Path(path).suffix or ".png"
    replace_file(path, lambda temporary: Image.fromarray(array).save(temporary), suffix)


CAMERA_SCHEMA = "pinhole_jax.camera/1"


def camera_to_dict(camera: Camera) -> dict[str, Any]:
    """Return the camera as JSON-ready numbers.

    - `e, p, u, phi, d, W, H`: the note's parameters (world units, rad, px); `phi_degrees` beside.
    - `lens`: null, or `principal_point` (film coordinates: px, origin bottom left, y up), `aspect`.
    - `pose`: free of the gauge. `right`, `up`, `forward` are the camera's unit axes and `eye` its
      place, in world coordinates; `focal_px` is [fx, fy].
    """
    b1, b2, v = camera_basis(camera)
    lens = camera.lens
    return {
        "schema": CAMERA_SCHEMA,
        "e": _numbers(camera.e),
        "p": _numbers(camera.p),
        "u": _numbers(camera.u),
        "phi": float(camera.phi),
        "phi_degrees": float(np.rad2deg(float(camera.phi))),
        "d": float(camera.d),
        "W": camera.W,
        "H": camera.H,
        "lens": None
        if lens is None
        else {"principal_point": _numbers(lens.principal_point), "aspect": float(lens.aspect)},
        "pose": {
            "eye": _numbers(camera.e),
            "right": _numbers(b1),
            "up": _numbers(b2),
            "forward": _numbers(v),
            "focal_px": [float(f) for f in focal_px(camera)],
            "principal_point": _numbers(principal_point(camera)),
        },
    }


def camera_from_dict(data: Any) -> Camera:
    """Return the camera of `camera_to_dict`'s numbers; `pose` and `phi_degrees` are not read.

    Raises ValueError where a field is missing or is not what it should be.
    """
    if not isinstance(data, dict):
        raise ValueError(f"`camera`: expected a JSON object, got {type(data).__name__}")
    schema = data.get("schema", CAMERA_SCHEMA)
    if schema != CAMERA_SCHEMA:
        raise ValueError(f"`schema`: expected {CAMERA_SCHEMA!r}, got {schema!r}")
    missing = [name for name in ("e", "p", "u", "phi", "W", "H") if name not in data]
    if missing:
        raise ValueError(f"`camera`: expected the field {missing[0]!r}, got {sorted(data)}")
    lens = data.get("lens")
    if lens is not None:
        if not isinstance(lens, dict) or "principal_point" not in lens:
            raise ValueError(f"`lens`: expected principal_point and aspect, got {lens!r}")
        lens = Lens(lens["principal_point"], lens.get("aspect", 1.0))
    numbers = (data["e"], data["p"], data["u"], data["phi"], data.get("d", 1.0))
    return Camera(*numbers, data["W"], data["H"], lens)


def save_camera(path: str | os.PathLike, camera: Camera, **more: Any) -> None:
    """Write a camera as JSON (see `camera_to_dict`); `more` are further fields."""
    text = json.dumps({**camera_to_dict(camera), **more}, indent=1, allow_nan=False) + "\n"
    replace_file(path, lambda temporary: temporary.write_text(text), ".json")


def load_camera(path: str | os.PathLike) -> Camera:
    """Return the camera of a JSON file that `save_camera` wrote.

    Raises FileNotFoundError, or ValueError naming the field that is missing or wrong.
    """
    file = Path(path)
    if not file.exists():
        raise FileNotFoundError(f"`path`: expected a camera file, got {str(path)!r}: no such file")
    try:
        data = json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"`path`: expected JSON, got {str(path)!r}: {error}") from error
    try:
        return camera_from_dict(data)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{error} (in {str(path)!r})") from error


def _numbers(array: Any) -> list[float]:
    return [float(x) for x in np.asarray(array)]


def replace_file(path: str | os.PathLike, write: Callable[[Path], Any], suffix: str) -> None:
    """Write to a temporary file beside the path, then rename it: never half a file."""
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(suffix=suffix, dir=target.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)
