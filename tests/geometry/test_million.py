"""A mesh of more than a million triangles, in a process of its own that reports its memory."""

import subprocess
import sys

import pytest

_PROGRAM = """
import resource
import jax, jax.numpy as jnp, numpy as np, trimesh
from refref_jax.geometry import bvh, bvh_build
from refref_jax.geometry.rays import Rays
triangles = trimesh.creation.icosphere(subdivisions=8).triangles.astype(np.float32)
assert len(triangles) > 1e6
tree = jax.tree.map(jnp.asarray, bvh_build.build(triangles)[0])
count = 100_000
generator = np.random.default_rng(0)
origins = jnp.asarray(generator.uniform(-0.5, 0.5, (count, 3)), jnp.float32)
directions = generator.normal(size=(count, 3))
directions = jnp.asarray(directions / np.linalg.norm(directions, axis=1)[:, None], jnp.float32)
hits = jax.jit(bvh.closest_hits)(
    tree, Rays(origins, directions, jnp.zeros(count)),
    limits=jnp.full(count, jnp.inf), exclude_primitive=jnp.full(count, bvh.NO_PRIMITIVE, jnp.int32),
)
reached = origins + hits.distances[:, None] * directions
radii = np.linalg.norm(np.asarray(reached, np.float64), axis=1)
print(np.abs(radii - 1.0).max(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


@pytest.mark.slow
def test_a_million_triangles_are_built_and_traced_in_two_gibibytes():
    run = subprocess.run(
        [sys.executable, "-c", _PROGRAM], capture_output=True, text=True, check=True
    )
    error, kibibytes = run.stdout.split()
    # The faces lie within 1e-5 of the sphere; a ray that slipped through would end far away.
    assert float(error) <= 2e-5
    assert int(kibibytes) <= 2 * 2**20
