"""The light paths of one pixel, as polylines to draw.

    model = render.load_model("runs/ball")
    ray = jax.tree.map(lambda x: x[64, 64], image_rays(cameras, 0))
    paths = trace_pixel(model, ray)
    print(describe(paths))                     # a table in Markdown
    for line, weight in zip(paths.polylines, paths.weights):
        axes.plot(*line.T, linewidth=5.0 * weight.mean() ** 0.5)

It is the tracer that renders images, under the same budget. Paths share their beginnings, and a
piece that several have in common carries what they carry together: `pieces` gives the tree as line
segments, each once.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from refref_jax.geometry.rays import Rays
from refref_jax.optics import path_tracing
from refref_jax.optics.budgets import Budget
from refref_jax.optics.details import Detail
from refref_jax.optics.light_paths import LightPaths, PathStatus
from refref_jax.optics.scene import Scene
from refref_jax.render import Model, dyes, transport
from refref_jax.render.dyes import Dyes
from refref_jax.sampling import domains
from refref_jax.sampling.domains import Domain

# Room for one pixel's paths: with the cut of 0.005 a flask of three media has about 40.
_MOST_PATHS = 512
_MOST_SEGMENTS = 8192

ENDINGS = {
    PathStatus.MISSED: "met nothing",
    PathStatus.ESCAPED: "left the objects",
    PathStatus.OUT_OF_BENDS: "ran out of bends",
    PathStatus.NOT_TRACED: "is not followed further",
    PathStatus.TOTALLY_REFLECTED: "met a total reflection",
}
"""What each status of a path means, in words that follow it."""


class PixelPaths(NamedTuple):
    """The light paths of one ray, the heaviest first.

    Attributes:
      polylines: one a path, `[points, 3]`, world units: the camera, every bend, and where the last
        segment is drawn to.
      weights: share of each path in the ray's linear RGB.
      statuses: how each ended.
      bends: refractions and reflections of each.
      lost: share of the ray's linear RGB that found no room.
    """

    polylines: tuple[Float[np.ndarray, "_ 3"], ...]
    weights: Float[np.ndarray, "paths 3"]
    statuses: tuple[PathStatus, ...]
    bends: Int[np.ndarray, " paths"]
    lost: Float[np.ndarray, "3"]


class Pieces(NamedTuple):
    """The tree of a pixel's light paths as line segments, each once.

    Attributes:
      ends: start and end of each, world units.
      shares: of the pixel's light that it carries, mean over RGB, as it arrives at the paths' ends.
    """

    ends: Float[np.ndarray, "pieces 2 3"]
    shares: Float[np.ndarray, " pieces"]


class _Traced(NamedTuple):
    """Paths, what was lost, and how far each last segment goes before it leaves the domain."""

    paths: LightPaths
    lost: Float[Array, "1 3"]
    leave: Float[Array, " paths"]


def trace_pixel(
    scene: Model | Scene, ray: Rays, *, budget: Budget | None = None, reach: float = 4.0
) -> PixelPaths:
    """Follows one ray along all branches that a budget follows.

    Args:
      scene: a model, or geometry alone. A model's learned colours dim its paths, and where
        there are walls last segments are drawn to them.
      ray: one camera ray, with a unit direction.
      budget: which light to follow; that of the model if not given.
      reach: length of the last segment where no walls end it, world units.

    Returns:
      NumPy arrays.

    Raises:
      ValueError: if there is geometry alone and no budget.
    """
    if isinstance(scene, Model):
        geometry, colours, domain = (
            scene.geometry,
            scene.params.dyes,
            transport.domain(scene.config),
        )
        budget = budget or scene.budget
    else:
        geometry, colours, domain = scene, None, None
    if budget is None:
        raise ValueError("Geometry alone does not say which light to follow. Give a budget.")
    roomy = dataclasses.replace(
        budget,
        live_per_ray=float(_MOST_PATHS),
        segments_per_ray=float(_MOST_SEGMENTS),
        paths_per_ray=float(_MOST_PATHS),
    )
    ray = Rays(*(np.asarray(x, np.float32)[None] for x in ray))
    traced = _trace(geometry, ray, colours, budget=roomy, domain=domain)
    return _polylines(jax.device_get(traced), reach)


def pieces(paths: PixelPaths) -> Pieces:
    """Returns each segment of the paths once, with the light of all paths that run along it."""
    shares: dict[bytes, float] = {}
    for line, weight in zip(paths.polylines, paths.weights, strict=True):
        for ends in np.stack([line[:-1], line[1:]], axis=1):
            key = np.ascontiguousarray(ends, np.float32).tobytes()
            shares[key] = shares.get(key, 0.0) + float(weight.mean())
    ends = np.frombuffer(b"".join(shares), np.float32).reshape(-1, 2, 3)
    return Pieces(ends, np.fromiter(shares.values(), np.float64, len(shares)))


def describe(paths: PixelPaths, *, most: int = 12) -> str:
    """Returns a table of paths in Markdown, and what it leaves out.

    Args:
      paths: of one pixel.
      most: rows of the table.
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
        rest = 100.0 * float(paths.weights[most:].mean(-1).sum())
        lines += ["", f"and {count - most} more, {rest:.2g} % together."]
    lost = 100.0 * float(paths.lost.mean())
    if lost > 0.0:
        lines += ["", f"{lost:.2g} % of the light found no room, or was left dark."]
    return "\n".join(lines)


