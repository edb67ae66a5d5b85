"""Pixels that see the body, and the field of what is behind it."""

from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Int

from refref_jax.data import local_layout, mask_margins
from refref_jax.geometry.cameras import pixel_rays
from refref_jax.geometry.surface_build import build_surfaces
from refref_jax.optics.interface_rules import NO_PARENT, nested
from refref_jax.optics.scene import Scene
from refref_jax.reconstruct.photometry import Evidence
from refref_jax.reconstruct.triangles import Mesh
from refref_jax.render.model import Model


class BodyPixels(NamedTuple):
    """Some pixels of a split.

    Attributes:
      evidence: rays, colours and the field.
      views: the image of each.
    """

    evidence: Evidence
    views: Int[np.ndarray, " rays"]


def look(scene: Path, split: str, model: Model, *, seed: int, rays: int) -> BodyPixels:
    """Draws pixels well inside of a split's masks, spread evenly over its views.

    Args:
      scene: its folder.
      split: of which images and masks are read.
      model: of the background.
      seed: of the choice.
      rays: how many, about; fewer where masks have no more.

    Raises:
      ValueError: if there are no masks, or they are too thin to have an inside.
    """
    frames = local_layout.read_frames(scene, split)
    inside = mask_margins.well_inside(local_layout.read_masks(frames))
    if not inside.any():
        raise ValueError(
            f"No pixel of the {split} views of {scene} lies inside of a mask and off its outline. "
            "Use larger images, or check the masks."
        )
    generator = np.random.default_rng(seed)
    each = -(-rays // len(inside))
    chosen = []
    for view, mask in enumerate(inside):
        places = np.flatnonzero(mask)
        picked = generator.choice(places, min(each, len(places)), replace=False)
        chosen.append(picked + view * mask.size)
    view, row, column = np.unravel_index(np.concatenate(chosen), inside.shape)
    rgb = local_layout.read_images(frames)[view, row, column].astype(np.float32) / 255.0
    seen = pixel_rays(frames.cameras, view, row, column)
    return BodyPixels(Evidence(model.params, *jax.device_put((seen, rgb))), view)


def body_geometry(mesh: Mesh, index: float) -> Scene:
    """Returns one clear body in air, on the device."""
    owners = np.zeros(len(mesh.faces), np.int64)
    surfaces = build_surfaces(mesh.vertices[mesh.faces], mesh.normals, owners)
    return jax.device_put(Scene(surfaces, nested([index], [NO_PARENT])))
