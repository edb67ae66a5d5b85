"""Integrates radiance along one light path: proposal levels, the radiance field, compositing.

Symbols, as in the paper (arXiv 2505.05848, section 4.1): interval `i` has density `sigma_i` and
length `delta_i`; `T_i = exp(-sum_{j<i} sigma_j delta_j)` is the light that reaches it and
`w_i = T_i (1 - exp(-sigma_i delta_i))` its weight in the colour.

All functions take one path; `pixels` maps them over a batch.

Source: Barron et al., Mip-NeRF 360 (2022), section 3, and Zip-NeRF (2023); paper (arXiv
2505.05848), section 4.2, for samples and directions on the bent path.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from refref_jax import numerics
from refref_jax.choices import LastSample
from refref_jax.fields import base, registry
from refref_jax.fields.base import Radiance, Seen, SubSpaces, Surface, SurfaceSums
from refref_jax.optics.light_paths import LightPaths
from refref_jax.render import learned_media
from refref_jax.render.model import ModelConfig, Params, field_of
from refref_jax.sampling import polylines, scene_bounds, stepfun
from refref_jax.sampling.polylines import Gaussians, Polyline, PolylinePoint

# Minimum dilation of a proposal, in units of the full path (Mip-NeRF 360, supplement).
_DILATION_BIAS = 0.0025

# Rotation between adjacent cone patterns (Zip-NeRF, supplement).
_PATTERN_TURN = jnp.pi / 6.0


class Composite(NamedTuple):
    """Colour and distance of a path.

    Attributes:
      rgb: linear colour.
      accumulation: sum of the weights, in `[0, 1]`.
      median: distance at which the cumulative weight is 0.5; `inf` if the accumulation is lower.
        This is the paper's distance: the nearest relevant surface, even if it is translucent.
      mean: weighted mean distance; `inf` if the accumulation is 0.
    """

    rgb: Float[Array, "3"]
    accumulation: Float[Array, ""]
    median: Float[Array, ""]
    mean: Float[Array, ""]


def alpha_weights(
    density: Float[Array, " samples"], lengths: Float[Array, " samples"]
) -> Float[Array, " samples"]:
    """Returns the weights `w_i`, which sum to at most 1.

    Value and gradient are finite for any density and length in `[0, inf)` whose product does not
    overflow, and also if one of them is infinite and the other is not 0. Edges that differ by a
    rounding error may be out of order: a length below 0 counts as 0, because an opaque sample would
    otherwise have a weight of minus infinity.

    Source: paper, volume rendering equation.
    """
    return depth_weights(density * jnp.where(lengths < 0.0, 0.0, lengths))


def depth_weights(depth: Float[Array, " samples"]) -> Float[Array, " samples"]:
    """Returns the weights of intervals with the optical depths `sigma_i delta_i`."""
    before = jnp.concatenate([jnp.zeros_like(depth[:1]), jnp.cumsum(depth[:-1])])
    return jnp.exp(-before) * -jnp.expm1(-depth)


def opaque_end(weights: Float[Array, " samples"]) -> Float[Array, " samples"]:
    """Adds the remaining transmittance to the last sample, as if it were opaque.

    The weights then sum to 1 for any density.
    """
    return weights.at[-1].set(jnp.maximum(1.0 - jnp.sum(weights[:-1]), 0.0))


def composite(
    weights: Float[Array, " samples"],
    rgb: Float[Array, "samples 3"],
    edges: Float[Array, " samples+1"],
    *,
    last_sample: LastSample = "middle",
) -> Composite:
    """Sums the samples of a path.

    Args:
      weights: weights `w_i`.
      rgb: linear colours.
      edges: distances of the edges of the intervals.
      last_sample: distance of the last interval: that of its `middle`, as for the others, or of its
        `end`, if it stands for a surface there.
    """
    accumulation = jnp.sum(weights)
    places = 0.5 * (edges[1:] + edges[:-1])
    half = jnp.full((1,), 0.5, weights.dtype)
    level = numerics.safe_divide(half, accumulation[None])
    median = stepfun.invert_cdf(level, edges, stepfun.integrate_weights(weights))[0]
    if last_sample == "end":
        places = places.at[-1].set(edges[-1])
        median = jnp.where(jnp.sum(weights[:-1]) < 0.5, edges[-1], median)
    mean = numerics.safe_divide(jnp.sum(weights * places), accumulation)
    return Composite(
        rgb=jnp.sum(weights[:, None] * rgb, axis=0),
        accumulation=accumulation,
        median=jnp.where(accumulation >= 0.5, median, jnp.inf),
        mean=jnp.where(accumulation > 0.0, mean, jnp.inf),
    )


class Jitter(NamedTuple):
    """Random offsets for stratified sampling of a path; all zero for rendering without noise.

    Attributes:
      offsets: offset of all samples of each sampling level, in `[-0.5, 0.5)` strata.
      rotations: rotation of each sampling level's cone patterns, radians.
    """

    offsets: Float[Array, "*paths levels"]
    rotations: Float[Array, "*paths levels"]


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
      surface: sums for the losses of a surface, if the field has one.
      bent: the bent ray, if the field has a deformation.
    """

    composite: Composite
    histograms: tuple[Histogram, ...]
    outside: Bool[Array, " samples"]
    surface: SurfaceSums | None = None
    bent: learned_media.BentRay | None = None


