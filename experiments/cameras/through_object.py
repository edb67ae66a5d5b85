"""Refines the poses of views by all of their light, also that which an object of known place bends.

The object and the surface behind it are known, so that every pixel can be rendered: straight beside
the object, along the path tree through it. Each view has six unknowns, `(w, t)` as in `bundle`, and
is fitted by itself, by Gauss-Newton steps with robust errors and derivatives by differences; other
pixels of the view judge the result. What bent light adds to `refinement`: glass magnifies, and
a view may show little beside it.

The surface behind the object is solved for with the given poses, from pixels beside the object.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from experiments.cameras import bundle
from experiments.cameras.bundle import Prior, Views
from experiments.cameras.refinement import Photo
from refref_jax.geometry.cameras import Cameras, pixel_rays
from refref_jax.geometry.rays import Rays
from refref_jax.numerics import host_array
from refref_jax.reconstruct import photometry
from refref_jax.reconstruct.photometry import Backdrop, TracedObject

# Pixels of a view that are fitted, and as many that judge; half of them are in its mask.
_PIXELS = 2000

# Step of the differences in pixels, as the middle of the cameras moves in a view.
_DIFFERENCE = 0.05

STEPS = 4
"""Number of steps."""

# Scale of the robust errors as a multiple of the median one, and the least one, sRGB.
_SCALE, _LEAST_SCALE = 3.0, 0.01

# Share of the pixels of a view whose derivatives are the largest, which are left out.
_OUTLINES = 0.1

# Largest error of a judging pixel, sRGB.
_CAP = 0.3


class RefinedThrough(NamedTuple):
    """Result of `refine`.

    Attributes:
      poses: refined poses; as given in views whose judging pixels they do not explain better.
      corrections: `(w, t)` from given to refined poses; see `bundle`.
      before: mean robust error of the judging pixels of each view, sRGB, with the given poses.
      after: the same with the refined poses.
    """

    poses: Float[np.ndarray, "views 3 4"]
    corrections: Float[np.ndarray, "views 6"]
    before: Float[np.ndarray, " views"]
    after: Float[np.ndarray, " views"]

    def record(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Returns facts for `cameras.json`, and those of each view."""
        of_views = {"before": self.before, "after": self.after}
        return {"error_srgb": float(self.after.mean())}, of_views

    def describe(self) -> str:
        """Returns a few lines of text."""
        moved = np.count_nonzero(self.after < self.before)
        return (
            f"Views:   {len(self.poses)}, of which {moved} are explained better than before\n"
            f"Error:   {self.before.mean():.4f} sRGB before, {self.after.mean():.4f} after"
        )


class _Sampled(NamedTuple):
    """Pixels of all views, as many of each.

    Attributes:
      row: their rows.
      column: their columns.
      rgb: sRGB in `[0, 1]`.
    """

    row: Int[np.ndarray, "views pixels"]
    column: Int[np.ndarray, "views pixels"]
    rgb: Float[np.ndarray, "views pixels 3"]


