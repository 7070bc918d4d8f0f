"""The camera of Frisvad's note, and the conventions of the whole library.

Source: J. R. Frisvad, "Ray Generation Using a Pinhole Camera Model" (2012).

THE CONVENTIONS

- `e` eye point, `p` view point, `u` up direction: world units. `u` need be neither of unit length
  nor orthogonal to the view.
- `phi` vertical field of view, the full angle: rad. `d` camera constant, eye to film: world units.
- `W, H` resolution, columns and rows: static integers, px.
- Film: height `h = 2 d tan(phi/2)`, width `w = h W/H`, centred on the view axis.
- Basis: `v = (p-e)/|p-e|` forward, `b1 = (v x u)/|v x u|` right, `b2 = b1 x v` up.
- A ray through film point (x, y) has direction `q/|q|` with `q = b1 x + b2 y + v d`.
- Film coordinates: px, origin at the film's bottom-left corner, x right, y up. Pixel (i, j) is the
  square [i, i+1] x [j, j+1]; pixel (0, 0) is bottom left; its centre is at (i+1/2, j+1/2).
- Arrays: shape (H, W), row 0 at the top: `image[H-1-j, i]` is pixel (i, j).
- A silhouette is coverage: the fraction of each pixel's square that the scene covers, in [0, 1].
- Gauge: `|p-e|`, `|u|`, `u.v` and (for given phi) `d` change no image: 7 degrees of freedom.
  `d` has a meaning only while the film's height is held: then `phi = 2 atan(h / (2d))`.
"""

from dataclasses import replace
from types import ModuleType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._numerics.arrays import (
    MISSING,
    ArrayLike,
    Input,
    as_count,
    check_above_zero,
    checked,
    float_array,
    float_dtype,
    is_concrete,
)
from .._numerics.pointwise import pointwise
from .._numerics.safe import cross_of_difference, norm, normalize
from .distortion import Distortion
from .film import Bend, FilmMap, FilmPart
from .lens import Lens, check_lens
from .matrices import Centres, as_intrinsics, as_rigid, half_pixel, is_rotation

#: Pixels are counted in 32 bits, with a margin around the film.
MOST_PIXELS = 1 << 30


class Basis(NamedTuple):
    """Orthonormal camera axes in world coordinates: `b1` right, `b2` up, `v` forward."""

    b1: Float[Array, "3"]
    b2: Float[Array, "3"]
    v: Float[Array, "3"]


@jax.jit
def basis(e: Float[Array, "3"], p: Float[Array, "3"], u: Float[Array, "3"]) -> Basis:
    """Return the camera's axes `v`, `b1 = v x u` and `b2 = b1 x v`, normalised (Frisvad, eq. 1-3).

    With `e = p` or `u` parallel to the view there is no basis: the vectors that are not determined
    are null, with derivative 0.
    """
    v = normalize(p - e)
    b1 = normalize(cross_of_difference(p, e, u))
    return Basis(b1, jnp.cross(b1, v), v)


