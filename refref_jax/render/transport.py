"""Radiance of one light path: proposal levels, then the radiance field.

All functions take one path; `pixels` maps them over a batch.

Source: Barron et al., Mip-NeRF 360 (2022), section 3, and Zip-NeRF (2023); paper (arXiv
2505.05848), section 4.2, for samples and directions on the bent path.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from refref_jax.fields import registry
from refref_jax.optics.light_paths import LightPaths
from refref_jax.render import compositing
from refref_jax.render.config import ModelConfig
from refref_jax.render.model import Params
from refref_jax.sampling import cones, domains, polylines, stepfun, warps
from refref_jax.sampling.cones import Gaussians
from refref_jax.sampling.polylines import Polyline

# Minimum dilation of a proposal, in units of the full path (Mip-NeRF 360, supplement).
_DILATION_BIAS = 0.0025

# Minimum length of a path, in units of the scene radius: `s` keeps four digits in float32.
_SHORTEST = 1e-3

# Rotation between adjacent cone patterns (Zip-NeRF, supplement).
_PATTERN_TURN = jnp.pi / 6.0


class Jitter(NamedTuple):
    """Random offsets for stratified sampling of a path; all zero for rendering without noise.

    Attributes:
      offsets: offset of all samples of each sampling level, in `[-0.5, 0.5)` strata.
      rotations: rotation of each sampling level's cone patterns, radians.
    """

    offsets: Float[Array, "*paths rounds"]
    rotations: Float[Array, "*paths rounds"]


class Histogram(NamedTuple):
    """Weights of one sampling level along a path.

    Attributes:
      edges: edges of the intervals, in the normalised coordinate `s` in `[0, 1]`.
      weights: weight of each interval in the colour of the path.
    """

    edges: Float[Array, "*paths edges"]
    weights: Float[Array, "*paths samples"]


class PathRadiance(NamedTuple):
    """Radiance of one path.

    Attributes:
      composite: colour and distances; distances are arc length from the camera.
      histograms: histogram of each proposal level, then of the radiance field.
      outside: whether each of the final intervals is outside the objects (by its middle).
    """

    composite: compositing.Composite
    histograms: tuple[Histogram, ...]
    outside: Bool[Array, " samples"]


class _Round(NamedTuple):
    """The intervals of one sampling level, in all coordinates.

    Attributes:
      s: edges in the normalised coordinate.
      t: edges in the coordinate of the polyline, world units.
      gaussians: multisamples of each interval, in the unit cube.
    """

    s: Float[Array, " edges"]
    t: Float[Array, " edges"]
    gaussians: Gaussians


def path_radiance(
    params: Params,
    config: ModelConfig,
    path: LightPaths,
    jitter: Jitter,
    anneal: Float[Array, ""],
) -> PathRadiance:
    """Renders one light path.

    Args:
      params: parameters of the model.
      config: configuration of the model.
      path: one light path.
      jitter: jitter of the path.
      anneal: exponent on the proposals' weights, from 0 for uniform sampling to 1 for the
        proposals' distribution.
    """
    line = _polyline(config, path)
    warp = distance_warp(config, line)
    # No interval straddles an interface, if there are enough edges.
    bends = warps.to_unit(warp, line.knots[1:])
    histograms = []
    for level, proposal in enumerate(config.proposals):
        s = _resample(config, histograms, jitter.offsets[level], anneal, proposal.samples)
        s = stepfun.snap(s, bends)
        samples = _place(config, line, warp, s, jitter.rotations[level])
        see = jax.vmap(registry.density, in_axes=(None, None, 0))
        density = see(params.proposals[level], proposal.field, samples.gaussians)
        histograms.append(Histogram(s, _weigh(config, density, samples.t)))

    s = _resample(config, histograms, jitter.offsets[-1], anneal, config.samples)
    s = stepfun.snap(s, bends)
    samples = _place(config, line, warp, s, jitter.rotations[-1])
    middles = 0.5 * (samples.t[1:] + samples.t[:-1])
    points = jax.vmap(polylines.point_at, in_axes=(None, 0))(line, middles)
    see = jax.vmap(registry.radiance, in_axes=(None, None, 0, 0))
    seen = see(params.field, config.field, samples.gaussians, points.direction)
    weights = _weigh(config, seen.density, samples.t)
    composited = compositing.composite(weights, seen.rgb, samples.t)
    return PathRadiance(
        composite=_in_arc_length(line, composited),
        histograms=(*histograms, Histogram(s, weights)),
        outside=points.outside,
    )


def rounds(config: ModelConfig) -> int:
    """Returns the number of sampling levels, including the final one."""
    return len(config.proposals) + 1


def distance_warp(config: ModelConfig, line: Polyline) -> warps.DistanceWarp:
    """Returns the distance warp of a path, which ends at the scene bounds, if any.

    The far distance is measured from the last bend, so that paths with many bends still reach the
    background.
    """
    last = jnp.sum(jnp.isfinite(line.knots)) - 1
    leave = domains.exit_distance(domain(config), line.points[last], line.directions[last])
    far = line.knots[last] + jnp.where(jnp.isfinite(leave), leave, config.far)
    # Keep a minimum length for samples even if the camera is on the scene bounds.
    far = jnp.maximum(far, config.near + _SHORTEST * config.radius)
    return warps.DistanceWarp(config.near, far, config.radius)


def domain(config: ModelConfig) -> domains.Domain:
    """Returns the scene bounds of a model."""
    return domains.Domain(config.radius, config.space)


def _polyline(config: ModelConfig, path: LightPaths) -> Polyline:
    if config.interior == "field":
        return polylines.whole_path(path)
    return polylines.outside_path(path)


def _resample(
    config: ModelConfig,
    histograms: Sequence[Histogram],
    offset: Float[Array, ""],
    anneal: Float[Array, ""],
    samples: int,
) -> Float[Array, " edges"]:
    """Samples the next level's intervals from the last histogram; uniformly at first."""
    strata = (jnp.arange(samples, dtype=offset.dtype) + 0.5 + offset) / samples
    if not histograms:
        ends = jnp.array([0.0, 1.0], offset.dtype)
        even = stepfun.sample_edges(strata, ends, jnp.ones_like(ends[:1]))
        # Jitter must not shorten the path: its end is opaque and would move with the noise.
        return even.at[jnp.array([0, -1])].set(ends)
    edges, weights = jax.lax.stop_gradient(histograms[-1])
    if config.dilation > 0.0:
        drawn = math.prod(histogram.weights.shape[-1] for histogram in histograms)
        edges, weights = stepfun.dilate(edges, weights, config.dilation / drawn + _DILATION_BIAS)
    # Bins of width 0 stay empty; the others tend to equal weight as the exponent tends to 0.
    trusted = jnp.where(jnp.diff(edges) > 0.0, weights**anneal, 0.0)
    return stepfun.sample_edges(strata, edges, trusted)