class Samples(NamedTuple):
    """The intervals of one sampling level, in all coordinates.

    Attributes:
      s: edges in the normalised coordinate.
      t: edges in the coordinate of the polyline, world units.
      gaussians: multisamples of each interval, in the unit cube.
      points: point of each interval, its middle or the end of the path, from whose direction the
        field is seen.
      bent: the bent ray, if a deformation has moved the samples.
    """

    s: Float[Array, " edges"]
    t: Float[Array, " edges"]
    gaussians: Gaussians
    points: PolylinePoint
    bent: learned_media.BentRay | None = None


def path_radiance(
    params: Params,
    config: ModelConfig,
    path: LightPaths,
    jitter: Jitter,
    anneal: Float[Array, ""],
    *,
    progress: Float[Array, ""] | None = None,
) -> PathRadiance:
    """Renders one light path.

    Args:
      params: parameters of the model.
      config: configuration of the model.
      path: one light path.
      jitter: jitter of the path.
      anneal: exponent on the proposals' weights, from 0 for uniform sampling to 1 for the
        proposals' distribution.
      progress: progress of the training, 0 to 1, on which the opacity of a surface and the details
        of a deformation depend; its end by default.
    """
    line, bent = polyline(config, path), None
    warp = distance_warp(config, line)
    done = jnp.ones_like(path.radii) if progress is None else progress
    if registry.knots(config.field):
        learned = field_of(params), config.field, config.domain
        line, bent = learned_media.bend(*learned, line, warp, done)
        warp = distance_warp(config, line)
    samples, seen, histograms = _sampled(params, config, line, warp, jitter, anneal, done)
    if isinstance(seen, Surface):
        weights, composited = _integrate_surface(params, config, seen, samples, done)
    else:
        weigh = functools.partial(_weigh, config, edges=samples.t)
        weights, composited = integrate(params, config, seen, samples.t, weigh=weigh)
    if samples.bent is not None:
        bent = samples.bent._replace(weights=jax.lax.stop_gradient(weights))
    return PathRadiance(
        composite=_in_arc_length(line, composited),
        histograms=(*histograms, Histogram(samples.s, weights)),
        outside=samples.points.outside,
        surface=base.sums(seen, weights) if isinstance(seen, Surface) else None,
        bent=bent,
    )