class Camera(eqx.Module):
    """A pinhole camera (e, p, u, phi, d, W, H); see the conventions at the top of this module.

    All of e, p, u, phi and d are differentiable leaves; W and H are static. `lens` is None for the
    ideal pinhole, or a `Lens` (principal point, pixel aspect, distortion).

    Raises ValueError where an argument has another shape or dtype than documented, is not finite,
    or makes no camera: `e` equal to `p`, `u` parallel to the view, `phi` outside (0, pi), `d <= 0`,
    `W` or `H` below 1, more than 2^30 pixels; or a lens whose image folds back within the film or
    reaches 90 degrees from the axis there.

    Traced arguments are checked for shape only. Where they make no camera (e = p, u along the
    view) all points project to the principal point and a silhouette is 0. Rays run along the view
    (and are shorter than 1) or are null and miss, and derivatives are finite.

    ```python
    nearer = camera.replace(e=[0.3, 1, 4])  # checked as the constructor does
    print(nearer)
    ```
    """

    e: Float[Array, "3"]
    p: Float[Array, "3"]
    u: Float[Array, "3"]
    phi: Float[Array, ""]
    d: Float[Array, ""]
    W: int = eqx.field(static=True)
    H: int = eqx.field(static=True)
    lens: Lens | None

    def __init__(
        self,
        e: Input[ArrayLike, "3"],
        p: Input[ArrayLike, "3"],
        u: Input[ArrayLike, "3"],
        phi: Input[ArrayLike, ""],
        d: Input[ArrayLike, ""] = 1.0,
        W: Input[int, "px"] = MISSING,
        H: Input[int, "px"] = MISSING,
        lens: Lens | None = None,
    ):
        if W is MISSING or H is MISSING:
            raise TypeError("Camera() missing W or H, the resolution in px (d comes before them)")
        dtype = float_dtype(e, p, u, phi, d)
        self.e = float_array("e", e, (3,), dtype)
        self.p = float_array("p", p, (3,), dtype)
        self.u = float_array("u", u, (3,), dtype)
        self.phi = float_array("phi", phi, (), dtype)
        self.d = float_array("d", d, (), dtype)
        self.W = resolution("W", W)
        self.H = resolution("H", H)
        if self.W * self.H > MOST_PIXELS:
            raise ValueError(
                f"`W`, `H`: expected at most {MOST_PIXELS} pixels, got {self.W} x {self.H}"
            )
        check_lens(lens)
        self.lens = jax.tree.map(lambda x: x.astype(dtype), lens)
        if is_concrete(self.phi) and not 0 < float(self.phi) < np.pi:
            raise ValueError(f"`phi`: expected an angle in (0, pi) rad, got {float(self.phi)}")
        check_above_zero("d", self.d, "a positive distance")
        if is_concrete(self.e, self.p, self.u):
            _check_view(*(np.asarray(x) for x in (self.e, self.p, self.u)))
        if self.distortion is not None and is_concrete(self):
            _check_lens(self)

    def __str__(self) -> str:
        """Return a table; traced or stacked cameras look as equinox shows them."""
        if not _is_single(self):
            return repr(self)
        rows = [f"  {name:<4} {value}   {words}".rstrip() for name, value, words in _rows(self)]
        title = "Camera" if _is_camera(self) else "Gradient, or change, of a camera"
        return "\n".join([f"{title} of {self.W} x {self.H} px", *rows])

    def _repr_html_(self) -> str | None:
        """Return the HTML of notebooks: a table, and the camera in space."""
        if not _is_single(self):
            return None
        from ..show.table import camera_card

        return camera_card(self, _rows(self))

    @property
    def K(self) -> Float[Array, "3 3"]:
        """OpenCV's K (px): y down, the first pixel's centre is (0, 0). Differentiable.

        `formats.to_opencv` also counts from the first pixel's corner (`pixel_centres="half"`).
        """
        check_camera(self)
        fx, fy = focal_px(self)
        x, y = principal_point(self)  # film coordinates: y up
        rows = [[fx, 0, x - 0.5], [0, fy, self.H - y - 0.5], [0, 0, 1]]
        return jnp.array(rows, fx.dtype)

    @property
    def R(self) -> Float[Array, "3 3"]:
        """OpenCV's R, x right, y down, z forward: `X_camera = R X_world + t`. Differentiable."""
        b1, b2, v = camera_basis(self)
        return jnp.stack([b1, -b2, v])

    @property
    def t(self) -> Float[Array, "3"]:
        """OpenCV's t (world units): `X_camera = R X_world + t`. Differentiable."""
        return -self.R @ self.e

    @property
    def distortion(self) -> Distortion | None:
        """The lens's distortion, with OpenCV's coefficients; None: it bends nothing."""
        return None if self.lens is None else self.lens.distortion

    def replace(self, **changes: Input[ArrayLike | Lens | None, "by name"]) -> "Camera":
        """Return the camera with some of its arguments changed, checked as the constructor does."""
        return replace(self, **changes)

    @classmethod
    def from_K(
        cls,
        K: Input[ArrayLike, "3 3"],
        R: Input[ArrayLike, "3 3"],
        t: Input[ArrayLike, "3"],
        W: Input[int, "px"],
        H: Input[int, "px"],
        *,
        pixel_centres: Input[Centres, "of K"],
        d: Input[ArrayLike, ""] = 1.0,
        distortion: Input[Distortion | None, "model"] = None,
    ) -> "Camera":
        """Return the camera of OpenCV's K (3, 3), R (3, 3), t (3,): x right, y down, z forward.

        `X_camera = R X_world + t` and `(u, v, 1) ~ K X_camera`. `pixel_centres` says where the
        source puts them: "integer" (OpenCV, M3T: the first pixel's centre is 0) or "half" (COLMAP,
        NeRF: 0.5). It costs half a pixel to get it wrong, so it has no default. Skew must be 0.

        `distortion` is the lens's (`BrownConrady(*distCoeffs)`, `Fisheye`). The view point is put
        at unit distance, up along the image's columns. Differentiable with respect to K, R and t;
        a camera of traced ones always has a `Lens`.

        Raises ValueError naming the argument where one has another shape, is not finite, or makes
        no camera: R no rotation, focal lengths not positive, K with skew or another last row.

        ```python
        K = [[120.0, 0, 48], [0, 120, 40], [0, 0, 1]]
        seen = pj.Camera.from_K(K, np.eye(3), [0, 0, 5], 96, 80, pixel_centres="half")
        ```
        """
        W, H, half = resolution("W", W), resolution("H", H), half_pixel(pixel_centres)
        k, (r, shift) = as_intrinsics(K, W, H), as_rigid(R, t)
        traced = not is_concrete(k, r, shift)
        xp: ModuleType = jnp if traced else np  # NumPy's float64: the parameters are rounded once
        centre = xp.stack([k[0, 2] + half, H - (k[1, 2] + half)])  # film coordinates: y up
        aspect, phi, eye = k[0, 0] / k[1, 1], 2 * xp.arctan(H / (2 * k[1, 1])), -r.T @ shift
        centred = not traced and np.allclose(centre, (W / 2, H / 2), rtol=0, atol=1e-9)
        plain = centred and abs(aspect - 1) < 1e-12 and distortion is None
        lens = None if plain else Lens(centre, aspect, distortion)
        return cls(eye, eye + r[2], -r[1], phi, d, W, H, lens)

    def with_focal(self, focal_px: Input[ArrayLike, "px"]) -> "Camera":
        """Return the camera with another focal length in px, all else as it is.

        One number is that along y, `H / (2 tan(phi/2))`, and x keeps its aspect; or (fx, fy).

        Raises ValueError for what is not one or two positive numbers.

        ```python
        longer = camera.with_focal(200.0)  # px
        ```
        """
        both = np.ndim(focal_px) == 1
        focal = float_array("focal_px", focal_px, (2,) if both else (), self.e.dtype)
        if is_concrete(focal) and not np.all(np.asarray(focal) > 0):
            raise ValueError(f"`focal_px`: expected positive numbers, got {np.asarray(focal)}")
        fy = focal[1] if both else focal
        lens = Lens(principal_point(self), focal[0] / fy, self.distortion) if both else self.lens
        return self.replace(phi=2 * jnp.arctan(self.H / (2 * fy)), lens=lens)

    def with_pose(self, eye: Input[ArrayLike, "3"], axes: Input[ArrayLike, "3 3"]) -> "Camera":
        """Return the camera at an eye (3,) with other axes (3, 3), in world coordinates.

        The rows of `axes` are b1, b2, v: right, up, forward. Neither may be traced. The distance
        from e to p stays.

        Raises ValueError where they have another shape, are not finite, or no such axes.

        ```python
        above = camera.with_pose([0, 4, 0], [[1, 0, 0], [0, 0, -1], [0, -1, 0]])
        ```
        """
        eye = np.asarray(checked("eye", eye, (3,), np.dtype(float)), float)
        axes = np.asarray(checked("axes", axes, (3, 3), np.dtype(float)), float)
        if not is_rotation(axes * [[1], [-1], [1]]):  # right, down, forward
            words = f"expected unit vectors right, up, forward, got {axes.tolist()}"
            raise ValueError(f"`axes`: {words}")
        far = float(np.linalg.norm(np.asarray(self.p, float) - np.asarray(self.e, float)))
        pose = [jnp.asarray(x, self.e.dtype) for x in (eye, eye + far * axes[2], axes[1])]
        return eqx.tree_at(lambda c: [c.e, c.p, c.u], self, pose)