def _place(
    config: ModelConfig,
    line: Polyline,
    warp: warps.DistanceWarp,
    s: Float[Array, " edges"],
    rotation: Float[Array, ""],
) -> _Round:
    """Maps intervals to the path, and their multisamples to the field's unit cube."""
    t = warps.to_distance(warp, s)
    turns = rotation + _PATTERN_TURN * (jnp.arange(t.shape[0] - 1, dtype=t.dtype) % 2)

    def cone(start: Array, end: Array, turn: Array) -> Gaussians:
        world = cones.multisamples(line, start, end, turn, count=config.multisamples)
        return domains.to_unit_cube(domain(config), world)

    return _Round(s, t, jax.vmap(cone)(t[:-1], t[1:], turns))


def _weigh(
    config: ModelConfig, density: Float[Array, " samples"], edges: Float[Array, " edges"]
) -> Float[Array, " samples"]:
    """Converts densities to weights; the last interval is opaque, like the background."""
    lengths = jnp.diff(edges) / config.radius
    return compositing.opaque_end(compositing.alpha_weights(density, lengths))


def _in_arc_length(line: Polyline, composite: compositing.Composite) -> compositing.Composite:
    """Converts distances from the coordinate of the polyline to arc length."""
    arc = jax.vmap(lambda t: polylines.point_at(line, t).arc)
    median, mean = arc(jnp.stack([composite.median, composite.mean]))
    return composite._replace(median=median, mean=mean)
