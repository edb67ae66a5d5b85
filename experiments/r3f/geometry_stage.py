"""Reconstructs the surface from masks, or from a field of the images, the first stage of R3F.

`about_masks` names the masks with which the surface disagrees.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.cli.progress import ProgressBar
from experiments.r3f import field_surface
from experiments.r3f.records import GeometryFacts, ReconstructionConfig
from refref_jax import atomic_files
from refref_jax.data import meshes, scene_folder, scene_names
from refref_jax.geometry.triangle_meshes import Mesh, diameter, volume
from refref_jax.reconstruct import ReconstructionError, occupancy
from refref_jax.reconstruct.grids import Box, Grid, find_isosurface
from refref_jax.reconstruct.masks import Views, carve, find_box, hull_field
from refref_jax.reconstruct.mesh_distance import carved_alone, silhouette_overlap, without_outliers
from refref_jax.reconstruct.model_selection import shape_from_outlines
from refref_jax.reconstruct.occupancy import OccupancyTrainingConfig
from refref_jax.reconstruct.refinement import Refinement, refine

FOLDER = "geometry"

MATERIAL = "glass"
"""Suffix of the mesh's name. It selects no material, because the index determines it."""

# Overlap of mask and silhouette below which they disagree; it is above 0.97 for correct masks of
# objects some tens of pixels wide.
_AGREES = 0.9

# Largest number of masks that are named.
_NAMED = 5

# Share of an object that a single mask may carve away alone; it is smaller if all of many masks are
# correct.
_MUCH = 0.05


class Inputs(NamedTuple):
    """What a surface is made of.

    Attributes:
      scene: folder of the scene.
      out: folder of the reconstruction.
      views: masks of the training views.
      names: names of the masks.
    """

    scene: Path
    out: Path
    views: Views
    names: Sequence[str]


def _hull(inputs: Inputs, config: ReconstructionConfig) -> Grid:
    return carve(
        *inputs.views, resolution=config.resolution, outliers=config.outliers, names=inputs.names
    )


def _occupancy(inputs: Inputs, config: ReconstructionConfig) -> Grid:
    settings = OccupancyTrainingConfig()
    with ProgressBar("occupancy", settings.steps) as bar:
        return occupancy.fit(
            *inputs.views,
            config=settings,
            seed=config.seed,
            resolution=config.resolution,
            progress=lambda step, report: bar.show(step, f"loss {float(report.loss):.4f}"),
        )


def _field(inputs: Inputs, config: ReconstructionConfig) -> Grid:
    return field_surface.find(inputs.scene, inputs.out, config)


GEOMETRIES: dict[str, Callable[[Inputs, ReconstructionConfig], Grid]] = {
    "hull": _hull,
    "occupancy": _occupancy,
    **dict.fromkeys(field_surface.NAMES, _field),
}
"""Methods by name, whose grid is negative inside the object."""


def box_of_masks(scene: Path) -> Box:
    """Returns a box around all that the training masks of a scene show.

    Raises:
      ValueError: if there are no masks, or no object fits them.
    """
    frames, masks = scene_folder.read_object_views(scene_folder.read_frames(scene, "train"))
    return find_box(hull_field(masks, frames.cameras), masks, frames.cameras)


