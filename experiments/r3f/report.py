"""Writes a report with figures, measured on held-out views: the last stage of R3F.

The views are those of the test split, otherwise of the validation split, otherwise the training
views. If the scene has its own meshes and they may be read, the surface is compared with the
outermost of them.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from experiments.cli import app
from experiments.figures import cut_open
from experiments.r3f import object_source, report_figures
from experiments.r3f.records import (
    DistanceFacts,
    IndexFacts,
    PartFacts,
    Reconstruction,
    ReportFacts,
)
from experiments.r3f.report_figures import Outline, SurfaceView, Window
from refref_jax import atomic_files
from refref_jax.data import SceneError, mesh_queries, meshes, scene_folder
from refref_jax.data.meshes import MeshPart
from refref_jax.data.scene_assembly import shaded_mesh
from refref_jax.data.scene_folder import Frames
from refref_jax.geometry.cameras import Cameras, image_rays
from refref_jax.geometry.rays import Rays
from refref_jax.geometry.surfaces import pack_meshes
from refref_jax.geometry.triangle_meshes import Mesh, diameter, join, volume
from refref_jax.optics.interface_rules import NO_PARENT
from refref_jax.reconstruct.masks import overlaps
from refref_jax.reconstruct.mesh_distance import compare_meshes, signed_distance, silhouettes
from refref_jax.render.images import FirstSurface, find_first_surface

FOLDER = "pictures"
FILE = "report.md"
_INSIDE = "inside.png"

_ROWS = 3

# Rows of pixels of an image of the surface, and the margin around the object as a share of it.
_HEIGHT = 300
_MARGIN = 0.2

_SPLITS = ("test", "val", "train")

_SEEN_ON = {
    "test": "test views, which were not used in the reconstruction",
    "val": "validation views, which were not fitted, but chose the shape",
    "train": "training views, which were used in the reconstruction",
}


JUDGES = {"val": "validation views", "train": "training views that were not fitted"}
"""Views that judge the refinement by light, by their split."""


class _Truth(NamedTuple):
    """The scene's own parts and their outermost surface, or the reason why these are missing."""

    mesh: Mesh | None
    remark: str
    parts: tuple[MeshPart, ...] = ()


def run(scene: Path, out: Path, found: Reconstruction, compare: bool) -> ReportFacts:
    """Measures a reconstruction and writes `pictures` and `report.md`.

    Args:
      scene: folder of the scene.
      out: folder of the reconstruction.
      found: results of the reconstruction.
      compare: whether to compare with the scene's own meshes.
    """
    mesh = object_source.read_mesh(out, found)
    split, frames = judging_frames(scene)
    outlines = _outlines(mesh, frames)
    truth = _read_truth(scene) if compare else _Truth(None, "The scene's meshes were not read.")
    facts = ReportFacts(
        split=split,
        names=frames.names,
        overlaps=tuple(outline.overlap for outline in outlines),
        truth=truth.mesh and DistanceFacts(*compare_meshes(mesh, truth.mesh)),
        remark=truth.remark,
    )
    parts = object_source.read_parts(out, found)
    with atomic_files.written_folder(out / FOLDER) as folder:
        if len(parts) > 1:
            cut_open.write(folder / _INSIDE, parts, truth.parts)
        report_figures.draw_overlaps(folder / "overlap.png", outlines)
        report_figures.draw_errors(folder / "iou.png", outlines)
        report_figures.draw_surface(
            folder / "surface.png", _surface_views(mesh, truth.mesh, frames)
        )
    with atomic_files.written_file(out / FILE) as page:
        page.write_text(markdown(out, found, facts), encoding="utf-8")
    return facts


def is_there(out: Path) -> bool:
    """Returns whether the files of the report exist."""
    return (out / FOLDER).is_dir() and (out / FILE).is_file()