def refine(
    views: Views,
    photos: Sequence[Photo],
    traced: TracedObject,
    surface: Backdrop,
    *,
    prior: Prior,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> RefinedThrough:
    """Refines the poses of views, each by itself.

    Args:
      views: cameras with the given poses.
      photos: their images, of one exposure, and masks.
      traced: the object, see `photometry.assemble`.
      surface: what is behind it.
      prior: standard deviations of the given poses.
      seed: seed of the draw of pixels.
      progress: function called with the number of steps done and their total.
    """
    generator = np.random.default_rng(seed)
    fitted, judges = (_sample(photos, generator) for _ in range(2))
    see = functools.partial(_errors, views, photos, traced, surface)
    scales = np.repeat([prior.rotation, prior.shift], 3)
    x, precision = np.zeros((len(photos), 6)), np.diag(scales**-2.0)
    for step in range(STEPS):
        progress(step, STEPS)
        errors = see(fitted, x)
        slope = functools.partial(_slope, see, fitted, x, errors, views)
        slopes = np.stack([slope(axis) for axis in range(6)], axis=-1)
        weights = (_weights(errors) * _is_smooth(slopes * scales))[..., None]
        matrix = np.einsum("vpci,vpcj->vij", weights[..., None] * slopes, slopes) + precision
        pull = np.einsum("vpci,vpc->vi", weights[..., None] * slopes, errors) + x @ precision
        x = x - np.linalg.solve(matrix, pull[..., None])[..., 0]
    before, after = (_robust(see(judges, each)) for each in (np.zeros_like(x), x))
    progress(STEPS, STEPS)
    better = after < before
    x = np.where(better[:, None], x, 0.0)
    found = bundle.corrected(views.poses, x)
    return RefinedThrough(found, x, before, np.where(better, after, before))


def _sample(photos: Sequence[Photo], generator: np.random.Generator) -> _Sampled:
    """Draws pixels of each view: half of them in its mask, if it has one."""
    rows, columns, colours = [], [], []
    for image, mask in photos:
        inside = np.zeros(image.shape[:2], bool) if mask is None else mask
        halves = [np.flatnonzero(each) for each in (inside, ~inside)]
        halves = [each for each in halves if len(each)]
        chosen = [generator.choice(each, _PIXELS // len(halves)) for each in halves]
        row, column = np.unravel_index(np.concatenate(chosen), image.shape[:2])
        rows.append(row)
        columns.append(column)
        colours.append(image[row, column] / 255.0)
    return _Sampled(np.stack(rows), np.stack(columns), np.stack(colours))


def _errors(
    views: Views,
    photos: Sequence[Photo],
    traced: TracedObject,
    surface: Backdrop,
    pixels: _Sampled,
    x: Float[np.ndarray, "views 6"],
) -> Float[np.ndarray, "views pixels 3"]:
    """Returns the errors of pixels in sRGB after corrections of the poses."""
    poses, rays = bundle.corrected(views.poses, x).astype(np.float32), []
    for view, (image, _) in enumerate(photos):
        height, width, _ = image.shape
        camera = Cameras(poses[view : view + 1], width, height, float(views.focals[view]))
        number = np.zeros(pixels.row.shape[1], np.int64)
        rays.append(pixel_rays(camera, number, pixels.row[view], pixels.column[view]))
    whole: Rays = jax.tree.map(lambda *each: host_array(np.concatenate(each)), *rays)
    seen = photometry.encode(photometry.predict(traced, surface, whole).linear)
    return seen.reshape(pixels.rgb.shape) - pixels.rgb


def _slope(
    see: Callable[..., Float[np.ndarray, "views pixels 3"]],
    pixels: _Sampled,
    x: Float[np.ndarray, "views 6"],
    errors: Float[np.ndarray, "views pixels 3"],
    views: Views,
    axis: int,
) -> Float[np.ndarray, "views pixels 3"]:
    """Returns the derivatives of errors by one correction of each view."""
    places = views.poses[..., 3]
    distance = np.linalg.norm(places - places.mean(axis=0), axis=-1) if axis >= 3 else 1.0
    length = _DIFFERENCE / views.focals * distance
    moved = x + length[:, None] * np.eye(6)[axis]
    return (see(pixels, moved) - errors) / length[:, None, None]


def _weights(errors: Float[np.ndarray, "views pixels 3"]) -> Float[np.ndarray, "views pixels"]:
    """Returns Geman-McClure weights over the variance, with the scale of each view."""
    size = np.sqrt(np.mean(errors**2, axis=-1))
    scale = np.maximum(_SCALE * np.median(size, axis=1, keepdims=True), _LEAST_SCALE)
    return (1.0 + (size / scale) ** 2) ** -2.0 / scale**2


def _is_smooth(slopes: Float[np.ndarray, "views pixels 3 6"]) -> Bool[np.ndarray, "views pixels"]:
    """Returns the pixels without the largest derivatives: those at outlines are not smooth."""
    size = np.sqrt(np.mean(slopes**2, axis=(2, 3)))
    return size <= np.quantile(size, 1.0 - _OUTLINES, axis=1, keepdims=True)


def _robust(errors: Float[np.ndarray, "views pixels 3"]) -> Float[np.ndarray, " views"]:
    size = np.sqrt(np.mean(errors**2, axis=-1))
    return np.mean(np.minimum(size, _CAP), axis=1)