def foreground_radiance(
    params: Params,
    config: ModelConfig,
    path: LightPaths,
    jitter: Jitter,
    anneal: Float[Array, ""],
) -> PathRadiance:
    """Renders what is in front of a backdrop along one light path.

    The field is sampled inside objects, or in a ball around them, and where the path ends on an
    opaque surface. The accumulation is the share of light from in front of the backdrop; arguments
    as in `path_radiance`.
    """
    nothing = jnp.zeros_like(path.radii)
    front = Composite(jnp.zeros_like(path.throughput), nothing, nothing + jnp.inf, nothing)
    histograms: tuple[Histogram, ...] = ()
    outside = jnp.ones((0,), bool)
    if config.interior == "field" or config.field_parts:
        line = polyline(config, path)
        assert line.stop is not None
        far = jnp.maximum(line.stop, scene_bounds.SHORTEST * config.radius)
        warp = scene_bounds.DistanceWarp(0.0, far, config.radius)
        samples, seen, proposed = _sampled(params, config, line, warp, jitter, anneal)
        assert not isinstance(seen, Surface)  # `resolve` refuses a backdrop behind a surface
        sampled, points = line.stop > 0.0, samples.points
        if config.backdrop is not None and (ball := config.backdrop.field_ball):
            hull = scene_bounds.OccupancyGrid(params.field.hull, ball)
            sampled &= scene_bounds.is_occupied(hull, points.position) | ~points.outside

        def weigh(density: Array) -> Array:
            return _weigh(config, jnp.where(sampled, density, 0.0), samples.t)

        weights, inside = integrate(params, config, seen, samples.t, weigh=weigh)
        front, histograms = _in_arc_length(line, inside), (*proposed, Histogram(samples.s, weights))
        outside = samples.points.outside
    if path.stop is not None:
        stop = path.stop.tau
        rgb = _opaque_surface(params, config, polylines.whole_path(path))
        closed = in_front_of(front, rgb, stop)
        front = jax.tree.map(lambda x, y: jnp.where(jnp.isfinite(stop), x, y), closed, front)
    return PathRadiance(front, histograms, outside)


def integrate(
    params: Params,
    config: ModelConfig,
    seen: Radiance | SubSpaces,
    edges: Float[Array, " edges"],
    *,
    weigh: Callable[[Array], Array],
) -> tuple[Float[Array, " samples"], Composite]:
    """Returns the weights of the intervals, and colour and distances of the path.

    Sub-spaces are weighed and integrated each by itself, decoded, and blended by their shares, in
    colour and weights. As much light passes through one as its own weights are short of 1.

    Args:
      params: parameters of the model.
      config: configuration of the model.
      seen: result of the field for each interval.
      edges: distances of the edges of the intervals.
      weigh: function of the densities of all intervals that returns their weights.

    Source: Yin et al., Multi-Space Neural Radiance Fields (2023), section 3, for sub-spaces.
    """
    last_sample = _last_sample(config)
    if isinstance(seen, Radiance):
        weights = weigh(seen.density)
        return weights, composite(weights, seen.rgb, edges, last_sample=last_sample)
    each = jax.vmap(weigh, in_axes=-1, out_axes=-1)(seen.density)
    features = jnp.sum(each[..., None] * seen.features, axis=0)
    blend = registry.blend(field_of(params), config.field, features)
    weights = jnp.sum(each * blend.shares[None], axis=-1)
    rgb = jnp.sum((blend.shares * jnp.sum(each, axis=0))[:, None] * blend.rgb, axis=0)
    composited = composite(weights, jnp.zeros((*weights.shape, 3)), edges, last_sample=last_sample)
    return weights, composited._replace(rgb=rgb)


def _integrate_surface(
    params: Params,
    config: ModelConfig,
    seen: Surface,
    samples: Samples,
    progress: Float[Array, ""],
) -> tuple[Float[Array, " samples"], Composite]:
    """Returns the same as `integrate`, of a field with a surface, by the field's optical depths."""
    lengths = jnp.maximum(jnp.diff(samples.t), 0.0) / config.radius
    depth = jax.vmap(registry.depth, in_axes=(None, None, 0, 0, 0, None))(
        field_of(params), config.field, seen, samples.points.direction, lengths, progress
    )
    weights = opaque_end(depth_weights(depth))
    return weights, composite(weights, seen.rgb, samples.t, last_sample=_last_sample(config))


