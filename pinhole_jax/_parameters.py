"""What a fit may change about a camera, as a vector that is 0 for the camera it starts from.

Pose moves are taken about a pivot (the middle of what is looked at), so that turning the camera
around the object, shifting it and changing the distance move the outline in ways of their own.
Focal length and distance are logarithmic: no step makes them negative.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._camera import Camera, camera_basis, focal_px, principal_point
from ._lens import Lens
from ._safe import norm, safe_divide, safe_sqrt

#: What `free` may name: the components of the move that each name frees.
COMPONENTS: dict[str, tuple[str, ...]] = {
    "pose": ("turn_b1", "turn_b2", "turn_v", "shift_b1", "shift_b2", "log_distance"),
    "position": ("shift_b1", "shift_b2", "log_distance"),
    "orientation": ("spin_b1", "spin_b2", "spin_v"),
    "phi": ("log_focal",),
    "d": ("log_focal",),
    "principal_point": ("principal_x", "principal_y"),
    "aspect": ("log_aspect",),
}

#: What is reported of each name: parameters with units a user reads.
REPORTED: dict[str, tuple[str, ...]] = {
    "pose": ("rotation_b1", "rotation_b2", "rotation_v", "e_x", "e_y", "e_z"),
    "position": ("e_x", "e_y", "e_z"),
    "orientation": ("rotation_b1", "rotation_b2", "rotation_v"),
    "phi": ("phi",),
    "d": ("d",),
    "principal_point": ("principal_x", "principal_y"),
    "aspect": ("aspect",),
}


def as_names(names: str | Sequence[str]) -> tuple[str, ...]:
    """Return names as a tuple; a string is one name."""
    return (names,) if isinstance(names, str) else tuple(names)


def focal_is_free(free: Sequence[str]) -> bool:
    """Return whether the focal length is fitted, under either of its names."""
    return not {"phi", "d"}.isdisjoint(free)


def check_free(free: str | Sequence[str]) -> tuple[str, ...]:
    """Return the names in a fixed order, or raise ValueError for unknown or conflicting ones."""
    names = as_names(free)
    known = ", ".join(COMPONENTS)
    for name in names:
        if name not in COMPONENTS:
            raise ValueError(f"`free`: expected names among {known}, got {name!r}")
    if not names:
        raise ValueError(f"`free`: expected at least one of {known}, got none")
    if {"phi", "d"} <= set(names):
        raise ValueError("`free`: expected phi or d (both set the focal length), got both")
    if "pose" in names and {"position", "orientation"} & set(names):
        raise ValueError("`free`: expected pose, or position or orientation, got both")
    return tuple(name for name in COMPONENTS if name in names)


def components(free: tuple[str, ...]) -> list[str]:
    """Return the components of a move that these names free."""
    return [c for name in free for c in COMPONENTS[name]]


class Move(NamedTuple):
    """Where a vector of moves starts: the camera, the pivot, and the size of one unit of each."""

    camera: Camera
    pivot: Float[Array, "3"]
    unit: Float[Array, "n"]


def units(
    camera: Camera,
    pivot: Float[Array, "3"],
    radius: Float[Array, ""],
    scale: Float[Array, ""] | Float[np.ndarray, ""],
    free: tuple[str, ...],
) -> Float[Array, "n"]:
    """Return how much of each component moves the outline by about one pixel.

    `radius` is that of the scene about the pivot; `scale` is pixels per unit of film coordinates.
    """
    one_px = 1 / (focal_px(camera)[1] * scale)
    spread = jnp.clip(safe_divide(radius, norm(pivot - camera.e)), 1e-3, 1)
    sizes = {"shift": one_px, "spin": one_px, "principal": 1 / scale}
    names = components(free)
    return jnp.stack([sizes.get(c.split("_")[0], one_px / spread) for c in names])


def moved(move: Move, y: Float[Array, "n"], free: tuple[str, ...]) -> Camera:
    """Return the camera moved by y (in units of `move.unit`); a rigid motion keeps the gauge."""
    names = components(free)
    step = dict(zip(names, y * move.unit, strict=True))
    zero = jnp.zeros_like(y[0])
    camera = move.camera
    axes = jnp.stack(camera_basis(camera))
    d, phi = camera.d, camera.phi

    turn = jnp.stack([step.get(f"turn_{b}", zero) for b in ("b1", "b2", "v")]) @ axes
    spin = jnp.stack([step.get(f"spin_{b}", zero) for b in ("b1", "b2", "v")]) @ axes
    rotate = rotation(turn)
    about_eye = rotation(spin)
    offset = camera.e - move.pivot
    # The pivot as the camera sees it slides sideways and comes nearer; the eye goes the other way.
    reach = norm(offset)
    aside = reach * (step.get("shift_b1", zero) * axes[0] + step.get("shift_b2", zero) * axes[1])
    e = move.pivot + rotate @ ((offset + aside) * jnp.exp(step.get("log_distance", zero)))
    p = e + rotate @ (about_eye @ (camera.p - camera.e))
    u = rotate @ (about_eye @ camera.u)

    if "log_focal" in step:
        longer = jnp.exp(step["log_focal"])
        phi = 2 * jnp.arctan(jnp.tan(phi / 2) / longer)
        d = d * longer if "d" in free else d
    camera = eqx.tree_at(lambda c: (c.e, c.p, c.u, c.phi, c.d), camera, (e, p, u, phi, d))
    if camera.lens is None:
        return camera
    shift = jnp.stack([step.get("principal_x", zero), step.get("principal_y", zero)])
    wider = jnp.exp(step.get("log_aspect", zero))
    lens = (camera.lens.principal_point + shift, camera.lens.aspect * wider)
    return eqx.tree_at(lambda c: (c.lens.principal_point, c.lens.aspect), camera, lens)


def reported(camera: Camera, moved: Camera, free: tuple[str, ...]) -> Float[Array, "n"]:
    """Return the reported parameters of `moved`; rotations are small ones away from `camera`.

    `rotation_b1, _b2, _v` turn the camera about its own axes (rad), `e_x, e_y, e_z` are the eye in
    world units, `phi` in rad, `d` in world units, the principal point in px.
    """
    before, after = jnp.stack(camera_basis(camera)), jnp.stack(camera_basis(moved))
    cross = jnp.sum(jnp.cross(before, after), axis=0) / 2  # rotation vector, to first order
    small = before @ cross
    values = {
        **{f"rotation_{b}": small[k] for k, b in enumerate(("b1", "b2", "v"))},
        **{f"e_{x}": moved.e[k] for k, x in enumerate("xyz")},
        "phi": moved.phi,
        "d": moved.d,
    }
    if moved.lens is not None:
        values["principal_x"], values["principal_y"] = moved.lens.principal_point
        values["aspect"] = moved.lens.aspect
    return jnp.stack([values[r] for name in free for r in REPORTED[name]])


def rotation(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return the rotation matrix about a vector by its length in rad (Rodrigues)."""
    x, y, z = vector
    zero = jnp.zeros_like(x)
    skew = jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])
    squared = x * x + y * y + z * z
    angle = safe_sqrt(squared)
    small = squared < 1e-4
    # sin(a)/a and (1 - cos(a))/a^2, by their series where the quotients lose digits.
    series_a = 1 - squared / 6 * (1 - squared / 20)
    series_b = (1 - squared / 12 * (1 - squared / 30)) / 2
    a = jnp.where(small, series_a, safe_divide(jnp.sin(angle), angle))
    half = safe_divide(jnp.sin(angle / 2), angle)
    b = jnp.where(small, series_b, 2 * half * half)
    return jnp.eye(3, dtype=vector.dtype) + a * skew + b * (skew @ skew)


def canonical(camera: Camera) -> Camera:
    """Return the same view on a film one pixel high, with a lens: W, H are no longer static facts.

    One compiled program then serves all resolutions; film coordinates are in film heights.
    """
    H = camera.H
    point = principal_point(camera) / H
    aspect = 1.0 if camera.lens is None else camera.lens.aspect
    return Camera(camera.e, camera.p, camera.u, camera.phi, camera.d, 1, 1, Lens(point, aspect))


def on_film(unit: Camera, camera: Camera, free: tuple[str, ...]) -> Camera:
    """Return a canonical camera on `camera`'s film, with a lens if that has one or it is free."""
    lens = None
    if unit.lens is not None and (
        camera.lens is not None or {"principal_point", "aspect"} & {*free}
    ):
        lens = Lens(unit.lens.principal_point * camera.H, unit.lens.aspect)
    return Camera(unit.e, unit.p, unit.u, unit.phi, unit.d, camera.W, camera.H, lens)
