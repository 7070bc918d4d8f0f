"""Random bits as scenes, for the compiled library: no call ends the process, each image is finite;
and random meshes, drawn as arrays draw them.

    python tests/fuzz_native.py --seconds 60 [--seed 0]

Run it against a library built with sanitizers (`.ci/sanitized`), where a wrong read ends it.
"""

import argparse
import time
from collections import namedtuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.random import default_rng
from numpy.testing import assert_allclose
from oracles import filled, random_camera
from slopes import both_ways

import pinhole_jax as pj
from pinhole_jax._camera.camera import film_map
from pinhole_jax._native.library import is_available
from pinhole_jax._native.look import MaskLevel, Sight, look, outline, pixels
from pinhole_jax._native.rasteriser import MODELS, Variables, _call, _image, coverage
from pinhole_jax._silhouette.motion import in_arrays

#: As many shapes of views are tried.
SHAPES = 60
#: How many numbers each model of a lens has, with focal lengths, principal point, trusted radius.
NUMBERS = {0: 0, **dict(zip(MODELS.values(), (10, 13, 9), strict=True))}
LOOK, CALL = eqx.filter_jit(look), eqx.filter_jit(_call)


class Random:
    """Arrays as hostile as bits can make them."""

    def __init__(self, seed):
        self.bits = default_rng(seed)
        #: Decides on shapes alone: of few, so that JAX compiles little.
        self.shapes = default_rng(seed % SHAPES)
        self.kind = self.shapes.choice([np.float32, np.float64])

    def reals(self, *shape):
        """Numbers of a few sorts in one array: plain, tiny, huge, equal, not finite, any bits."""
        plain = self.bits.normal(size=shape)
        scale = 10.0 ** self.bits.choice([0, 0, 0, 0, -30, 30, -300, 300], size=shape)
        with np.errstate(over="ignore"):
            values = (plain * scale).astype(self.kind)
        sort = self.bits.integers(0, 40, size=shape)
        values = np.where(sort < 8, np.round(values), values)
        values = np.where(sort < 2, np.array([np.nan, np.inf], self.kind)[sort % 2], values)
        if self.bits.random() < 0.1:
            values = np.frombuffer(self.bits.bytes(values.nbytes), self.kind).reshape(shape)
        return values if self.bits.random() < 0.5 else plain.astype(self.kind)  # (that is drawn)

    def integers(self, most, *shape):
        """Indices, a few of them out of range."""
        values = self.bits.integers(0, max(most, 1), size=shape)
        wrong = self.bits.random(shape) < self.bits.choice([0, 0, 0.05])
        return np.where(wrong, self.bits.integers(-(2**31), 2**31, size=shape), values).astype("i4")

    def count(self, most, least=0):
        """A number of things, often few or none."""
        return int(self.shapes.integers(least, least + self.shapes.choice([1, 2, 4, most])))


class Arrays(namedtuple("Arrays", "vertices faces edge_vertices edge_faces centers radii")):
    """A scene that nothing has checked: its mesh's arrays, and its spheres'."""

    mesh = spheres = property(lambda self: self)


#: A view's numbers, its scene, the lens's model, and the film's size.
View = namedtuple("View", "film lens frames scene model size")


def view_of(random):
    V, F, E, S = (random.count(n) for n in (40, 60, 90, 12))
    W, H = (random.count(70, least=1) for _ in "WH")
    model = int(random.shapes.integers(0, 4))
    film = random.reals(18)
    if random.bits.random() < 0.7:  # in front of the eye
        matrix = [[W, 0, W / 2], [0, W, H / 2], [0, 0, 1]]
        film = np.array([0, 0, -4, 0, 0, 0, *np.ravel(matrix), 2 * W, 2 * H, 4], random.kind)
    edges = random.integers(V, E, 2), random.integers(F, E, 2)
    balls = random.reals(S, 3), np.abs(random.reals(S))
    scene = Arrays(random.reals(V, 3), random.integers(V, F, 3), *edges, *balls)
    lens, frames = random.reals(NUMBERS[model]), random.reals(S, 9)
    return View(film, lens, frames, scene, model, np.array([W, H], np.int32))


@eqx.filter_jit
def pushed_and_pulled(of, variables, constants, directions, weight):
    image = lambda x: _image(of, x, constants)
    return both_ways(image, variables, directions, weight)


