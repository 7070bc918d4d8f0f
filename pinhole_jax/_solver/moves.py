"""Moves of a camera, as a vector that is 0 where it starts, and what is reported of them."""

from functools import cache
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.axes import axes_of
from .._camera.camera import Camera, camera_basis, focal_px, principal_point
from .._camera.lens import Lens
from .._camera.poses import at_pose, exponential, pose_of, rigid
from .._numerics.arrays import as_numpy
from .._numerics.safe import norm, safe_divide, safe_sqrt, times
from .parameters import (
    AXES,
    COMPONENTS,
    LABELS,
    PARAMETERS,
    TABLE,
    Scale,
    components,
    labels_of,
)

#: Where the corner of a film is, in film heights from the middle.
CORNER = 0.8
#: How near to an end of its bounds a parameter may begin, so that it can leave it.
ALMOST = 0.999999


class Bounds(eqx.Module):
    """Between what a camera's parameters stay (canonical units)."""

    labels: tuple[str, ...] = eqx.field(static=True)
    low: Float[Array, "k"]
    high: Float[Array, "k"]

    def into(self, start: Camera, moved: Camera) -> Camera:
        """Return a moved camera brought within the bounds: moves begin as they are, and a parameter
        swings to and fro where they would lead it out (as MINUIT's: a sine)."""
        middle, half = (self.high + self.low) / 2, (self.high - self.low) / 2
        before, after = (jnp.stack(self._leaves(camera)) for camera in (start, moved))
        at = jax.lax.stop_gradient(jnp.clip((before - middle) / half, -ALMOST, ALMOST))
        values = middle + half * jnp.sin(jnp.arcsin(at) + (after - before) / half)
        return eqx.tree_at(self._leaves, moved, [*values])

    def ended(self, camera: Camera) -> dict[str, float]:
        """Return which parameters are at an end of theirs, to 1e-4 of the way between: -1 at the
        low one, 1 at the high one."""
        values = np.array(self._leaves(camera))
        low, high = np.asarray(self.low), np.asarray(self.high)
        way = (2 * values - high - low) / (high - low)
        return {
            label: float(np.sign(x))
            for label, x in zip(self.labels, way, strict=True)
            if abs(x) > 1 - 2e-4
        }

    def _leaves(self, camera: Any) -> list[Any]:
        # What may have bounds is one number, whose label is its name.
        return [PARAMETERS[label].leaves[0].of(camera) for label in self.labels]


class Move(NamedTuple):
    """Where a vector of moves starts: the camera, the pivot, and the scale of each move."""

    camera: Camera
    pivot: Float[Array, "3"]
    scale: Float[Array, "n"]
    bounds: Bounds | None = None


def scales(
    camera: Camera,
    pivot: Float[Array, "3"],
    radius: Float[Array, ""],
    scale: Float[Array, ""] | Float[np.ndarray, ""],
    free: tuple[str, ...],
) -> Float[Array, "n"]:
    """The size of each component that moves the outline by about one pixel, in a film's corner
    if it is one of the distortion's.

    `camera` is canonical, `radius` that of the scene about the pivot, `scale` px per film height.
    """
    focal = focal_px(camera)[1]
    distortion = None if camera.lens is None else camera.lens.distortion
    pixel, spread = 1 / (focal * scale), safe_divide(radius, norm(pivot - camera.e))
    here = Scale(
        pixel=pixel,
        far=pixel / jnp.clip(spread, 1e-3, 1),
        film=1 / jnp.asarray(scale),
        corner=CORNER / focal,
        powers={} if distortion is None else distortion.powers,
    )
    return jnp.stack([COMPONENTS[name].size(here) for name in components(free)])


def moved(move: Move, y: Float[Array, "n"], free: tuple[str, ...]) -> Camera:
    """Return the camera moved by y (in units of `move.scale`); a rigid motion keeps the gauge."""
    camera, step = move.camera, dict(zip(components(free), y * move.scale, strict=True))
    if not {"pose", "position", "orientation"}.isdisjoint(free):
        camera = _moved_rigidly(camera, move.pivot, step)
    for row in (PARAMETERS[name] for name in free):
        for leaf in row.leaves:
            part = jnp.stack([step[component.name] for component in row.components])
            camera = eqx.tree_at(leaf.of, camera, leaf.moved(leaf.of(camera), part))
    return camera if move.bounds is None else move.bounds.into(move.camera, camera)


def _moved_rigidly(camera: Camera, pivot: Float[Array, "3"], step: dict[str, Array]) -> Camera:
    """Return the camera turned about its eye, shifted, brought nearer, turned about the pivot."""
    axes = jnp.stack(camera_basis(camera))
    zero = jnp.zeros_like(pivot[0])
    of = lambda kind, names: jnp.stack([step.get(f"{kind}_{b}", zero) for b in names])
    view, up = camera.p - camera.e, camera.u
    if "spin_v" in step:
        about_eye = rotation(times(of("spin", AXES), axes))
        view, up = times(about_eye, view), times(about_eye, up)

    offset = camera.e - pivot
    if "log_distance" in step:
        # The pivot as the camera sees it slides sideways and comes nearer; the eye goes the other
        # way.
        aside = norm(offset) * times(of("shift", AXES[:2]), axes[:2])
        offset = (offset + aside) * jnp.exp(step["log_distance"])
    if "turn_v" in step:
        about_pivot = rotation(times(of("turn", AXES), axes))
        view, up, offset = (times(about_pivot, x) for x in (view, up, offset))
    e = pivot + offset if "log_distance" in step else camera.e
    return eqx.tree_at(lambda c: (c.e, c.p, c.u), camera, (e, e + view, up))


