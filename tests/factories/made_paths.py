"""Light paths made by hand or at random, without tracing anything."""

import jax
import jax.numpy as jnp
import numpy as np

from refref_jax.optics.light_paths import LightPaths, PathStatus, RayDifferential


def path(
    lengths,
    directions,
    media,
    *,
    origin=(0.0, 0.0, 0.0),
    segments=None,
    radius=1e-3,
    throughput=(1.0, 1.0, 1.0),
    ray=0,
    status=PathStatus.ESCAPED,
):
    """Returns one light path from the lengths of its bounded segments and its directions.

    Args:
      lengths: of all segments but the last, which never ends.
      directions: of all segments; they are normalised.
      media: of all segments.
      origin: the camera.
      segments: number of slots; those that are not used are filled as the tracer does.
      radius: of the pixel's cone at unit distance.
      throughput: share of the path in its ray.
      ray: index of its ray.
      status: how it ended.
    """
    directions = np.asarray(directions, np.float64)
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    tau = np.concatenate([[0.0], np.cumsum(lengths)])
    steps = np.asarray(lengths, np.float64)[:, None] * directions[:-1]
    points = np.asarray(origin, np.float64) + np.concatenate(
        [np.zeros((1, 3)), np.cumsum(steps, axis=0)]
    )
    bends = len(lengths)
    unused = (segments or bends + 1) - bends - 1
    return LightPaths(
        points=jnp.asarray(np.pad(points, [(0, unused), (0, 0)], "edge"), jnp.float32),
        directions=jnp.asarray(np.pad(directions, [(0, unused), (0, 0)], "edge"), jnp.float32),
        tau=jnp.asarray(np.pad(tau, (0, unused), constant_values=np.inf), jnp.float32),
        ends=jnp.asarray(np.pad(tau[1:], (0, unused + 1), constant_values=np.inf), jnp.float32),
        differentials=RayDifferential(*[jnp.zeros((bends + 1 + unused, 0, 3), jnp.float32)] * 2),
        media=jnp.asarray(np.pad(np.asarray(media), (0, unused)), jnp.int32),
        rays=jnp.int32(ray),
        throughput=jnp.asarray(throughput, jnp.float32),
        radii=jnp.float32(radius),
        num_bends=jnp.int32(bends),
        statuses=jnp.int32(status),
        hit_counts=jnp.zeros(0, jnp.float32),
        path_lengths=jnp.zeros(0, jnp.float32),
    )


def random_path(seed, *, bends, segments, media=None, radius=1e-3):
    """Returns a path with random lengths and turns, in and out of objects by turns."""
    rng = np.random.default_rng(seed)
    alternating = np.arange(bends + 1) % 2
    return path(
        rng.uniform(0.1, 3.0, size=bends),
        rng.normal(size=(bends + 1, 3)),
        alternating if media is None else media,
        origin=rng.normal(size=3),
        segments=segments,
        radius=radius,
    )


def stack(paths):
    """Returns one record of several paths with the same number of slots."""
    return jax.tree.map(lambda *x: jnp.stack(x), *paths)