def run(
    scene: Path, out: Path, config: ReconstructionConfig, *, families: bool = False
) -> GeometryFacts:
    """Reconstructs the surface and writes it to `{out}/geometry`.

    Args:
      scene: folder of the scene.
      out: folder of the reconstruction.
      config: options of the reconstruction.
      families: whether families of shapes are fitted to the outlines, as where light cannot refine.

    Raises:
      ValueError: if there are no masks, or no object fits them.
    """
    frames, masks = scene_folder.read_object_views(scene_folder.read_frames(scene, "train"))
    views = Views(masks, frames.cameras)
    names = [_within(path, scene).as_posix() for path in frames.masks]
    cut = find_isosurface(GEOMETRIES[config.geometry](Inputs(scene, out, views, names), config))
    trusted = without_outliers(cut, views, config.outliers)
    refined = refine(cut, Refinement(), views=trusted)
    befores = [cut, *(stage.mesh for stage in refined)]
    mesh, chosen = befores[-1], None
    refused = [f"{stage.name}: {stage.refused}" for stage in refined if stage.refused]
    if families:
        try:
            with ProgressBar("families", 1) as bar:
                chosen = shape_from_outlines(
                    mesh, trusted, carved=befores[1], seed=config.seed, progress=bar.move
                )
        except ReconstructionError as error:
            refused.append(f"families of shapes: {error}")
        mesh = mesh if chosen is None else chosen.mesh
    name = f"{_object(scene)}_{MATERIAL}.ply"
    with atomic_files.written_folder(out / FOLDER) as folder:
        meshes.write_mesh(folder / name, *mesh)
    return describe(
        name,
        mesh,
        views,
        stages=(
            *(
                stage.name
                for before, stage in zip(befores, refined, strict=False)
                if not np.array_equal(before.vertices, stage.mesh.vertices)
            ),
            *(() if chosen is None else (f"fitted to outlines as {chosen.name}",)),
        ),
        refused=tuple(refused),
        families=families,
        warnings=(
            *field_surface.warnings(scene, out),
            *about_masks(mesh, views, names, outliers=config.outliers),
        ),
    )


def describe(
    name: str,
    mesh: Mesh,
    views: Views,
    *,
    stages: tuple[str, ...],
    refused: tuple[str, ...] = (),
    families: bool = False,
    warnings: tuple[str, ...] = (),
) -> GeometryFacts:
    """Returns the facts of a surface.

    Args:
      name: name of its file.
      mesh: the surface.
      views: masks of the object.
      stages: names of the stages that changed it.
      refused: skipped stages, and the reasons.
      families: whether families of shapes were fitted to the outlines.
      warnings: warnings about masks.
    """
    return GeometryFacts(
        mesh=name,
        masks=len(views.masks),
        width=views.cameras.width,
        height=views.cameras.height,
        vertices=len(mesh.vertices),
        faces=len(mesh.faces),
        volume=volume(mesh.vertices, mesh.faces),
        diameter=diameter(mesh.vertices),
        stages=stages,
        refused=refused,
        warnings=warnings,
        families=families,
    )


def is_there(out: Path, facts: GeometryFacts) -> bool:
    """Returns whether the file of the surface exists."""
    return (out / FOLDER / facts.mesh).is_file()


def _within(path: Path, scene: Path) -> Path:
    """Returns the path of a file relative to its scene, whose folder may be moved."""
    return path.relative_to(scene) if path.is_relative_to(scene) else path


def _object(scene: Path) -> str:
    """Returns the name of a scene's object: from the published name, else from the folder."""
    name = scene_names.of_folder(scene)
    return scene_names.parse(name).object if scene_names.is_name(name) else name


def about_masks(
    mesh: Mesh, views: Views, names: Sequence[str], *, outliers: int
) -> tuple[str, ...]:
    """Returns warnings about masks that disagree with the object or may have corrupted it.

    Args:
      mesh: mesh of the object.
      views: all masks from which it was made.
      names: names of the views.
      outliers: number of masks that may disagree without a warning.
    """
    overlaps = silhouette_overlap(mesh, *views)
    doubtful = np.flatnonzero(overlaps < _AGREES)
    if len(doubtful) <= outliers:
        return ()
    worst = doubtful[np.argsort(overlaps[doubtful])][:_NAMED]
    named = ", ".join(f"{names[view]} ({overlaps[view]:.2f})" for view in worst)
    message = (
        f"{len(doubtful)} of {len(overlaps)} training masks overlap with the object by less than "
        f"{_AGREES}, least {named}. Check the masks and the poses."
    )
    shares = carved_alone(views)
    taker = int(np.argmax(shares))
    if shares[taker] < _MUCH:
        return (message,)
    return (
        message,
        f"{names[taker]} alone carves away {shares[taker]:.0%} of the other masks' hull. If this "
        f"mask is wrong, fix it, remove its frame, or use --outliers={outliers + 1}.",
    )
