"""What the figures of docs/glass.md show: nothing is learned, the walls are known."""

import dataclasses
import functools
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Array, Float

from experiments.figures import cross_sections, glass_drawings
from experiments.figures.cross_sections import Panel
from experiments.figures.glass_drawings import Shown
from experiments.runs import known_scene as known_scenes
from experiments.runs.known_scene import KnownScene
from refref_jax.data import meshes
from refref_jax.geometry import cameras
from refref_jax.geometry.rays import Rays
from refref_jax.optics import light_paths, path_tracing
from refref_jax.optics.budgets import BUDGETS, Budget
from refref_jax.optics.scene import Scene
from refref_jax.render.first_surface import find_first_surface
from refref_jax.render.pixel_paths import PixelPaths, trace_pixel
from refref_jax.sampling import domains
from refref_jax.sampling.domains import Domain

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


def draw_views(scene: KnownScene, path: Path, *, side: int) -> None:
    """Draws the true image, and what three kinds of light paths make of it.

    Args:
      scene: with one view.
      path: of the picture.
      side: camera rays along each edge of a pixel.
    """
    shown = [_truth(scene)]
    for name, title in _NAMES.items():
        rgb = known_scenes.render_view(scene, 0, budget=BUDGETS[name], side=side).rgb
        shown.append(Shown(title, rgb, known_scenes.measure(scene, 0, rgb)["psnr_masked"]))
    glass_drawings.write_views(path, shown)


def draw_fan(scene: KnownScene, folder: Path, half: float, path: Path) -> None:
    """Draws a fan of camera rays, straight and bent.

    Args:
      scene: what bends them.
      folder: of the scene, whose meshes are cut.
      half: half the edge of the walls' cube, world units.
      path: of the picture.
    """
    outlines = cross_sections.outlines_of(meshes.read_meshes(folder))
    reach = 1.2 * cross_sections.width_of(outlines)
    rays = cross_sections.rays_towards(_CAMERA, list(np.linspace(-reach, reach, _RAYS_OF_A_FAN)))
    titles = {
        "straight": "what a NeRF assumes: light goes straight",
        "paper_no_reflection": "what light does: neighbours part, left and right swap",
    }
    panels = [Panel(title, _follow(scene, rays, BUDGETS[name])) for name, title in titles.items()]
    glass_drawings.write_fan(path, panels, outlines, half)


def draw_tree(scene: KnownScene, folder: Path, path: Path) -> None:
    """Draws the light paths of one ray under three budgets, and under a finer one.

    Args:
      scene: what bends it.
      folder: of the scene, whose meshes are cut.
      path: of the picture.
    """
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


def draw_distances(scene: KnownScene, half: float, path: Path) -> None:
    """Draws three distances of a pixel: to the glass, the wall behind, and the wall it shows.

    Args:
      scene: with one view.
      half: half the edge of the walls' cube, world units.
      path: of the picture.
    """
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
    geometry: Scene, rays: Rays, half: float
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
