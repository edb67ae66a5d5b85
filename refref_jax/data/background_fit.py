"""Measures the size and the centre of a background from depth maps (NumPy only).

Scenes of the data set do not state how far away their background is. Their depth maps do: a pixel
beside the object with planar depth `z` shows the point `p = o + z d`, where `o` is the position of
the camera and `d` the pixel's direction with unit depth along the camera's axis. The background is

    cube      max_i |p_i - c_i| = h      half edge h
    sphere    |p - c| = h                radius h

around a known centre, usually the origin (`c = 0`), or around one that is fitted as well. Size and
centre are fitted to the depths by least squares with Tukey's weights, after Beaton and Tukey, "The
fitting of power series, meaning polynomials, illustrated on band-spectroscopic data" (1974).

`fit_background` keeps the known centre unless the depths clearly show another one: the fitted
centre is further away than 0.1 % of the size and four standard errors, and the mean deviation of
the depths around it is less than half of that around the known one.

8-bit maps are inverted, saturated and rounded (see `image_files.read_depth`). Saturated values are
left out. Rounding causes an error of the depth that is uniform within a step and has no bias; a
deviation of less than a step is never an outlier. The errors of neighbouring pixels are correlated,
so the standard error is estimated between images (a sandwich estimate with one cluster per image).

The background is opaque and encloses the cameras, so a point that is nearer to its centre than some
camera must be on an object. Such points are left out, even where there are no masks.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from refref_jax.choices import ORIGIN, Position, Space, Split
from refref_jax.data import SceneError, image_files, scene_folder, scene_names
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

# Maximum standard errors of a size and a centre that are used, relative to the size.
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

# Deviation of depths that is never an outlier, relative to the size: float maps are that accurate.
# From a rough estimate of the centre it starts higher, and is halved in every iteration, since a
# wall whose place is still wrong would be an outlier.
_ROUNDING = 1e-5
_COARSE = 0.1

# Minimum distance of a fitted centre from the known one: relative to the size, and in standard
# errors. The mean deviation of the depths must fall to this part.
_LEAST_OFFSET = 0.001
_SIGNIFICANT = 4.0
_MUCH_BETTER = 0.5

# Share of points beyond the first estimate of the background on either side, along each axis.
_TAIL = 0.02


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
    centre: Position
    centre_error: Position
    agreement: float

    def describe(self) -> str:
        """Returns size and fitted centre with their standard errors, as in `7.298 +- 0.004`."""
        size = _with_error(self.size, self.error)
        if not any(self.centre_error):
            return size
        return f"{size} around ({', '.join(map(_with_error, self.centre, self.centre_error))})"


def fit_background(
    kind: Kind, samples: DepthSamples, *, centre: Position = ORIGIN
) -> BackgroundFit | None:
    """Fits a background around a known centre, or around another one that the depths clearly show.

    Args:
      kind: shape of the background.
      samples: pixels that may show it.
      centre: known centre, world units.

    Returns:
      The background; `None` if the depths do not show one.
    """
    known, free = fit_size(kind, samples, centre=centre), fit_size_and_centre(kind, samples)
    if free is None:
        return known
    offset = math.dist(free.centre, centre)
    if offset > max(_LEAST_OFFSET * free.size, _SIGNIFICANT * math.hypot(*free.centre_error)):
        if known is None:
            return free
        before, after = _mean_deviations(samples, known, free)
        if after < _MUCH_BETTER * before:
            return free
    return known or free._replace(centre=centre, centre_error=ORIGIN)


def fit_size(
    kind: Kind, samples: DepthSamples, *, centre: Position = ORIGIN
) -> BackgroundFit | None:
    """Fits a background around a known centre; `None` if the depths do not show one."""
    return _fit(kind, samples, np.array(centre, np.float64), unknowns=1)


def fit_size_and_centre(kind: Kind, samples: DepthSamples) -> BackgroundFit | None:
    """Fits a background around any centre; `None` if the depths do not show one.

    It has to enclose the cameras, whose distances from the first estimate of the centre decide
    which points may be on it. That estimate is the middle between the outermost points along each
    axis, and the fitted centre is the next one.
    """
    if not len(samples.depths):
        return None
    ends = np.quantile(_points(samples), [_TAIL, 1.0 - _TAIL], axis=0)
    first = _fit(kind, samples, np.mean(ends, axis=0), unknowns=4, coarse=_COARSE)
    found = first and _fit(kind, samples, np.array(first.centre), unknowns=4)
    if found is None or not max(found.centre_error) < _LARGEST_ERROR * found.size:
        return None
    encloses = np.max(_extents(kind, samples.origins - found.centre)) < found.size
    return found if encloses else None


def _with_error(value: float, error: float) -> str:
    places = int(np.clip(-np.floor(np.log10(max(error, 1e-6))), 2, 5))
    return f"{value:.{places}f} +- {max(error, 10.0**-places):.1g}"


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
      source: reason for the size, or for the centre if only that is known.
      notes: warnings.
      centre: centre, world units.
    """

    space: Space
    size: float | None
    source: str
    notes: tuple[str, ...] = ()
    centre: Position = ORIGIN


