"""The last stage of R3F: what it came to, measured on views that it has not seen, and pictures.

Views of the test split are looked at, else of the validation split, else those that it was made
from. Where the scene has meshes of its own, and they may be looked at, the surface is compared with
the outermost of them.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from experiments.r3f import (
    body,
    overlap_pictures,
    pages,
    surface_pictures,
    windows,
)
from experiments.r3f.overlap_pictures import Outline
from experiments.r3f.records import DistanceFacts, Reconstruction, ReportFacts
from experiments.r3f.surface_pictures import SurfaceView
from experiments.r3f.windows import Window
from refref_jax import atomic_files
from refref_jax.data import containment, local_layout, meshes
from refref_jax.data.errors import SceneError
from refref_jax.data.local_layout import Frames
from refref_jax.geometry.cameras import Cameras, image_rays
from refref_jax.geometry.rays import Rays
from refref_jax.geometry.surface_build import build_surfaces
from refref_jax.geometry.surfaces import Surfaces
from refref_jax.optics.interface_rules import NO_PARENT
from refref_jax.reconstruct.closest import signed_distance
from refref_jax.reconstruct.comparison import compare_meshes, silhouettes
from refref_jax.reconstruct.silhouettes import overlaps
from refref_jax.reconstruct.triangles import Mesh, diameter, join
from refref_jax.render.first_surface import FirstSurface, find_first_surface

FOLDER = "pictures"
FILE = "report.md"

_ROWS = 3

# Rows of pixels of a whole view of the surface, and what is shown around it, as a share of it.
_HEIGHT = 300
_MARGIN = 0.2

_SPLITS = ("test", "val", "train")


class _Truth(NamedTuple):
    """The scene's own outermost surface, or why it is not looked at."""

    mesh: Mesh | None
    remark: str


def run(scene: Path, out: Path, found: Reconstruction, compare: bool) -> ReportFacts:
    """Measures a reconstruction, and writes `pictures` and `report.md`.

    Args:
      scene: its folder.
      out: where it is.
      found: what it came to.
      compare: whether the scene's own meshes may be looked at.
    """
    mesh = body.read_mesh(out, found)
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
    with atomic_files.written_folder(out / FOLDER) as folder:
        overlap_pictures.draw_overlaps(folder / "overlap.png", outlines)
        overlap_pictures.draw_errors(folder / "iou.png", outlines)
        surface_pictures.draw_surface(
            folder / "surface.png", _surface_views(mesh, truth.mesh, frames)
        )
    with atomic_files.written_file(out / FILE) as page:
        page.write_text(pages.markdown(out, found, facts), encoding="utf-8")
    return facts


def is_there(out: Path) -> bool:
    """Returns whether the report is where it was written."""
    return (out / FOLDER).is_dir() and (out / FILE).is_file()


def judging_frames(scene: Path) -> tuple[str, Frames]:
    """Returns the views that a report looks at, and their split.

    They are of the first split that has masks, those that nothing was made from first.
    """
    for split in _SPLITS[:-1]:
        if (scene / f"transforms_{split}.json").is_file():
            frames = local_layout.read_frames(scene, split)
            if frames.masks is not None:
                return split, frames
    return _SPLITS[-1], local_layout.read_frames(scene, _SPLITS[-1])


def _outlines(mesh: Mesh, frames: Frames) -> list[Outline]:
    masks, images = local_layout.read_masks(frames), local_layout.read_images(frames)
    seen = silhouettes(mesh, frames.cameras)
    shares = overlaps(seen, masks)
    return [
        Outline(*view, overlap=float(share))
        for *view, share in zip(frames.names, images, masks, seen, shares, strict=True)
    ]


def _read_truth(scene: Path) -> _Truth:
    """Returns the outermost of the scene's meshes as one."""
    try:
        parts = meshes.read_meshes(scene)
    except SceneError as error:
        return _Truth(None, f"The scene's meshes could not be read: {error}")
    if not parts:
        return _Truth(None, "The scene has no meshes to compare with.")
    parents = containment.find_containment(parts).parents
    outer = [part for part, parent in zip(parts, parents, strict=True) if parent == NO_PARENT]
    joined = join([body.mesh_of(part) for part in outer])
    names = ", ".join(f"{part.name}.ply" for part in outer)
    inner = len(parts) - len(outer)
    within = f"; {inner} more within {'it' if len(outer) == 1 else 'them'}" if inner else ""
    return _Truth(joined, f"Compared with {names}{within}.")


def _surface_views(mesh: Mesh, truth: Mesh | None, frames: Frames) -> list[SurfaceView]:
    """Returns what a few cameras see, in windows around the object."""
    chosen = np.unique(np.linspace(0, len(frames.names) - 1, _ROWS).astype(int)).tolist()
    images = local_layout.read_images(
        frames._replace(images=tuple(frames.images[i] for i in chosen))
    )
    cameras = _resized(frames.cameras, _HEIGHT)
    ours = _surfaces(mesh)
    theirs = None if truth is None else _surfaces(truth)
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
    around = windows.around(seen, margin=_MARGIN)
    return [_within(view, window) for view, window in zip(views, around, strict=True)]


def _distances(first: FirstSurface, rays: Rays, truth: Mesh) -> Float[np.ndarray, "h w"]:
    """Returns how far from the truth what rays meet is, in percent of its diameter."""
    seen = np.isfinite(first.distances)
    reach = np.where(seen, first.distances, 0.0)[..., None]
    points = (rays.origins + reach * rays.directions).astype(np.float64)
    distances = np.full(seen.shape, np.nan)
    distances[seen] = 100.0 * signed_distance(truth)(points[seen]) / diameter(truth.vertices)
    return distances


def _within(view: SurfaceView, window: Window) -> SurfaceView:
    pictures_of_view = view._asdict()
    name = pictures_of_view.pop("name")
    parts = (
        None if picture is None else windows.cut(picture, window)
        for picture in pictures_of_view.values()
    )
    return SurfaceView(name, *parts)


def _surfaces(mesh: Mesh) -> Surfaces:
    owners = np.zeros(len(mesh.faces), np.int64)
    return build_surfaces(mesh.vertices[mesh.faces], mesh.normals, owners)


def _in_camera(
    normals: Float[np.ndarray, "h w 3"], cameras: Cameras, camera: int
) -> Float[np.ndarray, "h w 3"]:
    return normals @ cameras.poses[camera][:, :3]


def _resized(cameras: Cameras, height: int) -> Cameras:
    """Returns cameras of the same views with as many rows of pixels."""
    scale = height / cameras.height
    return cameras._replace(
        width=round(scale * cameras.width), height=height, focal=scale * cameras.focal
    )
