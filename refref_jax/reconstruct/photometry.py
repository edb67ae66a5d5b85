"""How well a geometry explains the pixels that see it, with gradients.

A field that is already there, usually of the background, is looked at along the main branches of
light through the geometry, and what is seen is compared with the images. The comparison has
gradients with respect to all of the geometry: indices of refraction, corners and normals.

This is one of the modules that call `jax.jit`.

Source: paper (arXiv 2505.05848), photometric loss; the estimation by it is ours.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax.geometry.rays import Rays
from refref_jax.optics.budgets import Budget
from refref_jax.optics.main_branches import follow_main_branches
from refref_jax.optics.scene import Scene, with_index
from refref_jax.render import pixels
from refref_jax.render.config import ModelConfig
from refref_jax.render.model import Params

TRACING = Budget(bends=12, reflections="all", cut=0.02)
"""The tree's cut, and half of its bends: the main branches of few rays are longer."""

REFLECTIONS = 3
"""At how many of the first surfaces a reflection is followed."""

# An error below this, in sRGB, counts by its square, one above it as it is: a hundredth is what a
# trained field is wrong by anyway. Where geometry is wrong, a few rays see something else
# altogether.
_NOISE = 0.01


class Evidence(NamedTuple):
    """Pixels, and the field that should explain them.

    Attributes:
      params: of the field.
      rays: of the pixels.
      rgb: their true sRGB, in `[0, 1]`.
    """

    params: Params
    rays: Rays
    rgb: Float[Array, "rays 3"]


class Slope(NamedTuple):
    """The mean error at an index, and its derivative."""

    error: Float[Array, ""]
    slope: Float[Array, ""]


def errors(
    evidence: Evidence, geometry: Scene, *, config: ModelConfig, budget: Budget = TRACING
) -> Float[Array, " rays"]:
    """Returns each pixel's error in sRGB: Charbonnier's, of the length of the difference.

    Args:
      evidence: the pixels.
      geometry: what bends their light.
      config: of the field's model; its footprint must be `cone`.
      budget: which light is followed, see `main_branches`.

    Raises:
      ValueError: if the model's footprint is another.
    """
    if config.footprint != "cone":
        raise ValueError(
            f"The model's footprint is {config.footprint!r}, but single paths carry no derivatives "
            "across the pixel. Train the background with 'cone'."
        )
    count = evidence.rays.radii.shape[0]
    follow = functools.partial(
        follow_main_branches, geometry, budget=budget, reflections=REFLECTIONS
    )
    branches = jax.vmap(follow)(evidence.rays)
    paths = jax.tree.map(lambda x: x.reshape(count * (1 + REFLECTIONS), *x.shape[2:]), branches)
    paths = paths._replace(rays=jnp.repeat(jnp.arange(count), 1 + REFLECTIONS))
    jitter = pixels.no_jitter(config, paths.radii.shape[0])
    full_trust = jnp.ones_like(evidence.rgb, shape=())
    seen = pixels.render_pixels(
        evidence.params, config, paths, jitter, rays=count, anneal=full_trust
    )
    difference = jnp.mean(jnp.square(seen.rgb - evidence.rgb), axis=-1)
    return jnp.sqrt(difference + _NOISE**2) - _NOISE


@functools.partial(jax.jit, static_argnames=("part", "config"))
def errors_at_index(
    index: Float[Array, ""],
    evidence: Evidence,
    geometry: Scene,
    *,
    part: int,
    config: ModelConfig,
) -> Float[Array, " rays"]:
    """Returns `errors` with an index of refraction for one part."""
    return errors(evidence, with_index(geometry, index, part=part), config=config)


@functools.partial(jax.jit, static_argnames=("part", "config"))
def slope_at_index(
    index: Float[Array, ""],
    evidence: Evidence,
    geometry: Scene,
    *,
    part: int,
    config: ModelConfig,
) -> Slope:
    """Returns the mean of `errors_at_index` and its derivative, by one pass forwards."""

    def mean(at: Float[Array, ""]) -> Float[Array, ""]:
        return jnp.mean(errors_at_index(at, evidence, geometry, part=part, config=config))

    return Slope(*jax.jvp(mean, (index,), (jnp.ones_like(index),)))