def find_bounds(
    scene: Path,
    properties: SceneProperties,
    *,
    space: Space | None,
    radius: float | None,
    centre: Position | None = None,
    measure: Callable[[Kind, Position], tuple[float, float] | None] = lambda kind, centre: None,
    cameras: Cameras | None = None,
) -> Bounds:
    """Determines the background of a scene: from `scene.json`, else from its name and depth maps.

    Args:
      scene: the scene folder.
      properties: properties of the scene.
      space: geometry that is given; `None` for the scene's own.
      radius: size that is given, in place of the scene's own; nothing is measured then.
      centre: centre that is given, in place of the scene's own.
      measure: function of shape and centre to the size that the images show, and its standard
        error, or `None`; called if neither `scene.json` nor depth maps tell the size.
      cameras: cameras, which have to be inside a background of the size that `scene.json` states.

    Raises:
      SceneError: if `scene.json`, a depth map or a mask is broken, or a camera is outside.
    """
    own, described = properties.space, properties.background
    found: Space = space or own
    if found == "unbounded":
        return Bounds(found, None, "", centre=centre or ORIGIN)
    known, file = centre or described.centre, properties.origins.get("background")
    stated = file.name if file else ""
    if described.extent is not None:
        bounds = Bounds(found, described.extent, stated, centre=known or ORIGIN)
        if cameras is not None and radius is None:
            _refuse_outside(cameras, bounds, described.extent, file)
        return bounds
    is_sphere = scene_names.of_folder(scene).split("_")[0] == "sphere"
    if space is None and own == "bounded" and is_sphere and described.kind is None:
        found = "spherical"
    # Without a radius, a sphere that only the scene's name states has the usual cube around it.
    unmeasured = Bounds(space or own, None, "" if known == centre else stated, (), known or ORIGIN)
    if radius is not None:
        return unmeasured._replace(space=found)
    kind: Kind = "sphere" if found == "spherical" else "cube"
    samples, fit = read_samples(scene), None
    if samples is not None:
        fit = fit_size(kind, samples, centre=known) if known else fit_background(kind, samples)
    if fit is None and (seen := measure(kind, known or ORIGIN)):
        source = f"measured from the parallax of the images: {_with_error(*seen)}"
        return Bounds(found, seen[0], source, centre=known or ORIGIN)
    if fit is None:
        return unmeasured._replace(notes=_unfit_warnings(kind, samples))
    source = f"measured from depth maps: {fit.describe()}"
    return Bounds(found, fit.size, source, centre=fit.centre)


def _refuse_outside(cameras: Cameras, bounds: Bounds, size: float, file: Path | None) -> None:
    """Refuses cameras outside of the background, which would look at it from behind."""
    offsets = np.abs(cameras.poses[:, :, 3] - np.asarray(bounds.centre))
    sphere = bounds.space == "spherical"
    reach = np.linalg.norm(offsets, axis=1) if sphere else np.max(offsets, axis=1)
    if reach.max() >= size:
        key = "radius" if sphere else "half_extent"
        raise SceneError(
            f"{file}: background.{key} is {size:g}, but camera {int(reach.argmax())} is "
            f"{reach.max():.4g} from its centre. Give a larger one, the right centre, or none, so "
            "that it is measured."
        )


