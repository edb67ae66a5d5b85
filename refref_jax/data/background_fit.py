"""Measures the size of a background from depth maps (NumPy only).

Scenes of the data set do not state how far away their background is. Their depth maps do: a pixel
beside the object with planar depth `z` shows the point `p = o + z d`, where `o` is the position of
the camera and `d` the pixel's direction with unit depth along the camera's axis. The background is

    cube      max_i |p_i - c_i| = h      half edge h
    sphere    |p - c| = h                radius h

around the origin (`c = 0`), or around a centre that is fitted as well. Size and centre are fitted
to the depths by least squares with Tukey's weights, after Beaton and Tukey, "The fitting of power
series, meaning polynomials, illustrated on band-spectroscopic data" (1974).

8-bit maps are inverted, saturated and rounded (see `image_files.read_depth`). Saturated values are
left out. Rounding causes an error of the depth that is uniform within a step and has no bias; a
deviation of less than a step is never an outlier. The errors of neighbouring pixels are correlated,
so the standard error is estimated between images (a sandwich estimate with one cluster per image).

The background is opaque and encloses the cameras, so a point that is nearer to the origin than some
camera must be on an object. Such points are left out, even where there are no masks.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from refref_jax.choices import Space, Split
from refref_jax.data import image_files, scene_folder, scene_names
from refref_jax.data.scene_properties import SceneProperties
from refref_jax.geometry.cameras import Cameras, planar_directions

Kind = Literal["cube", "sphere"]
"""Shape of a background that has a size."""

# Maximum numbers of images, and of pixels in each, that a fit uses.
_MOST_IMAGES = 60
_MOST_PIXELS = 4000

# Minimum number of pixels of a fit, and the part of them that must agree with the shape: within a
# step of an 8-bit map, and this deviation relative to the size.
_FEWEST_PIXELS = 200
_LEAST_AGREEMENT = 0.8
_AGREES = 0.01

# Maximum standard error of a size that is used, relative to the size.
_LARGEST_ERROR = 0.01

# Images are split into parts if there are fewer, to have enough clusters for a standard error.
_FEWEST_CLUSTERS = 10
_PARTS = 3

_ITERATIONS = 50
_CONVERGED = 1e-9

# Directions along a face are this far off it, to divide by them.
_SLOWEST = 1e-12

# Tukey's constant (95 % efficiency), and the standard deviation over the median deviation.
_TUKEY = 4.685
_GAUSSIAN = 1.4826

# Deviation of depths that is never an outlier, relative to the size; float maps are that accurate.
_ROUNDING = 1e-5

# Offset of the background from the origin that is reported: relative, and in standard errors.
_FAR_OFF = 0.005
_SIGNIFICANT = 4.0


class DepthSamples(NamedTuple):
    """Pixels of depth maps that may show the background.

    Attributes:
      origins: positions of the cameras, world units.
      directions: directions in the world, with unit depth along the camera's axis.
      depths: planar depths, world units.
      clusters: number of the cluster of each pixel: its image, or a part of its image.
      step: difference between two depths of an 8-bit map; 0 for float maps.
    """

    origins: Float[np.ndarray, "n 3"]
    directions: Float[np.ndarray, "n 3"]
    depths: Float[np.ndarray, " n"]
    clusters: Int[np.ndarray, " n"]
    step: float


class BackgroundFit(NamedTuple):
    """A cube or sphere fitted to depth maps.

    Attributes:
      kind: shape.
      size: half edge of the cube, or radius of the sphere, world units.
      error: standard error of the size.
      centre: centre of the shape, world units.
      centre_error: standard errors of the centre; zeros if it is given.
      agreement: share of the pixels that are at the fitted depth, 0 to 1.
    """

    kind: Kind
    size: float
    error: float
    centre: tuple[float, float, float]
    centre_error: tuple[float, float, float]
    agreement: float

    def describe(self) -> str:
        """Returns the size with its standard error, as in `7.298 +- 0.004`."""
        places = int(np.clip(-np.floor(np.log10(max(self.error, 1e-6))), 2, 5))
        return f"{self.size:.{places}f} +- {max(self.error, 10.0**-places):.1g}"


def fit_size(kind: Kind, samples: DepthSamples) -> BackgroundFit | None:
    """Fits a background around the origin; `None` if the depths do not show one."""
    return _fit(kind, samples, unknowns=1)


def fit_size_and_centre(kind: Kind, samples: DepthSamples) -> BackgroundFit | None:
    """Fits a background around any centre; `None` if the depths do not show one."""
    return _fit(kind, samples, unknowns=4)


def sample_depths(
    cameras: Cameras,
    depths: Float[np.ndarray, "views h w"],
    *,
    masks: Bool[np.ndarray, "views h w"] | None = None,
    step: float = 0.0,
) -> DepthSamples:
    """Draws pixels beside the object from depth maps, always the same ones.

    Args:
      cameras: cameras of the maps, in the same order.
      depths: planar depth maps, world units; `inf` where a ray hits nothing.
      masks: masks of the object, which are left out with a margin; `None` if there are none.
      step: difference between two depths of an 8-bit map; 0 for float maps. The depths of an 8-bit
        map are saturated at the ends of its range.
    """
    generator = np.random.default_rng(0)
    parts = 1 if len(depths) >= _FEWEST_CLUSTERS else _PARTS
    origins, directions, found, clusters = [], [], [], []
    usable = image_files.is_measured(depths) if step else np.isfinite(depths)
    if masks is not None:
        usable &= image_files.well_outside(masks)
    for i, depth in enumerate(depths):
        row, column = np.nonzero(usable[i])
        if len(row) > _MOST_PIXELS:
            chosen = generator.choice(len(row), _MOST_PIXELS, replace=False)
            row, column = row[chosen], column[chosen]
        pose = cameras.poses[i]
        directions.append(planar_directions(cameras, row, column) @ pose[:, :3].T)
        origins.append(np.broadcast_to(pose[:, 3], (len(row), 3)))
        found.append(np.asarray(depth[row, column], np.float64))
        part = parts * (row * parts // cameras.height) + column * parts // cameras.width
        clusters.append(i * parts**2 + part)
    join = np.concatenate
    return DepthSamples(join(origins), join(directions), join(found), join(clusters), step)


def read_samples(scene: Path, *, split: Split = "train") -> DepthSamples | None:
    """Draws pixels beside the object from the depth maps of some views, evenly spread.

    Args:
      scene: the scene folder.
      split: `train`, `val` or `test`.

    Returns:
      The pixels; `None` without depth maps, or if some are 8-bit maps and some are not.

    Raises:
      SceneError: if a file is missing or broken.
    """
    frames = scene_folder.read_frames(scene, split)
    if frames.depths is None or len({path.suffix for path in frames.depths}) > 1:
        return None
    count = min(len(frames.depths), _MOST_IMAGES)
    chosen = np.unique(np.linspace(0, len(frames.depths) - 1, count).astype(int))
    cameras = frames.cameras._replace(poses=frames.cameras.poses[chosen])
    depths = np.stack([image_files.read_depth(frames.depths[i]) for i in chosen])
    masks = None
    if frames.masks is not None:
        masks = np.stack([image_files.read_mask(frames.masks[i]) for i in chosen])
    step = 0.0 if frames.depths[0].suffix == ".exr" else image_files.DEPTH_STEP
    return sample_depths(cameras, depths, masks=masks, step=step)


class Bounds(NamedTuple):
    """Geometry of a scene's background, and how it is known.

    Attributes:
      space: geometry of the background.
      size: half edge or radius, world units; `None` if unknown or infinite.
      source: reason for the size.
      notes: warnings.
    """

    space: Space
    size: float | None
    source: str
    notes: tuple[str, ...] = ()


def find_bounds(
    scene: Path, properties: SceneProperties, *, space: Space | None, radius: float | None
) -> Bounds:
    """Determines the background of a scene: from `scene.json`, else from its name and depth maps.

    Args:
      scene: the scene folder.
      properties: properties of the scene.
      space: geometry that is given; `None` for the scene's own.
      radius: size that is given, in place of the scene's own; nothing is measured then.

    Raises:
      SceneError: if `scene.json`, a depth map or a mask is broken.
    """
    own, described = properties.space, properties.background
    found: Space = space or own
    if found == "unbounded":
        return Bounds(found, None, "")
    if described.extent is not None:
        return Bounds(found, described.extent, properties.origins["background"].name)
    is_sphere = scene_names.of_folder(scene).split("_")[0] == "sphere"
    if space is None and own == "bounded" and is_sphere and described.kind is None:
        found = "spherical"
    if radius is not None:
        return Bounds(found, None, "")
    kind: Kind = "sphere" if found == "spherical" else "cube"
    samples = read_samples(scene)
    free = None if samples is None else fit_size_and_centre(kind, samples)
    fit = None if samples is None else fit_size(kind, samples) or free
    notes = () if free is None else _offset_warnings(free)
    if fit is None:
        # Without a radius, a sphere that only the scene's name states has the usual cube around it.
        return Bounds(space or own, None, "", _unfit_warnings(kind, samples))
    return Bounds(found, fit.size, f"measured from depth maps: {fit.describe()}", notes)


def _unfit_warnings(kind: Kind, samples: DepthSamples | None) -> tuple[str, ...]:
    """Returns a warning if there are depths, but they do not show the shape."""
    if samples is None or len(samples.depths) < _FEWEST_PIXELS:
        return ()
    return (
        f"warning: the depth maps show no {kind}, so that the size of the background is assumed to "
        "be the usual one. Set radius, or background=unbounded.",
    )


def _offset_warnings(fit: BackgroundFit) -> tuple[str, ...]:
    """Returns a warning if the background is not around the origin, as models assume."""
    offset, error = math.hypot(*fit.centre), math.hypot(*fit.centre_error)
    if offset <= max(_FAR_OFF * fit.size, _SIGNIFICANT * error):
        return ()
    pairs = zip(fit.centre, fit.centre_error, strict=True)
    centre = ", ".join(f"{x:.3f} +- {deviation:.1g}" for x, deviation in pairs)
    return (
        f"warning: the depth maps show a {fit.kind} of size {fit.describe()} around ({centre}), "
        "but the background is taken to be around the origin. Move the poses and the meshes.",
    )


# ---- The fit ----

_Shape = Callable[
    [DepthSamples, Float[np.ndarray, " 4"]],
    tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 4"]],
]
"""Function of samples, and of size and centre, to the depths of the shape and their derivatives."""


def _cube(
    samples: DepthSamples, shape: Float[np.ndarray, " 4"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 4"]]:
    """Returns where rays leave a cube: through the nearest of three faces."""
    signs = np.where(samples.directions < 0.0, -1.0, 1.0)
    speeds = np.maximum(np.abs(samples.directions), _SLOWEST)
    distances = (shape[0] + signs * (shape[1:] - samples.origins)) / speeds
    axis = np.argmin(distances, axis=1)[:, None]
    slopes = np.zeros((len(axis), 4))
    slopes[:, :1] = 1.0 / np.take_along_axis(speeds, axis, 1)
    np.put_along_axis(slopes, axis + 1, slopes[:, :1] * np.take_along_axis(signs, axis, 1), 1)
    return np.take_along_axis(distances, axis, 1)[:, 0], slopes


def _sphere(
    samples: DepthSamples, shape: Float[np.ndarray, " 4"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 4"]]:
    """Returns where rays leave a sphere."""
    origins = samples.origins - shape[1:]
    squared = np.sum(samples.directions**2, axis=1)
    along = np.sum(origins * samples.directions, axis=1)
    beyond = np.maximum(shape[0] ** 2 - np.sum(origins**2, axis=1), 0.0)
    root = np.sqrt(along**2 + squared * beyond)
    depths = (root - along) / squared
    normals = (origins + depths[:, None] * samples.directions) / shape[0]
    # The root is the radius times the product of normal and direction.
    slopes = np.concatenate([np.ones((len(depths), 1)), normals], axis=1)
    return depths, slopes * (shape[0] / root)[:, None]


_SHAPES: dict[Kind, _Shape] = {"cube": _cube, "sphere": _sphere}


def _extents(kind: Kind, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Returns the sizes of the shapes around the origin on which points lie."""
    return np.max(np.abs(points), axis=1) if kind == "cube" else np.linalg.norm(points, axis=1)


