"""Refines poses by what images show beside the object, where light is straight (NumPy only).

1. Corners of neighbouring views that look alike and lie on each other's epipolar lines are
   joined to points; poses and points are solved for (`bundle`).
2. The patch around each point, in the view nearest to the middle of those that show it, is aligned
   with the other views, and with neighbours where no corner was found: places of patches are
   several times as exact as those of corners. Poses and points are solved for again.
3. The world is brought back to where the given poses have it, by a similarity.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.ndimage
import scipy.sparse
from jaxtyping import Bool, Float, Int, UInt8

from experiments.cameras import bundle, corners
from experiments.cameras.bundle import Prior, Sightings, Solution, Views
from experiments.cameras.corners import Corners, GreyImage

# Views that each view is compared with; most corners of a view.
_NEIGHBOURS, _MOST_CORNERS = 10, 500

# Largest distance from an epipolar line under given poses, pixels, per pixel of their error.
_OFF_LINE = 3.0

# Least correlation of corners; largest angle between views whose patches are compared, degrees.
_LIKENESS, _WIDEST = 0.8, 40.0

# Pixels around masks, which may be a little wrong, that are not used.
_MARGIN = 5

# Largest error of a sighting after each solution, pixels; smallest angle between the rays of a
# point, degrees; fewest points that a view needs.
_LARGEST_ERRORS, _LEAST_ANGLE, _FEWEST = (4.0, 1.0), 1.5, 12


class Photo(NamedTuple):
    """An image of a capture.

    Attributes:
      image: 8-bit sRGB.
      mask: pixels of the object, or `None` if they are unknown.
    """

    image: UInt8[np.ndarray, "h w 3"]
    mask: Bool[np.ndarray, "h w"] | None


class Refined(NamedTuple):
    """Result of `refine`.

    Attributes:
      poses: refined poses in the world of the given ones.
      corrections: `(w, t)` from given to refined poses; see `bundle`.
      deviations: their standard deviations.
      sightings: number of points that each view shows.
      points: places of the points.
      error: typical error of a sighting, pixels per axis.
    """

    poses: Float[np.ndarray, "views 3 4"]
    corrections: Float[np.ndarray, "views 6"]
    deviations: Float[np.ndarray, "views 6"]
    sightings: Int[np.ndarray, " views"]
    points: Float[np.ndarray, "points 3"]
    error: float

    def record(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Returns facts for `cameras.json`, and those of each view."""
        facts = {"error_pixels": self.error, "points": len(self.points)}
        return facts, {"sightings": self.sightings}

    def describe(self) -> str:
        """Returns a few lines of text."""
        return (
            f"Views:   {len(self.poses)}, with {self.sightings.min()} points or more each\n"
            f"Error:   {self.error:.3f} pixels per axis"
        )


def refine(
    views: Views,
    photos: Sequence[Photo],
    *,
    prior: Prior,
    report: Callable[[str], None] = lambda _: None,
) -> Refined:
    """Returns refined poses of views.

    Args:
      views: views with the given poses.
      photos: their images.
      prior: expected errors of given poses.
      report: function that receives progress and warnings, as lines of text.

    Raises:
      ValueError: if most views show too few points beside the object, or all are at one place.
    """
    greys = [corners.prepare(photo.image) for photo in photos]
    usable = [_usable(photo) for photo in photos]
    found = [
        corners.find_corners(image, allowed, most=_MOST_CORNERS)
        for image, allowed in zip(greys, usable, strict=True)
    ]
    pairs = neighbours(views)
    shown = np.array([len(each.places) for each in found])
    report(f"{shown.sum()} corners, {len(pairs)} pairs of views")
    if np.median(shown) < _FEWEST or not len(pairs):
        _judge(np.zeros_like(shown), report)
    seen = _tracks(views, found, pairs, prior)
    if not len(seen.view):
        _judge(np.zeros_like(shown), report)
    solution, seen = _solve(views, seen, prior, _LARGEST_ERRORS[0])
    report(_describe("corners", solution, seen))
    for _ in range(2):
        seen = _aligned(solution, seen, greys, usable, pairs)
        start = solution.views
        solution, seen = _solve(
            views, seen, prior, _LARGEST_ERRORS[1], start=start, points=solution.points
        )
        report(_describe("patches", solution, seen))
    shown = np.bincount(seen.view, minlength=len(views.poses))
    _judge(shown, report)
    known = shown >= _FEWEST
    change = bundle.similarity(solution.views.poses[known], views.poses[known])
    # A pose that few points determine is more likely wrong than the given one.
    poses = np.where(known[:, None, None], bundle.moved(solution.views.poses, change), views.poses)
    points = change.scale * solution.points @ change.rotation.T + change.shift
    return Refined(
        poses,
        bundle.correction_between(views.poses, poses),
        solution.deviations,
        shown,
        points,
        float(np.median(solution.errors)) / 1.1774,
    )


