"""Renders one ray, from pixel to colour: the whole method on one page, written to be read.

`render_image` and training compute the same for many rays at once, compiled; a test compares them
(`tests/render/test_one_ray.py`).

Symbols, as in the paper (arXiv 2505.05848, section 4): a light path is `r(t) = p_i + (t - tau_i)
d_i`; interval `i` of its samples has density `sigma_i`, colour `c_i` and length `delta_i`, and
`T_i = exp(-sum_{j<i} sigma_j delta_j)` is its transmittance. `s` in `[0, 1]` is the normalised
coordinate in which samples are drawn (Zip-NeRF, section 4); `x` are multisamples of intervals.
"""

import functools
from collections.abc import Iterator

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax.fields import registry
from refref_jax.fields.base import Radiance
from refref_jax.geometry.rays import Rays
from refref_jax.optics import path_tracing
from refref_jax.optics.light_paths import LightPaths, PathStatus
from refref_jax.render import learned_media, volume_rendering
from refref_jax.render.model import Model, path_detail
from refref_jax.render.pixels import linear_to_srgb
from refref_jax.render.volume_rendering import Histogram, Jitter


def render_ray(model: Model, ray: Rays) -> Float[Array, "3"]:
    """Returns the sRGB colour of one camera ray, not clipped; runs uncompiled, in seconds.

    Args:
      model: fields, scene and path settings.
      ray: one camera ray, without leading axes.

    Raises:
      ValueError: if the model has a backdrop instead of fields, or its field has sub-spaces or
        a surface.
    """
    config, params = model.config, model.params
    if config.backdrop is not None:
        raise ValueError("This page shows fields, but the model has a backdrop. Use render_rays.")
    if registry.has_sub_spaces(config.field) or registry.has_surface(config.field):
        raise ValueError(
            f"This page shows fields with density and one colour at a point, but the field is of "
            f"kind {config.field.kind}. Use render_rays."
        )
    density = jax.vmap(registry.density, in_axes=(None, None, 0))
    radiance = jax.vmap(registry.radiance, in_axes=(None, None, 0, 0))
    middle = functools.partial(
        volume_rendering.sample, jitter=Jitter(jnp.zeros(()), jnp.zeros(())), anneal=jnp.ones(())
    )
    colour = jnp.zeros(3)

    # Trace: Snell's law, total internal reflection and Fresnel's equations at every surface.
    for path in _light_paths(model, ray):
        r = volume_rendering.polyline(config, path)
        warp = volume_rendering.distance_warp(config, r)

        # Sample: each proposal level draws from the histogram of the level before.
        draw = functools.partial(middle, config, r, warp)
        histograms: list[Histogram] = []
        for proposal, learned in zip(config.proposals, params.proposals, strict=True):
            s, t, x, _ = draw(histograms, proposal.samples)
            sigma = density(learned, proposal.field, x)
            histograms.append(Histogram(s, _weights(sigma, jnp.diff(t) / config.radius)))

        # Query: density and colour of the multisamples, seen along the local direction.
        s, t, x, points = draw(histograms, config.samples)
        seen = radiance(params.field, config.field, x, points.direction)
        assert isinstance(seen, Radiance)
        sigma, c = seen

        # Composite: the volume rendering integral along the path.
        w = _weights(sigma, jnp.diff(t) / config.radius)
        # Combine: the weight of a path is the product of its Fresnel factors and tints.
        colour += path.throughput * jnp.sum(w[:, None] * c, axis=0)

    # Encode: radiance adds up linearly, images are sRGB.
    return linear_to_srgb(colour)


def _light_paths(model: Model, ray: Rays) -> Iterator[LightPaths]:
    """Yields the light paths of one ray, the heaviest first."""
    batch = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32)[None], ray)
    detail = path_detail(model.config, model.settings)
    paths = path_tracing.trace(model.scene, batch, settings=model.settings, detail=detail).paths
    paths = learned_media.attenuate(model.params.tints, paths, radius=model.config.radius)
    for i, status in enumerate(paths.statuses):
        if status != PathStatus.EMPTY:
            yield jax.tree.map(lambda x, i=i: x[i], paths)


def _weights(
    sigma: Float[Array, " samples"], delta: Float[Array, " samples"]
) -> Float[Array, " samples"]:
    """Returns `w_i = T_i (1 - exp(-sigma_i delta_i))`; the last interval is opaque."""
    depth = jnp.concatenate([jnp.zeros(1), jnp.cumsum(sigma * delta)])
    w = jnp.exp(-depth[:-1]) * (1.0 - jnp.exp(-sigma * delta))
    return w.at[-1].set(1.0 - jnp.sum(w[:-1]))
