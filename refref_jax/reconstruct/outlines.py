"""Outlines of masks as equations of a fit, and bodies of revolution fitted to them (NumPy only).

`Outlines` are equations of the masks' outlines, for `gauss_newton`. Where the surface turns away
from a camera, its image has an edge, and the edge of the mask should be there. A point of this rim
that moves by `dx` moves its image across the edge by
`d (signed distance) / d pixel . d pixel / d point . dx`; moving along the line of sight changes
nothing. Masks are sampled at the centres of pixels, so the distance of a point has an error of
about a third of a pixel. Masks that are wrong, or show something else, lose their weight.

`fit_profile` fits a body of revolution to outlines alone. A mesh from masks is up to half a pixel
too narrow and has waves along its profile; the outlines of all views together determine it to some
hundredths of a pixel, and its normals to half a degree. Smoothed distances hide what is narrower
than three pixels, such as rings and threads. Which pixels are in a mask shows it, since the rays
through their centres pass at all heights: a body is fitted to them by how deep each enters it.

Source: Cipolla and Blake, Surface Shape from the Deformation of Apparent Contours (1992), for the
derivative; its use beside refraction is ours.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from scipy.special import expit

from refref_jax.compilation import threads
from refref_jax.geometry.cameras import Projection, pixel_rays, project, projection_slopes
from refref_jax.geometry.rays import Rays
from refref_jax.reconstruct.families import Revolution
from refref_jax.reconstruct.gauss_newton import Candidate, Rows
from refref_jax.reconstruct.masks import Views, sample_with_slope, signed_distances
from refref_jax.reconstruct.relief import Relief, fitted_to_outlines
from refref_jax.reconstruct.revolution import Curve
from refref_jax.reconstruct.shapes import (
    Creases,
    Posed,
    Unknowns,
    creases_of,
    edges_of,
    tilt,
    vertex_normals_of,
)

OUTLINE_DEVIATION = 0.3
"""Standard deviation of a signed distance, the unit of the errors of outlines, in pixels."""

# Distance at which a point has lost half of its weight, in pixels; points that are further away are
# of an inner edge, which a mask does not show.
_WRONG, _FURTHEST = 1.0, 3.0

# Largest number of rim points per view: neighbours have the same error, so more add nothing.
_POINTS = 100

# Steps of the fit of a profile, fits of a relief before it, and the standard deviation of the
# second differences of its knots, as a share of the size: neighbours have errors that are alike.
_ROUNDS, _RELIEF_ROUNDS, _BEND = 5, 3, 0.001

# Pixels that are nearer to an outline than this are fitted to, in pixels; one view in so many
# judges; numbers of pixels; and the share of wrong ones below which there are
# neither reliefs nor ridges.
_BESIDE, _JUDGE_EVERY, _FITTED, _JUDGES, _FEW_WRONG = 1.8, 5, 24_000, 8_000, 0.015

# Scale of the logistic function of a depth, in pixels, and share of the pixels that are wrong.
_MASK_DEVIATION, _MISTAKES = 0.15, 0.02

# Knots of a fine profile, scale of the changes of its second differences, as a share of the size,
# most steps with each scale, and a gain in the logarithm of the probability that ends them.
# Multiples of this scale, each with a scale of the logistic function of a depth, in pixels.
_FINE_KNOTS, _FINE_BEND, _FINE_ROUNDS, _LEAST_GAIN = 200, 0.00003, 5, 2.0
_SCALES = ((30.0, 0.15), (10.0, 0.15), (3.0, 0.1), (1.0, 0.05))

# Damping of the first step, factor of those after it, and the largest one.
_DAMPING, _DAMPING_STEP, _MOST_DAMPING = 0.1, 6.0, 100.0

# Pieces of each segment of a profile. Places that are tried on a ray, three times ever finer.
_PIECES, _AROUND = 3, 1.2
_TICKS = (np.linspace(-1.0, 1.0, 41), np.linspace(-1.0, 1.0, 9), np.linspace(-1.0, 1.0, 9))

# Points along a crease.
_ALONG_CREASE = 12

# Largest error of a body with a relief, as a share of that of the body without it.
_BETTER = 0.95


class _Rim(NamedTuple):
    """Points between two vertices, where the surface turns away from a camera.

    Attributes:
      first: vertex at one end.
      second: vertex at the other end.
      share: share of the second vertex.
    """

    first: Int[np.ndarray, " points"]
    second: Int[np.ndarray, " points"]
    share: Float[np.ndarray, " points"]


class Outlines:
    """The outlines of masks, as a function of a candidate to `Rows`."""

    def __init__(
        self,
        views: Views,
        *,
        common: float = 0.0,
        seed: int = 0,
        reach: float = _FURTHEST,
        creased: bool = False,
    ) -> None:
        """Measures the signed distances of all masks.

        Args:
          views: masks and their cameras.
          common: standard deviation, in pixels, of how much too wide all masks are.
          seed: seed of the draws of rim points.
          reach: distance from an outline beyond which points have no say, pixels.
          creased: whether surfaces turn away at creases, too, as meshes that are given may.
        """
        self._cameras, self._common, self._seed = views.cameras, common, seed
        self._reach, self._creased = reach, creased
        self._distances = [
            signed_distances(mask).astype(np.float32) if mask.any() and not mask.all() else None
            for mask in views.masks
        ]

    def __call__(self, candidate: Candidate) -> Rows:
        """Returns the equations of the outline of the first part, which contains all others."""
        return self.of_surface(candidate.parts[0])

    def of_surface(self, part: Posed) -> Rows:
        """Returns the equations of the outline of a surface."""
        normals = vertex_normals_of(part)
        edges, creases = edges_of(part.faces), creases_of(part) if self._creased else None
        if creases is not None:  # the mean of normals on both sides of a crease says nothing
            edges = edges[~np.any(np.isin(edges, creases.edges), axis=1)]
        generator = np.random.default_rng(self._seed)
        found = [
            self._of_view(view, distances, part, normals, edges, creases, generator)
            for view, distances in enumerate(self._distances)
            if distances is not None
        ]
        errors = np.concatenate([each[0] for each in found])
        derivatives = scipy.sparse.vstack([each[1] for each in found]).tocsr()
        wrong = _WRONG * self._reach / _FURTHEST
        weights = 1.0 / (1.0 + (errors * OUTLINE_DEVIATION / wrong) ** 2) ** 2
        return Rows(
            errors, derivatives @ part.by_vertices, weights, self._common / OUTLINE_DEVIATION
        )

    def of_surfaces(self, parts: Sequence[Posed]) -> Rows:
        """Returns the equations of the outlines of surfaces that depend on the same unknowns."""
        each = [self.of_surface(part) for part in parts]
        return Rows(
            np.concatenate([rows.errors for rows in each]),
            np.concatenate([rows.derivatives for rows in each]),
            np.concatenate([rows.weights for rows in each]),
            each[0].common,
        )

    def _of_view(
        self,
        view: int,
        distances: Float[np.ndarray, "h w"],
        part: Posed,
        normals: Float[np.ndarray, "vertices 3"],
        edges: Int[np.ndarray, "edges 2"],
        creases: "Creases | None",
        generator: np.random.Generator,
    ) -> tuple[Float[np.ndarray, " points"], scipy.sparse.csr_array]:
        """Returns errors and derivatives by the vertices of the rim of one view."""
        pose, columns = self._cameras.poses[view], 3 * len(part.vertices)
        rim = _rim(part.vertices, normals, edges, pose[:, 3])
        if creases is not None:
            along = _crease_rim(part, creases, pose[:, 3])
            rim = _Rim(*(np.concatenate(both) for both in zip(rim, along, strict=True)))
        share = rim.share[:, None]
        points = (1.0 - share) * part.vertices[rim.first] + share * part.vertices[rim.second]
        seen = project(points, pose, self._cameras)
        distance, slope = sample_with_slope(distances, seen.pixels)
        size = np.array([self._cameras.width, self._cameras.height])
        visible = (seen.depths > 0.0) & np.all((seen.pixels > 0) & (seen.pixels < size), axis=-1)
        near = np.flatnonzero((np.abs(distance) < self._reach) & visible)
        near = generator.permutation(near)[:_POINTS]
        by_column, by_row = projection_slopes(
            Projection(*(x[near] for x in seen)), pose, self._cameras
        )
        rows = slope[near, :1] * by_column + slope[near, 1:] * by_row
        first, second = rim.first[near], rim.second[near]
        blocks = np.concatenate([(1.0 - share[near]) * rows, share[near] * rows], axis=1)
        at = 3 * np.stack([first, second], axis=1)[..., None] + np.arange(3)
        row = np.repeat(np.arange(len(near)), 6)
        entries = (blocks.ravel() / OUTLINE_DEVIATION, (row, at.ravel()))
        matrix = scipy.sparse.coo_array(entries, shape=(len(near), columns)).tocsr()
        return distance[near] / OUTLINE_DEVIATION, matrix


def fit_profile(
    outer: Revolution, views: Views, *, relief: Relief | None = None, seed: int = 0
) -> Revolution:
    """Fits a body of revolution to outlines alone.

    It gets a relief, and then narrow ridges such as rings and threads, only if the body without
    them leaves pixels of masks unexplained, and if the masks are then explained better.

    Args:
      outer: a body near the outlines, such as that of a mesh from masks.
      views: masks and their cameras.
      relief: possible difference from a body of revolution; meshes from masks have one in hollows,
        too.
      seed: seed of the draws of points and pixels.
    """
    outlines = Outlines(views, seed=seed)
    fitted, judges = _pixels_beside(views, seed=seed)
    found = _fitted(outer.with_relief(None), outlines)
    of_single_view = not len(fitted.inside) or not len(judges.inside)
    if not of_single_view and _judged(found, judges)[0] < _FEW_WRONG:
        return found
    if relief is not None:
        raised = _best_relief(outer, relief, outlines, judges)
        found = raised if _error(raised, outlines) < _BETTER * _error(found, outlines) else found
    if of_single_view:
        return found
    wrong, surprise = _judged(found, judges)
    if wrong < _FEW_WRONG:
        return found
    fine = _fitted_to_pixels(found.with_knots(_FINE_KNOTS), fitted)
    return fine if _judged(fine, judges)[1] < _BETTER * surprise else found


def _best_relief(
    outer: Revolution, relief: Relief, outlines: Outlines, judges: "_Pixels"
) -> Revolution:
    """Returns a body with the relief, as given or fitted, that explains the judges best."""
    found = [_fitted(outer.with_relief(relief), outlines)]
    for number in range(_RELIEF_ROUNDS):
        body = found[-1] if number else outer
        relief = fitted_to_outlines(relief, body.raised, outlines.of_surface)
        found.append(_fitted(body.with_relief(relief), outlines))
    if not len(judges.inside):
        return found[0]
    return min(found, key=lambda each: _judged(each, judges)[1])


def _fitted(outer: Revolution, outlines: Outlines) -> Revolution:
    x = outer.start()
    for _ in range(_ROUNDS):
        rows = outlines.of_surface(outer.pose(x))
        weighted = rows.weights[:, None] * rows.derivatives
        precision, gradient = outer.prior(x, bend=_BEND)
        matrix = weighted.T @ rows.derivatives + precision
        x = x - np.linalg.solve(matrix, weighted.T @ rows.errors + gradient)
    return outer.moved(x)


def _error(outer: Revolution, outlines: Outlines) -> float:
    """Returns the mean distance from the outlines, in standard deviations, up to the largest."""
    errors = outlines.of_surface(outer.pose(outer.start())).errors
    return float(np.mean(np.minimum(np.abs(errors), _WRONG / OUTLINE_DEVIATION)))


class _Pixels(NamedTuple):
    """Pixels beside the outlines of masks.

    Attributes:
      rays: rays through their centres.
      inside: whether they are in a mask.
      share: number of these pixels as a share of all that were found.
    """

    rays: Rays
    inside: Bool[np.ndarray, " pixels"]
    share: float


def _pixels_beside(views: Views, *, seed: int) -> tuple[_Pixels, _Pixels]:
    """Returns pixels to fit, and pixels of other views, which judge."""
    generator = np.random.default_rng(seed)
    distances = [signed_distances(mask, blur=0.0) for mask in views.masks]
    beside = np.argwhere(np.abs(np.stack(distances)) < _BESIDE)
    judging = beside[:, 0] % _JUDGE_EVERY == 0
    found = []
    for some, count in ((beside[~judging], _FITTED), (beside[judging], _JUDGES)):
        view, row, column = generator.permutation(some)[:count].T
        rays = pixel_rays(views.cameras, view, row, column)
        share = len(view) / max(len(some), 1)
        found.append(_Pixels(rays, views.masks[view, row, column], share))
    return found[0], found[1]


class _Deepest(NamedTuple):
    """The point of each ray that is deepest inside a body, or nearest to it.

    Attributes:
      depths: distances from the surface in pixels, positive inside.
      points: the points, in the frame of the axis before it was tilted and shifted.
      normals: radial and axial part of the normal of the nearest point of the profile.
      segment: segment of this point.
      share: its place on the segment.
      pixel: width of a pixel there, world units.
    """

    depths: Float[np.ndarray, " rays"]
    points: Float[np.ndarray, "rays 3"]
    normals: Float[np.ndarray, "rays 2"]
    segment: Int[np.ndarray, " rays"]
    share: Float[np.ndarray, " rays"]
    pixel: Float[np.ndarray, " rays"]


def _deepest(body: Revolution, x: Unknowns, rays: Rays) -> _Deepest:
    """Finds where rays are deepest inside a body at given unknowns."""
    axis, profile = body.axis, body.profile(x)
    origins = (np.asarray(rays.origins, np.float64) - axis.point) @ axis.frame
    origins -= np.append(x[2:4], 0.0)
    directions = np.asarray(rays.directions, np.float64) @ axis.frame
    tilted = tilt(x[:2])[0]
    share = np.arange(_PIECES)[:, None] / _PIECES
    last = len(profile.points) - (0 if body.closed else 1)
    points, normals = (
        ((1.0 - share) * of[:, None] + share * np.roll(of, -1, axis=0)[:, None])[:last].reshape(
            -1, 2
        )
        for of in (profile.points, profile.normals)
    )
    tree = KDTree(points)

    def depths(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        local = (origins[:, None] + t[..., None] * directions[:, None]).reshape(-1, 3) @ tilted
        local = local if body.relief is None else body.relief.shrink(local)
        flat = np.stack([np.hypot(local[:, 0], local[:, 1]), local[:, 2]], axis=-1)
        nearest = tree.query(flat, workers=threads())[1]
        away = np.sum(normals[nearest] * (flat - points[nearest]), axis=-1)
        return -away.reshape(t.shape), nearest.reshape(t.shape)

    widest = 1.0 if body.relief is None else 1.0 + body.relief.factors.max()
    t, half = _within(profile.points * [widest, 1.0], origins, directions)
    each = np.arange(len(t))
    for ticks in _TICKS:
        tried = t[:, None] + half[:, None] * ticks
        found, nearest = depths(tried)
        best = np.argmax(found, axis=1)
        t, half = tried[each, best], half * (ticks[1] - ticks[0])
    nearest = nearest[each, best]
    pixel = 0.5 * math.sqrt(12.0) * np.asarray(rays.radii, np.float64) * t
    return _Deepest(
        found[each, best] / pixel,
        origins + t[:, None] * directions,
        normals[nearest] / np.linalg.norm(normals[nearest], axis=-1, keepdims=True),
        nearest // _PIECES,
        (nearest % _PIECES) / _PIECES,
        pixel,
    )


def _within(
    profile: Curve, origins: Float[np.ndarray, "rays 3"], directions: Float[np.ndarray, "rays 3"]
) -> tuple[Float[np.ndarray, " rays"], Float[np.ndarray, " rays"]]:
    """Returns the middle and half the length of each ray within a cylinder around a profile."""
    flat = np.maximum(np.sum(directions[:, :2] ** 2, axis=-1), 1e-12)
    near = -np.sum(origins[:, :2] * directions[:, :2], axis=-1) / flat
    away = np.linalg.norm(origins[:, :2] + near[:, None] * directions[:, :2], axis=-1)
    radius = np.maximum(_AROUND * profile[:, 0].max(), away)
    half = np.sqrt((radius**2 - away**2) / flat)
    steep = np.where(np.abs(directions[:, 2]) > 1e-9, directions[:, 2], 1e-9)
    low, high = profile[:, 1].min(), profile[:, 1].max()
    margin = 0.5 * (_AROUND - 1.0) * (high - low)
    limits = [(low - margin, high + margin)] - origins[:, 2:]
    limits = np.sort(limits / steep[:, None], axis=-1)
    first = np.clip(limits[:, 0], near - half, near + half)
    last = np.clip(limits[:, 1], near - half, near + half)
    return 0.5 * (first + last), 0.5 * (last - first)


def _depths_by_unknowns(
    body: Revolution, x: Unknowns, deepest: _Deepest
) -> Float[np.ndarray, "rays unknowns"]:
    """Returns the derivatives of the depths; how a relief turns normals is left out."""
    share, segment = deepest.share[:, None, None], deepest.segment
    moved = body.profile(x).by_points
    moved = (1.0 - share) * moved[segment] + share * np.roll(moved, -1, axis=0)[segment]
    tilted, *by_angles = tilt(x[:2])
    local = deepest.points @ tilted
    radial = local[:, :2] / np.maximum(np.linalg.norm(local[:, :2], axis=-1), 1e-12)[:, None]
    normals = np.concatenate([deepest.normals[:, :1] * radial, deepest.normals[:, 1:]], axis=-1)
    turned = [-np.sum(normals * (deepest.points @ by), axis=-1) for by in by_angles]
    shifted = normals @ tilted[:2].T
    offsets = np.einsum("nk,nkm->nm", deepest.normals, moved)
    rows = np.concatenate([np.stack(turned, axis=-1), shifted, offsets], axis=-1)
    return rows / deepest.pixel[:, None]


def _surprises(
    depths: Float[np.ndarray, " rays"], inside: Bool[np.ndarray, " rays"], deviation: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns minus the logarithm of the probability of each pixel's mask; slope and curvature.

    The probability that a pixel is in a mask is a logistic function of its depth; a small share of
    the pixels is wrong.
    """
    logistic = expit(depths / deviation)
    likely = _MISTAKES + (1.0 - 2.0 * _MISTAKES) * logistic
    slope = (1.0 - 2.0 * _MISTAKES) * logistic * (1.0 - logistic) / deviation
    of_mask = np.where(inside, likely, 1.0 - likely)
    return (
        -np.log(of_mask),
        np.where(inside, -slope, slope) / of_mask,
        slope**2 / (likely * (1.0 - likely)),
    )


