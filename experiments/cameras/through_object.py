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

# Step of the differences, pixels, of a point at the cameras' mean distance from their middle.
_DIFFERENCE = 0.05

STEPS = 4
"""Number of steps."""

# Scale of the robust errors as a multiple of the median one, and the least one, sRGB.
_SCALE, _LEAST_SCALE = 3.0, 0.01

# Share of the pixels of a view whose derivatives are the largest, which are left out.
_OUTLINES = 0.1

# Largest error of a judging pixel, sRGB.
_CAP = 0.3

# Share of the light of a pixel that must come from where the surface is seen, and that may be lost.
_COVERED, _DROPPED = 0.5, 0.3


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
        of_views = {"error_before_srgb": self.before, "error_after_srgb": self.after}
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
      row: row of each pixel.
      column: column of each pixel.
      rgb: sRGB of each pixel, in `[0, 1]`.
      usable: whether the rendering with the given poses is known: little light was dropped, and
        most of it comes from where pixels beside the object show the surface behind it.
    """

    row: Int[np.ndarray, "views pixels"]
    column: Int[np.ndarray, "views pixels"]
    rgb: Float[np.ndarray, "views pixels 3"]
    usable: Bool[np.ndarray, "views pixels"]


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
      surface: backdrop behind it.
      prior: standard deviations of the given poses.
      seed: seed of the draw of pixels.
      progress: function called with the number of steps done and their total.

    Raises:
      ValueError: if all cameras are at one place.
    """
    distance = bundle.mean_distance(views)
    if not distance > 0.0:
        raise ValueError("All cameras are at one place. Give a scene with views from several.")
    generator = np.random.default_rng(seed)
    fitted, judges = (
        each._replace(usable=_usable(views, photos, traced, surface, each))
        for each in _sample(photos, generator)
    )
    see = functools.partial(_errors, views, photos, traced, surface)
    scales = np.repeat([prior.rotation, prior.shift], 3)
    x, precision = np.zeros((len(photos), 6)), np.diag(scales**-2.0)
    for step in range(STEPS):
        progress(step, STEPS)
        errors = see(fitted, x)
        lengths = _DIFFERENCE / views.focals[:, None] * np.repeat([1.0, distance], 3)
        slope = functools.partial(_slope, see, fitted, x, errors, lengths)
        slopes = np.stack([slope(axis) for axis in range(6)], axis=-1)
        weights = (_weights(errors, fitted.usable) * _is_smooth(slopes * scales))[..., None]
        matrix = np.einsum("vpci,vpcj->vij", weights[..., None] * slopes, slopes) + precision
        pull = np.einsum("vpci,vpc->vi", weights[..., None] * slopes, errors) + x @ precision
        x = x - np.linalg.solve(matrix, pull[..., None])[..., 0]
    before, after = (_robust(see(judges, each), judges.usable) for each in (np.zeros_like(x), x))
    progress(STEPS, STEPS)
    better = after < before
    x = np.where(better[:, None], x, 0.0)
    found = bundle.corrected(views.poses, x)
    return RefinedThrough(found, x, before, np.where(better, after, before))