class ResizableCamera(Camera):
    """The same camera with a resolution that is data: one compiled program serves all sizes."""

    W: Any
    H: Any

    def __init__(self, camera: Camera):
        for name in ("e", "p", "u", "phi", "d", "lens"):
            setattr(self, name, getattr(camera, name))
        self.W, self.H = np.array([camera.W, camera.H], camera.e.dtype)


def _is_single(camera: Camera) -> bool:
    """True for one camera of numbers, neither traced nor stacked."""
    numbers = all(map(eqx.is_array, (camera.e, camera.p, camera.u, camera.phi, camera.d)))
    return numbers and is_concrete(camera) and not np.ndim(camera.phi)


def _is_camera(camera: Camera) -> bool:
    """False for a gradient, which has a camera's parameters, and 0 for d."""
    phi = float(camera.phi)
    return not (phi <= 0 or phi >= np.pi or float(camera.d) <= 0)  # NaN is a camera that failed


def _rows(camera: Camera) -> list[tuple[str, str, str]]:
    """Return a row of name, value and description for each parameter."""
    if not _is_camera(camera):
        return _gradient_rows(camera)
    # Places are shown to a millionth of the viewing distance, wherever the world begins.
    far = float(np.linalg.norm(np.asarray(camera.p, float) - np.asarray(camera.e, float)))
    known = np.isfinite(far) and far > 0
    decimals = min(max(6 - int(np.floor(np.log10(far))), 0), 12) if known else 6
    in_digits = lambda x: np.format_float_positional(x, precision=decimals, trim="-")
    place = lambda x: f"({', '.join(map(in_digits, np.asarray(x, float)))})"
    point = lambda x: "(" + ", ".join(f"{v:.6g}" for v in np.asarray(x)) + ")"
    phi = float(camera.phi)
    rows = [
        ("e", place(camera.e), "eye"),
        ("p", place(camera.p), "view point"),
        ("u", point(camera.u), "up"),
        ("phi", f"{phi:.6g} rad", f"vertical field of view ({np.rad2deg(phi):.6g} degrees)"),
        ("d", f"{float(camera.d):.6g}", "camera constant"),
    ]
    if camera.lens is not None:
        aspect = f"aspect {float(camera.lens.aspect):.6g}"
        middle = f"principal point {point(camera.lens.principal_point)} px, {aspect}"
        rows.append(("lens", middle, ""))
    if (distortion := camera.distortion) is not None:
        numbers = (f"{name} = {value:.6g}" for name, value in distortion.coefficients().items())
        rows.append(("", f"{type(distortion).__name__}: {', '.join(numbers)}", ""))
    return rows