def _judge(shown: Int[np.ndarray, " views"], report: Callable[[str], None]) -> None:
    """Refuses a refinement of most views by too few points, and warns of single ones."""
    few = np.nonzero(shown < _FEWEST)[0]
    if 2 * len(few) > len(shown):
        raise ValueError(
            f"{len(few)} of {len(shown)} views show fewer than {_FEWEST} points beside the object. "
            "Surround the object with textured things, and take more views."
        )
    if len(few):
        names = ", ".join(map(str, few[:8]))
        report(
            f"warning: {len(few)} views show fewer than {_FEWEST} points beside the object (views "
            f"{names}, from 0, split after split), and keep their poses."
        )


def neighbours(views: Views) -> Int[np.ndarray, "pairs 2"]:
    """Returns the pairs of views that are close in place and direction, the lower number first."""
    places, axes = views.poses[..., 3], views.poses[..., 2]
    spread = np.linalg.norm(places - places.mean(axis=0), axis=-1).mean()
    if not spread > 1e-9 * (1.0 + np.abs(places).max()):
        raise ValueError(
            "All cameras are at one place, from where no depth is seen. Check the poses."
        )
    apart = np.linalg.norm(places[:, None] - places, axis=-1) / spread
    angle = np.arccos(np.clip(axes @ axes.T, -1.0, 1.0))
    far = apart + angle
    np.fill_diagonal(far, np.inf)
    far[angle > np.radians(_WIDEST)] = np.inf
    pairs = set()
    for first in range(len(far)):
        for second in np.argsort(far[first], kind="stable")[:_NEIGHBOURS].tolist():
            if np.isfinite(far[first, second]):
                pairs.add((min(first, second), max(first, second)))
    return np.array(sorted(pairs), np.int64).reshape(-1, 2)


def _usable(photo: Photo) -> Bool[np.ndarray, "h w"]:
    if photo.mask is None or not photo.mask.any():
        return np.ones(photo.image.shape[:2], bool)
    return ~scipy.ndimage.binary_dilation(photo.mask, iterations=_MARGIN)


def _tracks(
    views: Views, found: Sequence[Corners], pairs: Int[np.ndarray, "pairs 2"], prior: Prior
) -> Sightings:
    """Returns the sightings of points, from pairs of corners that are alike."""
    starts = np.concatenate([[0], np.cumsum([len(each.places) for each in found])])
    links = []
    for first, second in pairs:
        likeness = found[first].patches @ found[second].patches.T
        off = off_line(views, first, second, found[first].places, found[second].places)
        # Both poses are wrong, in rotation and in place.
        reach = _OFF_LINE * views.focals[second] * 1.5 * max(prior.rotation, 1e-4)
        matched = corners.pair_up(likeness, off < max(reach, 1.0), least=_LIKENESS)
        links.append(matched + np.array([starts[first], starts[second]]))
    joined = np.concatenate(links)
    total = starts[-1]
    graph = scipy.sparse.coo_array((np.ones(len(joined)), tuple(joined.T)), (total, total))
    _, point = scipy.sparse.csgraph.connected_components(graph, directed=False)
    view = np.repeat(np.arange(len(found)), np.diff(starts))
    places = np.concatenate([each.places for each in found])
    # A point that a view shows twice is none.
    keys = point * len(found) + view
    twice = np.bincount(keys, minlength=keys.max(initial=0) + 1)[keys] > 1
    doubled = np.isin(point, point[twice])
    return _renumbered(Sightings(view, point, places), ~doubled)


def _renumbered(seen: Sightings, kept: np.ndarray) -> Sightings:
    """Returns the kept sightings of points that at least two views show, points from 0."""
    total = seen.point.max(initial=-1) + 1
    kept = kept & (np.bincount(seen.point[kept], minlength=total)[seen.point] > 1)
    _, point = np.unique(seen.point[kept], return_inverse=True)
    return Sightings(seen.view[kept], point, seen.places[kept])


