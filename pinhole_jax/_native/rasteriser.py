"""Coverage by the compiled library, with its exact derivative in both directions."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.distortion import BrownConrady, Fisheye, Rational
from .._camera.film import Bend, FilmMap, turned
from .._camera.lens import Lens
from .._numerics.components import perpendicular
from .._numerics.on_devices import spread
from .._numerics.safe import length, safe_sqrt
from .._scene.scene import Scene, Spheres
from .linear import differentiable_once, linear, moves_of

#: Lens models as the library numbers them; 0 is none.
MODELS = {BrownConrady: 1, Rational: 2, Fisheye: 3}


class Variables(NamedTuple):
    """The variables that coverage can be differentiated by; empty where a scene has none.

    - `film`: eye, view, three rows of the matrix, base.
    - `lens`: coefficients, focal lengths and principal point (px); the trusted radius, held.
    - `frames`: the spheres' outlines as conics, row by row.
    """

    film: Float[Array, "18"]
    lens: Float[Array, "n"]
    vertices: Float[Array, "V 3"]
    frames: Float[Array, "S 9"]


#: The library's operands after these, which coverage is not differentiated by: faces, vertices and
#: faces of edges, centres, radii, W and H.
Constants = list[Array]


def coverage(film: FilmMap, scene: Scene) -> Float[Array, "H W"]:
    """Exact coverage of each pixel, row 0 on top."""
    real, size = film.eye.dtype, np.array([film.W, film.H], np.int32)
    constants = [jnp.asarray(x) for x in (*scene_arrays(scene, real)[1:], size)]
    film_of_image = model_of(film.bend), (film.H, film.W)
    return _image(film_of_image, variables_of(film, scene), jax.lax.stop_gradient(constants))


def model_of(lens: Bend | Lens | None) -> int:
    """The number of a lens's model; 0 without a distortion."""
    distortion = None if lens is None else lens.distortion
    return 0 if distortion is None else MODELS[type(distortion)]


def variables_of(film: FilmMap, scene: Scene) -> Variables:
    """The numbers of a view that its image can be differentiated by."""
    real, mesh, spheres = film.eye.dtype, scene.mesh, scene.spheres
    numbers = [film.eye, film.view, film.matrix.reshape(-1), film.base]
    return Variables(
        jnp.concatenate(numbers),
        jnp.zeros(0, real) if film.bend is None else film.bend.numbers,
        jnp.zeros((0, 3), real) if mesh is None else mesh.vertices,
        jnp.zeros((0, 9), real) if spheres is None else sphere_frames(film, spheres),
    )


def scene_arrays(scene: Scene, real: Any) -> list[Any]:
    """Vertices, faces, the edges' vertices and faces, centres and radii; empty without them."""
    mesh, spheres = scene.mesh, scene.spheres
    none, triples = np.zeros((0, 3), real), np.zeros((0, 3), np.int32)
    arrays = [none, triples, triples[:, :2], triples[:, :2], none, none[:, 0]]
    if mesh is not None:
        arrays[:4] = mesh.vertices, mesh.faces, mesh.edge_vertices, mesh.edge_faces
    if spheres is not None:
        arrays[4:] = spheres.centers, spheres.radii
    return arrays


def sphere_frames(film: FilmMap, spheres: Spheres) -> Float[Array, "S 9"]:
    """The spheres' outlines: homogeneous film points `row 0 + row 1 w_1 + row 2 w_2`, |w| = 1.

    Rays touch a sphere (centre c from the eye, radius r) on a circle. Their unit directions are
    `c t / |c|^2 + (r / |c|) (e1 w_1 + e2 w_2)`: t is the tangent's length (below: over |c|), e1 and
    e2 are perpendicular to c. Their film points are a conic.
    """
    offset, radius = (spheres.centers - film.eye[None]).T, spheres.radii
    distance = length(*offset)
    distance = jnp.where(jax.lax.stop_gradient(distance > radius), distance, 2 * radius)
    sine = radius / distance
    tangent = safe_sqrt((distance - radius) / distance * (1 + sine))
    e2, e1 = perpendicular([x / distance for x in offset])  # counter-clockwise to the eye
    ring = jnp.stack([sine * x for x in (*e1, *e2)], axis=1).reshape(-1, 2, 3)
    middle = film(spheres.centers) * (tangent / distance)[:, None]
    return jnp.concatenate([middle, turned(film.matrix, ring).reshape(-1, 6)], axis=1)


# --- calls ----------------------------------------------------------------------------------------


def _call(name: str, model: int, shapes: Sequence[Any], *arguments: Array) -> Sequence[Array]:
    call = jax.ffi.ffi_call(f"pinhole_{name}", [*shapes], vmap_method="expand_dims")
    given = spread(arguments, [])
    return spread(call(*given, model=model), given)


def _with_edges(model: int, shape: tuple[int, int], given: list[Array]) -> Sequence[Array]:
    """The image and its contour's edges, which the derivative reuses.

    There is room for a quarter of the mesh's edges; if a rough mesh's contour has more, the
    derivative finds them again.
    """
    edge_vertices = given[5]
    room = jax.ShapeDtypeStruct((3 + len(edge_vertices) // 4,), jnp.int32)
    return _call("image", model, (jax.ShapeDtypeStruct(shape, given[0].dtype), room), *given)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _image(
    of: tuple[int, tuple[int, int]], variables: Variables, constants: Constants
) -> Float[Array, "H W"]:
    """The coverage (H, W); `of` is the lens's model and the image's shape."""
    return _with_edges(*of, [*variables, *constants])[0]


@partial(_image.defjvp, symbolic_zeros=True)
def _image_jvp(of: tuple[int, tuple[int, int]], primals: Any, tangents: Any):
    """The coverage's change: the visible outline's length in each pixel times its velocity."""
    (model, _), (variables, constants) = of, primals
    moves = moves_of(tangents[0])
    # (Variables that do not move are empty, and cost nothing.)
    empty = jax.tree.map(lambda x: jnp.zeros((0,) * x.ndim, x.dtype), variables)
    change = eqx.filter(tangents[0], moves), empty
    given = spread(differentiable_once([*variables, *constants]), change)
    velocities, empty = spread(change, given)
    image, edges = _with_edges(*of, given)
    shape = jax.ShapeDtypeStruct(image.shape, image.dtype)

    def push(velocities: Variables) -> Array:
        every = eqx.combine(velocities, empty)
        return _call("image_push", model, [shape], *given, edges, *every)[0]

    def pull(weights: Array) -> Variables:
        like = eqx.combine(eqx.filter(variables, moves), empty)
        shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in like]
        every = Variables(*_call("image_pull", model, shapes, *given, edges, weights))
        return eqx.filter(every, moves)

    return image, linear(push, pull, velocities, shape)
