"""Colours of pixels from the light paths of a batch.

Paths are rendered side by side; a pixel's colour is the weighted sum over its paths, in linear
space (paper, arXiv 2505.05848, Fresnel blend), and is encoded as sRGB at the very end.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from refref_jax.optics.light_paths import LightPaths
from refref_jax.render import colour, dyes, transport
from refref_jax.render.config import ModelConfig
from refref_jax.render.model import Params
from refref_jax.render.transport import Jitter, PathRadiance


class Light(NamedTuple):
    """The light of a batch of rays, or what some of its paths add to it.

    Attributes:
      linear: linear RGB.
      paths: what each path sees, for the losses.
    """

    linear: Float[Array, "rays 3"]
    paths: PathRadiance


class Pixels(NamedTuple):
    """A batch of rendered rays.

    Attributes:
      rgb: sRGB colours, not clipped.
      paths: what each path sees, for the losses.
    """

    rgb: Float[Array, "rays 3"]
    paths: PathRadiance


def render_pixels(
    params: Params,
    config: ModelConfig,
    paths: LightPaths,
    jitter: Jitter,
    *,
    rays: int,
    anneal: Float[Array, ""],
) -> Pixels:
    """Renders a batch of rays from all of their paths.

    Args:
      params: the model's parameters.
      config: the model.
      paths: the light paths, in any order.
      jitter: of each path.
      rays: number of rays in the batch.
      anneal: see `transport.path_radiance`.
    """
    light = gather_light(params, config, paths, jitter, rays=rays, anneal=anneal)
    return Pixels(colour.linear_to_srgb(light.linear), light.paths)


def gather_light(
    params: Params,
    config: ModelConfig,
    paths: LightPaths,
    jitter: Jitter,
    *,
    rays: int,
    anneal: Float[Array, ""],
) -> Light:
    """Sums the light of paths over the rays that they belong to; arguments as `render_pixels`."""
    seen = render_paths(params, config, paths, jitter, anneal=anneal)
    paths = dyes.dye(params.dyes, paths, radius=config.radius)
    linear = jax.ops.segment_sum(paths.weights * seen.composite.rgb, paths.rays, num_segments=rays)
    return Light(linear, seen)


def render_paths(
    params: Params,
    config: ModelConfig,
    paths: LightPaths,
    jitter: Jitter,
    *,
    anneal: Float[Array, ""],
) -> PathRadiance:
    """Renders each path of a batch on its own."""
    render = jax.vmap(transport.path_radiance, in_axes=(None, None, 0, 0, None))
    return render(params, config, paths, jitter, anneal)


def random_jitter(key: Array, config: ModelConfig, slots: Int[Array, " paths"]) -> Jitter:
    """Draws one offset and one rotation for every round of every path.

    Each slot of a batch's list has noise of its own, which knows nothing of the others: the list
    can be shared out among devices, or be longer, and the noise stays the same.

    Args:
      key: of the batch.
      config: the model.
      slots: place of each path in the batch's list.
    """
    shape = (2, transport.rounds(config))
    draw = jax.vmap(lambda slot: jax.random.uniform(jax.random.fold_in(key, slot), shape))
    drawn = draw(slots)
    return Jitter(drawn[:, 0] - 0.5, 2.0 * jnp.pi * drawn[:, 1])


def no_jitter(config: ModelConfig, paths: int) -> Jitter:
    """Returns the jitter of a rendering without noise, in single precision as the fields are."""
    zeros = jnp.zeros((paths, transport.rounds(config)), jnp.float32)
    return Jitter(zeros, zeros)