def judging_frames(scene: Path) -> tuple[str, Frames]:
    """Returns the views that a report measures, and their split.

    Held-out splits come first; the first split with masks is used. Views without the object are
    left out.
    """
    for split in _SPLITS[:-1]:
        if (scene / f"transforms_{split}.json").is_file():
            frames = scene_folder.read_frames(scene, split)
            if frames.masks is not None and scene_folder.read_masks(frames).any():
                return split, scene_folder.read_object_views(frames)[0]
    frames = scene_folder.read_frames(scene, _SPLITS[-1])
    return _SPLITS[-1], scene_folder.read_object_views(frames)[0]


def _outlines(mesh: Mesh, frames: Frames) -> list[Outline]:
    masks, images = scene_folder.read_masks(frames), scene_folder.read_images(frames)
    seen = silhouettes(mesh, frames.cameras)
    shares = overlaps(seen, masks)
    return [
        Outline(*view, overlap=float(share))
        for *view, share in zip(frames.names, images, masks, seen, shares, strict=True)
    ]


def _read_truth(scene: Path) -> _Truth:
    """Returns the outermost of the scene's meshes as one mesh."""
    try:
        parts = meshes.read_meshes(scene)
    except SceneError as error:
        return _Truth(None, f"The scene's meshes could not be read: {error}")
    if not parts:
        return _Truth(None, "The scene has no meshes to compare with.")
    parents = mesh_queries.find_containment(parts).parents
    outer = [part for part, parent in zip(parts, parents, strict=True) if parent == NO_PARENT]
    joined = join([shaded_mesh(part) for part in outer])
    names = ", ".join(f"{part.name}.ply" for part in outer)
    inner = len(parts) - len(outer)
    within = f"; {inner} more within {'it' if len(outer) == 1 else 'them'}" if inner else ""
    return _Truth(joined, f"Compared with {names}{within}.", tuple(parts))


def _surface_views(mesh: Mesh, truth: Mesh | None, frames: Frames) -> list[SurfaceView]:
    """Renders the surface from a few cameras, in windows around the object."""
    chosen = np.unique(np.linspace(0, len(frames.names) - 1, _ROWS).astype(int)).tolist()
    images = scene_folder.read_images(
        frames._replace(images=tuple(frames.images[i] for i in chosen))
    )
    cameras = _resized(frames.cameras, _HEIGHT)
    ours = pack_meshes([mesh])
    theirs = None if truth is None else pack_meshes([truth])
    views = []
    for i, image in zip(chosen, images, strict=True):
        rays = image_rays(cameras, i)
        first = find_first_surface(ours, rays)
        view = SurfaceView(frames.names[i], image, _in_camera(first.normals, cameras, i))
        if truth is not None:
            view = view._replace(
                true_normals=_in_camera(find_first_surface(theirs, rays).normals, cameras, i),
                distance=_distances(first, rays, truth),
            )
        views.append(view)
    seen = [np.any(view.normals != 0.0, axis=-1) for view in views]
    around = report_figures.windows_around(seen, margin=_MARGIN)
    return [_within(view, window) for view, window in zip(views, around, strict=True)]


def _distances(first: FirstSurface, rays: Rays, truth: Mesh) -> Float[np.ndarray, "h w"]:
    """Returns the distance of ray hits from the true surface, in percent of its diameter."""
    seen = np.isfinite(first.distances)
    reach = np.where(seen, first.distances, 0.0)[..., None]
    points = (rays.origins + reach * rays.directions).astype(np.float64)
    distances = np.full(seen.shape, np.nan)
    distances[seen] = 100.0 * signed_distance(truth)(points[seen]) / diameter(truth.vertices)
    return distances


def _within(view: SurfaceView, window: Window) -> SurfaceView:
    panels_of_view = view._asdict()
    name = panels_of_view.pop("name")
    parts = (
        None if panel is None else report_figures.crop(panel, window)
        for panel in panels_of_view.values()
    )
    return SurfaceView(name, *parts)


