"""Draws where runs put samples and weights along one ray, to compare distortion losses.

The figure has the form of the paper's (arXiv 2505.05848, section 4.2): samples above, weights
below, a column for each run. The original loss moves all weights together, the corrected one only
those outside the objects, so that translucent objects keep their density.
"""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from experiments.figures.style import COLOURS, pyplot, style
from refref_jax.geometry import cameras
from refref_jax.geometry.cameras import Cameras
from refref_jax.geometry.rays import Rays
from refref_jax.optics import path_tracing
from refref_jax.optics.media import Scene
from refref_jax.optics.path_settings import PathSettings
from refref_jax.render import Model, volume_rendering
from refref_jax.render.model import ModelConfig, Params, path_detail
from refref_jax.render.volume_rendering import Jitter
from refref_jax.sampling import scene_bounds

# Room for the light paths of one ray, whatever the path settings allow per ray.
_PATHS, _SEGMENTS = 64, 2048

# Smaller weights are drawn as this one.
_LEAST_WEIGHT = 1e-4

_DPI, _QUALITY = 150, 88


class RaySamples(NamedTuple):
    """Samples of a model's field along the heaviest light path of a ray.

    Attributes:
      edges: edges of the intervals, arc length from the camera, world units.
      weights: weight of each interval in the colour of the path; they sum to 1.
      outside: whether each interval is outside the objects, by its middle.
      objects: arc lengths at which the path enters and leaves an object, for each passage.
    """

    edges: Float[np.ndarray, " edges"]
    weights: Float[np.ndarray, " samples"]
    outside: Bool[np.ndarray, " samples"]
    objects: Float[np.ndarray, "passages 2"]


class Panel(NamedTuple):
    """A column of the figure."""

    title: str
    samples: RaySamples


def pixel_ray(views: Cameras, view: int, column: int, row: int) -> Rays:
    """Returns the ray through the centre of a pixel."""
    return jax.tree.map(lambda x: x[row, column], cameras.image_rays(views, view))


def sample_ray(model: Model, ray: Rays) -> RaySamples:
    """Samples the heaviest light path of one ray as rendering does, without noise.

    Args:
      model: trained model that samples a field inside its objects too.
      ray: one camera ray, with a unit direction.

    Raises:
      ValueError: if the model takes no samples inside objects or has a backdrop, or the path enters
        no object.
    """
    if model.config.interior != "field":
        raise ValueError(
            f"The model's interior is {model.config.interior}, so it has no samples inside the "
            "objects. Choose runs of methods with --interior=field, such as oracle."
        )
    if model.config.backdrop is not None:
        raise ValueError(
            "The model's far field is a backdrop, so that its samples do not cover whole paths. "
            "Choose runs with --far_field=field."
        )
    roomy = dataclasses.replace(
        model.settings,
        live_per_ray=float(_PATHS),
        segments_per_ray=float(_SEGMENTS),
        paths_per_ray=float(_PATHS),
    )
    one = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32)[None], ray)
    seen = _sample(model.params, model.scene, one, config=model.config, settings=roomy)
    edges, weights, outside, knots, segments = map(np.asarray, jax.device_get(seen))
    entered = np.flatnonzero(np.isfinite(knots) & ~segments)
    if not entered.size:
        raise ValueError(
            "The ray of this pixel enters no object. Choose a --pixel inside the object."
        )
    return RaySamples(edges, weights, outside, np.stack([knots[entered], knots[entered + 1]], -1))


@functools.partial(jax.jit, static_argnames=("config", "settings"))
def _sample(
    params: Params, scene: Scene, ray: Rays, *, config: ModelConfig, settings: PathSettings
) -> tuple[Array, ...]:
    """Returns edges, weights, outside, and knots and outside of the segments of a path."""
    detail = path_detail(config, settings)
    paths = path_tracing.trace(scene, ray, settings=settings, capacity=_PATHS, detail=detail).paths
    heaviest = jnp.argmax(jnp.mean(paths.throughput, axis=-1))
    path = jax.tree.map(lambda x: x[heaviest], paths)
    still = jnp.zeros(volume_rendering.levels(config), jnp.float32)
    one = jnp.ones((), jnp.float32)
    seen = volume_rendering.path_radiance(params, config, path, Jitter(still, still), one)
    line = volume_rendering.polyline(config, path)
    final = seen.histograms[-1]
    edges = scene_bounds.to_distance(volume_rendering.distance_warp(config, line), final.edges)
    return edges, final.weights, seen.outside, line.knots, line.outside


def write(path: Path, panels: Sequence[Panel]) -> None:
    """Draws samples and weights of each panel over the distance; objects are shaded."""
    figure, axes = pyplot.subplots(
        2,
        len(panels),
        figsize=(4.8 * len(panels), 5.0),
        layout="constrained",
        squeeze=False,
        sharex=True,
        sharey="row",
    )
    for (above, below), panel in zip(axes.T, panels, strict=True):
        above.set_title(panel.title, fontsize=11)
        _draw_samples(above, panel.samples)
        _draw_weights(below, panel.samples)
        for axis in (above, below):
            style(axis)
            for start, end in panel.samples.objects:
                axis.axvspan(start, end, color="#dcecf7", zorder=0)
        below.set_xlabel("distance along the light path, world units")
    axes[0, 0].set_ylabel("samples per world unit")
    axes[1, 0].set_ylabel("weight of a sample")
    figure.savefig(path, dpi=_DPI, facecolor="white", pil_kwargs={"quality": _QUALITY})
    pyplot.close(figure)


def _draw_samples(axis: pyplot.Axes, samples: RaySamples) -> None:
    """Draws the density of the samples, and a tick for each."""
    widths = np.maximum(np.diff(samples.edges), 1e-6)
    axis.stairs(1.0 / widths, samples.edges, color=COLOURS[0], fill=True, alpha=0.35)
    axis.plot(_middles(samples), np.zeros(len(widths)), "|", color="black", markersize=9)
    inside = int(np.sum(~samples.outside))
    _say(axis, f"inside: {inside} of {len(samples.outside)} samples")


def _draw_weights(axis: pyplot.Axes, samples: RaySamples) -> None:
    """Draws the weights on a logarithmic axis, since the background's is a hundred times larger."""
    middles, drawn = _middles(samples), np.maximum(samples.weights, _LEAST_WEIGHT)
    axis.set_yscale("log")
    axis.set_ylim(_LEAST_WEIGHT, 2.0)
    for chosen, colour in ((samples.outside, COLOURS[0]), (~samples.outside, COLOURS[1])):
        axis.vlines(middles[chosen], _LEAST_WEIGHT, drawn[chosen], color=colour, linewidth=1.5)
        axis.plot(middles[chosen], drawn[chosen], "o", color=colour, markersize=4)
    _say(axis, f"inside: {100.0 * samples.weights[~samples.outside].sum():.2g} % of the weight")


def _middles(samples: RaySamples) -> Float[np.ndarray, " samples"]:
    return 0.5 * (samples.edges[1:] + samples.edges[:-1])


def _say(axis: pyplot.Axes, text: str) -> None:
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85}
    axis.text(0.02, 0.95, text, transform=axis.transAxes, va="top", fontsize=10, bbox=box)
