"""A mask, its weights, and the film that it lies on."""

from dataclasses import dataclass, replace
from functools import cached_property

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._camera.camera import Camera, bent, film_map, focal_px, principal_point
from .edges import SparseImage, alike, edge_band
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
        """Return the weights of pixels near the mask's edge, less the farther they are from it
        (Tukey's biweight): none `reach` + 1 (px) away."""
        made = self._made
        if reach not in made:
            band = edge_band(inside_of(self.target), reach)
            near = (1 - (band.value / (1 + reach)) ** 2) ** 2
            made[reach] = band._replace(value=self.weight[band.rows_columns] * near)
        return made[reach]

    @cached_property
    def _made(self) -> dict[float, SparseImage]:
        """Keep the weights near the edge, by their reach."""
        return {}

    def longer(self, factor: float) -> "Mask":
        """Return the mask as seen with a focal length times a factor."""
        phi = 2 * np.arctan(np.tan(np.asarray(self.camera.phi) / 2) / factor)
        phi = jnp.asarray(phi, self.camera.e.dtype)
        return replace(self, camera=eqx.tree_at(lambda c: c.phi, self.camera, phi))

    def signature(self, hidden: float | None = None) -> Signature:
        """Return the mask's signature; as if a part were `hidden` in a direction (rad)."""
        focal = np.array([float(f) for f in focal_px(self.camera)])
        centre = np.asarray(principal_point(self.camera), float)
        if self.camera.distortion is None:
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
        left, right, bottom, top = np.asarray(film_map(self.camera).bounds, float)
        corner, size = np.array([left, bottom]), np.array([right - left, top - bottom])
        across, down = (np.arange(W) + 0.5) / W, 1 - (np.arange(H) + 0.5) / H
        ideal = corner + size * np.stack(np.meshgrid(across, down), axis=-1)
        column, row = np.moveaxis(bent(self.camera, ideal), -1, 0)
        at = np.stack([H - row - 0.5, column - 0.5])
        image, weight = (
            map_coordinates(z, at, order=1, cval=0.0) for z in (self.image, self._shares() + 0.0)
        )
        return image, weight, corner, np.array([W, H]) / size
