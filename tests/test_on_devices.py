"""Within `jax.shard_map`, as it is by default, each device gets what one device alone works out.

All cases run in one process of four devices: this file itself.
"""

import json
import math
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
    mesh, lens = pj.shapes.bumpy(0), pj.Lens([6.2, 4.9], 1.1, pj.Fisheye(0.05, -0.01))
    shapes = mesh.vertices + jnp.asarray(random.normal(size=(4, *mesh.vertices.shape)) * 0.02)
    centers = jnp.asarray(random.normal(size=(4, 2, 3)) * 0.5)

    def view(e, lens=lens):
        return pj.Camera(e, jnp.zeros(3), jnp.array([0.0, 1, 0]), 0.7, 1.0, 12, 10, lens)

    def scene_of(vertices, centers):
        spheres = pj.Spheres(centers, jnp.array([0.5, 0.4]))
        return pj.Scene(mesh=pj.Mesh(vertices, np.asarray(mesh.faces)), spheres=spheres)

    def derivatives(function, x):
        value, along = jax.linearize(function, x)
        forward = along(jax.tree.map(jnp.ones_like, x))
        return value, forward, jax.linear_transpose(along, x)(jnp.ones_like(value))

    def masks(e, vertices, centers, weight):
        image = lambda x: jnp.sum(weight * pj.silhouette(view(x[0]), scene_of(*x[1:])))
        return derivatives(image, (e, vertices, centers))

    def shared_mesh(vertices, eyes, weights):
        """The loss over all eyes of one mesh."""
        image = lambda e: pj.silhouette(view(e, None), scene_of(vertices, centers[0]))
        return jnp.sum(weights * jax.vmap(image)(eyes))

    def hits(e, vertices, centers, weight):
        """Of closest and any hits, of a camera's rays and of any."""
        scene = scene_of(vertices, centers)
        near = lambda e: jnp.sum(weight / pj.trace(scene, pj.camera_rays(view(e))).t)
        blocked = pj.occluded(scene, pj.camera_rays(view(e))).astype(float)
        return (
            blocked,
            pj.normals(view(e), scene),
            1 / pj.depth(view(e), scene),
            derivatives(near, e),
        )

    given, every, same = (eyes, shapes, centers, weights), P("d"), lambda function: function
    summed = lambda *x: jax.lax.psum(shared_mesh(*x), "d")
    meshes = (mesh.vertices, eyes, weights), (P(), every, every), P()
    cases = {
        "masks": (jax.vmap(masks), jax.vmap(masks), same, given, every, every),
        "hits": (jax.vmap(hits), jax.vmap(hits), same, given, every, every),
        # The derivative by vertices that all devices share is the sum over these.
        "shared mesh": (summed, shared_mesh, jax.value_and_grad, *meshes),
    }
    found = {}
    for name, (inside, alone, wrap, x, specs, results) in cases.items():
        shape = CASES[name]
        among = np.array(jax.devices()[: math.prod(shape)]).reshape(shape)
        devices = Devices(among, ("d", "other")[: len(shape)])
        spread = jax.shard_map(inside, mesh=devices, in_specs=specs, out_specs=results)
        pairs = zip(*(jax.tree.leaves(jax.jit(wrap(f))(*x)) for f in (spread, alone)), strict=True)
        found[name] = max(float(jnp.max(abs(a - b)) / jnp.max(abs(b))) for a, b in pairs)
    print(json.dumps(found))


if __name__ == "__main__":
    main()
