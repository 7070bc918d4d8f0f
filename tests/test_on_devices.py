"""Within `jax.shard_map`, as it is by default, each device gets what one device alone works out.

All cases run in one process of four devices: this file itself.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

#: Each with the devices that it is sharded over.
CASES = {"masks": (2,), "shared mesh": (4,), "hits": (2, 2)}


@pytest.fixture(scope="module")
def errors():
    """The largest difference of each result from that of one device, relative to the largest."""
    programs = Path(__file__).parents[1] / ".pytest_cache" / "programs"
    kept = {"JAX_COMPILATION_CACHE_DIR": str(programs), "JAX_ENABLE_X64": "1"}
    kept["PYTHONPATH"] = str(Path(__file__).parents[1])
    given = {"env": {**os.environ, **kept}, "capture_output": True, "text": True, "check": False}
    done = subprocess.run([sys.executable, __file__], **given)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("case", CASES)
def test_sharded_results_are_those_of_one_device(errors, case):
    assert errors[case] < 1e-9


def main():
    """Print the errors of all cases."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    from jax.sharding import Mesh as Devices, PartitionSpec as P

    import pinhole_jax as pj

    jax.config.update("jax_num_cpu_devices", 4)
    random = np.random.default_rng(0)
    eyes = jnp.asarray(random.normal(size=(4, 3)) * 0.3 + [0, 0, 4])
    weights = jnp.asarray(random.uniform(size=(4, 10, 12)))
    lens = pj.Lens([6.2, 4.9], 1.1, pj.Fisheye(0.05, -0.01))
    mesh, radii = pj.shapes.bumpy(0), jnp.array([0.5, 0.4])
    shapes = mesh.vertices + jnp.asarray(random.normal(size=(4, *mesh.vertices.shape)) * 0.02)
    centers = jnp.asarray(random.normal(size=(4, 2, 3)) * 0.5)
    spread = lambda f, devices, given, results: jax.shard_map(
        f, mesh=devices, in_specs=given, out_specs=results
    )

    def view(e, lens=None):
        return pj.Camera(e, jnp.zeros(3), jnp.array([0.0, 1, 0]), 0.7, 1.0, 12, 10, lens)

    def total(weight, camera, vertices, spheres=None):
        scene = pj.Scene(mesh=pj.Mesh(vertices, np.asarray(mesh.faces)), spheres=spheres)
        return jnp.sum(weight * pj.silhouette(camera, scene))

    def derivatives(function, x):
        """The value, its derivative forward along all of `x`, and in reverse."""
        value, along = jax.linearize(function, x)
        forward = along(jax.tree.map(jnp.ones_like, x))
        return value, forward, jax.linear_transpose(along, x)(jnp.ones_like(value))

    def masks(x, weight):
        loss = lambda x: total(weight, view(x[0], lens), x[1], pj.Spheres(x[2], radii))
        return derivatives(loss, x)

    def hits(e, weight):
        """Of closest and any hits, of a camera's rays and of any."""
        scene = pj.Scene(mesh=mesh, spheres=pj.Spheres(centers[0], radii))

        def far(e):
            there = pj.trace(scene, pj.camera_rays(view(e, lens))).t
            return jnp.sum(weight * jnp.where(jnp.isfinite(there), there, 0))

        blocked = pj.occluded(scene, pj.camera_rays(view(e))).astype(float)
        images = pj.normals(view(e), scene), 1 / pj.depth(view(e), scene)
        return blocked, images, derivatives(far, e)

    def by_device(function, x):
        batch = jax.vmap(function)
        return lambda devices: (
            spread(batch, devices, P("d"), P("d"))(x, weights),
            batch(x, weights),
        )

    def shared_mesh(devices):
        """The derivative by vertices that all devices share is the sum over these."""
        loss = lambda vertices, eyes, weights: jnp.sum(
            jax.vmap(lambda e, weight: total(weight, view(e), vertices))(eyes, weights)
        )
        given, specs = (mesh.vertices, eyes, weights), (P(), P("d"), P("d"))
        summed = spread(lambda *x: jax.lax.psum(loss(*x), "d"), devices, specs, P())
        inside = spread(jax.grad(loss), devices, specs, P())(*given)
        value, slope = jax.value_and_grad(loss)(*given)
        return (*jax.value_and_grad(summed)(*given), inside), (value, slope, slope)

    def error(got, wanted):
        leaves = zip(jax.tree.leaves(got), jax.tree.leaves(wanted), strict=True)
        return max(float(jnp.max(jnp.abs(a - b)) / jnp.max(jnp.abs(b))) for a, b in leaves)

    found = {}
    runs = by_device(masks, (eyes, shapes, centers)), shared_mesh, by_device(hits, eyes)
    for (name, shape), run in zip(CASES.items(), runs, strict=True):
        among = np.array(jax.devices()[: int(np.prod(shape))]).reshape(shape)
        devices = Devices(among, ("d", "other")[: len(shape)])
        found[name] = error(*jax.jit(lambda run=run, devices=devices: run(devices))())
    print(json.dumps(found))


if __name__ == "__main__":
    main()
