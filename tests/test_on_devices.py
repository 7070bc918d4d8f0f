"""Within `jax.shard_map`, as it is by default, each device gets what one device alone works out.

All cases run in one process of four devices: this file itself.
"""

import os
from pathlib import Path

import pytest
from processes import printed


@pytest.mark.long
def test_sharded_results_are_those_of_one_device():
    root = Path(__file__).parents[1]
    programs = str(root / ".pytest_cache" / "programs")
    kept = {"JAX_COMPILATION_CACHE_DIR": programs, "JAX_ENABLE_X64": "1", "PYTHONPATH": str(root)}
    printed(__file__, env={**os.environ, **kept})


def main():
    """Compare views on two by two devices, and a mesh that four share, with one device."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    from jax.sharding import Mesh as Devices, PartitionSpec as P
    from slopes import both_ways

    import pinhole_jax as pj

    jax.config.update("jax_num_cpu_devices", 4)
    random = np.random.default_rng(0)
    eyes = jnp.asarray(random.normal(size=(4, 3)) * 0.3 + [0, 0, 4])
    weights = jnp.asarray(random.uniform(size=(4, 2, 10, 12)))
    lens = pj.Lens([6.2, 4.9], 1.1, pj.Fisheye(0.05, -0.01))
    mesh, radii = pj.shapes.bumpy(0), jnp.array([0.5, 0.4])
    shapes = mesh.vertices + jnp.asarray(random.normal(size=(4, *mesh.vertices.shape)) * 0.02)
    centers = jnp.asarray(random.normal(size=(4, 2, 3)) * 0.5)

    def view(e, vertices, centers=None):
        """A camera, and a scene of a mesh and maybe spheres."""
        camera = pj.Camera(e, jnp.zeros(3), jnp.array([0.0, 1, 0]), 0.7, 1.0, 12, 10, lens)
        spheres = None if centers is None else pj.Spheres(centers, radii)
        return camera, pj.Scene(pj.Mesh(vertices, np.asarray(mesh.faces)), spheres)

    def seen(x):
        """The mask and the hits' distances."""
        camera, scene = view(*x)
        far = pj.trace(scene, camera).t
        return jnp.stack([pj.silhouette(camera, scene), jnp.where(jnp.isfinite(far), far, 0)])

    def all_of_it(x, weight):
        """Images, their change along all of `x`, the gradient of their weighted sum."""
        camera, scene = view(*x)
        images = pj.occluded(scene, camera) * 1.0, pj.normals(camera, scene)
        along = jax.tree.map(jnp.ones_like, x)
        return images, 1 / pj.depth(camera, scene), both_ways(seen, x, along, weight)

    square = Devices(np.reshape(jax.devices(), (2, 2)), ("d", "other"))
    row = Devices(np.array(jax.devices()), ("d",))
    spread = lambda f, devices, given, results: jax.shard_map(
        f, mesh=devices, in_specs=given, out_specs=results
    )

    def views():
        batch, given = jax.vmap(all_of_it), ((eyes, shapes, centers), weights)
        return spread(batch, square, P("d"), P("d"))(*given), batch(*given)

    def shared_mesh():
        """The derivative by vertices that all devices share is the sum over these."""
        image = jax.vmap(lambda vertices, e: seen((e, vertices)), (None, 0))
        loss = lambda vertices, e, weight: jnp.sum(weight * image(vertices, e))
        given, specs = (mesh.vertices, eyes, weights), (P(), P("d"), P("d"))
        summed = spread(lambda *x: jax.lax.psum(loss(*x), "d"), row, specs, P())
        inside = spread(jax.grad(loss), row, specs, P())(*given)
        value, slope = jax.value_and_grad(loss)(*given)
        return (*jax.value_and_grad(summed)(*given), inside), (value, slope, slope)

    for case in (views, shared_mesh):
        for got, wanted in zip(*map(jax.tree.leaves, jax.jit(case)()), strict=True):
            np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-9 * jnp.max(jnp.abs(wanted)))


if __name__ == "__main__":
    main()