def _sample(photos: Sequence[Photo], generator: np.random.Generator) -> tuple[_Sampled, _Sampled]:
    """Draws pixels of each view twice, none in both: half of them in its mask, if it has one."""
    drawn: tuple[list, list] = ([], [])
    for image, mask in photos:
        inside = np.zeros(image.shape[:2], bool) if mask is None else mask
        every = (generator.permutation(np.flatnonzero(each)) for each in (inside, ~inside))
        halves = [each for each in every if len(each) > 1]
        for number, chosen in enumerate(drawn):
            some = [np.resize(each[number::2], _PIXELS // len(halves)) for each in halves]
            row, column = np.unravel_index(np.concatenate(some), image.shape[:2])
            chosen.append((row, column, image[row, column] / 255.0, np.ones(len(row), bool)))
    fitted, judges = (_Sampled(*map(np.stack, zip(*each, strict=True))) for each in drawn)
    return fitted, judges


def _usable(
    views: Views, photos: Sequence[Photo], traced: TracedObject, surface: Backdrop, pixels: _Sampled
) -> Bool[np.ndarray, "views pixels"]:
    """Returns which pixels can be rendered with the given poses; see `_Sampled`."""
    rays = _rays(views.poses, views, photos, pixels)
    seen = photometry.predict(traced, surface._replace(mips=surface.coverage), rays)
    known = (seen.linear.mean(axis=1) > _COVERED) & (seen.dropped < _DROPPED)
    return known.reshape(pixels.row.shape)


def _rays(
    poses: Float[np.ndarray, "views 3 4"], views: Views, photos: Sequence[Photo], pixels: _Sampled
) -> Rays:
    """Returns the rays of pixels with given poses, view by view."""
    rays, poses = [], poses.astype(np.float32)
    for view, (image, _) in enumerate(photos):
        height, width, _ = image.shape
        camera = Cameras(poses[view : view + 1], width, height, float(views.focals[view]))
        number = np.zeros(pixels.row.shape[1], np.int64)
        rays.append(pixel_rays(camera, number, pixels.row[view], pixels.column[view]))
    return jax.tree.map(lambda *each: host_array(np.concatenate(each)), *rays)


def _errors(
    views: Views,
    photos: Sequence[Photo],
    traced: TracedObject,
    surface: Backdrop,
    pixels: _Sampled,
    x: Float[np.ndarray, "views 6"],
) -> Float[np.ndarray, "views pixels 3"]:
    """Returns the errors of pixels in sRGB after corrections of the poses."""
    rays = _rays(bundle.corrected(views.poses, x), views, photos, pixels)
    seen = photometry.encode(photometry.predict(traced, surface, rays).linear)
    return seen.reshape(pixels.rgb.shape) - pixels.rgb


def _slope(
    see: Callable[..., Float[np.ndarray, "views pixels 3"]],
    pixels: _Sampled,
    x: Float[np.ndarray, "views 6"],
    errors: Float[np.ndarray, "views pixels 3"],
    lengths: Float[np.ndarray, "views 6"],
    axis: int,
) -> Float[np.ndarray, "views pixels 3"]:
    """Returns the derivatives of errors by one correction of each view."""
    moved = x + lengths * np.eye(6)[axis]
    return (see(pixels, moved) - errors) / lengths[:, axis, None, None]


def _weights(
    errors: Float[np.ndarray, "views pixels 3"], usable: Bool[np.ndarray, "views pixels"]
) -> Float[np.ndarray, "views pixels"]:
    """Returns Geman-McClure weights over the variance, with the scale of each view."""
    size = np.sqrt(np.mean(errors**2, axis=-1))
    median = np.median(np.where(usable, size, 0.0), axis=1, keepdims=True)
    scale = np.maximum(_SCALE * median, _LEAST_SCALE)
    return usable * (1.0 + (size / scale) ** 2) ** -2.0 / scale**2


def _is_smooth(slopes: Float[np.ndarray, "views pixels 3 6"]) -> Bool[np.ndarray, "views pixels"]:
    """Returns the pixels without the largest derivatives: those at outlines are not smooth."""
    size = np.sqrt(np.mean(slopes**2, axis=(2, 3)))
    return size <= np.quantile(size, 1.0 - _OUTLINES, axis=1, keepdims=True)


def _robust(
    errors: Float[np.ndarray, "views pixels 3"], usable: Bool[np.ndarray, "views pixels"]
) -> Float[np.ndarray, " views"]:
    """Returns the mean capped error of the usable pixels of each view; 0 if there are none."""
    size = np.minimum(np.sqrt(np.mean(errors**2, axis=-1)), _CAP)
    return np.sum(usable * size, axis=1) / np.maximum(usable.sum(axis=1), 1)