def reported(camera: Camera, moved: Camera, free: tuple[str, ...]) -> Float[Array, "n"]:
    """Return the reported parameters of `moved` (`labels_of`); rotations are small ones away from
    `camera`.

    `rotation_b1, rotation_b2, rotation_v` turn the camera about its own axes (rad); `e_x, e_y, e_z`
    are the eye. Units: world for `e` and `d`, rad for `phi`, px for the principal point.
    """
    labels, small = labels_of(free), {}
    if "rotation_v" in labels:
        before, after = jnp.stack(camera_basis(camera)), jnp.stack(camera_basis(moved))
        cross = jnp.sum(jnp.cross(before, after), axis=0) / 2  # rotation vector, to first order
        small = dict(zip((f"rotation_{b}" for b in AXES), times(before, cross), strict=True))

    def value(label: str) -> Any:
        of = LABELS[label].value
        return small[label] if of is None else of(moved)

    return jnp.stack([value(label) for label in labels])


def displaced(camera: Camera, labels: tuple[str, ...], step: np.ndarray) -> Camera:
    """Return the camera with its reported parameters changed by a small step (n,).

    Raises ValueError for labels that are none.
    """
    if unknown := sorted({*labels} - LABELS.keys()):
        raise ValueError(f"`fit`: expected known parameters, got {unknown}")
    change = dict(zip(labels, step.tolist(), strict=True))
    of = lambda row: np.array([change.get(label.name, 0.0) for label in row.labels])
    turn, shift = np.split(of(PARAMETERS["pose"]), 2)
    motion, pose = exponential(np.append(turn @ axes_of(camera), 0 * turn)), pose_of(camera)
    camera = at_pose(camera, rigid(motion[:3, :3] @ pose[:3, :3], pose[:3, 3] + shift))
    for row in (row for row in TABLE if row.leaves and row.labels[0].name in change):
        leaf, *others = row.leaves
        value = np.asarray(leaf.of(camera))
        changed = (value + of(row).reshape(value.shape)).astype(value.dtype)
        camera = eqx.tree_at(leaf.of, camera, changed)
        for other in others:  # the film's height stays while d changes
            stretch = jnp.log(jnp.asarray(changed / value))[None]
            camera = eqx.tree_at(other.of, camera, other.moved(other.of(camera), stretch))
    return jax.tree.map(jnp.asarray, camera)


def rotation(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return the rotation matrix about a vector by its length in rad (Rodrigues)."""
    x, y, z = vector
    zero, angle = jnp.zeros_like(x), safe_sqrt(x * x + y * y + z * z)
    skew = jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])
    # sin(a)/a and (1 - cos(a))/a^2
    a, b = jnp.sinc(angle / jnp.pi), jnp.sinc(angle / (2 * jnp.pi)) ** 2 / 2
    return jnp.eye(3, dtype=vector.dtype) + a * skew + b * times(skew, skew)


def canonical(camera: Camera) -> Camera:
    """Return the same view on a film one pixel high, with a lens: W, H are no longer static facts.

    One compiled program then serves all resolutions; film coordinates are in film heights.
    """
    lens, dtype = camera.lens, camera.e.dtype
    point = jnp.asarray(as_numpy(principal_point(camera)) / camera.H, dtype)
    aspect, bends = (jnp.ones((), dtype), None) if lens is None else (lens.aspect, lens.distortion)
    parts = lambda lens: (lens.principal_point, lens.aspect, lens.distortion)
    moving = lambda c: (c.e, c.p, c.u, c.phi, c.d, *parts(c.lens))
    values = (camera.e, camera.p, camera.u, camera.phi, camera.d, point, aspect, bends)
    # (Put in here, nothing is checked again, nor is it asked whether the film's corners are seen.)
    return eqx.tree_at(moving, _unit(), values, is_leaf=lambda x: x is None)


@cache
def _unit() -> Camera:
    """A camera on a film of one pixel, with a lens."""
    with jax.ensure_compile_time_eval():  # (what is traced must not stay)
        return Camera([0, 0, 1], [0, 0, 0], [0, 1, 0], 1.0, 1.0, 1, 1, Lens([0.5, 0.5]))


def on_film(canonical_one: Camera, camera: Camera) -> Camera:
    """Return a canonical camera on `camera`'s film, with a lens if that has one."""
    one = canonical_one
    lens = one.lens
    if lens is not None:
        place = as_numpy(lens.principal_point) * camera.H
        lens = None if camera.lens is None else Lens(place, lens.aspect, lens.distortion)
    moving = lambda c: (c.e, c.p, c.u, c.phi, c.d, c.lens)
    values = (one.e, one.p, one.u, one.phi, one.d, lens)
    return eqx.tree_at(moving, camera, values, is_leaf=lambda x: x is None)
