"""Counts the rounds and iterations that light paths take on a GPU, by tracing them on this CPU.

On a GPU all rays of a block walk through the tree in lock-step: a round casts a block, and takes as
many iterations of the traversal as its slowest ray. With the launches of a round and of an
iteration (`counters.launches`), they give the launches of a pool of batches.
"""

from typing import NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from benchmarks.ahead_of_time.programs import SCENE
from refref_jax.geometry import bvh, traversal
from refref_jax.optics import path_tracing, wavefront
from refref_jax.optics.media import Scene
from refref_jax.optics.path_step import RayState
from refref_jax.training.config import TrainConfig, require
from refref_jax.training.fit import prepare, read_pixels


class Walks(NamedTuple):
    """Rounds of a pool, and the iterations of the traversal in all of them."""

    rounds: int
    iterations: int


def count(preset: str, *, block: int) -> Walks:
    """Traces the first pool of batches of the bundled scene, and returns what a GPU would do.

    Args:
      preset: name of a preset.
      block: number of rays cast in a round.
    """
    asked = TrainConfig().override(scene=str(SCENE), preset=preset, paths="tree")
    (config, model, *_), scene = prepare(asked, report=lambda line: None)
    numbers = np.arange(require(config.schedule.pretraced_batches))
    rays = jax.tree.map(jnp.asarray, read_pixels(config, SCENE).draw(numbers).rays)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rays)
    slowest: list[int] = []
    cast = wavefront._cast

    def counted(scene: Scene, state: RayState, alive: Bool[Array, " block"]) -> bvh.Hits:
        most = jnp.max(jax.vmap(_iterations, in_axes=(None, 0, 0))(scene, state, alive))
        jax.debug.callback(lambda found: slowest.append(int(found)), most)
        return cast(scene, state, alive)

    with mock.patch.object(wavefront, "_cast", counted):
        trace = jax.jit(
            lambda scene, rays: path_tracing.trace_ends(
                scene, rays, settings=model.settings, block=block
            )
        )
        jax.block_until_ready(trace(jax.tree.map(jnp.asarray, scene), flat))
        jax.effects_barrier()
    return Walks(len(slowest), sum(slowest))


def _iterations(scene: Scene, state: RayState, alive: Bool[Array, ""]) -> Array:
    """Returns the number of iterations in which a ray walks through the tree."""
    tree = scene.surfaces.bvh
    nodes = tree.nodes.reshape(-1, bvh.WORDS)
    boxes = bvh.boxes(nodes)
    limit = jnp.where(alive, jnp.inf, -1.0).astype(jnp.float32)
    ray, end, start = traversal.begin_ray(
        nodes, state.origin, state.direction, limit, state.exclude_primitive
    )

    def advance(carry: tuple[traversal.RayWalk, Array]) -> tuple[traversal.RayWalk, Array]:
        walk, taken = carry
        return traversal.advance_ray(boxes, tree.facets, ray, end, walk), taken + 1

    start = (start, jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(lambda carry: carry[0].node < end, advance, start)[1]
