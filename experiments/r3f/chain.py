"""Runs the stages of R3F, skipping those that are finished."""

import dataclasses
import functools
import hashlib
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from experiments.r3f import (
    field_surface,
    geometry_stage,
    index_stage,
    light_stage,
    object_source,
    records,
    report,
)
from experiments.r3f.records import IndexFacts, LightFacts, Reconstruction, ReconstructionConfig
from refref_jax import atomic_files, configuration
from refref_jax.choices import Position, Space
from refref_jax.data import SceneError, scene_folder, scene_names, scene_properties
from refref_jax.data.meshes import MeshPart
from refref_jax.reconstruct.grids import import_skimage
from refref_jax.training.resolve import Resolved

INDEX_FILE = "index.json"
_INDEX_FOLDER = "index"

Say = Callable[[str], None]

_Background = Callable[[], Resolved]


def reconstruct(
    scene: Path,
    out: Path,
    config: ReconstructionConfig,
    *,
    compare: bool,
    say: Say = print,
) -> Reconstruction:
    """Reconstructs a scene's object from images and masks, or resumes a reconstruction.

    Args:
      scene: folder of the scene.
      out: folder of the reconstruction, see `records`.
      config: options of the reconstruction.
      compare: whether the report may read the scene's own meshes.
      say: function called with a line of text for every stage.

    Raises:
      ValueError: if the scene lacks required files, if the packages for extracting surfaces are not
        installed, if no object fits the masks, or if the folder contains anything else.
    """
    import_skimage()
    if config.geometry not in field_surface.NAMES or field_surface.has_masks(scene):
        _check_masks(scene, config)
    if config.geometry in field_surface.NAMES:
        field_surface.check(scene, config)
    asked = Reconstruction(scene_names.of_folder(scene), fingerprint(scene), config)
    found = records.begin(out, asked)
    with atomic_files.hold(out):
        found = records.read(out)  # another process may have finished it meanwhile
        scene = field_surface.masked_scene(scene, out, config)
        background = functools.cache(lambda: _resolve_background(scene, out, config))
        families = _takes_families(config, background)
        if not _has_surface(out, found, families):
            read = "images" if config.geometry in field_surface.NAMES else "masks"
            say(f"geometry: {config.geometry} of the training {read}, {config.resolution} cells")
            if without := _views_without_object(scene):
                say(f"geometry: {without} training views are left out, whose masks mark no object")
            facts = geometry_stage.run(scene, out, config, families=families)
            found = dataclasses.replace(found, geometry=facts, index=None, light=None, report=None)
            records.write(out, found)
        say(_describe_geometry(found))
        if found.index is None:
            found = dataclasses.replace(
                found, index=_index(scene, out, found, background), report=None
            )
            records.write(out, found)
        say(describe_index(found.index))
        found = _refined(scene, out, found, background, say)
        configuration.write(out / INDEX_FILE, object_source.index_facts(found))
        if found.report is None or not report.is_there(out):
            found = dataclasses.replace(found, report=report.run(scene, out, found, compare))
            records.write(out, found)
        say(_describe_report(found))
    return found


def _check_masks(scene: Path, config: ReconstructionConfig) -> None:
    """Reads all masks, also those that judge: broken files are reported now, not after hours."""
    frames = scene_folder.read_frames(scene, "train")
    masks = len(scene_folder.read_object_views(frames)[1])
    if config.outliers >= masks:
        raise ValueError(
            f"--outliers={config.outliers}, but there are {masks} train masks. Use fewer."
        )
    for split in ("val", "test"):
        if (scene / f"transforms_{split}.json").is_file():
            frames = scene_folder.read_frames(scene, split)
            if frames.masks is not None:
                scene_folder.read_masks(frames)


def _views_without_object(scene: Path) -> int:
    masks = scene_folder.read_masks(scene_folder.read_frames(scene, "train"))
    return int((~masks.any(axis=(1, 2))).sum())


def read_parts(out: Path) -> list[MeshPart]:
    """Reads the parts of a finished reconstruction, with their indices of refraction.

    Raises:
      ValueError: if the folder contains no reconstruction, or an unfinished one.
    """
    found = records.read(out)
    waits_for_light = found.config.refinement == "light" and found.light is None
    if (
        found.geometry is None
        or found.index is None
        or waits_for_light
        or not object_source.are_there(out, found)
    ):
        raise ValueError(
            f"The reconstruction in {out} is not finished. Repeat the command that started it."
        )
    return object_source.read_parts(out, found)


def fingerprint(scene: Path) -> str:
    """Returns a hash of the inputs of a reconstruction: the training images, masks and poses.

    Raises:
      ValueError: if a file is missing, or the transforms file is broken.
    """
    found = hashlib.sha256()
    frames = scene_folder.read_frames(scene, "train")
    found.update(frames.cameras.poses.tobytes())
    found.update(repr(frames.cameras.focal).encode())
    for path in (*frames.images, *(frames.masks or ())):
        found.update(hashlib.sha256(path.read_bytes()).digest())
    return found.hexdigest()


def bounds_of(
    scene: Path,
    overlay: str,
    *,
    space: Space | None,
    radius: float | None,
    centre: Position | None = None,
) -> tuple[Space | None, float | None, Position | None]:
    """Returns type, size and centre of the background; `None` stands for what `scene.json` says.

    Args:
      scene: folder of the scene.
      overlay: file whose properties override those of `scene.json`, or an empty string.
      space: type of the background, if it is given.
      radius: size of the background, if it is given.
      centre: centre of the background, if it is given.

    Raises:
      SceneError: if the properties are not valid, or the ambient medium is not air.
    """
    told = scene_properties.read(scene, overlay=overlay)
    if told.ambient_index != 1.0:
        raise SceneError(
            f"{told.origins['ambient_index']}: ambient_index is {told.ambient_index:g}, but "
            "reconstruction in a medium other than air is not supported yet. Train with the "
            "scene's meshes."
        )
    if not overlay or told.origins.get("background") != Path(overlay):
        return space, radius, centre
    background = told.background
    return space or told.space, radius or background.extent, centre or background.centre


