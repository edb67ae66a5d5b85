"""What training minimises: the losses of a batch, from what its light paths sum to.

In two halves: `total` sums over paths, of which a device may have a part, and `measure` takes the
sums over all of them.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from refref_jax import losses, numerics
from refref_jax.fields import hash_grid
from refref_jax.optics import light_paths
from refref_jax.optics.light_paths import LightPaths
from refref_jax.render import colour, dyes, pixels
from refref_jax.render.model import Params
from refref_jax.training.config import LossConfig


class StepReport(NamedTuple):
    """What a step measured before it moved the parameters.

    Attributes:
      loss: what is minimised.
      psnr: of the batch's sRGB colours, in dB.
      interlevel: unweighted interlevel loss.
      distortion: unweighted distortion loss.
      hash_decay: unweighted hash decay.
      lost: mean share of a ray's light that found no room among the batch's paths.
    """

    loss: Float[Array, ""]
    psnr: Float[Array, ""]
    interlevel: Float[Array, ""]
    distortion: Float[Array, ""]
    hash_decay: Float[Array, ""]
    lost: Float[Array, ""]


class Totals(NamedTuple):
    """What light paths sum to: the sums of parts of a batch's paths add up to the batch's.

    Attributes:
      linear: the rays' linear RGB.
      interlevel: interlevel losses.
      distortion: distortion losses.
      paths: number of paths that exist.
    """

    linear: Float[Array, "rays 3"]
    interlevel: Float[Array, ""]
    distortion: Float[Array, ""]
    paths: Float[Array, ""]


def total(light: pixels.Light, paths: LightPaths, config: LossConfig) -> Totals:
    """Sums what some paths of a batch are to the loss."""
    *proposals, final = light.paths.histograms
    exists = light_paths.exists(paths)
    missed = jnp.zeros(())
    for proposal, blur in zip(proposals, config.blurs, strict=True):
        per_path = jax.vmap(functools.partial(losses.interlevel, blur=blur))(final, proposal)
        missed += _sum_where(exists, per_path)
    counted = light.paths.outside
    if config.distortion_over == "everywhere":
        counted = jnp.ones_like(counted)
    spread = jax.vmap(losses.distortion)(final, counted)
    count = jnp.sum(exists, dtype=missed.dtype)
    return Totals(light.linear, missed, _sum_where(exists, spread), count)


def measure(
    params: Params,
    totals: Totals,
    target: Float[Array, "rays 3"],
    lost: Float[Array, "rays 3"],
    config: LossConfig,
) -> StepReport:
    """Returns the losses of a batch; those of paths are means over the paths that exist."""
    rgb = colour.linear_to_srgb(totals.linear)
    mse = losses.mean_squared_error(rgb, target)
    data = mse if config.data == "mse" else losses.charbonnier(rgb, target)
    # Without any path both are 0, with gradient 0.
    interlevel = numerics.safe_divide(totals.interlevel, totals.paths)
    distortion = numerics.safe_divide(totals.distortion, totals.paths)
    decay = losses.hash_decay(hash_grid.tables(params))
    loss = (
        data
        + config.interlevel * interlevel
        + config.distortion * distortion
        + config.hash_decay * decay
        + config.dye_decay * dyes.optical_density(params.dyes)
    )
    psnr = -10.0 * jnp.log10(mse)
    return StepReport(loss, psnr, interlevel, distortion, decay, jnp.mean(lost))


def _sum_where(mask: Bool[Array, " n"], values: Float[Array, " n"]) -> Float[Array, ""]:
    """Returns the sum of the values that count."""
    return jnp.sum(jnp.where(mask, values, 0.0))
