"""Draws the figures of docs/glass.md: why glass is hard, and what following its light is worth.

python -m experiments.glass_figures --scene=experiments/data/cube_smcvx_ball --out=runs/glass

`scene.json` must tell the walls of a cube. Nothing is learned. Each figure is a JPEG,
`{out}/glass_{figure}.jpg`.
"""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
from absl import flags
from jaxtyping import Array, Float

from experiments import (
    commands,
    cross_sections,
    glass_drawings,
    known_scenes,
    scene_option,
    scenes,
    supersampling,
)
from experiments.cross_sections import Panel
from experiments.glass_drawings import Shown
from experiments.known_scenes import KnownScene
from experiments.viewing.pixel_paths import PixelPaths, trace_pixel
from refref_jax.data import background, cameras, meshes
from refref_jax.geometry.rays import Rays
from refref_jax.optics import light_paths, path_tracing
from refref_jax.optics.branching import Geometry
from refref_jax.optics.budgets import BUDGETS, Budget
from refref_jax.render.backgrounds import CubeBackground
from refref_jax.render.first_surface import find_first_surface
from refref_jax.sampling import domains
from refref_jax.sampling.domains import Domain

FIGURES = ("views", "fan", "tree", "distances")

_SCENE = flags.DEFINE_string("scene", None, f"The scene: {scene_option.FORMS}.", required=True)
_OUT = flags.DEFINE_string("out", None, "Folder to write the figures to.", required=True)
_FIGURES = flags.DEFINE_multi_enum(
    "figure", list(FIGURES), list(FIGURES), "What to draw, all by default; may be repeated."
)
_VIEW = flags.DEFINE_integer("view", 0, "Number of the view of the split.", 0)
_OVERWRITE = flags.DEFINE_bool("overwrite", False, "Replace figures that are there.")
flags.adopt_module_key_flags(scenes)
flags.adopt_module_key_flags(known_scenes)

_NAMES = {"straight": "straight light", "paper": "the paper's paths", "tree": "the path tree"}

_CAMERA = 4.0
"""Distance of the camera that is drawn from the origin, as in the data set; world units."""

_RAYS_OF_A_FAN = 15

# Where the one ray of a tree is aimed, as a share of the body's width: near the rim, where
# reflections carry some of the light.
_AIM = 0.9

# Share of the light below which a branch of the finer tree is not followed: the scale's end.
_FINER = 1e-3

# Beyond any wall: last segments are cut where the picture ends.
_FAR = 100.0


def main() -> None:
    """Draws the figures that are asked for."""
    wanted = list(dict.fromkeys(_FIGURES.value))
    targets = {name: Path(_OUT.value) / f"glass_{name}.jpg" for name in wanted}
    _refuse(targets)
    folder = scene_option.opened(_SCENE.value)
    walls = background.read_background(folder)
    if not isinstance(walls, CubeBackground):
        raise ValueError(
            f"The background of {folder} is no cube, whose walls are drawn. Choose a scene in one."
        )
    half = float(walls.half_extent)
    scene = known_scenes.read_scene(
        folder,
        split=known_scenes.SPLIT.value,
        views=str(_VIEW.value),
        rule=scenes.RULE.value,
        indices=scenes.given_indices(),
    )
    draw: dict[str, Callable[[Path], None]] = {
        "views": functools.partial(_draw_views, scene),
        "fan": functools.partial(_draw_fan, scene, folder, half),
        "tree": functools.partial(_draw_tree, scene, folder),
        "distances": functools.partial(_draw_distances, scene, half),
    }
    Path(_OUT.value).mkdir(parents=True, exist_ok=True)
    with commands.ProgressBar("draw", len(wanted)) as bar:
        for i, name in enumerate(wanted):
            draw[name](targets[name])
            bar.show(i + 1, name)
    print(f"Figures: {', '.join(map(str, targets.values()))}")
    print(f"Next: {commands.shell('render_known', f'--scene={_SCENE.value}', '--out=runs/known')}")


def _refuse(targets: dict[str, Path]) -> None:
    """Refuses to replace files unasked."""
    there = [path for path in targets.values() if path.exists()]
    if there and not _OVERWRITE.value:
        raise ValueError(f"{there[0]} exists. Give another --out, or --overwrite to replace it.")


