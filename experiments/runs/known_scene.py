"""Reads, renders and measures scenes with a known background, without any training."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from experiments.runs import view_numbers
from refref_jax import metrics
from refref_jax.choices import RuleName
from refref_jax.data import (
    mesh_checks,
    mesh_queries,
    meshes,
    scene_analysis,
    scene_folder,
    scene_names,
    scene_properties,
)
from refref_jax.data.mesh_queries import Containment
from refref_jax.data.meshes import MeshPart
from refref_jax.data.scene_assembly import assemble_scene, read_background
from refref_jax.data.scene_properties import SceneProperties
from refref_jax.geometry import cameras
from refref_jax.geometry.rays import Rays
from refref_jax.optics.media import Scene, interior_length
from refref_jax.optics.path_settings import PathSettings
from refref_jax.render import pixels
from refref_jax.render.background_rendering import TILE, KnownRendering, render_known
from refref_jax.render.backgrounds import Radiance, radiance_of


class KnownScene(NamedTuple):
    """A scene and some of its views.

    Attributes:
      name: name of the folder.
      objects: scene that refracts and reflects the rays.
      radiance: background radiance.
      frames: selected views.
      indices: number of each view in its split.
      images: true images of the views, 8-bit sRGB.
      masks: object masks, or `None` if the split has none.
      interior_list: interior list of each view's camera; `None` if the interface rule does not need
        it.
    """

    name: str
    objects: Scene
    radiance: Radiance
    frames: scene_folder.Frames
    indices: tuple[int, ...]
    images: UInt8[np.ndarray, "views h w 3"]
    masks: Bool[np.ndarray, "views h w"] | None
    interior_list: Int[np.ndarray, "views slots"] | None


class View(NamedTuple):
    """A rendered view.

    Attributes:
      rgb: sRGB in `[0, 1]`.
      casts: closest-hit queries per camera ray.
      paths: light paths per camera ray.
      dropped: share of the throughput dropped because buffers were full, mean over rays and
        channels.
      seconds: time to render the view.
    """

    rgb: Float[np.ndarray, "h w 3"]
    casts: float
    paths: float
    dropped: float
    seconds: float


def read_scene(
    scene: Path,
    *,
    split: str,
    views: str,
    rule: RuleName | None,
    indices: Mapping[str, float],
    overlay: str | None = None,
) -> KnownScene:
    """Reads the data for rendering and measuring some views.

    Args:
      scene: folder of the scene.
      split: `train`, `val` or `test`.
      views: numbers of views in the split, as in `0,10,20`, or `all`.
      rule: rule for the medium outside each mesh, see `optics.interface_rules`; by default that of
        `scene.json`, else `nested`.
      indices: indices of refraction by name, see `meshes.read_meshes`.
      overlay: file whose properties override those of `scene.json`, see `scene_properties`.

    Raises:
      ValueError: if a file is missing or broken, or a view does not exist.
    """
    frames = scene_folder.read_frames(scene, split)
    chosen = view_numbers.choose(views, len(frames.names))
    properties = scene_properties.read(scene, overlay=overlay)
    parts = meshes.read_meshes(scene, indices=indices, properties=properties)
    meshes.refuse_missing(parts, properties.origins)
    tree, rule = mesh_queries.find_containment(parts), rule or rule_of(properties)
    notes = mesh_checks.check_meshes(parts, tree, rule=rule)
    if properties.rule is not None and properties.rule == rule:
        notes += (f"note: rule={rule}, from {properties.origins['rule'].name}.",)
    print("\n".join((*notes, *scene_analysis.overridden(properties, parts, rule=rule))))
    return build_scene(
        scene, parts, tree, frames=frames, chosen=chosen, rule=rule, properties=properties
    )


def rule_of(properties: SceneProperties) -> RuleName:
    """Returns the interface rule of `scene.json`, or the default."""
    return properties.rule or "nested"


def build_scene(
    scene: Path,
    parts: Sequence[MeshPart],
    tree: Containment,
    *,
    frames: scene_folder.Frames,
    chosen: Sequence[int],
    rule: RuleName,
    properties: SceneProperties,
) -> KnownScene:
    """Returns a scene of meshes that have been checked before.

    Args:
      scene: folder of the scene.
      parts: meshes of the scene.
      tree: nesting of the meshes.
      frames: a split of the scene.
      chosen: numbers of views in the split.
      rule: rule for the medium outside each mesh.
      properties: properties of the scene: its background, and the ambient medium.

    Raises:
      ValueError: if the background is unknown, or an image is missing or broken.
    """
    frames = _choose(frames, chosen)
    objects = assemble_scene(
        parts,
        tree.parents,
        rule=rule,
        overlaps=tree.overlaps,
        ambient=properties.ambient_index,
    )
    return KnownScene(
        name=scene_names.of_folder(scene),
        objects=jax.device_put(objects),
        radiance=jax.device_put(radiance_of(read_background(scene, properties=properties))),
        frames=frames,
        indices=tuple(chosen),
        images=scene_folder.read_images(frames),
        masks=scene_folder.read_masks(frames) if frames.masks else None,
        interior_list=(
            mesh_queries.parts_around(parts, frames.cameras.poses[:, :, 3])
            if interior_length(objects.interfaces)
            else None
        ),
    )


def warm_up(scene: KnownScene, settings: PathSettings) -> None:
    """Renders one tile, so that later timings exclude compilation."""
    rays = cameras.pixel_rays(scene.frames.cameras, *np.zeros((3, TILE), np.int64))
    _render(scene, 0, rays, settings)


def render_view(scene: KnownScene, view: int, *, settings: PathSettings, side: int) -> View:
    """Renders a view with `side x side` rays per pixel, averaged in linear radiance.

    Args:
      scene: scene to render.
      view: position in the selected views.
      settings: path settings.
      side: number of rays along each edge of a pixel.
    """
    rays = cameras.image_rays(cameras.supersample(scene.frames.cameras, side), view)
    if scene.objects.interfaces.alpha.size:
        rays = rays._replace(strata=cameras.strata(scene.frames.cameras, side))
    start = time.monotonic()
    seen = _render(scene, view, rays, settings)
    seconds = time.monotonic() - start
    linear = jax.device_put(cameras.box_filter(seen.linear, side))
    return View(
        rgb=np.clip(np.asarray(pixels.linear_to_srgb(linear)), 0.0, 1.0),
        casts=seen.casts / seen.paths.size,
        paths=float(np.mean(seen.paths)),
        dropped=float(np.mean(seen.dropped)),
        seconds=seconds,
    )


def measure(
    scene: KnownScene, view: int, rgb: Float[np.ndarray, "h w 3"]
) -> dict[str, float | None]:
    """Returns the PSNR over the image, inside the mask and outside of it, in dB.

    It compares unrounded sRGB in `[0, 1]` with the 8-bit image, and is `None` over zero pixels.
    """
    target = (scene.images[view] / 255.0).astype(np.float32)
    pair = jax.device_put((rgb, target))
    result: dict[str, float | None] = {"psnr": float(metrics.psnr(*pair))}
    masks = {"psnr_masked": None, "psnr_outside": None}
    if scene.masks is not None:
        masks = {"psnr_masked": scene.masks[view], "psnr_outside": ~scene.masks[view]}
    for key, mask in masks.items():
        known = mask is not None and mask.any()
        result[key] = float(metrics.psnr_masked(*pair, jax.device_put(mask))) if known else None
    return result


def _render(scene: KnownScene, view: int, rays: Rays, settings: PathSettings) -> KnownRendering:
    interior_list = scene.interior_list
    if interior_list is not None:
        interior_list = np.broadcast_to(
            interior_list[view], (*rays.radii.shape, interior_list.shape[1])
        )
    return render_known(
        scene.objects, scene.radiance, rays, settings=settings, interior_list=interior_list
    )


def _choose(frames: scene_folder.Frames, chosen: Sequence[int]) -> scene_folder.Frames:
    def choose(items: tuple[Path, ...]) -> tuple[Path, ...]:
        return tuple(items[i] for i in chosen)

    return scene_folder.Frames(
        names=tuple(frames.names[i] for i in chosen),
        images=choose(frames.images),
        masks=frames.masks and choose(frames.masks),
        depths=frames.depths and choose(frames.depths),
        cameras=frames.cameras._replace(poses=frames.cameras.poses[list(chosen)]),
    )
