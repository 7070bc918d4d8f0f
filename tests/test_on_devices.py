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
CASES = {"views": (2, 2), "shared mesh": (4,)}


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

    def view(e, vertices, centers=None):
        """A camera, and a scene of a mesh and maybe spheres."""
        camera = pj.Camera(e, jnp.zeros(3), jnp.array([0.0, 1, 0]), 0.7, 1.0, 12, 10, lens)
        spheres = None if centers is None else pj.Spheres(centers, radii)
        return camera, pj.Scene(mesh=pj.Mesh(vertices, np.asarray(mesh.faces)), spheres=spheres)

    def totals(x, weight):
        """Weighted sums of the mask and of the hits' distances."""
        camera, scene = view(*x)
        far = pj.trace(scene, camera).t
        shown = pj.silhouette(camera, scene), jnp.where(jnp.isfinite(far), far, 0)
        return jnp.stack([jnp.sum(weight * image) for image in shown])

    def all_of_it(x, weight):
        """Images, the totals, their derivative forward along all of `x`, and in reverse."""
        camera, scene = view(*x)
        images = pj.occluded(scene, camera) * 1.0, pj.normals(camera, scene)
        value, along = jax.linearize(lambda x: totals(x, weight), x)
        forward = along(jax.tree.map(jnp.ones_like, x))
        reverse = jax.linear_transpose(along, x)(jnp.ones_like(value))
        return images, 1 / pj.depth(camera, scene), value, forward, reverse

    def views(devices):
        batch, given = jax.vmap(all_of_it), ((eyes, shapes, centers), weights)
        return spread(batch, devices, P("d"), P("d"))(*given), batch(*given)

    def shared_mesh(devices):
        """The derivative by vertices that all devices share is the sum over these."""
        total = jax.vmap(lambda vertices, e, weight: totals((e, vertices), weight)[0], (None, 0, 0))
        loss = lambda *x: jnp.sum(total(*x))
        given, specs = (mesh.vertices, eyes, weights), (P(), P("d"), P("d"))
        summed = spread(lambda *x: jax.lax.psum(loss(*x), "d"), devices, specs, P())
        inside = spread(jax.grad(loss), devices, specs, P())(*given)
        value, slope = jax.value_and_grad(loss)(*given)
        return (*jax.value_and_grad(summed)(*given), inside), (value, slope, slope)

    def error(got, wanted):
        leaves = zip(jax.tree.leaves(got), jax.tree.leaves(wanted), strict=True)
        return max(float(jnp.max(jnp.abs(a - b)) / jnp.max(jnp.abs(b))) for a, b in leaves)

    found = {}
    for (name, shape), run in zip(CASES.items(), (views, shared_mesh), strict=True):
        among = np.array(jax.devices()[: int(np.prod(shape))]).reshape(shape)
        devices = Devices(among, ("d", "other")[: len(shape)])
        found[name] = error(*jax.jit(lambda run=run, devices=devices: run(devices))())
    print(json.dumps(found))


if __name__ == "__main__":
    main()
