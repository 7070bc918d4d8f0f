"""A mask, its weights, and the film that it lies on."""

from dataclasses import dataclass, replace
from functools import cached_property

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._camera.camera import Camera, bent, film_map, focal_px, principal_point
from .edges import SparseImage, alike, near_weights
from .kinds import Kind, kind_of
from .signatures import Signature, signatures
from .target import as_coverage, inside_of, object_window


@dataclass(frozen=True)
class Mask:
    """A target (H, W), its weights, and a camera whose film, phi and lens are used."""

    target: np.ndarray
    weight: np.ndarray
    camera: Camera

    @property
    def image(self) -> np.ndarray:
        """Return the target as floats."""
        return as_coverage(self.target)

    @cached_property
    def usual_weight(self) -> float:
        """The median weight of the pixels that count: residuals' squares are in its unit."""
        some = self.weight[:1, :1] if alike(self.weight) else self.weight
        weighed = some[some > 0]
        return float(np.median(weighed)) if weighed.size else 1.0

    @cached_property
    def kind(self) -> Kind:
        """The mask's kind, in the camera's float type."""
        window = object_window(self.target)
        return kind_of(window.crop(self.target), window.crop(self.weight), self.camera.e.dtype)

    def near_edge(self, reach: float) -> SparseImage:
        """Return the weights of pixels near the mask's edge; 0 farther than `reach` (px)."""
        made = self._made
        if reach not in made:
            inside = inside_of(self.target)
            made[reach] = near_weights(inside, self.weight, object_window(inside), reach)
        return made[reach]

    @cached_property
    def _made(self) -> dict[float, SparseImage]:
        """Keep the weights near the edge, by their reach."""
        return {}

    def longer(self, factor: float) -> "Mask":
        """Return the mask as seen with a focal length times a factor."""
        dtype = self.camera.e.dtype
        phi = np.asarray(2 * np.arctan(np.tan(np.asarray(self.camera.phi) / 2) / factor), dtype)
        phi = jnp.asarray(phi, dtype)
        return replace(self, camera=eqx.tree_at(lambda c: c.phi, self.camera, phi))

    def signature(self, hidden: float | None = None) -> Signature:
        """Return the mask's signature; as if a part were `hidden` in a direction (rad)."""
        focal = np.array([float(f) for f in focal_px(self.camera)])
        centre = np.asarray(principal_point(self.camera), float)
        if self.camera.lens is None or self.camera.lens.distortion is None:
            return signatures(self.image[None], self._shares(), focal, centre, hidden)
        image, weight, corner, scale = self._straightened()
        return signatures(image[None], weight, focal * scale, (centre - corner) * scale, hidden)

    def _shares(self) -> np.ndarray:
        """Return the weights, the largest as 1."""
        most = float(np.max(self.weight))
        return self.weight if most == 1 else self.weight / most

    def _straightened(self) -> tuple[np.ndarray, ...]:
        """Return mask and weight (H, W) resampled without distortion, their lower left corner (px),
        and how many of their pixels are one of the film's (x, y)."""
        from scipy.ndimage import map_coordinates

        H, W = self.image.shape
        corner, size = _ideal_rectangle(self.camera)
        x, y = (
            c + (np.arange(n) + 0.5) / n * s for c, n, s in zip(corner, (W, H), size, strict=True)
        )
        ideal = np.stack(np.meshgrid(x, y[::-1]), axis=-1)
        column, row = np.moveaxis(bent(self.camera, ideal), -1, 0)
        at = np.stack([H - row - 0.5, column - 0.5])
        image, weight = (
            map_coordinates(z, at, order=1, cval=0.0) for z in (self.image, self._shares() + 0.0)
        )
        return image, weight, corner, np.array([W, H]) / size


def _ideal_rectangle(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return lower left corner and size (px) of a part of the ideal film that shows all."""
    left, right, bottom, top = (float(x) for x in film_map(camera).bounds)
    return np.array([left, bottom]), np.array([right - left, top - bottom])