def off_line(
    views: Views, first: int, second: int, places: np.ndarray, others: np.ndarray
) -> Float[np.ndarray, "n m"]:
    """Returns the distances of places in one view from epipolar lines of those in another one.

    Args:
      views: the views.
      first: view whose rays are drawn as lines in the other one.
      second: view in which distances are measured, in pixels.
      places: pixel coordinates in the first view.
      others: pixel coordinates in the second view.
    """

    def towards(number: int, at: np.ndarray) -> np.ndarray:
        flat = (at - views.middles[number]) / views.focals[number] * [1.0, -1.0]
        return np.concatenate([flat, -np.ones((len(at), 1))], axis=-1)

    one, two = views.poses[first], views.poses[second]
    rays = towards(first, places) @ (two[:, :3].T @ one[:, :3]).T
    base = two[:, :3].T @ (one[:, 3] - two[:, 3])
    normals = np.cross(base, rays)
    seen = towards(second, others)
    slant = np.linalg.norm(normals[:, :2], axis=-1)
    return views.focals[second] * np.abs(normals @ seen.T) / np.maximum(slant, 1e-12)[:, None]


def _solve(
    views: Views,
    seen: Sightings,
    prior: Prior,
    largest: float,
    *,
    start: Views | None = None,
    points: np.ndarray | None = None,
) -> tuple[Solution, Sightings]:
    """Solves for poses and points, without sightings that do not agree; twice."""
    begin = start or views
    if points is None:
        points = bundle.triangulate(begin, seen, seen.point.max() + 1)
    for limit in (4.0 * largest, largest):
        images, depths = bundle.project(begin, points[seen.point], seen.view)
        error = np.linalg.norm(images - seen.places, axis=-1)
        good = (error < limit) & (depths > 0.0)
        good &= (_widest(begin, points, seen, good) > np.radians(_LEAST_ANGLE))[seen.point]
        if not good.any():
            _judge(np.zeros(len(views.poses), np.int64), lambda _: None)
        counted = np.bincount(seen.point[good], minlength=len(points))
        points = points[counted > 1]
        seen = _renumbered(seen, good)
        solution = bundle.solve(views, points, seen, prior)
        begin, points = solution.views, solution.points
    return solution, seen


def _widest(
    views: Views, points: np.ndarray, seen: Sightings, good: np.ndarray
) -> Float[np.ndarray, " points"]:
    """Returns the largest angle between the first ray of each point and another one."""
    rays = points[seen.point] - views.poses[seen.view, :, 3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    first = np.full(len(points), -1)
    number = np.nonzero(good)[0][::-1]
    first[seen.point[number]] = number
    partner = rays[np.maximum(first, 0)[seen.point]]
    angle = np.arccos(np.clip((rays * partner).sum(axis=-1), -1.0, 1.0))
    found = np.zeros(len(points))
    np.maximum.at(found, seen.point[good], angle[good])
    return found


def _aligned(
    solution: Solution,
    seen: Sightings,
    greys: Sequence[GreyImage],
    usable: Sequence[np.ndarray],
    pairs: Int[np.ndarray, "pairs 2"],
) -> Sightings:
    """Returns where the patch of each point is in the views near to the one that shows it best."""
    views, points = solution.views, solution.points
    home, at = _homes(views, points, seen)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    view, point, places = [home], [np.arange(len(points))], [at]
    for first, second in both:
        here = np.nonzero(home == first)[0]
        start, depth = bundle.project(views, points[here], np.full(len(here), second))
        height, width = usable[second].shape
        inside = (depth > 0.0) & np.all((start > 8.0) & (start < [width - 8.0, height - 8.0]), -1)
        here, start = here[inside], start[inside]
        column, row = start.astype(np.int64).T
        free = usable[second][row, column]
        here, start = here[free], start[free]
        if not len(here):
            continue
        where, alike = corners.align_patches(greys[first], greys[second], at[here], start)
        view.append(np.full(np.count_nonzero(alike), second))
        point.append(here[alike])
        places.append(where[alike])
    return Sightings(np.concatenate(view), np.concatenate(point), np.concatenate(places))


def _homes(views: Views, points: np.ndarray, seen: Sightings) -> tuple[np.ndarray, np.ndarray]:
    """Returns for each point the view in the middle of those that show it, and its place there."""
    rays = views.poses[seen.view, :, 3] - points[seen.point]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    mean = np.zeros((len(points), 3))
    np.add.at(mean, seen.point, rays)
    order = np.argsort((rays * mean[seen.point]).sum(axis=-1), kind="stable")
    home, at = np.zeros(len(points), np.int64), np.zeros((len(points), 2))
    home[seen.point[order]] = seen.view[order]
    at[seen.point[order]] = seen.places[order]
    return home, at


def _describe(what: str, solution: Solution, seen: Sightings) -> str:
    typical = float(np.median(solution.errors)) / 1.1774
    counts = f"{len(solution.points)} points, {len(seen.view)} sightings"
    return f"{what}: {counts}, {typical:.3f} pixels"