def _in_camera(
    normals: Float[np.ndarray, "h w 3"], cameras: Cameras, camera: int
) -> Float[np.ndarray, "h w 3"]:
    return normals @ cameras.poses[camera][:, :3]


def _resized(cameras: Cameras, height: int) -> Cameras:
    """Returns cameras with the same poses and another image height."""
    scale = height / cameras.height
    return cameras._replace(
        width=round(scale * cameras.width), height=height, focal=scale * cameras.focal
    )


def markdown(out: Path, found: Reconstruction, facts: ReportFacts) -> str:
    """Returns the text of a report.

    Args:
      out: folder of the reconstruction; its figures are expected in `pictures`.
      found: results of the geometry and the index.
      facts: measurements of the report.
    """
    geometry = found.geometry
    parts = [
        f"# The object of {found.scene}, reconstructed",
        f"From {geometry.masks} masks of {geometry.width} x {geometry.height} pixels and their "
        f"poses; {_of_index(found.index)}.",
        *(f"**Warning:** {doubt}" for doubt in geometry.warnings),
        _table(out, found, facts),
        f"## Silhouettes\n\nMeasured on {len(facts.overlaps)} {_SEEN_ON[facts.split]}. IoU is the "
        "number of pixels in both mask and silhouette over the number in either.",
        "![Masks and silhouettes](pictures/overlap.png)",
        "![Errors of the silhouettes](pictures/iou.png)",
        f"## Surface\n\n{_of_truth(facts)}",
        "![Normals, and the distance to the true surface](pictures/surface.png)",
        *_inside(found),
        *_pictures_of_index(out),
        *_of_light(found),
        "## Options\n\n" + _making(found),
        "## Next steps\n\n```bash\n"
        + app.shell("train", "--scene=SCENE", "--reconstruction=OUT", "--out=RUN")
        + "\n```\n\nwhere SCENE is the scene's folder and OUT is this folder.",
    ]
    return "\n\n".join(parts) + "\n"


def _of_index(index: IndexFacts) -> str:
    if index.source == "given":
        return "the index of refraction was given"
    return "the index of refraction was estimated from their images"


def _table(out: Path, found: Reconstruction, facts: ReportFacts) -> str:
    index, mesh = object_source.index_facts(found), object_source.read_mesh(out, found)
    error = "" if index.error is None else f" ± {index.error:.4f} (one standard deviation)"
    surface = object_source.surface_file(out, found).relative_to(out)
    rows = [
        ("surface", f"[{surface.name}]({surface}), {len(mesh.faces):,} triangles"),
        (
            "diameter, volume",
            f"{diameter(mesh.vertices):.3f}, {volume(mesh.vertices, mesh.faces):.3f} (world units)",
        ),
        ("index of refraction", f"**{index.index:.4f}**{error}, {index.source}"),
        (
            "silhouettes: mean IoU, least",
            f"**{facts.mean_overlap:.4f}**, {min(facts.overlaps):.4f}",
        ),
    ]
    for part in found.light.parts[1:] if found.light is not None else ():
        where = "inside" if part.radiance is None else "opaque"
        rows.append((f"{where}: [{part.mesh}](light/{part.mesh})", _of_inside(part)))
    if found.light is not None and found.light.before is not None:
        light = found.light
        after = f"{light.after:.4f} as a {light.shape}" if light.kept else "not refined"
        rows.append((f"error of {JUDGES[light.split]}, sRGB", f"{light.before:.4f}; {after}"))
    if facts.truth is not None:
        truth = facts.truth
        rows += [
            (
                "distance to the truth: mean (Chamfer), largest",
                f"**{truth.chamfer:.3%}**, {truth.furthest:.2%} of the diameter",
            ),
            (
                "angle to the true normals: mean, 99 of 100 below",
                f"**{truth.normal_error:.2f}°**, {truth.normal_error_99:.1f}°",
            ),
        ]
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)])