def _judged(body: Revolution, pixels: _Pixels) -> tuple[float, float]:
    """Returns the share of pixels on whose masks a body is wrong, and the mean of `_surprises`."""
    depths = _deepest(body, body.start(), pixels.rays).depths
    wrong = np.mean((depths > 0.0) != pixels.inside)
    return float(wrong), float(np.mean(_surprises(depths, pixels.inside, _MASK_DEVIATION)[0]))


def _fitted_to_pixels(body: Revolution, pixels: _Pixels) -> Revolution:
    """Fits a body to which pixels are in masks, by the rays through their centres.

    Profiles consist of straight lines and arcs: changes of their curvature have a Cauchy
    distribution, whose scale becomes smaller.
    """
    x = body.start()
    for scale, deviation in _SCALES:
        x = _descended(body, x, pixels, scale * _FINE_BEND * body.size, deviation)
    return body.moved(x)


def _descended(
    body: Revolution, x: Unknowns, pixels: _Pixels, scale: float, deviation: float
) -> Unknowns:
    """Returns unknowns after steps with one scale of the changes of curvature, world units."""
    rest, by_offsets = body.curvature_changes()
    bends = np.zeros((len(rest), 4 + body.knots))
    rest, bends[:, 4:] = rest / scale, by_offsets / scale
    loose, _ = body.prior(body.start(), bend=math.inf)

    def look(x: Unknowns) -> tuple[float, _Deepest]:
        deepest = _deepest(body, x, pixels.rays)
        surprise = np.sum(_surprises(deepest.depths, pixels.inside, deviation)[0]) / pixels.share
        prior = 0.5 * x @ loose @ x + np.sum(np.log1p((rest + bends @ x) ** 2))
        return float(surprise + prior), deepest

    damping = _DAMPING
    energy, deepest = look(x)
    for _ in range(_FINE_ROUNDS):
        rows = _depths_by_unknowns(body, x, deepest)
        _, slopes, weights = _surprises(deepest.depths, pixels.inside, deviation)
        ratio = rest + bends @ x
        robust = 2.0 / (1.0 + ratio**2)
        matrix = (rows.T * weights) @ rows / pixels.share + loose + (bends.T * robust) @ bends
        gradient = rows.T @ slopes / pixels.share + loose @ x + bends.T @ (robust * ratio)
        gain = 0.0
        while gain <= 0.0 and damping < _MOST_DAMPING:
            step = np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), -gradient)
            lower, there = look(x + step)
            gain = energy - lower
            damping *= _DAMPING_STEP if gain <= 0.0 else 1.0 / _DAMPING_STEP
        if gain > 0.0:
            x, energy, deepest = x + step, lower, there
        if gain < _LEAST_GAIN:
            break
    return x


