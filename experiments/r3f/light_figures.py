"""Draws what light has changed: pixels before and after, and the uncertainty of normals."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.spatial import KDTree

from experiments.figures.style import pyplot
from refref_jax.choices import Split
from refref_jax.data import scene_folder
from refref_jax.data.scene_folder import Frames
from refref_jax.geometry.cameras import image_rays
from refref_jax.geometry.rays import Rays
from refref_jax.geometry.surfaces import pack_meshes
from refref_jax.reconstruct import gauss_newton, photometry
from refref_jax.reconstruct.model_selection import Trial
from refref_jax.reconstruct.photometry import Backdrop
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
    trials = (before, after)
    for row, view in zip(axes, chosen, strict=True):
        panels = _panels(frames, int(view), images[view], masks[view], trials, surface, ends)
        for axis, panel in zip(row[:3], panels[:3], strict=True):
            axis.imshow(panel)
        for axis, panel in zip(row[3:5], panels[3:], strict=True):
            errors = axis.imshow(panel, vmin=0.0, vmax=_MOST_ERROR, cmap="magma")
        if deviations is not None:
            seen = _seen_deviations(frames, int(view), after, deviations)
            shown = row[5].imshow(seen, vmin=0.0, vmax=_MOST_DEVIATION, cmap="viridis")
    figure.colorbar(errors, ax=axes[:, 3:5], label="sRGB", shrink=0.8, aspect=40, pad=0.01)
    if deviations is not None:
        figure.colorbar(shown, ax=axes[:, 5], label="degrees", shrink=0.8, aspect=40, pad=0.01)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _panels(
    frames: Frames,
    view: int,
    image: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    trials: Sequence[Trial],
    surface: Backdrop,
    ends: Callable[[Rays], Float[np.ndarray, "rays 3"]],
) -> list[np.ndarray]:
    """Returns the photograph, the predictions, and their errors within the mask."""
    rays = image_rays(frames.cameras, view)
    flat = rays._replace(**{k: getattr(rays, k).reshape(-1, *s) for k, s in _SHAPES.items()})
    photograph = image.astype(np.float64) / 255.0
    predicted, opaque = [], ends(flat)
    for number, trial in enumerate(trials):
        traced = gauss_newton.traced_object(trial.model.pose(trial.fit.x))
        linear = photometry.predict(traced, surface, flat).linear
        if number > 0:  # the surface from masks has no opaque parts
            linear = np.where(np.isnan(opaque), linear, opaque)
        predicted.append(photometry.encode(linear).reshape(photograph.shape))
    errors = [
        np.where(mask, np.sqrt(np.mean((each - photograph) ** 2, axis=-1)), np.nan)
        for each in predicted
    ]
    return [photograph, *predicted, *errors]


_SHAPES = {"origins": (3,), "directions": (3,), "radii": ()}


def _seen_deviations(
    frames: Frames, view: int, trial: Trial, deviations: Float[np.ndarray, " normals"]
) -> Float[np.ndarray, "h w"]:
    """Returns the deviation of the normal that each pixel sees, NaN beside the object."""
    rays = image_rays(frames.cameras, view)
    first = find_first_surface(pack_meshes([trial.mesh]), rays)
    seen = np.full(first.distances.shape, np.nan)
    hit = np.isfinite(first.distances)
    if not hit.any():
        return seen
    part = trial.model.pose(trial.fit.x).parts[0]
    of_vertices = np.zeros(len(part.vertices))
    of_vertices[part.faces.ravel()] = deviations[part.normal_ids.ravel()]
    reach = np.where(hit, first.distances, 0.0)[..., None]
    points = (rays.origins + reach * rays.directions)[hit]
    seen[hit] = of_vertices[KDTree(part.vertices).query(points)[1]]
    return seen
