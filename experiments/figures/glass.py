"""Draws the figures of docs/glass.md, of scenes with a known background."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import matplotlib
import numpy as np
from jaxtyping import Array, Float
from matplotlib.colors import LogNorm

from experiments.figures import cross_sections
from experiments.figures.comparison import ERROR_GAIN, amplified_error
from experiments.figures.cross_sections import Line, Outline, Panel, lines_within
from experiments.figures.style import pyplot
from experiments.runs import known_scene
from experiments.runs.known_scene import KnownScene
from refref_jax.data import meshes
from refref_jax.geometry import cameras
from refref_jax.geometry.rays import Rays
from refref_jax.optics import light_paths, path_tracing
from refref_jax.optics.media import Scene
from refref_jax.optics.path_settings import PATH_PRESETS, PathSettings
from refref_jax.render.images import find_first_surface
from refref_jax.render.pixel_paths import PixelPaths, trace_pixel
from refref_jax.sampling import scene_bounds
from refref_jax.sampling.scene_bounds import Domain

_NAMES = {"straight": "straight rays", "paper": "the paper's paths", "tree": "the path tree"}

_CAMERA = 4.0
"""Distance of the drawn camera from the origin, as in the data set; world units."""

_RAYS_OF_A_FAN = 15

# Target of the single ray of a tree, as a share of the object's width: near the rim, where
# reflections carry some of the light.
_AIM = 0.9

# Throughput threshold of the finer tree: the end of the colour scale.
_FINER = 1e-3

# Beyond the background: last segments are cut at the edge of the figure.
_FAR = 100.0

_DPI = 150
_QUALITY = 88

_GLASS = {"facecolor": "#dcecf7", "edgecolor": "#5b8db8", "linewidth": 1.4, "zorder": 1}
_SHARES = "plasma_r"
_LEAST_SHARE = 1e-3
_HUES = "turbo"
_DISTANCES = "viridis"


class Shown(NamedTuple):
    """One image of a row.

    Attributes:
      title: title above the image.
      rgb: sRGB in `[0, 1]`.
      psnr: masked PSNR relative to the first image of the row, dB; `None` for that one.
    """

    title: str
    rgb: Float[np.ndarray, "h w 3"]
    psnr: float | None = None


def draw_views(scene: KnownScene, path: Path, *, side: int) -> None:
    """Draws the true image, and renderings with three kinds of light paths.

    Args:
      scene: scene with one view.
      path: output file.
      side: camera rays along each edge of a pixel.
    """
    shown = [_truth(scene)]
    for name, title in _NAMES.items():
        rgb = known_scene.render_view(scene, 0, settings=PATH_PRESETS[name], side=side).rgb
        shown.append(Shown(title, rgb, known_scene.measure(scene, 0, rgb)["psnr_masked"]))
    write_views(path, shown)


def draw_fan(scene: KnownScene, folder: Path, half: float, path: Path) -> None:
    """Draws a fan of camera rays, straight and bent.

    Args:
      scene: refractive scene.
      folder: folder of the scene; its meshes are cut.
      half: half the edge of the background cube, world units.
      path: output file.
    """
    outlines = cross_sections.outlines_of(meshes.read_meshes(folder))
    reach = 1.2 * cross_sections.width_of(outlines)
    rays = cross_sections.rays_towards(_CAMERA, list(np.linspace(-reach, reach, _RAYS_OF_A_FAN)))
    titles = {
        "straight": "the model of NeRF: straight rays",
        "paper_no_reflection": "actual light: neighbours separate, left and right swap",
    }
    panels = [
        Panel(title, _follow(scene, rays, PATH_PRESETS[name])) for name, title in titles.items()
    ]
    write_fan(path, panels, outlines, half)


def draw_tree(scene: KnownScene, folder: Path, path: Path) -> None:
    """Draws the light paths of one ray under three presets, and under a finer one.

    Args:
      scene: refractive scene.
      folder: folder of the scene; its meshes are cut.
      path: output file.
    """
    outlines = cross_sections.outlines_of(meshes.read_meshes(folder))
    rays = cross_sections.rays_towards(_CAMERA, [_AIM * cross_sections.width_of(outlines)])
    all_settings = {title: PATH_PRESETS[name] for name, title in _NAMES.items()}
    finer = dataclasses.replace(PATH_PRESETS["tree"], min_throughput=_FINER)
    all_settings[f"the tree, threshold {100.0 * _FINER:g} %"] = finer
    panels = [
        Panel(title, _follow(scene, rays, settings)) for title, settings in all_settings.items()
    ]
    write_tree(path, panels, outlines)


def _follow(scene: KnownScene, rays: list[Rays], settings: PathSettings) -> list[PixelPaths]:
    trace = functools.partial(trace_pixel, scene.objects, settings=settings, reach=_FAR)
    return [trace(ray) for ray in rays]


def draw_distances(scene: KnownScene, domain: Domain, path: Path) -> None:
    """Draws three distances of a pixel: glass, background behind it, and visible background.

    Args:
      scene: scene with one view.
      domain: background cube.
      path: output file.
    """
    rays = cameras.image_rays(scene.frames.cameras, 0)
    first = find_first_surface(scene.objects.surfaces, rays).distances
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rays)
    walls = _walls(scene.objects, flat, domain)
    straight, bent = (np.asarray(x).reshape(first.shape) for x in walls)
    write_distances(
        path,
        _truth(scene),
        [
            ("to the first surface", np.where(np.isfinite(first), first, straight)),
            ("to the wall, straight on", straight),
            ("to the wall, along the light", bent),
        ],
    )


@functools.partial(jax.jit, static_argnames="domain")
def _walls(
    scene: Scene, rays: Rays, domain: Domain
) -> tuple[Float[Array, " rays"], Float[Array, " rays"]]:
    """Returns the arc length of light to the background, straight and refracted."""
    leave = jax.vmap(functools.partial(scene_bounds.exit_distance, domain))
    # Without reflections every ray has one path.
    ends = path_tracing.trace_ends(scene, rays, settings=PATH_PRESETS["paper_no_reflection"]).ends
    reached = jax.numpy.where(
        light_paths.exists(ends), ends.tau + leave(ends.origins, ends.directions), -jax.numpy.inf
    )
    count = rays.radii.shape[0]
    bent = jax.ops.segment_max(reached, ends.rays, num_segments=count)
    return leave(rays.origins, rays.directions), bent


def _truth(scene: KnownScene) -> Shown:
    return Shown("true image", (scene.images[0] / 255.0).astype(np.float32))


def write_views(path: Path, views: Sequence[Shown]) -> None:
    """Draws a true image and renderings of it, with their errors below."""
    figure, axes = pyplot.subplots(
        2, len(views), figsize=(2.6 * len(views), 5.7), layout="constrained", squeeze=False
    )
    truth = views[0].rgb
    for (above, below), view in zip(axes.T, views, strict=True):
        _show(above, view.rgb)
        above.set_title(view.title, fontsize=12)
        if view.psnr is None:
            below.axis("off")
            below.text(
                0.5,
                0.5,
                f"below each image:\nits error,\namplified {ERROR_GAIN:g} times,\nand masked PSNR",
                ha="center",
                va="center",
                fontsize=11,
                color="#444444",
                transform=below.transAxes,
            )
            continue
        _show(below, amplified_error(view.rgb, truth))
        below.set_xlabel(f"{view.psnr:.1f} dB", fontsize=13, fontweight="bold")
    _save(figure, path)


def write_fan(
    path: Path, panels: Sequence[Panel], outlines: Sequence[Outline], half: float
) -> None:
    """Draws many rays of a camera, each in its own colour, up to the background cube."""
    figure, axes = pyplot.subplots(
        1, len(panels), figsize=(4.6 * len(panels), 4.9), layout="constrained", squeeze=False
    )
    for axis, panel in zip(axes[0], panels, strict=True):
        _draw_body(axis, outlines, half)
        hues = matplotlib.colormaps[_HUES](np.linspace(0.05, 0.95, len(panel.paths)))
        for paths, hue in zip(panel.paths, hues, strict=True):
            for line in lines_within(paths, half):
                axis.plot(*line.points.T, color=hue, linewidth=1.5, zorder=2)
                axis.plot(*line.points[-1], "s", color=hue, markersize=8, clip_on=False, zorder=3)
        axis.plot(*panel.paths[0].polylines[0][0, :2], "o", color="black", markersize=7, zorder=4)
        axis.set_title(panel.title, fontsize=12)
    _save(figure, path)


def write_tree(path: Path, panels: Sequence[Panel], outlines: Sequence[Outline]) -> None:
    """Draws the light paths of one ray, coloured and labelled by their share of the light."""
    half = 3.0 * max(float(np.max(np.abs(outline))) for outline in outlines)
    figure, axes = pyplot.subplots(
        1, len(panels), figsize=(3.3 * len(panels) + 0.8, 3.7), layout="constrained", squeeze=False
    )
    norm = LogNorm(_LEAST_SHARE, 1.0)
    colours = matplotlib.cm.ScalarMappable(norm, matplotlib.colormaps[_SHARES])
    for axis, panel in zip(axes[0], panels, strict=True):
        _draw_body(axis, outlines, half)
        lines = [line for paths in panel.paths for line in lines_within(paths, half)]
        for line in sorted(lines, key=lambda line: line.share):
            weight = 0.9 + 2.6 * float(np.sqrt(line.share))
            colour = colours.to_rgba(line.share)
            axis.plot(*line.points.T, color=colour, linewidth=weight, zorder=2 + line.share)
        _label_shares(axis, lines, half)
        start = panel.paths[0].polylines[0][0, :2]
        axis.plot(*start, "o", color="black", markersize=7, zorder=4, clip_on=False)
        axis.set_title(panel.title, fontsize=12)
    scale = figure.colorbar(colours, ax=axes, shrink=0.75, pad=0.01)
    scale.set_label("share of the pixel's light")
    scale.ax.set_yticks([1.0, 0.1, 0.01, 0.001], ["100 %", "10 %", "1 %", "0.1 %"])
    _save(figure, path)


def write_distances(
    path: Path, truth: Shown, maps: Sequence[tuple[str, Float[np.ndarray, "h w"]]]
) -> None:
    """Draws an image next to distance maps on one scale; missing distances are white."""
    count = 1 + len(maps)
    figure, axes = pyplot.subplots(
        1, count, figsize=(2.75 * count + 0.6, 3.2), layout="constrained", squeeze=False
    )
    _show(axes[0, 0], truth.rgb)
    axes[0, 0].set_title(truth.title, fontsize=11)
    known = np.concatenate([values[np.isfinite(values)] for _, values in maps])
    for axis, (title, values) in zip(axes[0, 1:], maps, strict=True):
        shown = axis.imshow(
            np.where(np.isfinite(values), values, np.nan),
            cmap=_DISTANCES,
            vmin=float(known.min()),
            vmax=float(known.max()),
        )
        axis.set_xticks([])
        axis.set_yticks([])
        axis.set_title(title, fontsize=11)
    figure.colorbar(shown, ax=axes[0, -1], label="world units", shrink=0.8)
    _save(figure, path)


def _draw_body(axis: pyplot.Axes, outlines: Sequence[Outline], half: float) -> None:
    for outline in outlines:
        axis.fill(*outline.T, **_GLASS)
    axis.set_xlim(-half, half)
    axis.set_ylim(-half, half)
    axis.set_aspect("equal")
    axis.set_xticks([])
    axis.set_yticks([])
    for spine in axis.spines.values():
        spine.set_color("#aaaaaa")


def _label_shares(axis: pyplot.Axes, lines: Sequence[Line], half: float) -> None:
    """Writes each path's share next to its end, slightly inside the frame."""
    for line in lines:
        end, before = line.points[-1], line.points[-2]
        back = (before - end) / np.linalg.norm(before - end)
        place = end + 0.16 * half * back
        axis.text(
            *place,
            f"{100.0 * line.share:.3g} %",
            ha="center",
            va="center",
            fontsize=11,
            zorder=5,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.2, "alpha": 0.85},
        )


def _show(axis: pyplot.Axes, rgb: Float[np.ndarray, "h w 3"]) -> None:
    axis.imshow(np.clip(rgb, 0.0, 1.0), interpolation="bicubic")
    axis.set_xticks([])
    axis.set_yticks([])


def _save(figure: pyplot.Figure, path: Path) -> None:
    figure.savefig(path, dpi=_DPI, facecolor="white", pil_kwargs={"quality": _QUALITY})
    pyplot.close(figure)