def _gradient_rows(camera: Camera) -> list[tuple[str, str, str]]:
    """Return a row of name and numbers, which have no unit, for each parameter."""
    lens = [] if camera.lens is None else [("lens", camera.lens)]
    parts = [(name, getattr(camera, name)) for name in ("e", "p", "u", "phi", "d")] + lens
    numbers = lambda x: np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(x)])
    return [(name, " ".join(f"{v:.6g}" for v in numbers(part)), "") for name, part in parts]


def check_camera(camera: object, name: str = "camera") -> None:
    """Raise ValueError for anything but a single camera."""
    if not isinstance(camera, Camera):
        raise ValueError(f"`{name}`: expected a Camera, got {type(camera).__name__}")
    if np.ndim(camera.e) != 1:
        raise ValueError(
            f"`{name}`: expected one camera, got several (e of shape {np.shape(camera.e)}):"
            " `jax.vmap` takes each by itself"
        )


def camera_basis(camera: Camera) -> Basis:
    """Return the camera's axes in world coordinates.

    ```python
    right, up, forward = pj.camera_basis(camera)
    ```
    """
    check_camera(camera)
    return basis(camera.e, camera.p, camera.u)


def focal_px(camera: Camera) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the focal length (px) along x and y: `H / (2 tan(phi/2))`, x times the aspect."""
    fy = camera.H / (2 * jnp.tan(camera.phi / 2))
    return (fy if camera.lens is None else fy * camera.lens.aspect), fy


def principal_point(camera: Camera) -> Float[Array, "2"]:
    """Return the view axis's point on the film, in film coordinates (px)."""
    if camera.lens is not None:
        return camera.lens.principal_point
    return jnp.array([camera.W / 2, camera.H / 2], camera.e.dtype)