def in_front_of(front: Composite, rgb: Float[Array, "3"], distance: Float[Array, ""]) -> Composite:
    """Returns the colour and distance of a path that ends on an opaque surface.

    Args:
      front: light from in front of the surface.
      rgb: linear radiance of the surface.
      distance: distance of the surface.
    """
    rest = jnp.maximum(1.0 - front.accumulation, 0.0)
    near = jnp.where(jnp.isfinite(front.mean), front.mean, 0.0)
    return Composite(
        rgb=front.rgb + rest * rgb,
        accumulation=front.accumulation + rest,
        median=jnp.where(jnp.isfinite(front.median), front.median, distance),
        mean=front.accumulation * near + jnp.where(rest > 0.0, rest * distance, 0.0),
    )


def _opaque_surface(params: Params, config: ModelConfig, whole: Polyline) -> Float[Array, "3"]:
    """Returns the radiance of the opaque surface that a path ends on; any if it does not."""
    assert whole.stop is not None
    at = jnp.where(jnp.isfinite(whole.stop), whole.stop, 0.0)
    cone = polylines.multisamples(whole, at, at, jnp.zeros_like(at), count=config.multisamples)
    cell = scene_bounds.to_unit_cube(config.domain, cone)
    direction = polylines.point_at(whole, at).direction
    seen = registry.radiance(field_of(params), config.field, cell, direction)
    if not isinstance(seen, SubSpaces):
        return seen.rgb
    blend = registry.blend(field_of(params), config.field, seen.features)
    return jnp.sum(blend.shares[:, None] * blend.rgb, axis=0)


def _sampled(
    params: Params,
    config: ModelConfig,
    line: Polyline,
    warp: scene_bounds.DistanceWarp,
    jitter: Jitter,
    anneal: Float[Array, ""],
    progress: Float[Array, ""] | None = None,
) -> tuple[Samples, Seen, list[Histogram]]:
    """Returns the final samples, what the field returns there, and the proposals' histograms."""

    def drawn(level: int, count: int, learned: base.Params) -> Samples:
        noise = jax.tree.map(lambda x: x[level], jitter)
        straight = sample(config, line, warp, histograms, count, jitter=noise, anneal=anneal)
        if not registry.has_deformation(config.field) or registry.knots(config.field):
            return straight
        assert progress is not None  # `resolve` refuses a backdrop behind a deformation
        given = config.field, config.domain, straight.gaussians, straight.points, progress
        return Samples(straight.s, straight.t, *learned_media.move(learned, *given))

    field = field_of(params)
    histograms: list[Histogram] = []
    for level, proposal in enumerate(config.proposals):
        # Proposals see what the field sees, but do not train the deformation.
        samples = drawn(level, proposal.samples, jax.lax.stop_gradient(field))
        density = jax.vmap(registry.density, in_axes=(None, None, 0))(
            params.proposals[level], proposal.field, samples.gaussians
        )
        histograms.append(Histogram(samples.s, _weigh(config, density, samples.t)))

    samples = drawn(-1, config.samples, field)
    seen = jax.vmap(registry.radiance, in_axes=(None, None, 0, 0))(
        field, config.field, samples.gaussians, samples.points.direction
    )
    return samples, seen, histograms


def levels(config: ModelConfig) -> int:
    """Returns the number of sampling levels, including the final one."""
    return len(config.proposals) + 1


def distance_warp(config: ModelConfig, line: Polyline) -> scene_bounds.DistanceWarp:
    """Returns the distance warp of a path, which ends on an opaque surface or the scene bounds."""
    return scene_bounds.warp_along(config.domain, line, near=config.near, far=config.far)


def polyline(config: ModelConfig, path: LightPaths) -> Polyline:
    """Returns the polyline that a model samples: without the segments that it takes to be empty."""
    if config.backdrop is not None:
        if (ball := config.backdrop.field_ball) is not None:
            end = scene_bounds.background_distance(config.domain, polylines.whole_path(path))
            return polylines.path_in_ball(path, ball, end=end)
        return polylines.inside_path(
            path, parts=None if config.interior == "field" else config.field_parts
        )
    if config.interior == "field":
        return polylines.whole_path(path)
    return polylines.outside_path(path, also=config.field_parts)