def describe_index(index: IndexFacts) -> str:
    """Returns a one-line description of the index."""
    if index.error is None:
        return f"index of refraction: {index.index:.6g} ({index.source})"
    return f"index of refraction: {index.index:.4f} +- {index.error:.4f} ({index.source})"


def _index(scene: Path, out: Path, found: Reconstruction, background: _Background) -> IndexFacts:
    config = found.config
    if config.index is not None:
        return IndexFacts("given", config.index, None, None)
    folder = out / _INDEX_FOLDER
    folder.mkdir(exist_ok=True)
    mesh = object_source.read_mesh(out, found)
    estimate = index_stage.run(scene, mesh, folder, seed=config.seed, wanted=background())
    if not math.isfinite(estimate.deviation):
        if config.refinement == "light":  # which may find out that the object is not solid
            return IndexFacts("estimated", estimate.index, None, estimate.error)
        _refuse_index(out, estimate.index)
    return IndexFacts("estimated", estimate.index, estimate.deviation, estimate.error)


def _refuse_index(out: Path, index: float) -> NoReturn:
    raise ValueError(
        f"The index of refraction was estimated as {index:.3f}, but the error does not depend on "
        f"it (see {out / _INDEX_FOLDER}). Set it explicitly, as in --ior=1.5."
    )


def _refined(
    scene: Path, out: Path, found: Reconstruction, background: _Background, say: Say
) -> Reconstruction:
    """Refines the object by light, if requested and not done yet."""
    there = found.light is not None and object_source.are_there(out, found)
    if found.config.refinement == "light" and not there:
        bare = dataclasses.replace(found, light=None, report=None)
        found = dataclasses.replace(bare, light=_light(scene, out, bare, background))
        records.write(out, found)
    if found.light is not None:
        say(_describe_light(found.light))
    refined = found.light is not None and found.light.kept
    if found.index.source == "estimated" and found.index.error is None and not refined:
        # Without it, --ior may be given when the command is repeated.
        records.write(out, dataclasses.replace(found, index=None, light=None, report=None))
        _refuse_index(out, found.index.index)
    return found


def _has_surface(out: Path, found: Reconstruction, families: bool) -> bool:
    """Returns whether the surface is there, and was made with or without families, as wanted."""
    facts = found.geometry
    if facts is None or facts.families not in (None, families):
        return False
    return geometry_stage.is_there(out, facts)


def _takes_families(config: ReconstructionConfig, background: _Background) -> bool:
    """Returns whether outlines choose a family of shapes: in front of a field, light cannot."""
    if config.refinement != "light" or config.geometry in field_surface.NAMES:
        return False
    return background().model.config.backdrop is None


def _resolve_background(scene: Path, out: Path, config: ReconstructionConfig) -> Resolved:
    """Returns how the background is learned."""
    names = "space", "radius", "centre", "exposure", "seed"
    given: dict[str, Any] = {name: getattr(config, name) for name in names}
    return index_stage.resolve_background(scene, out / _INDEX_FOLDER, **given)


def _light(scene: Path, out: Path, found: Reconstruction, background: _Background) -> LightFacts:
    folder = out / _INDEX_FOLDER
    folder.mkdir(exist_ok=True)
    surface = index_stage.learn_backdrop(scene, folder, wanted=background())
    return light_stage.run(
        scene,
        object_source.read_mesh(out, found),
        found.index,
        surface,
        out / light_stage.FOLDER / found.geometry.mesh,
        seed=found.config.seed,
        gains=index_stage.read_gains(folder),
    )


def _describe_light(facts: LightFacts) -> str:
    if facts.before is None:
        return f"refinement by light: none, since {facts.remark}"
    line = f"refinement by light: error of {report.JUDGES[facts.split]} {facts.before:.4f} before"
    deviation = "" if facts.deviation is None else f" +- {facts.deviation:.4f}"
    if facts.kept:
        line += f", {facts.after:.4f} after; {facts.shape}, index {facts.index:.4f}{deviation}"
    else:
        line += f"; the surface from masks stays, since {facts.remark}"
    return f"{line}\nwarning: {facts.doubt}" if facts.doubt else line


def _describe_geometry(found: Reconstruction) -> str:
    facts = found.geometry
    lines = [
        f"geometry: {facts.faces} faces from {facts.masks} masks of {facts.width} x "
        f"{facts.height}; {', '.join(facts.stages) or 'not refined'}"
    ]
    lines += [f"  skipped {refused}" for refused in facts.refused]
    lines += [f"warning: {doubt}" for doubt in facts.warnings]
    return "\n".join(lines)


def _describe_report(found: Reconstruction) -> str:
    facts = found.report
    lines = [
        f"silhouettes: overlap {facts.mean_overlap:.4f}, least {min(facts.overlaps):.4f}, of "
        f"{len(facts.overlaps)} {facts.split} views"
    ]
    if facts.truth is not None:
        lines.append(
            f"true surface: Chamfer distance {facts.truth.chamfer:.3%} of the diameter, normals "
            f"{facts.truth.normal_error:.2f} degrees"
        )
    return "\n".join(lines)
