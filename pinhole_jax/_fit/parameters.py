"""What a fit may change about a camera, as a vector that is 0 for the camera it starts from.

Pose moves are taken about a pivot (the middle of what is looked at), so that turning the camera
around the object, shifting it and changing the distance move the outline in ways of their own.
Focal length and distance are logarithmic: no step makes them negative.
"""

from collections.abc import Sequence
from dataclasses import fields
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.camera import Camera, camera_basis, focal_px, principal_point
from .._camera.distortion import COEFFICIENTS, BrownConrady
from .._camera.lens import Lens
from .._numerics.safe import norm, safe_divide, safe_sqrt

#: What `free` may name, but for `distortion` (all coefficients of the lens): the components of the
#: move that each name frees.
COMPONENTS: dict[str, tuple[str, ...]] = {
    "pose": ("turn_b1", "turn_b2", "turn_v", "shift_b1", "shift_b2", "log_distance"),
    "position": ("shift_b1", "shift_b2", "log_distance"),
    "orientation": ("spin_b1", "spin_b2", "spin_v"),
    "phi": ("log_focal",),
    "d": ("log_focal",),
    "principal_point": ("principal_x", "principal_y"),
    "aspect": ("log_aspect",),
    **{name: (name,) for name in COEFFICIENTS},
}

#: All that `free` may name.
NAMES = (*COMPONENTS, "distortion")

#: What is reported of each name: parameters with units a user reads.
REPORTED: dict[str, tuple[str, ...]] = {
    "pose": ("rotation_b1", "rotation_b2", "rotation_v", "e_x", "e_y", "e_z"),
    "position": ("e_x", "e_y", "e_z"),
    "orientation": ("rotation_b1", "rotation_b2", "rotation_v"),
    "phi": ("phi",),
    "d": ("d",),
    "principal_point": ("principal_x", "principal_y"),
    "aspect": ("aspect",),
    **{name: (name,) for name in COEFFICIENTS},
}


def as_names(names: str | Sequence[str]) -> tuple[str, ...]:
    """Return names as a tuple; a string is one name."""
    return (names,) if isinstance(names, str) else tuple(names)


def focal_is_free(free: Sequence[str]) -> bool:
    """Return whether the focal length is fitted, under either of its names."""
    return not {"phi", "d"}.isdisjoint(free)


def check_free(free: str | Sequence[str], camera: Camera | None = None) -> tuple[str, ...]:
    """Return the names in a fixed order, or raise ValueError for unknown or conflicting ones.

    The coefficients are those of the camera's distortion; where it has none, of a `BrownConrady`.
    """
    lens = None if camera is None else camera.lens
    model = BrownConrady if lens is None or lens.distortion is None else type(lens.distortion)
    own = [field.name for field in fields(model)]
    names = tuple(n for name in as_names(free) for n in (own if name == "distortion" else [name]))
    known = ", ".join(NAMES)
    for name in names:
        if name not in COMPONENTS:
            raise ValueError(f"`free`: expected names among {known}, got {name!r}")
        if name in COEFFICIENTS and name not in own:
            raise ValueError(
                f"`free`: expected coefficients of a {model.__name__} ({', '.join(own)}), got"
                f" {name!r}"
            )
    if not names:
        raise ValueError(f"`free`: expected at least one of {known}, got none")
    if {"phi", "d"} <= set(names):
        raise ValueError("`free`: expected phi or d (both set the focal length), got both")
    if "pose" in names and {"position", "orientation"} & set(names):
        raise ValueError("`free`: expected pose, or position or orientation, got both")
    return tuple(name for name in COMPONENTS if name in names)


def with_lens(camera: Camera, names: tuple[str, ...]) -> Camera:
    """Return the camera with what these names need: a lens, a distortion (that bends nothing)."""
    lens, bent = camera.lens, not set(COEFFICIENTS).isdisjoint(names)
    if lens is None and (bent or {"principal_point", "aspect"} & {*names}):
        lens = Lens(principal_point(camera))
    if lens is not None and lens.distortion is None and bent:
        lens = Lens(lens.principal_point, lens.aspect, BrownConrady())
    if lens is camera.lens:
        return camera
    return Camera(camera.e, camera.p, camera.u, camera.phi, camera.d, camera.W, camera.H, lens)


