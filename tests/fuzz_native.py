"""Random bits as scenes, for the compiled library: no call ends the process, each image is finite.

    python tests/fuzz_native.py --seconds 60 [--seed 0]

Run it against a library built with sanitizers (`.ci/sanitized`), where a wrong read ends it.
"""

import argparse
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pinhole_jax._native.library import is_available
from pinhole_jax._native.look import MaskLevel, Sight, look, pixels
from pinhole_jax._native.rasteriser import MODELS, _call
from pinhole_jax._scene.scene import Mesh, Scene, Spheres

#: As many shapes of views are tried.
SHAPES = 60
#: How many numbers each model of a lens has, with focal lengths and principal point.
NUMBERS = {0: 0, **dict(zip(MODELS.values(), (9, 12, 8), strict=True))}


LOOK = eqx.filter_jit(look)
CALL = eqx.filter_jit(_call)


class Random:
    """Arrays as hostile as bits can make them."""

    def __init__(self, seed: int):
        self.bits = np.random.default_rng(seed)
        #: Decides on shapes alone: of few, so that JAX compiles little.
        self.shapes = np.random.default_rng(seed % SHAPES)
        self.kind = self.shapes.choice([np.float32, np.float64])

    def reals(self, *shape: int) -> np.ndarray:
        """Numbers of a few sorts in one array: plain, tiny, huge, equal, not finite, any bits."""
        plain = self.bits.normal(size=shape)
        scale = 10.0 ** self.bits.choice([0, 0, 0, 0, -30, 30, -300, 300], size=shape)
        with np.errstate(over="ignore"):
            values = (plain * scale).astype(self.kind)
        sort = self.bits.integers(0, 40, size=shape)
        values[sort == 0] = np.nan
        values[sort == 1] = np.inf
        values[sort < 8] = np.round(values[sort < 8])
        if self.bits.random() < 0.1:
            whole = self.bits.integers(0, 256, values.nbytes, dtype=np.uint8)
            values = whole.view(self.kind)[: values.size].reshape(shape)
        if self.bits.random() < 0.5:  # a view that is drawn
            values = np.nan_to_num(plain).astype(self.kind)
        return values

    def integers(self, most: int, *shape: int) -> np.ndarray:
        """Indices, a few of them out of range."""
        values = self.bits.integers(0, max(most, 1), size=shape)
        wrong = self.bits.random(shape) < self.bits.choice([0, 0, 0.05])
        return np.where(wrong, self.bits.integers(-(2**31), 2**31, size=shape), values).astype("i4")

    def count(self, most: int) -> int:
        """A number of things, often few or none."""
        return int(self.shapes.integers(0, self.shapes.choice([1, 2, 4, most])))


def view(random: Random) -> tuple[list[np.ndarray], int, tuple[int, int]]:
    """What the library is given of a view, the lens's model, and the film's size."""
    V, F, E, S = (random.count(n) for n in (40, 60, 90, 12))
    W, H = (int(random.shapes.integers(1, random.shapes.choice([2, 8, 70]))) for _ in "WH")
    model = int(random.shapes.integers(0, 4))
    film = random.reals(18)
    if random.bits.random() < 0.7:  # in front of the eye
        film[6:15] = (np.eye(3) * [[W], [W], [1]] + [[0, 0, W / 2], [0, 0, H / 2], [0] * 3]).ravel()
        film[:3], film[3:6] = [0, 0, -4], 0
        film[15:] = [2 * W, 2 * H, 4]
    lens = random.reals(NUMBERS[model] + 1 if model else 0)
    mesh = (
        random.reals(V, 3),
        random.integers(V, F, 3),
        random.integers(V, E, 2),
        random.integers(F, E, 2),
    )
    balls = random.reals(S, 3), np.abs(random.reals(S)), random.reals(S, 9)
    return [film, lens, *mesh, *balls, np.array([W, H], np.int32)], model, (W, H)


def drawn(random: Random) -> None:
    """An image of a view, its push and pull."""
    given, model, (W, H) = view(random)
    film, lens, vertices, frames = (given[k] for k in (0, 1, 2, 8))
    arrays = [jnp.asarray(x) for x in given]
    image = jax.ShapeDtypeStruct((H, W), film.dtype)
    room = jax.ShapeDtypeStruct((3 + random.count(9),), jnp.int32)
    seen, edges = CALL("image", model, [image, room], *arrays)
    if random.bits.random() < 0.5:
        edges = jnp.asarray(random.integers(90, *edges.shape))
    assert np.all((np.asarray(seen) >= 0) & (np.asarray(seen) <= 1)), seen
    moves = film, lens[: NUMBERS[model]], vertices, frames
    own = [random.reals(*x.shape) if random.shapes.random() < 0.7 else x[:0] for x in moves]
    own = [x if x.size else np.zeros((0,) * x.ndim, x.dtype) for x in own]
    CALL("image_push", model, [image], *arrays, edges, *map(jnp.asarray, own))
    results = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in own]
    CALL("image_pull", model, results, *arrays, edges, jnp.asarray(random.reals(H, W)))


def looked(random: Random) -> None:
    """A look at a view, and its pixels."""
    (film, lens, *mesh, centers, radii, frames, _), model, (W, H) = view(random)
    n, real = int(random.shapes.integers(1, 8)), film.dtype
    scene = Scene(mesh=object.__new__(Mesh), spheres=object.__new__(Spheres))
    names = "vertices", "faces", "edge_vertices", "edge_faces"
    for name, array in zip(names, mesh, strict=True):
        object.__setattr__(scene.mesh, name, jnp.asarray(array))
    object.__setattr__(scene.spheres, "centers", jnp.asarray(centers))
    object.__setattr__(scene.spheres, "radii", jnp.asarray(radii))
    moves = (random.reals(n, *x.shape) for x in (film, lens[: NUMBERS[model]], frames))
    sight = Sight(*map(jnp.asarray, (film, lens, frames, *moves)))
    pages, cells = int(random.shapes.integers(1, 40)), 64 * int(random.shapes.integers(1, 30))
    level = MaskLevel(
        np.array([W, H], np.int32),
        random.integers(64 * pages, 1),
        np.ones(1, real),
        random.integers(cells // 64, pages),
        random.reals(4, pages),
        random.reals(6, cells),
    )
    known = jnp.asarray(random.reals(3, n + 1))
    LOOK(sight, known, scene, jax.tree.map(jnp.asarray, level), model)
    found = pixels(sight, scene, level, model)
    assert np.all((found.coverage >= 0) & (found.coverage <= 1))


def main() -> None:
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
        random = Random(seed)
        if given.verbose:
            print(f"seed {seed}", flush=True)
        (looked if seed % 4 == 3 else drawn)(random)
        seed += 1
    print(f"{seed - given.seed} scenes from seed {given.seed}: none ended the process")


if __name__ == "__main__":
    main()
