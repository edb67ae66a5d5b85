"""A marked call must compile wherever a user puts it: XLA ends the process where it can not."""

import subprocess
import sys

import pytest

from tests.processes import code_generator

_PREAMBLE = """
import jax, jax.numpy as jnp, numpy as np
from refref_jax.geometry import bvh, bvh_build
from refref_jax.geometry.rays import Rays
generator = np.random.default_rng(0)
triangles = generator.normal(size=(50, 3, 3)).astype(np.float32)
tree = jax.tree.map(jnp.asarray, bvh_build.build(triangles)[0])
origins = jnp.asarray(generator.normal(size=(20, 3)) * 4, jnp.float32)
directions = -origins / jnp.linalg.norm(origins, axis=-1, keepdims=True)
limits, exclude_primitive = jnp.full(20, jnp.inf), jnp.full(20, -1, jnp.int32)
def cast(tree, origins, directions):
    rays = Rays(origins, directions, jnp.zeros(len(origins)))
    hits = bvh.closest_hits(tree, rays, limits=limits, exclude_primitive=exclude_primitive)
    return hits.distances
expected = np.asarray(cast(tree, origins, directions))
"""

_CONTEXTS = {
    "arguments": "jax.jit(cast)(tree, origins, directions)",
    "the tree is a constant": "jax.jit(lambda o, d: cast(tree, o, d))(origins, directions)",
    "the rays are constants": "jax.jit(lambda t: cast(t, origins, directions))(tree)",
    "everything is constant": "jax.jit(lambda: cast(tree, origins, directions))()",
    "scan": (
        "jax.jit(lambda o: jax.lax.scan(lambda c, _: (c, cast(tree, c, directions)), o, None, "
        "length=2)[1][1])(origins)"
    ),
    "while": (
        "jax.jit(lambda o: jax.lax.while_loop(lambda c: c[0] < 1, "
        "lambda c: (c[0] + 1, cast(tree, o, directions)), (0, jnp.zeros(20))))(origins)[1]"
    ),
    "cond": (
        "jax.jit(lambda o: jax.lax.cond(o[0, 0] > -9, lambda: cast(tree, o, directions), "
        "lambda: jnp.zeros(20)))(origins)"
    ),
    "vmap": "jax.jit(jax.vmap(lambda o: cast(tree, o, directions)))(origins[None])[0]",
    "map": (
        "jax.jit(lambda o: jax.lax.map(lambda x: cast(tree, x, directions), o))(origins[None])[0]"
    ),
    "gradient": (
        "jax.jit(jax.grad(lambda o: jnp.sum(o[:, 0] + cast(tree, o, directions))))(origins)[:, 0] "
        "- 1 + expected"
    ),
    "remat": "jax.jit(jax.checkpoint(lambda o: cast(tree, o, directions)))(origins)",
}


@pytest.mark.slow
def test_the_traversal_compiles_in_any_context():
    checks = [
        f"print({name!r}, flush=True)\n"
        f"np.testing.assert_allclose({expression}, expected, rtol=1e-6)"
        for name, expression in _CONTEXTS.items()
    ]
    result = subprocess.run(
        [sys.executable, "-c", "\n".join([_PREAMBLE, *checks])],
        env=code_generator.of_users(),
        capture_output=True,
        text=True,
        check=False,
    )
    reached = result.stdout.splitlines()
    assert result.returncode == 0, f"ended at {reached[-1:]}: {result.stderr[-2000:]}"
    assert reached == list(_CONTEXTS)