def labels_of(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the reported parameters of the names that are free."""
    return tuple(r for name in names for r in REPORTED[name])


def components(free: tuple[str, ...]) -> list[str]:
    """Return the components of a move that these names free."""
    return [c for name in free for c in COMPONENTS[name]]


#: Where the corner of a film is, in film heights from the middle.
CORNER = 0.8


class Bounds(eqx.Module):
    """Between what a camera's parameters stay (canonical units)."""

    labels: tuple[str, ...] = eqx.field(static=True)
    low: Float[Array, "k"]
    high: Float[Array, "k"]

    def into(self, start: Camera, moved: Camera) -> Camera:
        """Return a moved camera brought within the bounds: moves begin as they are, and a parameter
        swings to and fro where they would lead it out (as MINUIT's: a sine)."""
        leaves = lambda c: [BOUNDED[label](c) for label in self.labels]
        middle, half = (self.high + self.low) / 2, (self.high - self.low) / 2
        values = []
        for k, (before, after) in enumerate(zip(leaves(start), leaves(moved), strict=True)):
            at = jax.lax.stop_gradient(jnp.clip((before - middle[k]) / half[k], -ALMOST, ALMOST))
            angle = jnp.arcsin(at) + (after - before) / half[k]
            values.append(middle[k] + half[k] * jnp.sin(angle))
        return eqx.tree_at(leaves, moved, values)

    def ended(self, camera: Camera) -> tuple[str, ...]:
        """Return which parameters are at an end of theirs, to 1e-4 of the way between."""
        values = np.array([BOUNDED[label](camera) for label in self.labels])
        low, high = np.asarray(self.low), np.asarray(self.high)
        near = np.minimum(values - low, high - values) < 1e-4 * (high - low)
        return tuple(label for label, there in zip(self.labels, near, strict=True) if there)


#: What may have bounds; and how near to one a parameter may begin, so that it can leave it.
BOUNDED = {
    "phi": lambda c: c.phi,
    "aspect": lambda c: c.lens.aspect,
    **{k: lambda c, k=k: getattr(c.lens.distortion, k) for k in COEFFICIENTS},
}
ALMOST = 0.999999


class Prior(eqx.Module):
    """What is known of reported parameters beforehand (canonical units), and a residual's noise."""

    labels: tuple[str, ...] = eqx.field(static=True)
    mean: Float[Array, "k"]
    std: Float[Array, "k"]
    noise: Float[Array, ""]

    def residuals(self, camera: Camera, free: tuple[str, ...]) -> Float[Array, "k"]:
        """Return how far off the means parameters are, in units in which noise is a residual's."""
        known = labels_of(free)
        values = reported(camera, camera, free)
        off = jnp.stack([values[known.index(label)] for label in self.labels]) - self.mean
        return off * (self.noise / self.std)


class Move(NamedTuple):
    """Where a vector of moves starts: the camera, the pivot, and the size of one unit of each."""

    camera: Camera
    pivot: Float[Array, "3"]
    unit: Float[Array, "n"]
    bounds: Bounds | None = None


def units(
    camera: Camera,
    pivot: Float[Array, "3"],
    radius: Float[Array, ""],
    scale: Float[Array, ""] | Float[np.ndarray, ""],
    free: tuple[str, ...],
) -> Float[Array, "n"]:
    """Return how much of each component moves the outline by about one pixel, in a film's corner
    if it is one of the distortion's.

    `camera` is canonical, `radius` that of the scene about the pivot, `scale` px per film height.
    """
    one_px = 1 / (focal_px(camera)[1] * scale)
    spread = jnp.clip(safe_divide(radius, norm(pivot - camera.e)), 1e-3, 1)
    corner = CORNER / focal_px(camera)[1]
    sizes = {"shift": one_px, "spin": one_px, "principal": 1 / scale}
    sizes |= {name: one_px / corner**power for name, power in COEFFICIENTS.items()}
    names = components(free)
    return jnp.stack([sizes.get(c.split("_")[0], one_px / spread) for c in names])


def moved(move: Move, y: Float[Array, "n"], free: tuple[str, ...]) -> Camera:
    """Return the camera moved by y (in units of `move.unit`); a rigid motion keeps the gauge."""
    camera = _moved(move, y, free)
    return camera if move.bounds is None else move.bounds.into(move.camera, camera)


def _moved(move: Move, y: Float[Array, "n"], free: tuple[str, ...]) -> Camera:
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
    bent = [name for name in COEFFICIENTS if name in step]
    leaves = lambda c: (
        c.lens.principal_point,
        c.lens.aspect,
        *(getattr(c.lens.distortion, name) for name in bent),
    )
    place, aspect, *k = leaves(camera)
    k = [value + step[name] for name, value in zip(bent, k, strict=True)]
    return eqx.tree_at(leaves, camera, (place + shift, aspect * wider, *k))


def reported(camera: Camera, moved: Camera, free: tuple[str, ...]) -> Float[Array, "n"]:
    """Return the reported parameters of `moved`; rotations are small ones away from `camera`.

    `rotation_b1, rotation_b2, rotation_v` turn the camera about its own axes (rad), `e_x, e_y, e_z`
    are the eye in world units, `phi` in rad, `d` in world units, the principal point in px.
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
        bent = moved.lens.distortion
        values |= {name: getattr(bent, name) for name in free if name in COEFFICIENTS}
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
    point = principal_point(camera) / camera.H
    aspect = 1.0 if camera.lens is None else camera.lens.aspect
    unit = Camera(camera.e, camera.p, camera.u, camera.phi, camera.d, 1, 1, Lens(point, aspect))
    if camera.lens is None or camera.lens.distortion is None:
        return unit
    bent = lambda c: c.lens.distortion  # (put in here, it is not asked whether the film's corners
    return eqx.tree_at(bent, unit, camera.lens.distortion, is_leaf=lambda x: x is None)  # are seen)


def on_film(unit: Camera, camera: Camera) -> Camera:
    """Return a canonical camera on `camera`'s film, with a lens if that has one."""
    lens = unit.lens
    if lens is not None:
        place = lens.principal_point * camera.H
        lens = None if camera.lens is None else Lens(place, lens.aspect, lens.distortion)
    moving = lambda c: (c.e, c.p, c.u, c.phi, c.d, c.lens)
    values = (unit.e, unit.p, unit.u, unit.phi, unit.d, lens)
    return eqx.tree_at(moving, camera, values, is_leaf=lambda x: x is None)
