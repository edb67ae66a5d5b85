"""Draws what light has changed: pixels before and after, and the uncertainty of normals."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.spatial import KDTree

from experiments.figures.style import pyplot
from refref_jax.choices import Split
from refref_jax.compilation import at_once
from refref_jax.data import scene_folder
from refref_jax.geometry.cameras import image_rays
from refref_jax.geometry.rays import Rays
from refref_jax.geometry.surfaces import pack_meshes
from refref_jax.reconstruct import gauss_newton, photometry
from refref_jax.reconstruct.model_selection import Trial
from refref_jax.reconstruct.photometry import Backdrop, TracedObject
from refref_jax.render.images import find_first_surface

# Rows of the figure, and largest error and deviation that it distinguishes, in sRGB and degrees.
_ROWS, _MOST_ERROR, _MOST_DEVIATION = 3, 0.2, 0.5


def draw(
    path: Path,
    scene: Path,
    split: Split,
    before: Trial,
    after: Trial,
    surface: Backdrop,
    deviations: Float[np.ndarray, " normals"] | None,
    ends: Callable[[Rays], Float[np.ndarray, "rays 3"]],
    *,
    names: tuple[str, str] = ("from masks", "by light"),
) -> None:
    """Draws views: the photograph, what both surfaces predict, their errors, and the uncertainty.

    Args:
      path: file to write.
      scene: folder of the scene.
      split: split of the views.
      before: the surface from masks.
      after: the chosen one.
      surface: backdrop.
      deviations: standard deviation of each normal of the chosen surface, degrees; `None` if light
        has not determined them.
      ends: function of rays that returns the linear RGB of the opaque part that each meets first,
        NaN without any.
      names: names of both surfaces.
    """
    frames, masks = scene_folder.read_object_views(scene_folder.read_frames(scene, split))
    count = len(frames.names)
    chosen = np.unique(np.linspace(0, count - 1, min(_ROWS, count)).astype(int))
    images = scene_folder.read_images(frames)
    titles = ["photograph", *names, "error before", "error after"]
    titles += [] if deviations is None else ["normals ±"]
    figure, axes = pyplot.subplots(
        len(chosen),
        len(titles),
        figsize=(12.5, 2.1 * len(chosen) + 0.3),
        squeeze=False,
        layout="constrained",
    )
    for axis in axes.flat:
        axis.axis("off")
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=9)
    objects = at_once(lambda trial: gauss_newton.traced_object(trial.candidate), (before, after))
    look = None if deviations is None else _deviations_seen(after, deviations)
    for row, view in zip(axes, chosen, strict=True):
        rays = image_rays(frames.cameras, int(view))
        panels = _panels(rays, images[view], masks[view], objects, surface, ends)
        for axis, panel in zip(row[:3], panels[:3], strict=True):
            axis.imshow(panel)
        for axis, panel in zip(row[3:5], panels[3:], strict=True):
            errors = axis.imshow(panel, vmin=0.0, vmax=_MOST_ERROR, cmap="magma")
        if look is not None:
            shown = row[5].imshow(look(rays), vmin=0.0, vmax=_MOST_DEVIATION, cmap="viridis")
    figure.colorbar(errors, ax=axes[:, 3:5], label="sRGB", shrink=0.8, aspect=40, pad=0.01)
    if look is not None:
        figure.colorbar(shown, ax=axes[:, 5], label="degrees", shrink=0.8, aspect=40, pad=0.01)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _panels(
    rays: Rays,
    image: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    objects: Sequence[TracedObject],
    surface: Backdrop,
    ends: Callable[[Rays], Float[np.ndarray, "rays 3"]],
) -> list[np.ndarray]:
    """Returns the photograph, the predictions, and their errors within the mask."""
    flat = rays._replace(**{k: getattr(rays, k).reshape(-1, *s) for k, s in _SHAPES.items()})
    photograph = image.astype(np.float64) / 255.0
    opaque = ends(flat)
    before, after = at_once(lambda each: photometry.predict(each, surface, flat).linear, objects)
    after = np.where(np.isnan(opaque), after, opaque)  # the surface from masks has no opaque parts
    predicted = [photometry.encode(each).reshape(photograph.shape) for each in (before, after)]
    errors = [
        np.where(mask, np.sqrt(np.mean((each - photograph) ** 2, axis=-1)), np.nan)
        for each in predicted
    ]
    return [photograph, *predicted, *errors]


_SHAPES = {"origins": (3,), "directions": (3,), "radii": ()}


def _deviations_seen(
    trial: Trial, deviations: Float[np.ndarray, " normals"]
) -> Callable[[Rays], Float[np.ndarray, "h w"]]:
    """Returns a function of rays: the deviation of the normal that each sees, NaN if none."""
    part = trial.candidate.parts[0]
    surfaces, nearest = pack_meshes([trial.mesh]), KDTree(part.vertices)
    of_vertices = np.zeros(len(part.vertices))
    of_vertices[part.faces.ravel()] = deviations[part.normal_ids.ravel()]

    def look(rays: Rays) -> Float[np.ndarray, "h w"]:
        distances = find_first_surface(surfaces, rays).distances
        seen, hit = np.full(distances.shape, np.nan), np.isfinite(distances)
        if hit.any():
            reach = np.where(hit, distances, 0.0)[..., None]
            points = (rays.origins + reach * rays.directions)[hit]
            seen[hit] = of_vertices[nearest.query(points)[1]]
        return seen

    return look