def _fit(kind: Kind, samples: DepthSamples, *, unknowns: int) -> BackgroundFit | None:
    """Fits the first `unknowns` of size and centre (four numbers); the others stay 0."""
    extents = _extents(kind, samples.origins + samples.depths[:, None] * samples.directions)
    if not len(extents):
        return None
    behind = extents > np.max(_extents(kind, samples.origins))
    samples = _choose(samples, behind)
    if len(samples.depths) < _FEWEST_PIXELS:
        return None
    shape = np.array([np.median(extents[behind]), 0.0, 0.0, 0.0])
    inverse = np.eye(unknowns)
    for _ in range(_ITERATIONS):
        depths, slopes = _SHAPES[kind](samples, shape)
        errors, slopes = samples.depths - depths, slopes[:, :unknowns]
        weights = _weights(errors, max(samples.step, _ROUNDING * shape[0]))
        normal = slopes.T @ (weights[:, None] * slopes)
        if np.linalg.matrix_rank(normal) < unknowns:
            return None
        inverse = np.linalg.inv(normal)
        change = inverse @ (slopes.T @ (weights * errors))
        shape[:unknowns] += change
        if not 0.0 < shape[0] < np.inf:
            return None
        if np.max(np.abs(change)) < _CONVERGED * shape[0]:
            break
    scores = slopes * (weights * errors)[:, None]
    error = _standard_errors(scores, samples.clusters, inverse)
    agreement = float(np.mean(np.abs(errors) < samples.step + _AGREES * shape[0]))
    if agreement < _LEAST_AGREEMENT or not error[0] < _LARGEST_ERROR * shape[0]:
        return None
    size, *centre = shape.tolist()
    spread = [*error.tolist(), 0.0, 0.0, 0.0]
    return BackgroundFit(kind, size, spread[0], tuple(centre), tuple(spread[1:4]), agreement)


