"""The surface of a field that is trained on the images alone: `neus` and `nunerf` of R3F.

    {out}/field/            a run: a field of that kind along straight rays
    {out}/masked/{name}/    a scene without masks, with silhouettes of that surface as its masks

The colour of these fields depends on the point of the surface and on the direction of view, so that
it memorises what is seen through the glass; the surface goes where such a picture agrees in all
views, which is the glass. That is the first stage of NU-NeRF, where Schlick's equation splits the
colour into a reflected and a transmitted part, each with a network (`--geometry=nunerf`). With
`--geometry=neus`, one network has both.

Masks are not used. Later stages need some: to know which pixels show what is behind the object. A
scene without masks is copied, with silhouettes of the surface in their place.

Source: Sun et al., NU-NeRF (2024), first stage, and `jjjkkyz/NU-NeRF` at commit 1083625.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import label

from experiments.exporting.field_mesh import look_up_surfaces, surface_box
from experiments.r3f import index_stage
from experiments.r3f.records import ReconstructionConfig
from refref_jax.choices import SPLITS
from refref_jax.data import SceneError, scene_folder
from refref_jax.geometry.cameras import image_rays
from refref_jax.geometry.surfaces import pack_meshes
from refref_jax.reconstruct.grids import Box, Grid, find_isosurface, sample
from refref_jax.render import Model
from refref_jax.render.images import find_first_surface
from refref_jax.training.config import TrainConfig
from refref_jax.training.resolve import Resolved, read_facts, resolve

NAMES = ("neus", "nunerf")
"""Names of these geometries, which are those of their kinds of field."""

RUN = "field"
"""Name of the run of the field."""

MASKED = "masked"
"""Name of the folder of a copy of a scene without masks."""

PRESET = "tiny"
"""Preset of the field."""

# Cells along the ball of the surface with which the object is looked for.
_COARSE = 64

# Distance between the object and the border of its grid, in coarse cells.
_MARGIN = 2.0


def has_masks(scene: Path) -> bool:
    """Returns whether the training views of a scene have masks."""
    return scene_folder.read_frames(scene, "train").masks is not None


def check(scene: Path, config: ReconstructionConfig) -> None:
    """Rejects a scene on which the field cannot be trained.

    Raises:
      ValueError: if it is one, as where the background is unbounded.
    """
    try:
        _resolved(scene, config)
    except ValueError as error:
        raise ValueError(
            f"--geometry={config.geometry} cannot be used here, since its field cannot be trained: "
            f"{error} Use --geometry=hull, with masks."
        ) from error


def masked_scene(scene: Path, out: Path, config: ReconstructionConfig) -> Path:
    """Returns a scene with masks: the scene itself, or a copy with those of the field's surface.

    Args:
      scene: folder of the scene.
      out: folder of the reconstruction.
      config: options of the reconstruction.

    Raises:
      SceneError: if no view shows the surface.
      ValueError: if the field has no surface, or cannot be trained on the scene.
      KeyboardInterrupt: if its training was stopped; it has been saved.
    """
    if config.geometry not in NAMES or has_masks(scene):
        return scene
    copy = out / MASKED / scene.resolve().name
    if not copy.is_dir():
        copy.parent.mkdir(exist_ok=True)
        mesh = find_isosurface(find(scene, out, config))
        surfaces = pack_meshes([mesh])
        seen: dict[Path, Bool[np.ndarray, "h w"]] = {}
        for split in SPLITS:
            if not (scene / f"transforms_{split}.json").is_file():
                continue
            frames = scene_folder.read_frames(scene, split)
            for i, image in enumerate(frames.images):
                first = find_first_surface(surfaces, image_rays(frames.cameras, i))
                seen[image.resolve()] = np.isfinite(first.distances)
        scene_folder.add_masks(scene, copy, lambda image: seen[image.resolve()])
    return copy


def warnings(scene: Path, out: Path) -> tuple[str, ...]:
    """Returns warnings about a scene of `masked_scene`."""
    if scene.parent != out / MASKED:
        return ()
    return (
        "the scene has no masks. Later stages read silhouettes of the surface itself, so that the "
        "overlap says nothing.",
    )


def find(scene: Path, out: Path, config: ReconstructionConfig) -> Grid:
    """Returns the signed value of a field's surface around the object, training the field first.

    Of several pieces, the largest is the object.

    Args:
      scene: folder of the scene.
      out: folder of the reconstruction.
      config: options of the reconstruction.

    Raises:
      ValueError: if the field has no surface, or cannot be trained on the scene.
      KeyboardInterrupt: if its training was stopped; it has been saved.
    """
    model = index_stage.learned(scene, out / RUN, _resolved(scene, config))
    return _largest(_around_object(model, config.resolution))


def _resolved(scene: Path, config: ReconstructionConfig) -> Resolved:
    asked = TrainConfig().override(
        scene=str(scene.resolve()),
        paths="straight",
        field=config.geometry,
        preset=PRESET,
        background=config.space,
        radius=config.radius,
        centre=config.centre,
        seed=config.seed,
        **({} if config.exposure == "fixed" else {"exposure": config.exposure}),
    )
    return resolve(asked, read_facts(asked.scene, parts=()))


def _around_object(model: Model, resolution: int) -> Grid:
    """Returns the signed value in the box of the largest piece, with some cells along its edge."""

    def signed(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        return look_up_surfaces(model, points, None)[0].astype(np.float64)

    ball = Box(*surface_box(model, None))
    coarse = _largest(sample(signed, ball, spacing=float(np.max(ball.high - ball.low)) / _COARSE))
    inside = coarse.low + coarse.spacing * np.argwhere(coarse.values < 0.0)
    edge = _MARGIN * coarse.spacing
    box = Box(inside.min(axis=0) - edge, inside.max(axis=0) + edge)
    return sample(signed, box, spacing=float(np.max(box.high - box.low)) / resolution)


def _largest(grid: Grid) -> Grid:
    """Returns the grid with the largest piece alone, by its number of points."""
    pieces, count = label(grid.values < 0.0)
    if count == 0:
        raise SceneError(
            "The field has no surface: its signed value is positive everywhere. Check the poses, "
            "or use --geometry=hull with masks."
        )
    largest = 1 + int(np.argmax(np.bincount(pieces.ravel())[1:]))
    others = (pieces != 0) & (pieces != largest)
    return grid._replace(values=np.where(others, np.abs(grid.values), grid.values))
