"""Files in and out: meshes, masks, pictures, the project's own camera JSON."""

import json
import os
from collections.abc import Callable
from dataclasses import fields
from io import BytesIO
from typing import Any

import equinox as eqx
import numpy as np

from .._camera.camera import Basis, Camera, camera_basis, focal_px, principal_point
from .._camera.distortion import BrownConrady, Fisheye
from .._camera.lens import Lens
from .._files.exif import FieldOfView, field_of_view
from .._files.paths import existing, path_of, read_json, reason, replace_file
from .._files.pictures import by_bands, eight_bits, from_picture
from .._mesh_files import MESH_ENDINGS, Polygons, read_polygons, triangulated
from .._scene.scene import Mesh
from .masks import read_mask, way_of

#: The most pixels of a picture (Pillow's limit, too: what is written can be read).
MOST_PIXELS = 178_956_970


def load_mesh(path: str | os.PathLike) -> Mesh:
    """Return the triangles of a mesh file (obj, ply, stl, glb, gltf, off), as one mesh.

    Polygons of any shape in any plane are cut into triangles that run the way they do, and vertices
    at exactly the same place are merged so that faces share edges. Axes and lengths are the file's.

    - A glTF scene is put together with its nodes' transforms, instances, morph weights and skins as
      the file has them, with no animation. Triangles, strips and fans count, lines and points do
      not. Buffers are read from the file's folder and below.
    - Of an obj file all polygons count; the material files that it names are not opened.
    - Of a ply file the faces and triangle strips count.

    Raises FileNotFoundError, or ValueError where the file is no mesh, has no faces, fewer or more
    data than its header says, vertices that are not finite, faces that name vertices it does not
    have, a polygon whose sides cross or that has too many corners to cut in seconds (some 100 000,
    unless its first corner sees them all), curved surfaces (obj), binary or not three dimensions
    (off), or a required glTF extension that is not read (KHR_draco_mesh_compression,
    EXT_meshopt_compression): the extension, field or face is named.
    """
    file = existing(path, "a mesh file")
    if file.suffix.lower() not in MESH_ENDINGS:
        raise ValueError(f"`path`: expected one of {', '.join(MESH_ENDINGS)}, got {file.name!r}")
    if file.stat().st_size == 0:
        raise ValueError(f"`path`: expected a mesh file, got {str(path)!r}: empty")
    try:
        polygons = read_polygons(file)
    except Exception as error:  # whatever a reader meets that it did not expect
        raise ValueError(
            f"`path`: expected a readable mesh, got {str(path)!r}: {reason(error)}"
        ) from error
    _check_corners(polygons, path)
    try:
        faces = triangulated(polygons)
    except ValueError as error:
        raise ValueError(
            f"`path`: expected polygons that can be cut, got {str(path)!r}: {error}"
        ) from error
    if not len(faces):
        raise ValueError(f"`path`: expected a mesh with faces, got {str(path)!r}: none")
    merged, place = _merged(polygons.points, faces)
    try:
        return Mesh(merged, place)
    except ValueError as error:  # too large for float32
        raise ValueError(f"{error} (in {str(path)!r})") from error


def _check_corners(polygons: Polygons, path: Any) -> None:
    points, corners, _ = polygons
    if corners.size and not (corners.min() >= 0 and corners.max() < len(points)):
        raise ValueError(
            f"`path`: expected faces with vertices 0 to {len(points) - 1}, got {str(path)!r}:"
            f" {corners.min()} to {corners.max()}"
        )
    if not np.all(np.isfinite(points[corners])):
        raise ValueError(f"`path`: expected finite vertices, got {str(path)!r}: NaN or infinity")