def _row(paths: PixelPaths, i: int) -> str:
    weight = paths.weights[i]
    channels = ", ".join(f"{x:.3f}" for x in weight)
    share, ending = f"{100.0 * weight.mean():.2f} %", ENDINGS[paths.statuses[i]]
    return f"| {i + 1} | {share} | {channels} | {paths.bends[i]} | {ending} |"


def _polylines(traced: _Traced, reach: float) -> PixelPaths:
    paths = traced.paths
    real: Sequence[int] = np.flatnonzero(paths.statuses != PathStatus.EMPTY)
    weight = paths.weights.mean(axis=-1)
    order = sorted(real, key=lambda i: -weight[i])
    lines = []
    for i in order:
        last = int(np.sum(np.isfinite(paths.tau[i]))) - 1
        length = traced.leave[i] if np.isfinite(traced.leave[i]) else reach
        end = paths.points[i, last] + np.float32(length) * paths.directions[i, last]
        lines.append(np.concatenate([paths.points[i, : last + 1], end[None]]))
    return PixelPaths(
        polylines=tuple(lines),
        weights=paths.weights[order],
        statuses=tuple(PathStatus(int(paths.statuses[i])) for i in order),
        bends=paths.bends[order],
        lost=traced.lost[0],
    )


@functools.partial(jax.jit, static_argnames=("budget", "domain"))
def _trace(
    geometry: Scene, ray: Rays, colours: Dyes | None, *, budget: Budget, domain: Domain | None
) -> _Traced:
    tally = "none" if colours is None else "parts"
    traced = path_tracing.trace(
        geometry,
        ray,
        budget=budget,
        capacity=_MOST_PATHS,
        detail=Detail("all", budget.bends + 1, tally=tally),
    )
    paths = traced.paths
    if domain is None:
        return _Traced(paths, traced.lost, jnp.full_like(paths.radii, jnp.inf))
    last = jnp.sum(jnp.isfinite(paths.tau), axis=-1, dtype=jnp.int32) - 1

    def leave(points: Array, directions: Array, i: Array) -> Array:
        return domains.exit_distance(domain, points[i], directions[i])

    ends = jax.vmap(leave)(paths.points, paths.directions, jnp.maximum(last, 0))
    return _Traced(dyes.dye(colours, paths, radius=domain.radius), traced.lost, ends)