def drawn(random):
    """An image of a view, its push and pull."""
    view = view_of(random)
    variables = Variables(view.film, view.lens, view.scene.vertices, view.frames)
    constants = [*view.scene[1:], view.size]
    (W, H), directions = view.size.tolist(), Variables(*(random.reals(*x.shape) for x in variables))
    moving = jax.tree.map(jnp.asarray, (variables, constants, directions, random.reals(H, W)))
    image, _, _ = pushed_and_pulled((view.model, (H, W)), *moving)
    assert np.all((np.asarray(image) >= 0) & (np.asarray(image) <= 1)), image
    # The edges of a contour, which an image leaves to its derivative, are not checked either.
    n = random.count(9, least=1)
    edges = np.append(random.integers(n + 1, 3), random.integers(90, n))
    given = [*moving[0], *moving[1], jnp.asarray(edges)]
    CALL("image_push", view.model, [image], *given, *moving[2])
    CALL("image_pull", view.model, [*variables], *given, moving[3])


@eqx.filter_jit
def by_both(camera, scene, ways, weight):
    """The image, its change and its gradient by the eye and the scene: the library's, arrays'."""
    moving, held = eqx.partition((camera.e, scene), eqx.is_inexact_array)

    def found(draw):
        def image(moving):
            e, scene = eqx.combine(moving, held)
            return draw(film_map(camera.replace(e=e)), scene)

        return jax.tree.leaves(both_ways(image, moving, ways, weight))

    return found(coverage), found(in_arrays)


def compare(camera, scene, random, close):
    """Assert that the library draws as arrays do: to this many px^2, of slopes 2000 times that."""
    normal = lambda x: jnp.asarray(random.normal(size=x.shape))
    ways = jax.tree.map(normal, eqx.filter((camera.e, scene), eqx.is_inexact_array))
    weight = jnp.asarray(random.normal(size=(camera.H, camera.W)))
    for number, (a, b) in enumerate(zip(*by_both(camera, scene, ways, weight), strict=True)):
        most = 2000 * close * max(1, np.abs(b).max()) if number else close
        assert_allclose(a, b, rtol=0, atol=most)


def compared(random):
    """A mesh of faces that share few vertices: its edges are of any number of them."""
    faces = random.bits.integers(0, 12, (20, 3))
    mesh = filled(random.bits.normal(size=(12, 3)), faces, 40)
    compare(random_camera(random.bits, 24, 18), pj.Scene(mesh), random.bits, 1e-12)


def looked(random):
    """A look at a view, its pixels, and its outline."""
    view = view_of(random)
    n, real = random.count(8, least=1), view.film.dtype
    vertices = view.scene.vertices[: random.shapes.choice([0, 40])]
    variables = view.film, view.lens, vertices, view.frames
    moves = (random.reals(n, *x.shape) for x in variables)
    sight = Sight(*variables, *moves)
    pages, blocks = random.count(40, least=1), random.count(30, least=1)
    level = MaskLevel(
        view.size,
        random.integers(64 * pages, 1),
        np.ones(1, real),
        random.integers(blocks, pages),
        random.reals(4, pages),
        random.reals(6, 64 * blocks),
    )
    given = jax.tree.map(jnp.asarray, (sight, random.reals(3, n + 1), view.scene, level))
    LOOK(*given, view.model)
    found = pixels(sight, view.scene, level, view.model)
    assert np.all((found.coverage >= 0) & (found.coverage <= 1))
    table = outline(sight, view.scene, level, view.model)
    assert len(table) <= len(found.cell)
    assert np.all((table[:, 2] > 0) & (table[:, 2] < 1))


def main():
    """Try scenes for some time."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--verbose", action="store_true", help="name each seed before it is tried")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if not is_available():
        raise SystemExit("there is no library here")
    end, seed = time.monotonic() + given.seconds, given.seed
    while time.monotonic() < end:
        if given.verbose:
            print(f"seed {seed}", flush=True)
        (drawn, compared, drawn, looked)[seed % 4](Random(seed))
        seed += 1
    print(f"{seed - given.seed} scenes from seed {given.seed}: none ended the process")


if __name__ == "__main__":
    main()