def film_map(camera: Camera) -> FilmMap:
    """Return the camera as a map to the film, whose size is 0 where that is data."""
    b1, b2, v = basis(camera.e, camera.p, camera.u)
    fx, fy = focal_px(camera)
    centre = principal_point(camera)
    matrix = jnp.stack([fx * b1 + centre[0] * v, fy * b2 + centre[1] * v, v])
    base = jnp.append(centre, jnp.ones(1, centre.dtype)) * norm(camera.p - camera.e)
    size = (0, 0) if isinstance(camera, ResizableCamera) else (camera.W, camera.H)
    return FilmMap(camera.e, camera.p, matrix, base, *size, bend(camera))


def bend(camera: Camera) -> Bend | None:
    """Return the lens's map from ideal to distorted film points, None without a distortion."""
    if (distortion := camera.distortion) is None:
        return None
    focal, centre = jnp.stack(focal_px(camera)), principal_point(camera)
    return Bend(distortion, distortion.trusted_radius(), focal, centre)


def bent(camera: Camera, points: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
    """Return the distorted points (px) of ideal film points, any number of them by one program."""
    if camera.distortion is None:
        return points
    points = np.asarray(points, camera.e.dtype)
    return np.asarray(_bent(ResizableCamera(camera), points), float)


@pointwise
def _bent(camera: ResizableCamera, points: Array) -> Array:
    lens = bend(camera)
    return points if lens is None else lens(points)


def lens_holds(camera: Camera, part: FilmPart) -> Bool[Array, ""]:
    """Return True where the distortion's formula counts on all of a part of the film."""
    lens = bend(camera)
    if lens is None:
        return jnp.ones((), bool)
    sides = jnp.stack([jnp.asarray(x, camera.e.dtype) for x in part]).reshape(2, 2)
    x, y = (sides - lens.centre[:, None]) / lens.focal[:, None]
    return jnp.all(lens.distortion.trusts(jnp.tile(x, 2), jnp.repeat(y, 2)))


def resolution(name: str, value: Any) -> int:
    """Return a number of pixels, or raise ValueError with the argument's name."""
    if (size := as_count(name, value)) > MOST_PIXELS:
        raise ValueError(f"`{name}`: expected at most {MOST_PIXELS} pixels, got more")
    return size


@eqx.filter_jit
def _lens_holds(camera: ResizableCamera) -> Bool[Array, ""]:
    return lens_holds(camera, FilmPart(0, camera.W, 0, camera.H))


def _check_lens(camera: Camera) -> None:
    with jax.ensure_compile_time_eval():
        if bool(_lens_holds(ResizableCamera(camera))):
            return
    model = type(camera.distortion).__name__
    raise ValueError(
        f"`lens`: expected a distortion that holds up to the film's corners, got a {model} whose"
        " image folds back, or shows 90 degrees from the axis, within the film"
    )


def _check_view(e: np.ndarray, p: np.ndarray, u: np.ndarray) -> None:
    if np.array_equal(e, p):
        raise ValueError(f"`p`: expected a view point other than the eye `e`, got both at {e}")
    if not np.any(u):
        raise ValueError("`u`: expected an up direction, got the null vector")
    view = (p - e) / np.max(np.abs(p - e))
    up = u / np.max(np.abs(u))
    if not np.any(np.abs(np.cross(view, up)) > 4 * np.finfo(e.dtype).eps):
        raise ValueError(f"`u`: expected a direction not parallel to the view p - e, got u = {u}")
