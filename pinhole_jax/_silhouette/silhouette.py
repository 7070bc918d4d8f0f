"""`silhouette`: the image of a scene's exact coverage, with its exact derivative."""

import equinox as eqx
import jax
from jaxtyping import Array, Float

from .._camera.camera import Camera, film_map
from .._camera.film import FilmMap
from .._native.library import is_available
from .._native.rasteriser import coverage
from .._scene.scene import Scene, astype, check_view
from .motion import in_arrays


def silhouette(camera: Camera, scene: Scene, overlaps: bool = True) -> Float[Array, "H W"]:
    """The fraction of each pixel's square that the scene covers: (H, W), row 0 on top.

    Exact (box filter, no sampling, no blur) for any scene: the coverage of the union of all
    projected triangles and spheres. Meshes may be closed or open, wind consistently or not,
    overlap, reach through the plane of the eye or surround it. An eye inside a closed mesh or a
    sphere sees everything covered. The cost follows the occluding contour. Coverage is in [0, 1]
    for coordinates of any size; but the visible side of a face is undefined if its corners'
    distances from the eye differ by more than 1 / epsilon of the float type. `overlaps` has no
    effect any more.

    The derivative, in forward and reverse mode, with respect to the camera, vertices, centers and
    radii is exact as well: the visible contour's normal velocity. Coverage is not differentiable
    where a face is seen edge-on, where contours coincide over a length, where one runs along a
    pixel's side, and where a sphere touches the eye; there it is the derivative of the contour as
    it is (of one of the coinciding pieces), which is a one-sided derivative, and it is finite. A
    contour along a pixel's side counts for the pixel above it or to its right.

    ```python
    mask = pj.silhouette(camera, scene)  # (H, W), in [0, 1]
    moves = jax.jacfwd(lambda phi: pj.silhouette(camera.replace(phi=phi), scene))(camera.phi)
    ```
    """
    check_view(camera, scene)
    return _silhouette(camera, scene)


@eqx.filter_jit
def _silhouette(camera: Camera, scene: Scene) -> Float[Array, "H W"]:
    return on_film(film_map(camera), astype(scene, camera.e.dtype))


def on_film(film: FilmMap, scene: Scene) -> Float[Array, "H W"]:
    """The coverage of each pixel of a film, by the library where it runs; both of one type."""
    if not is_available():
        return in_arrays(film, scene)
    if jax.default_backend() == "cpu":
        return coverage(film, scene)
    return jax.lax.platform_dependent(film, scene, cpu=coverage, default=in_arrays)
