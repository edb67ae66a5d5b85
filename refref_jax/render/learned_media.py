"""Learned tints of interfaces and learned absorption of media.

The throughput of a path is attenuated at every hit of a part's surface, reflected or refracted, and
along its length in the part's medium: `exp(-sum_p (n_p density_p + length_p absorption_p))`. The
tint of a surface is `exp(-density)`. A softplus, which has a gradient everywhere, keeps densities
and absorptions positive.

Source: the Beer-Lambert law; the tint is the colour of Blender Cycles' glass BSDF.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Array, Float

from refref_jax import numerics
from refref_jax.optics.light_paths import LightPaths

# Almost white, with a useful slope of the softplus.
_INITIAL = -3.0

# Least density of a learned part.
_LEAST = 1e-6


class LearnedTints(NamedTuple):
    """Learned tints and absorption, before the softplus, linear RGB.

    Attributes:
      density: optical density of each part's surface, per hit.
      absorption: absorption of each part's medium, per scene radius.
    """

    density: Float[Array, "parts 3"]
    absorption: Float[Array, "parts 3"]


def init(parts: int) -> LearnedTints:
    """Returns initial values, for nearly clear parts."""
    # Two separate arrays, since training donates both buffers.
    initial = (jnp.full((parts, 3), _INITIAL, jnp.float32) for _ in LearnedTints._fields)
    return LearnedTints(*initial)


def tints(learned: LearnedTints) -> Float[Array, "parts 3"]:
    """Returns the factor on linear RGB at every hit of each part's surface."""
    return jnp.exp(-jax.nn.softplus(learned.density))


def absorptions(learned: LearnedTints, radius: float) -> Float[Array, "parts 3"]:
    """Returns the absorption of every part's medium, linear RGB, per world unit.

    Args:
      learned: learned tints and absorption.
      radius: radius of the scene, world units.
    """
    return jax.nn.softplus(learned.absorption) / radius


def optical_density(learned: LearnedTints | None) -> Float[Array, ""]:
    """Returns the mean density of all surfaces and of all media over a scene radius; 0 for none.

    With a small weight in the loss, it resolves an ambiguity of the images: a tint at both ends of
    a segment looks similar to absorption along it, and needs far less density.
    """
    if learned is None:
        return jnp.zeros(())
    return jnp.mean(jax.nn.softplus(learned.density)) + jnp.mean(
        jax.nn.softplus(learned.absorption)
    )


def attenuate(learned: LearnedTints | None, paths: LightPaths, *, radius: float) -> LightPaths:
    """Attenuates the throughput of paths by the tints and absorption along them.

    Args:
      learned: learned tints and absorption; `None` leaves the paths unchanged.
      paths: any number of paths, with hit counts and path lengths per part.
      radius: radius of the scene, world units.
    """
    if learned is None:
        return paths
    dimmed = jnp.exp(numerics.product(-crossings(paths, radius=radius), densities(learned)))
    return paths._replace(throughput=paths.throughput * dimmed)


def crossings(paths: LightPaths, *, radius: float) -> Float[Array, "paths unknowns"]:
    """Returns how often paths hit each part, then their lengths in each medium over the radius."""
    return jnp.concatenate([paths.hit_counts, paths.path_lengths / radius], axis=-1)


def densities(learned: LearnedTints) -> Float[Array, "unknowns 3"]:
    """Returns the optical density of each surface, then that of each medium over the radius."""
    return jax.nn.softplus(jnp.concatenate(learned))


def of_densities(found: Float[Array, "unknowns 3"]) -> LearnedTints:
    """Inverts `densities`; they are at least 1e-6, where the softplus still has a gradient."""
    raw = jnp.maximum(found, _LEAST)
    return LearnedTints(*jnp.split(raw + jnp.log(-jnp.expm1(-raw)), 2))


def non_negative(
    normal: Float[np.ndarray, "unknowns unknowns"], right: Float[np.ndarray, " unknowns"]
) -> Float[np.ndarray, " unknowns"]:
    """Returns the non-negative densities `x` that minimise `x @ normal @ x / 2 - right @ x`."""
    ridge = 1e-9 * (np.trace(normal) or 1.0)
    root = np.linalg.cholesky(normal + ridge * np.eye(len(normal)))
    return scipy.optimize.nnls(root.T, np.linalg.solve(root, right))[0]