def _crease_rim(part: Posed, creases: Creases, camera: Float[np.ndarray, "3"]) -> _Rim:
    """Returns points of the creases with one face towards the camera and one away from it."""
    corners = part.vertices[part.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    front = np.sum(normals * (camera - corners[:, 0]), axis=-1) > 0.0
    seen = creases.edges[front[creases.faces[:, 0]] != front[creases.faces[:, 1]]]
    # The ends are left out, where the smoothed distances of a mask cut corners.
    share = (np.arange(_ALONG_CREASE) + 1.5) / (_ALONG_CREASE + 2.0)
    repeated = np.repeat(seen, _ALONG_CREASE, axis=0)
    return _Rim(repeated[:, 0], repeated[:, 1], np.tile(share, len(seen)))


def _rim(
    vertices: Float[np.ndarray, "vertices 3"],
    normals: Float[np.ndarray, "vertices 3"],
    edges: Int[np.ndarray, "edges 2"],
    camera: Float[np.ndarray, "3"],
) -> _Rim:
    """Returns where the interpolated normals are perpendicular to the lines of sight."""
    facing = np.sum(normals * (camera - vertices), axis=-1)
    first, second = facing[edges[:, 0]], facing[edges[:, 1]]
    turns = np.flatnonzero((first > 0.0) != (second > 0.0))
    share = first[turns] / (first[turns] - second[turns])
    return _Rim(edges[turns, 0], edges[turns, 1], share)
