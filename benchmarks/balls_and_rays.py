"""A body, rays to send into it and where they end, for benchmarks and tests."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from refref_jax.data.meshes import MeshPart
from refref_jax.geometry.rays import Rays
from refref_jax.optics import path_tracing


def ball(radius=1.0, *, index=1.5, subdivisions=4, centre=(0.0, 0.0, 0.0), name="ball_glass"):
    """Makes a part of a ball."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return MeshPart(name, mesh.vertices + np.asarray(centre), mesh.faces, index, "auto")


def rays(origins, directions):
    """Makes rays of origins and directions of any length, in double precision until the end."""
    origins = np.atleast_2d(np.asarray(origins, np.float64))
    directions = np.atleast_2d(np.asarray(directions, np.float64))
    origins, directions = np.broadcast_arrays(origins, directions)
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    return Rays(
        jnp.asarray(origins, jnp.float32),
        jnp.asarray(unit, jnp.float32),
        jnp.full(len(origins), 1e-3, jnp.float32),
    )


@functools.partial(jax.jit, static_argnames="settings")
def trace_ends(geometry, rays, *, settings):
    """Traces a batch of rays in one program."""
    return path_tracing.trace_ends(geometry, rays, settings=settings)
