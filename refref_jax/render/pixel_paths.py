"""Light paths of one pixel, as polylines for plots.

    model = render.load_model("runs/ball")
    ray = jax.tree.map(lambda x: x[64, 64], image_rays(cameras, 0))
    paths = trace_pixel(model, ray)
    print(describe(paths))                     # a table in Markdown
    for line, throughput in zip(paths.polylines, paths.throughput):
        axes.plot(*line.T, linewidth=5.0 * throughput.mean() ** 0.5)

The paths come from the tracer that renders images, with the same path settings. Paths share their
first segments: `pieces` returns each line segment of the tree once, with the combined throughput of
its paths.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from refref_jax.compilation import jit_quickly
from refref_jax.geometry.rays import Rays
from refref_jax.numerics import host_array
from refref_jax.optics import path_tracing
from refref_jax.optics.light_paths import LightPaths, PathStatus
from refref_jax.optics.media import Scene
from refref_jax.optics.path_settings import Detail, PathSettings, Tally
from refref_jax.render import Model, learned_media
from refref_jax.render.learned_media import LearnedTints
from refref_jax.sampling import scene_bounds
from refref_jax.sampling.scene_bounds import Domain

# Capacity for one pixel's paths: at a throughput threshold of 0.005, a flask of three media has
# about 40.
_MOST_PATHS = 512
_MOST_SEGMENTS = 8192

ENDINGS = {
    PathStatus.MISSED: "met nothing",
    PathStatus.ESCAPED: "left the objects",
    PathStatus.OUT_OF_BENDS: "ran out of bends",
    PathStatus.NOT_TRACED: "is not followed further",
    PathStatus.TOTALLY_REFLECTED: "met a total reflection",
    PathStatus.OPAQUE: "met an opaque surface",
}
"""Description of each path status, as a predicate of "the path"."""


class PixelPaths(NamedTuple):
    """The light paths of one ray, the heaviest first.

    Attributes:
      polylines: one polyline `[points, 3]` per path, world units: the camera, every bend, and the
        end of the last segment as drawn.
      throughput: share of the ray's linear RGB that each path carries.
      statuses: status of each path.
      num_bends: number of refractions and reflections of each path.
      dropped: dropped throughput of the ray, linear RGB.
    """

    polylines: tuple[Float[np.ndarray, "_ 3"], ...]
    throughput: Float[np.ndarray, "paths 3"]
    statuses: tuple[PathStatus, ...]
    num_bends: Int[np.ndarray, " paths"]
    dropped: Float[np.ndarray, "3"]


class Pieces(NamedTuple):
    """The tree of a pixel's light paths as line segments, each once.

    Attributes:
      ends: start and end of each segment, world units.
      shares: share of the pixel's light on each segment: throughput of its paths, mean over RGB.
    """

    ends: Float[np.ndarray, "pieces 2 3"]
    shares: Float[np.ndarray, " pieces"]


class _Traced(NamedTuple):
    """Paths, dropped throughput, and the distance at which each last segment leaves the bounds."""

    paths: LightPaths
    dropped: Float[Array, "1 3"]
    leave: Float[Array, " paths"]


def trace_pixel(
    scene: Model | Scene, ray: Rays, *, settings: PathSettings | None = None, reach: float = 4.0
) -> PixelPaths:
    """Traces one ray along all branches that the path settings follow.

    Args:
      scene: a model, or only its scene. The learned tints and absorption of a model attenuate the
        paths, and last segments are drawn up to its scene bounds.
      ray: one camera ray, with a unit direction.
      settings: path settings; those of the model by default.
      reach: length of last segments that have no scene bounds, world units.

    Returns:
      NumPy arrays.

    Raises:
      ValueError: if `scene` is not a model and `settings` is not given.
    """
    colours = domain = None
    if isinstance(scene, Model):
        colours, domain = scene.params.tints, scene.config.domain
        settings = settings or scene.settings
        scene = scene.scene
    if settings is None:
        raise ValueError("settings is None, but scene is not a model. Give path settings.")
    roomy = dataclasses.replace(
        settings,
        live_per_ray=float(_MOST_PATHS),
        segments_per_ray=float(_MOST_SEGMENTS),
        paths_per_ray=float(_MOST_PATHS),
    )
    ray = jax.tree.map(lambda x: host_array(np.asarray(x)[None]), ray)
    traced = _trace(scene, ray, colours, settings=roomy, domain=domain)
    return _polylines(jax.device_get(traced), reach)


def pieces(paths: PixelPaths) -> Pieces:
    """Returns each segment of the paths once, with the combined share of its paths."""
    shares: dict[bytes, float] = {}
    for line, throughput in zip(paths.polylines, paths.throughput, strict=True):
        for ends in np.stack([line[:-1], line[1:]], axis=1):
            key = np.ascontiguousarray(ends, np.float32).tobytes()
            shares[key] = shares.get(key, 0.0) + float(throughput.mean())
    ends = np.frombuffer(b"".join(shares), np.float32).reshape(-1, 2, 3)
    return Pieces(ends, np.fromiter(shares.values(), np.float64, len(shares)))


def describe(paths: PixelPaths, *, most: int = 12) -> str:
    """Returns a Markdown table of paths, with a summary of the paths that it omits.

    Args:
      paths: light paths of one pixel.
      most: maximum number of rows of the table.
    """
    count = len(paths.polylines)
    lines = [
        f"**{count} light path{'s' * (count != 1)}**",
        "",
        "| path | share | R, G, B | bends | ended |",
        "|---|---|---|---|---|",
    ]
    lines += [_row(paths, i) for i in range(min(most, count))]
    if count > most:
        rest = 100.0 * float(paths.throughput[most:].mean(-1).sum())
        lines += ["", f"and {count - most} more, {rest:.2g} % together."]
    dropped = 100.0 * float(paths.dropped.mean())
    if dropped > 0.0:
        lines += [
            "",
            f"{dropped:.2g} % of the throughput was dropped: a buffer was full, or truncated paths "
            "are black.",
        ]
    return "\n".join(lines)


def _row(paths: PixelPaths, i: int) -> str:
    throughput = paths.throughput[i]
    channels = ", ".join(f"{x:.3f}" for x in throughput)
    share, ending = f"{100.0 * throughput.mean():.2f} %", ENDINGS[paths.statuses[i]]
    return f"| {i + 1} | {share} | {channels} | {paths.num_bends[i]} | {ending} |"


def _polylines(traced: _Traced, reach: float) -> PixelPaths:
    paths = traced.paths
    real = np.flatnonzero(paths.statuses != PathStatus.EMPTY).tolist()
    throughput = paths.throughput.mean(axis=-1)
    order = sorted(real, key=lambda i: -throughput[i])
    lines = []
    for i in order:
        last = int(np.sum(np.isfinite(paths.tau[i]))) - 1
        length = traced.leave[i] if np.isfinite(traced.leave[i]) else reach
        end = paths.points[i, last] + np.float32(length) * paths.directions[i, last]
        lines.append(np.concatenate([paths.points[i, : last + 1], end[None]]))
    return PixelPaths(
        polylines=tuple(lines),
        throughput=np.asarray(paths.throughput)[order],
        statuses=tuple(PathStatus(int(paths.statuses[i])) for i in order),
        num_bends=np.asarray(paths.num_bends)[order],
        dropped=np.asarray(traced.dropped)[0],
    )


@functools.partial(jit_quickly, static_argnames=("settings", "domain"))
def _trace(
    scene: Scene,
    ray: Rays,
    colours: LearnedTints | None,
    *,
    settings: PathSettings,
    domain: Domain | None,
) -> _Traced:
    tally: Tally = "none" if colours is None else "parts"
    traced = path_tracing.trace(
        scene,
        ray,
        settings=settings,
        capacity=_MOST_PATHS,
        detail=Detail("all", settings.max_bends + 1, tally=tally),
    )
    paths = traced.paths
    if domain is None:
        return _Traced(paths, traced.dropped, jnp.full_like(paths.radii, jnp.inf))
    last = jnp.sum(jnp.isfinite(paths.tau), axis=-1, dtype=jnp.int32) - 1

    def leave(points: Array, directions: Array, i: Array) -> Array:
        return scene_bounds.exit_distance(domain, points[i], directions[i])

    ends = jax.vmap(leave)(paths.points, paths.directions, jnp.maximum(last, 0))
    return _Traced(
        learned_media.attenuate(colours, paths, radius=domain.radius), traced.dropped, ends
    )