def _of_inside(part: PartFacts) -> str:
    def numbers(colour: tuple[float, ...]) -> str:
        return " ".join(f"{channel:.3f}" for channel in colour)

    if part.radiance is not None:
        return f"radiance {numbers(part.radiance)}, linear RGB"
    tint = "" if part.tint is None else f", tint {numbers(part.tint)}"
    absorbs = f", absorption {numbers(part.absorption)} per unit" * any(part.absorption)
    return f"index {part.index:.4f}{tint}{absorbs}"


def _of_truth(facts: ReportFacts) -> str:
    shown = (
        "Masks do not show cavities, dents that no line of sight grazes, or the inside of glass; "
        "only light does. Normals are in the camera's frame: right is red, up is green, towards "
        "the camera is blue."
    )
    if facts.truth is None:
        return f"{facts.remark} {shown}"
    return (
        f"{facts.remark} {shown} Distances are those of the visible surface to the closest point "
        "of the true one."
    )


def _of_light(found: Reconstruction) -> list[str]:
    """Returns the section on the refinement by light."""
    light = found.light
    if light is None:
        return []
    if light.before is None:
        return [f"## Refinement by light\n\nThere was none, since {light.remark}."]
    lines = [
        "| shape | unknowns | error, sRGB | worse than the best | index | steps |",
        "|---|---|---|---|---|---|",
    ]
    for trial in light.trials:
        name = f"**{trial.shape}**" if trial.shape == light.shape else trial.shape
        lines.append(
            f"| {name} | {trial.unknowns} | {trial.error:.4f} | {trial.worse:.4f} ± "
            f"{trial.worse_error:.4f} | {trial.index:.4f} ± {trial.deviation:.4f} | {trial.steps} |"
        )
    chosen = (
        f"The smallest shape that is not worse than the best by two standard errors is the "
        f"**{light.shape}**. Light has not determined {light.undetermined:.0%} of its normals to "
        "half a degree; these keep the prior."
    )
    if not light.kept:
        chosen = f"The surface from masks stays as it is, since {light.remark}."
    return [
        f"## Refinement by light\n\nShapes fitted to pixels of the training views, judged by "
        f"{JUDGES[light.split]}; deviations are one standard error.",
        "\n".join(lines),
        chosen,
        *([f"**Warning:** {light.doubt}"] if light.doubt else []),
        "![Pixels before and after, and the uncertainty of the normals](light/errors.png)",
    ]


def _inside(found: Reconstruction) -> list[str]:
    """Returns the section on what is inside the object, if something is."""
    if found.light is None or len(found.light.parts) < 2:
        return []
    return [
        f"## Inside\n\nThe object is a {found.light.shape}. Its nearer half is removed. Cut glass "
        "is grey, opaque parts are brown; where there is air its walls are seen.",
        f"![The object, cut open]({FOLDER}/{_INSIDE})",
    ]


def _pictures_of_index(out: Path) -> list[str]:
    found = sorted((out / "index").glob("*.png"))
    return ["## Index of refraction"] * bool(found) + [
        f"![{path.stem.replace('_', ' ')}](index/{path.name})" for path in found
    ]


def _making(found: Reconstruction) -> str:
    config, geometry = found.config, found.geometry
    lines = [
        f"- `--geometry={config.geometry} --resolution={config.resolution} "
        f"--outliers={config.outliers} --refinement={config.refinement} --seed={config.seed}`"
        + (f" `--ior={config.index:g}`" if config.index is not None else "")
        + (f" `--background={config.space}`" if config.space is not None else "")
        + (f" `--radius={config.radius:g}`" if config.radius is not None else "")
        + (f" around {config.centre}" if config.centre is not None else ""),
        f"- refined: {', '.join(geometry.stages) or 'nothing to do'}",
        *(f"- skipped {refused}" for refused in geometry.refused),
    ]
    return "\n".join(lines)