def _draw_views(scene: KnownScene, path: Path) -> None:
    """The true image, and what three kinds of light paths make of it, with nothing learned."""
    side = supersampling.side_of(known_scenes.RAYS_PER_PIXEL.value)
    shown = [_truth(scene)]
    for name, title in _NAMES.items():
        rgb = known_scenes.render_view(scene, 0, budget=BUDGETS[name], side=side).rgb
        shown.append(Shown(title, rgb, known_scenes.measure(scene, 0, rgb)["psnr_masked"]))
    glass_drawings.write_views(path, shown)


def _draw_fan(scene: KnownScene, folder: Path, half: float, path: Path) -> None:
    """A fan of camera rays, straight and bent."""
    outlines = cross_sections.outlines_of(meshes.read_meshes(folder))
    reach = 1.2 * cross_sections.width_of(outlines)
    rays = cross_sections.rays_towards(_CAMERA, list(np.linspace(-reach, reach, _RAYS_OF_A_FAN)))
    titles = {
        "straight": "what a NeRF assumes: light goes straight",
        "paper_no_reflection": "what light does: neighbours part, left and right swap",
    }
    panels = [Panel(title, _follow(scene, rays, BUDGETS[name])) for name, title in titles.items()]
    glass_drawings.write_fan(path, panels, outlines, half)


def _draw_tree(scene: KnownScene, folder: Path, path: Path) -> None:
    """The light paths of one ray under three budgets, and under a finer one."""
    outlines = cross_sections.outlines_of(meshes.read_meshes(folder))
    rays = cross_sections.rays_towards(_CAMERA, [_AIM * cross_sections.width_of(outlines)])
    budgets = {title: BUDGETS[name] for name, title in _NAMES.items()}
    finer = dataclasses.replace(BUDGETS["tree"], cut=_FINER)
    budgets[f"the tree, cut at {100.0 * _FINER:g} %"] = finer
    panels = [Panel(title, _follow(scene, rays, budget)) for title, budget in budgets.items()]
    glass_drawings.write_tree(path, panels, outlines)


def _follow(scene: KnownScene, rays: list[Rays], budget: Budget) -> list[PixelPaths]:
    trace = functools.partial(trace_pixel, scene.geometry, budget=budget, reach=_FAR)
    return [trace(ray) for ray in rays]


def _draw_distances(scene: KnownScene, half: float, path: Path) -> None:
    """Three distances of a pixel: to the glass, to the wall behind, and to the wall it shows."""
    rays = cameras.image_rays(scene.frames.cameras, 0)
    first = find_first_surface(scene.geometry.surfaces, rays).distances
    flat = Rays(*(x.reshape(-1, *x.shape[2:]) for x in rays))
    straight, bent = (
        np.asarray(x).reshape(first.shape) for x in _walls(scene.geometry, flat, half)
    )
    glass_drawings.write_distances(
        path,
        _truth(scene),
        [
            ("to the first surface", np.where(np.isfinite(first), first, straight)),
            ("to the wall, straight on", straight),
            ("to the wall, along the light", bent),
        ],
    )


@functools.partial(jax.jit, static_argnames="half")
def _walls(
    geometry: Geometry, rays: Rays, half: float
) -> tuple[Float[Array, " rays"], Float[Array, " rays"]]:
    """Returns how far light goes to the walls, straight on and refracted; arc length."""
    leave = jax.vmap(functools.partial(domains.exit_distance, Domain(half, "bounded")))
    # Without reflections every ray has one path.
    ends = path_tracing.trace_ends(geometry, rays, budget=BUDGETS["paper_no_reflection"]).ends
    reached = jax.numpy.where(
        light_paths.exists(ends), ends.tau + leave(ends.origins, ends.directions), -jax.numpy.inf
    )
    count = rays.radii.shape[0]
    bent = jax.ops.segment_max(reached, ends.rays, num_segments=count)
    return leave(rays.origins, rays.directions), bent


def _truth(scene: KnownScene) -> Shown:
    return Shown("true image", (scene.images[0] / 255.0).astype(np.float32))


if __name__ == "__main__":
    commands.run(main)