def _merged(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points that faces use, each place once and in order, and the faces of these."""
    used = np.zeros(len(points), bool)
    used[faces] = True
    places = points[used]
    order = np.lexsort(places.T[::-1])  # four times as fast as np.unique
    places = places[order]
    first = np.ones(len(places), bool)
    first[1:] = np.any(places[1:] != places[:-1], axis=1)

    number = np.empty(len(points), int)
    number[np.flatnonzero(used)[order]] = np.cumsum(first) - 1
    return places[first], number[faces]


def load_image(path: str | os.PathLike) -> np.ndarray:
    """Return an image file as uint8: (H, W) if it is grey, else (H, W, 3) or (H, W, 4).

    A photo that says that it was taken sideways (EXIF) is turned upright. Grey values of more than
    8 bits are scaled so that the largest is 255; negative ones become 0.

    Raises FileNotFoundError, or ValueError where the file is no PNG, JPEG, TIFF, WebP, BMP or PNM
    that can be read, has values that are not finite, or more than some 179 million pixels
    (Pillow's limit; half of it in WebP). It takes at most ten bytes a pixel as it works, WebP 17.
    """

    def read(image: Any) -> np.ndarray:
        through = image.has_transparency_data
        if image.mode.startswith(("I", "F")) or (image.mode in ("1", "L") and not through):
            return eight_bits(image)
        mode = "RGBA" if through else "RGB"
        return by_bands(image, lambda band: np.asarray(band.convert(mode)), (len(mode),))

    return from_picture(path, "a readable image", read)


def load_mask(
    path: str | os.PathLike,
    mask_from: str | None = None,
    say: Callable[[str], Any] | None = None,
) -> np.ndarray:
    """Return a mask file as uint8 (H, W), 255 where the object is; turned upright as `load_image`.

    `mask_from` is how to read it:

    - None: transparency if it varies, else a grey picture that is mostly black and white, soft
      edges as they are (a JPEG's too: its ringing costs a fit less than a threshold would).
    - "alpha": the transparency. "luminance": the brightness, whatever it is.
    - "label=N": the pixels with this grey value or palette entry; edges are hard.
    - "background=COLOR": a photo before a background of one colour, by name or as #rrggbb. The
      object is what is farther from it in CIE Lab than Otsu's threshold, or than the tolerance of
      "background=COLOR,TOLERANCE" (2.3 is just noticeable); edges are soft where colours mix.

    `say` is told how it was read, where that is not just a grey mask as it is.

    Raises FileNotFoundError or ValueError like `load_image`, and ValueError for a picture that does
    not hold what is asked for.
    """
    way = way_of(mask_from)
    read = from_picture(path, "a mask", lambda image: read_mask(image, way))
    if say is not None and read.words:
        say(read.words)
    return read.mask


def photo_fov(path: str | os.PathLike) -> FieldOfView | None:
    """Return the vertical field of view `phi` (rad) that a photo's EXIF data tell, and in `words`
    how; None where they do not. It is a first guess, as good as some per cent.

    Raises FileNotFoundError or ValueError like `load_image`.
    """
    return from_picture(path, "a readable image", field_of_view)


def save_image(path: str | os.PathLike, image: np.ndarray) -> None:
    """Write a uint8 image, or bool or floats in [0, 1] as 8 bits, by the path's ending.

    The shape is (H, W), (H, W, 3), or (H, W, 4) with transparency. Floats beyond [0, 1] are
    clipped.

    Raises ValueError for other shapes and types, for values that are not finite, and for a path
    that cannot be written.
    """
    from PIL import Image

    array = np.asarray(image)
    shown = array.ndim == 2 or (array.ndim == 3 and array.shape[2] in (3, 4))
    if not shown or 0 in array.shape:
        raise ValueError(f"`image`: expected shape (H, W), (H, W, 3 or 4), got {array.shape}")
    if array.dtype == bool or np.issubdtype(array.dtype, np.floating):
        if not np.all(np.isfinite(array)):
            raise ValueError("`image`: expected finite values, got NaN or infinity")
        array = np.round(np.clip(array.astype(float), 0, 1) * 255).astype(np.uint8)
    elif array.dtype != np.uint8:
        raise ValueError(f"`image`: expected dtype bool, uint8 or float, got {array.dtype}")
    suffix = path_of(path).suffix or ".png"
    if suffix.lower() not in Image.registered_extensions():
        raise ValueError(f"`path`: expected the ending of an image format, got {suffix!r}")
    data = BytesIO()
    try:
        Image.fromarray(array).save(data, Image.registered_extensions()[suffix.lower()])
    except (OSError, ValueError, KeyError) as error:  # a format's limits
        words = f"an image format that can hold it, got {str(path)!r}: {reason(error)}"
        raise ValueError(f"`path`: expected {words}") from error
    replace_file(path, data.getvalue())


CAMERA_SCHEMA = "pinhole_jax.camera/1"


def camera_to_dict(camera: Camera) -> dict[str, Any]:
    """Return the camera as JSON-ready numbers.

    - `e, p, u, phi, d, W, H`: the note's parameters (world units, rad, px); `phi_degrees` beside.
    - `lens`: null, or `principal_point` (film coordinates: px, origin bottom left, y up), `aspect`
      and, if it has one, `distortion`: `model` (BrownConrady or Fisheye) and its coefficients.
    - `pose`: free of the gauge. `right`, `up`, `forward` are the camera's unit axes and `eye` its
      place, in world coordinates; `focal_px` is [fx, fy].
    """
    (b1, b2, v), focal, principal = _pose(camera)
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
        "lens": None if lens is None else _lens_to_dict(lens),
        "pose": {
            "eye": _numbers(camera.e),
            "right": _numbers(b1),
            "up": _numbers(b2),
            "forward": _numbers(v),
            "focal_px": [float(f) for f in focal],
            "principal_point": _numbers(principal),
        },
    }


@eqx.filter_jit
def _pose(camera: Camera) -> tuple[Basis, Any, Any]:
    """Return the axes, the focal length (px) and the principal point (px)."""
    return camera_basis(camera), focal_px(camera), principal_point(camera)


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
        lens = _lens_from_dict(lens)
    numbers = (data["e"], data["p"], data["u"], data["phi"], data.get("d", 1.0))
    return Camera(*numbers, data["W"], data["H"], lens)


def _lens_to_dict(lens: Lens) -> dict[str, Any]:
    data = {"principal_point": _numbers(lens.principal_point), "aspect": float(lens.aspect)}
    if lens.distortion is None:
        return data
    return {
        **data,
        "distortion": {"model": type(lens.distortion).__name__, **lens.distortion.coefficients()},
    }


def _lens_from_dict(data: Any) -> Lens:
    if not isinstance(data, dict) or "principal_point" not in data:
        raise ValueError(f"`lens`: expected principal_point and aspect, got {data!r}")
    if unknown := sorted(set(data) - {"principal_point", "aspect", "distortion"}):
        raise ValueError(f"`lens`: expected principal_point and aspect, got also {unknown}")
    bent = data.get("distortion")
    if bent is not None:
        known = {model.__name__: model for model in (BrownConrady, Fisheye)}
        model = known.get(str(bent.get("model"))) if isinstance(bent, dict) else None
        names = {field.name for field in fields(model)} if model else set()
        if model is None or set(bent) - names - {"model"}:
            words = f"a model ({', '.join(known)}) and its coefficients"
            raise ValueError(f"`distortion`: expected {words}, got {bent!r}")
        bent = model(**{name: bent[name] for name in bent if name != "model"})
    return Lens(data["principal_point"], data.get("aspect", 1.0), bent)


def save_camera(path: str | os.PathLike, camera: Camera, **more: Any) -> None:
    """Write a camera as JSON (see `camera_to_dict`); `more` are further fields.

    Raises ValueError for what is no camera, fields that JSON cannot hold (NaN is one), and a path
    that cannot be written.
    """
    if not isinstance(camera, Camera):
        raise ValueError(f"`camera`: expected a Camera, got {type(camera).__name__}")
    data = camera_to_dict(camera)
    if hidden := sorted(data.keys() & more.keys()):
        raise ValueError(f"`more`: expected fields that no camera has, got {hidden}")
    try:
        text = json.dumps({**data, **more}, indent=1, allow_nan=False) + "\n"
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(
            f"`more`: expected what JSON can hold, got {sorted(more)}: {error}"
        ) from error
    replace_file(path, text.encode())


def load_camera(path: str | os.PathLike) -> Camera:
    """Return the camera of a JSON file that `save_camera` wrote.

    Raises FileNotFoundError, or ValueError naming the field that is missing or wrong.
    """
    data = read_json(path, "a camera file")
    try:
        return camera_from_dict(data)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{error} (in {str(path)!r})") from error


def _numbers(array: Any) -> list[float]:
    return [float(x) for x in np.asarray(array)]
