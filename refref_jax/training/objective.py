"""Losses, and the training objective that sums them.

Each loss takes one path or one batch of colours and returns a scalar. The objective is computed in
two halves: `total` sums over paths, of which a device may hold a part, and `measure` combines the
sums over all of them.

Rendered colours are compared without clipping: colours below black or above white have gradients
that move them back, and black pixels have the slope 12.92 of the transfer function (see
`render.pixels`). Only saturated pixels may be brighter than they look: a brighter colour has no
error there. Fields return colours in `[-0.001, brightest + 0.001]`, so that their sigmoid has a
non-zero slope at black and white.

Symbols: `s` is the normalised distance along a path, `w` its weights (see `sampling.stepfun`).
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from refref_jax import numerics
from refref_jax.choices import SATURATED
from refref_jax.fields import hash_grid
from refref_jax.fields.base import SurfaceSums
from refref_jax.optics import light_paths
from refref_jax.optics.light_paths import LightPaths
from refref_jax.render import learned_media, pixels
from refref_jax.render.learned_media import BentRay
from refref_jax.render.model import Params
from refref_jax.render.volume_rendering import Histogram
from refref_jax.sampling import stepfun
from refref_jax.training.config import LossConfig, require

_CHARBONNIER_PADDING = 0.001

# Share of the training in which the weight of the curvature grows; factor per training after it.
_CURVATURE_WARMUP, _CURVATURE_DECAY = 0.25, 1.38**-2.0

# Weight of a bend where no light comes from; share of a ray that two of its points must be apart,
# so that rounding makes no bends.
_LEAST_BEND, _LEAST_GAP = 1e-3, 1e-4

# Keeps the loss finite if a proposal is empty where the final histogram is not (Zip-NeRF).
_INTERLEVEL_PADDING = 1e-5


def mean_squared_error(
    rendered: Float[Array, "rays 3"], target: Float[Array, "rays 3"]
) -> Float[Array, ""]:
    """Returns the mean squared error over pixels and channels (paper, photometric loss)."""
    return jnp.mean(jnp.square(rendered - target))


def charbonnier(
    rendered: Float[Array, "rays 3"], target: Float[Array, "rays 3"]
) -> Float[Array, ""]:
    """Returns the mean of `sqrt(e^2 + 0.001^2)`, which is robust to outliers (Zip-NeRF)."""
    return jnp.mean(jnp.sqrt(jnp.square(rendered - target) + _CHARBONNIER_PADDING**2))


def interlevel(final: Histogram, proposal: Histogram, *, blur: float) -> Float[Array, ""]:
    """Penalises a proposal that is lower than the final histogram of a path.

    The final histogram is blurred by a box of half-width `blur` before the comparison, so that the
    loss is smooth when a surface moves past the proposal's edges. Only the proposal receives
    gradients.

    Source: Barron et al., Zip-NeRF (2023), section 3 (anti-aliased interlevel loss).
    """
    edges, weights = jax.lax.stop_gradient(final)
    below = stepfun.blurred_mass_below(proposal.edges, edges, weights, blur)
    target = jax.lax.stop_gradient(jnp.diff(below))
    shortfall = jnp.maximum(target - proposal.weights, 0.0)
    return jnp.sum(jnp.square(shortfall) / (proposal.weights + _INTERLEVEL_PADDING))


def distortion(final: Histogram, outside: Bool[Array, " samples"]) -> Float[Array, ""]:
    """Concentrates the weights of a path, over the samples outside the objects only.

    The loss is `sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 delta_i`, over intervals with middle
    `m` and width `delta` for which `outside` holds. Inside a translucent object, light may come
    from everywhere, and the original loss would empty it.

    Source: paper (arXiv 2505.05848), corrected distortion loss; Mip-NeRF 360 (2022), Eq 15.
    """
    weights = jnp.where(outside, final.weights, 0.0)
    middles = 0.5 * (final.edges[1:] + final.edges[:-1])
    apart = jnp.abs(middles[:, None] - middles[None, :])
    between = jnp.sum(weights * jnp.sum(weights[None, :] * apart, axis=-1))
    within = jnp.sum(jnp.square(weights) * jnp.diff(final.edges)) / 3.0
    return between + within


def hash_decay(tables: Sequence[Float[Array, "_ _"]]) -> Float[Array, ""]:
    """Returns the sum over levels of the mean squared entry.

    The mean per level gives more weight to the entries of coarse levels, which have few.

    Source: Barron et al., Zip-NeRF (2023), section 2 (normalised weight decay).
    """
    return sum((jnp.mean(jnp.square(table)) for table in tables), jnp.zeros(()))


class Deformation(NamedTuple):
    """Losses of a bent ray, or their sums over rays.

    Attributes:
      bends: sum of the changes of slope from point to point, each weighted by the light there and a
        constant. Their lengths are not squared: a few bends cost less than an arc.
      turns: mean of 1 minus the cosine between the turned direction and that of the moved points.
      size: mean squared offset of points, in scene radii, and of directions.
    """

    bends: Float[Array, ""]
    turns: Float[Array, ""]
    size: Float[Array, ""]


def deformation(bent: BentRay) -> Deformation:
    """Returns losses that make a bent ray piecewise linear, consistent, and nearly straight.

    Source: ours; "a regularization strategy that encourages piece-wise linear light paths" is all
    that the abstract of Deng et al., Ray Deformation Networks (2024), says.
    """
    gaps = jnp.diff(bent.places)
    apart = gaps > _LEAST_GAP * bent.places[-1]
    steps = jnp.diff(bent.offsets, axis=0) / jnp.where(apart, gaps, 1.0)[:, None]
    slopes = bent.straight[:-1] + jnp.where(apart[:, None], steps, 0.0)
    weights = bent.weights
    around = 0.25 * (weights[:-2] + 2.0 * weights[1:-1] + weights[2:]) + _LEAST_BEND
    kinks = numerics.length(jnp.diff(slopes, axis=0))
    bends = jnp.sum(jnp.where(apart[1:] & apart[:-1], around * kinks, 0.0))
    agreement = numerics.dot(bent.turned[:-1], numerics.normalize(slopes))
    turns = jnp.sum(jnp.where(apart, weights[:-1] * (1.0 - agreement), 0.0))
    both = jnp.concatenate([bent.offsets, bent.turned - bent.straight], axis=-1)
    return Deformation(bends, turns, jnp.mean(jnp.sum(jnp.square(both), axis=-1)))


class StepReport(NamedTuple):
    """Losses and metrics of a step, before its update of the parameters.

    Attributes:
      loss: training objective.
      psnr: PSNR of the batch's sRGB colours, in dB.
      interlevel: unweighted interlevel loss.
      distortion: unweighted distortion loss.
      hash_decay: unweighted hash decay.
      dropped: mean dropped throughput of the batch's rays.
      eikonal: unweighted eikonal loss, if the field has a surface.
      curvature: unweighted curvature loss.
      surface_share: share of the light that comes from inside the ball of the surface, or, if it
        bends light, of the paths that meet it.
      bends: unweighted loss of the bends of a deformation, if the field has one.
      turns: unweighted loss of its turns.
      offsets: unweighted loss of its size.
    """

    loss: Float[Array, ""]
    psnr: Float[Array, ""]
    interlevel: Float[Array, ""]
    distortion: Float[Array, ""]
    hash_decay: Float[Array, ""]
    dropped: Float[Array, ""]
    eikonal: Float[Array, ""] | None = None
    curvature: Float[Array, ""] | None = None
    surface_share: Float[Array, ""] | None = None
    bends: Float[Array, ""] | None = None
    turns: Float[Array, ""] | None = None
    offsets: Float[Array, ""] | None = None


class Totals(NamedTuple):
    """Sums over light paths; those of disjoint parts of a batch add up to those of the batch.

    Attributes:
      linear: linear RGB of the rays.
      interlevel: sum of interlevel losses.
      distortion: sum of distortion losses.
      paths: number of paths in the interlevel and distortion losses.
      surface: sums for the losses of a surface, if the field has one.
      deformation: sums of the losses of bent rays, if the field bends them.
    """

    linear: Float[Array, "rays 3"]
    interlevel: Float[Array, ""]
    distortion: Float[Array, ""]
    paths: Float[Array, ""]
    surface: SurfaceSums | None = None
    deformation: Deformation | None = None


def total(light: pixels.Light, paths: LightPaths, config: LossConfig) -> Totals:
    """Sums the contributions of paths of a batch to the losses.

    Paths that are reflected at the first surface are left out of the interlevel and distortion
    losses if `config.path_losses` is `transmitted`, but remain in the colours of their rays.
    """
    if not light.paths.histograms:  # the only samples are on opaque surfaces
        return Totals(light.linear, *jnp.zeros(3))
    *proposals, final = light.paths.histograms
    included = light_paths.exists(paths)
    if config.path_losses == "transmitted":
        included &= ~light_paths.reflected_first(paths)
    missed = jnp.zeros(())
    for proposal, blur in zip(proposals, require(config.blurs), strict=True):
        per_path = jax.vmap(functools.partial(interlevel, blur=blur))(final, proposal)
        missed += _sum_where(included, per_path)
    counted = light.paths.outside
    if config.distortion_over == "everywhere":
        counted = jnp.ones_like(counted)
    spread = jax.vmap(distortion)(final, counted)
    count = jnp.sum(included, dtype=missed.dtype)
    surface = jax.tree.map(lambda x: _sum_where(included, x), light.paths.surface)
    bent = light.paths.bent
    losses = None if bent is None else jax.vmap(deformation)(bent)
    losses = jax.tree.map(lambda x: _sum_where(included, x), losses)
    return Totals(light.linear, missed, _sum_where(included, spread), count, surface, losses)


def measure(
    params: Params,
    totals: Totals,
    target: Float[Array, "rays 3"],
    dropped: Float[Array, "rays 3"],
    config: LossConfig,
    *,
    progress: Float[Array, ""] | None = None,
    views: Int[Array, " rays"] | None = None,
) -> StepReport:
    """Returns the losses of a batch; losses of paths are averaged over the included paths.

    Args:
      params: parameters of the model.
      totals: sums over all paths.
      target: true sRGB colours of the rays.
      dropped: dropped throughput of the rays.
      config: weights of the losses.
      progress: progress of the training, 0 to 1, if the field has a surface.
      views: index of the image of each ray, if the gains of images are learned.
    """
    linear = totals.linear if views is None else totals.linear * gains(params)[views]
    rgb = _as_seen(pixels.linear_to_srgb(linear), target)
    mse = mean_squared_error(rgb, target)
    data = mse if config.data == "mse" else charbonnier(rgb, target)
    # Without paths, both are 0 with gradient 0.
    interlevel = numerics.safe_divide(totals.interlevel, totals.paths)
    distortion = numerics.safe_divide(totals.distortion, totals.paths)
    decay = hash_decay(hash_grid.tables(params))
    loss = (
        data
        + config.interlevel * interlevel
        + config.distortion * distortion
        + require(config.hash_decay) * decay
        + config.tint_decay * learned_media.optical_density(params.tints)
    )
    psnr = -10.0 * jnp.log10(mse)
    report = StepReport(loss, psnr, interlevel, distortion, decay, jnp.mean(dropped))
    if totals.deformation is not None:
        bent = [numerics.safe_divide(each, totals.paths) for each in totals.deformation]
        weights = require(config.deformation_weights)
        loss += sum(weight * each for weight, each in zip(weights, bent, strict=True))
        bends, turns, offsets = bent
        return report._replace(loss=loss, bends=bends, turns=turns, offsets=offsets)
    if totals.surface is None:
        return report
    assert progress is not None
    sums = totals.surface
    eikonal = numerics.safe_divide(sums.eikonal, sums.samples)
    curvature = numerics.safe_divide(sums.curvature, sums.samples)
    weight = require(config.curvature) * curvature_schedule(progress)
    loss += require(config.eikonal) * eikonal + weight * curvature
    share = numerics.safe_divide(sums.share, totals.paths)
    return report._replace(loss=loss, eikonal=eikonal, curvature=curvature, surface_share=share)


def _as_seen(rgb: Float[Array, "rays 3"], target: Float[Array, "rays 3"]) -> Float[Array, "rays 3"]:
    """Returns sRGB colours as a camera that saturates records them: the target at most, there."""
    return jnp.where((target >= SATURATED) & (rgb > target), target, rgb)


def gains(params: Params) -> Float[Array, "views 3"]:
    """Returns the learned gains of the training images; their geometric mean is 1.

    Without this constraint, brighter gains and a darker field would be the same.

    Raises:
      ValueError: if they are not learned.
    """
    if params.gains is None:
        raise ValueError("These parameters have no gains. Train with exposure=per_image.")
    return jnp.exp(params.gains - jnp.mean(params.gains, axis=0, keepdims=True))


def curvature_schedule(progress: Float[Array, ""]) -> Float[Array, ""]:
    """Returns the factor on the weight of the curvature loss: a linear warm-up, then a decay.

    Source: sdfstudio, `neus-facto`, in shares of its 20,000 steps: 5000 of warm-up, after which
    the factor falls as the cells of a grid that is refined by 1.38 every 10,000 steps.
    """
    after = jnp.maximum(progress - _CURVATURE_WARMUP, 0.0)
    return jnp.minimum(progress / _CURVATURE_WARMUP, _CURVATURE_DECAY**after)


def _sum_where(mask: Bool[Array, " n"], values: Float[Array, " n"]) -> Float[Array, ""]:
    """Returns the sum of the values where the mask is true."""
    return jnp.sum(jnp.where(mask, values, 0.0))