def sample(
    config: ModelConfig,
    line: Polyline,
    warp: scene_bounds.DistanceWarp,
    histograms: Sequence[Histogram],
    count: int,
    *,
    jitter: Jitter,
    anneal: Float[Array, ""],
) -> Samples:
    """Samples one level's intervals from the histogram of the level before; uniformly at first.

    The last interval is opaque. With `last_sample="end"`, the field is evaluated at the end of the
    path, on a surface, so that its colour does not depend on the length of the interval.

    Args:
      config: configuration of the model.
      line: polyline of the path.
      warp: distance warp of the path.
      histograms: histograms of the levels before this one, coarse to fine.
      count: number of intervals.
      jitter: jitter of this level.
      anneal: exponent on the weights of the last histogram.
    """
    strata = (jnp.arange(count, dtype=jitter.offsets.dtype) + 0.5 + jitter.offsets) / count
    # No interval straddles an interface, if there are enough edges. Learned bends are none.
    interfaces = line.knots[:0] if registry.knots(config.field) else line.knots[1:]
    bends = scene_bounds.to_unit(warp, interfaces)
    s = stepfun.snap(_draw(config, histograms, strata, anneal), bends)
    t = scene_bounds.to_distance(warp, s)
    starts, ends = t[:-1], t[1:]
    if _last_sample(config) == "end":
        starts, ends = (x.at[-1].set(warp.far) for x in (starts, ends))
    points = jax.vmap(polylines.point_at, in_axes=(None, 0))(line, 0.5 * (starts + ends))
    turns = jitter.rotations + _PATTERN_TURN * (jnp.arange(count, dtype=t.dtype) % 2)

    def cone(start: Array, end: Array, turn: Array) -> Gaussians:
        world = polylines.multisamples(line, start, end, turn, count=config.multisamples)
        return scene_bounds.to_unit_cube(config.domain, world)

    return Samples(s, t, jax.vmap(cone)(starts, ends, turns), points)


def _last_sample(config: ModelConfig) -> LastSample:
    """Returns where the last interval is: at its end only if there is a surface."""
    surface = config.space != "unbounded" and config.backdrop is None
    return config.last_sample if surface else "middle"


def _draw(
    config: ModelConfig,
    histograms: Sequence[Histogram],
    strata: Float[Array, " samples"],
    anneal: Float[Array, ""],
) -> Float[Array, " edges"]:
    """Draws intervals in proportion to the weights of the last histogram, if there is one."""
    if not histograms:
        ends = jnp.array([0.0, 1.0], strata.dtype)
        even = stepfun.sample_intervals(strata, ends, jnp.ones_like(ends[:1]))
        # Jitter must not shorten the path: its end is opaque and would move with the noise.
        return even.at[jnp.array([0, -1])].set(ends)
    edges, weights = jax.lax.stop_gradient(histograms[-1])
    if config.dilation > 0.0:
        drawn = math.prod(histogram.weights.shape[-1] for histogram in histograms)
        edges, weights = stepfun.dilate(edges, weights, config.dilation / drawn + _DILATION_BIAS)
    # Bins of width 0 stay empty; the others tend to equal weight as the exponent tends to 0.
    trusted = jnp.where(jnp.diff(edges) > 0.0, weights**anneal, 0.0)
    intervals = stepfun.sample_intervals(strata, edges, trusted)
    if config.backdrop is None:
        return intervals
    # In front of a backdrop, no light may pass beside the intervals.
    return intervals.at[0].set(edges[0]).at[-1].set(edges[-1])


def _weigh(
    config: ModelConfig, density: Float[Array, " samples"], edges: Float[Array, " edges"]
) -> Float[Array, " samples"]:
    """Converts densities to weights; the last interval is opaque, unless there is a backdrop."""
    lengths = jnp.diff(edges) / config.radius
    weights = alpha_weights(density, lengths)
    return weights if config.backdrop is not None else opaque_end(weights)


def _in_arc_length(line: Polyline, composite: Composite) -> Composite:
    """Converts distances from the coordinate of the polyline to arc length."""
    arc = jax.vmap(lambda t: polylines.point_at(line, t).arc)
    median, mean = arc(jnp.stack([composite.median, composite.mean]))
    return composite._replace(median=median, mean=mean)