def _choose(samples: DepthSamples, chosen: Bool[np.ndarray, " n"]) -> DepthSamples:
    return DepthSamples(
        samples.origins[chosen],
        samples.directions[chosen],
        samples.depths[chosen],
        samples.clusters[chosen],
        samples.step,
    )


def _weights(errors: Float[np.ndarray, " n"], least: float) -> Float[np.ndarray, " n"]:
    """Returns Tukey's biweights of deviations; they are positive for deviations up to `least`."""
    scale = max(_TUKEY * _GAUSSIAN * float(np.median(np.abs(errors))), 2.0 * least)
    return np.maximum(1.0 - (errors / scale) ** 2, 0.0) ** 2


def _standard_errors(
    scores: Float[np.ndarray, "n unknowns"],
    clusters: Int[np.ndarray, " n"],
    inverse: Float[np.ndarray, "unknowns unknowns"],
) -> Float[np.ndarray, " unknowns"]:
    """Returns standard errors, if only errors in different clusters are independent."""
    number = np.unique(clusters, return_inverse=True)[1]
    count = int(number.max()) + 1
    sums = np.stack([np.bincount(number, each, count) for each in scores.T], axis=1)
    variance = inverse @ (sums.T @ sums) @ inverse
    return np.sqrt(np.diag(variance) * count / max(count - 1, 1))