def _unfit_warnings(kind: Kind, samples: DepthSamples | None) -> tuple[str, ...]:
    """Returns a warning if there are depths, but they do not show the shape."""
    if samples is None or len(samples.depths) < _FEWEST_PIXELS:
        return ()
    return (
        f"warning: the depth maps show no {kind}, so that the size of the background is assumed to "
        "be the usual one. Set radius, or background=unbounded.",
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


def depths_of(
    kind: Kind,
    origins: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "n 3"],
    *,
    size: float,
) -> Float[np.ndarray, " n"]:
    """Returns where rays from within a background around the origin meet it, in their lengths."""
    unknown = np.zeros(len(origins))
    rays = DepthSamples(origins, directions, unknown, unknown.astype(np.int32), 0.0)
    return _SHAPES[kind](rays, np.array([size, 0.0, 0.0, 0.0]))[0]


def _extents(kind: Kind, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Returns the sizes of the shapes on which points lie, relative to the centre."""
    return np.max(np.abs(points), axis=1) if kind == "cube" else np.linalg.norm(points, axis=1)


def _points(samples: DepthSamples) -> Float[np.ndarray, "n 3"]:
    return samples.origins + samples.depths[:, None] * samples.directions


def _mean_deviations(samples: DepthSamples, *fits: BackgroundFit) -> list[float]:
    """Returns the mean deviation of each fit, over the pixels that agree with any of them."""
    shapes = [_SHAPES[fit.kind](samples, np.array([fit.size, *fit.centre])) for fit in fits]
    deviations = np.abs(samples.depths - np.stack([depths for depths, _ in shapes]))
    sizes = np.array([[fit.size] for fit in fits])
    agree = np.any(deviations < samples.step + _AGREES * sizes, axis=0)
    return np.mean(deviations[:, agree], axis=1).tolist()


def _fit(
    kind: Kind,
    samples: DepthSamples,
    centre: Float[np.ndarray, "3"],
    *,
    unknowns: int,
    coarse: float = _ROUNDING,
) -> BackgroundFit | None:
    """Fits the first `unknowns` of size and centre (four numbers); the others stay as given."""
    extents = _extents(kind, _points(samples) - centre)
    if not len(extents):
        return None
    behind = extents > np.max(_extents(kind, samples.origins - centre))
    samples = _choose(samples, behind)
    if len(samples.depths) < _FEWEST_PIXELS:
        return None
    shape = np.array([np.median(extents[behind]), *centre])
    inverse = np.eye(unknowns)
    for _ in range(_ITERATIONS):
        depths, slopes = _SHAPES[kind](samples, shape)
        errors, slopes = samples.depths - depths, slopes[:, :unknowns]
        weights = _weights(errors, max(samples.step, coarse * shape[0]))
        normal = slopes.T @ (weights[:, None] * slopes)
        if np.linalg.matrix_rank(normal) < unknowns:
            return None
        inverse = np.linalg.inv(normal)
        change = inverse @ (slopes.T @ (weights * errors))
        shape[:unknowns] += change
        if not 0.0 < shape[0] < np.inf:
            return None
        if coarse == _ROUNDING and np.max(np.abs(change)) < _CONVERGED * shape[0]:
            break
        coarse = max(0.5 * coarse, _ROUNDING)
    scores = slopes * (weights * errors)[:, None]
    error = _standard_errors(scores, samples.clusters, inverse)
    agreement = float(np.mean(np.abs(errors) < samples.step + _AGREES * shape[0]))
    if agreement < _LEAST_AGREEMENT or not error[0] < _LARGEST_ERROR * shape[0]:
        return None
    size, *place = shape.tolist()
    spread = [*error.tolist(), 0.0, 0.0, 0.0]
    return BackgroundFit(kind, size, spread[0], tuple(place), tuple(spread[1:4]), agreement)


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
