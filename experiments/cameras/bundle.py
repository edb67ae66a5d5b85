"""Poses of cameras and places of points from where images show the points (NumPy only).

A correction of a pose is a small rotation `w` and a shift `t` in the world, `R -> exp(w) R` and
`c -> c + t`, six numbers. With `y = R^T (X - c)` the point in the frame of its camera, whose image
is `u = W/2 - f y_0 / y_2`, `v = H/2 + f y_1 / y_2`,

    dy/dt = -R^T,   dy/dw = R^T [X - c]x,   dy/dX = R^T.

Levenberg-Marquardt steps minimise robust errors of pixels plus a prior: corrections have the given
standard deviations. Points are eliminated from each step (Schur complement). The prior holds the
common rotation, place and scale, which images do not show; `similarity` removes what is left.

Sources: Triggs et al., Bundle Adjustment - A Modern Synthesis (2000); Umeyama (1991) for the
similarity, but for its rotation; Geman and McClure (1987) for the robust error.
"""

from typing import NamedTuple

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

# Steps of one solution; relative change of the error at which it ends; damping at first.
_STEPS, _ENOUGH, _DAMPING = 40, 1e-5, 1e-4

# Scale of the robust error as a multiple of the typical one, and the least one, pixels.
_SCALE, _LEAST_SCALE = 2.5, 0.1


class Views(NamedTuple):
    """Pinhole cameras, each with its own size.

    Attributes:
      poses: camera-to-world matrices, x right, y up, looking along -z.
      focals: focal lengths, pixels.
      middles: principal points, column and row, pixels.
    """

    poses: Float[np.ndarray, "views 3 4"]
    focals: Float[np.ndarray, " views"]
    middles: Float[np.ndarray, "views 2"]


class Sightings(NamedTuple):
    """Where views show points.

    Attributes:
      view: number of the view.
      point: number of the point.
      places: pixel coordinates, column and row.
    """

    view: Int[np.ndarray, " n"]
    point: Int[np.ndarray, " n"]
    places: Float[np.ndarray, "n 2"]


class Prior(NamedTuple):
    """Standard deviations of the errors of given poses, per axis.

    Attributes:
      rotation: standard deviation of rotations, radians.
      shift: standard deviation of positions, world units.
    """

    rotation: float
    shift: float


class Solution(NamedTuple):
    """Result of `solve`.

    Attributes:
      views: views with corrected poses.
      points: places of the points, world units.
      errors: distance between where a point is seen and its image, pixels, of each sighting.
      deviations: standard deviations of the corrections, `w` in radians and `t` in world units.
    """

    views: Views
    points: Float[np.ndarray, "points 3"]
    errors: Float[np.ndarray, " n"]
    deviations: Float[np.ndarray, "views 6"]


def mean_distance(views: Views) -> float:
    """Returns the mean distance of the cameras from their middle, world units."""
    places = views.poses[..., 3]
    return float(np.linalg.norm(places - places.mean(axis=0), axis=-1).mean())


def corrected(
    poses: Float[np.ndarray, "views 3 4"], corrections: Float[np.ndarray, "views 6"]
) -> Float[np.ndarray, "views 3 4"]:
    """Returns poses after corrections `(w, t)`; see the module."""
    turns = Rotation.from_rotvec(corrections[:, :3]).as_matrix()
    turned = turns @ poses[..., :3]
    return np.concatenate([turned, poses[..., 3:] + corrections[:, 3:, None]], axis=-1)


def correction_between(
    before: Float[np.ndarray, "views 3 4"], after: Float[np.ndarray, "views 3 4"]
) -> Float[np.ndarray, "views 6"]:
    """Returns the corrections that lead from poses to others, the inverse of `corrected`."""
    turns = Rotation.from_matrix(after[..., :3] @ before[..., :3].transpose(0, 2, 1))
    return np.concatenate([turns.as_rotvec(), after[..., 3] - before[..., 3]], axis=-1)


def project(
    views: Views, points: Float[np.ndarray, "n 3"], view: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Returns pixel coordinates of points in a view each, and their depths."""
    inside = _in_camera(views, points, view)
    depth = -inside[:, 2]
    safe = np.where(depth > 0.0, depth, np.inf)[:, None]
    flat = inside[:, :2] * [1.0, -1.0] / safe
    return views.middles[view] + views.focals[view, None] * flat, depth


def derivatives(
    views: Views, points: Float[np.ndarray, "n 3"], view: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 2 6"], Float[np.ndarray, "n 2 3"]]:
    """Returns the derivatives of `project` by the corrections of the view, and by the point."""
    y = _in_camera(views, points, view)
    back = views.poses[view, :, :3].transpose(0, 2, 1)
    x = points - views.poses[view, :, 3]
    zero = np.zeros(len(x))
    cross = np.stack(
        [zero, -x[:, 2], x[:, 1], x[:, 2], zero, -x[:, 0], -x[:, 1], x[:, 0], zero], axis=-1
    ).reshape(-1, 3, 3)
    scale = views.focals[view] / y[:, 2]
    by_y = np.zeros((len(x), 2, 3))
    by_y[:, 0, 0], by_y[:, 1, 1] = -scale, scale
    by_y[:, 0, 2], by_y[:, 1, 2] = scale * y[:, 0] / y[:, 2], -scale * y[:, 1] / y[:, 2]
    by_point = by_y @ back
    return np.concatenate([by_point @ cross, -by_point], axis=-1), by_point


def triangulate(views: Views, seen: Sightings, count: int) -> Float[np.ndarray, "points 3"]:
    """Returns the points nearest to the rays that show them, by least squares of distances."""
    flat = (seen.places - views.middles[seen.view]) / views.focals[seen.view, None]
    towards = np.concatenate([flat * [1.0, -1.0], -np.ones((len(flat), 1))], axis=-1)
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    towards = np.einsum("nij,nj->ni", views.poses[seen.view, :, :3], towards)
    across = np.eye(3) - towards[:, :, None] * towards[:, None, :]
    total = np.tile(1e-12 * np.eye(3), (count, 1, 1))
    pulled = np.zeros((count, 3))
    np.add.at(total, seen.point, across)
    starts = views.poses[seen.view, :, 3]
    np.add.at(pulled, seen.point, np.einsum("nij,nj->ni", across, starts))
    return np.linalg.solve(total, pulled[..., None])[..., 0]


def solve(views: Views, points: np.ndarray, seen: Sightings, prior: Prior) -> Solution:
    """Returns the most likely poses and points.

    Args:
      views: views with the given poses.
      points: first guess of the points, `[points, 3]`.
      seen: sightings; each point has two at least.
      prior: expected errors of given poses.
    """
    given = views.poses
    weights_of_prior = np.repeat([prior.rotation**-2.0, prior.shift**-2.0], 3)
    damping, errors = _DAMPING, _errors(views, points, seen)
    for _ in range(_STEPS):
        noise = _typical(errors)
        scale = max(_SCALE * noise, _LEAST_SCALE)
        correction = correction_between(given, views.poses)
        before = _cost(errors, scale, noise, correction, weights_of_prior)
        system = _linearise(views, points, seen, scale, noise)
        while True:
            by_view, by_point = _step(system, correction, weights_of_prior, damping)
            trial = views._replace(poses=corrected(views.poses, by_view))
            moved = points + by_point
            trial_errors = _errors(trial, moved, seen)
            after = _cost(
                trial_errors,
                scale,
                noise,
                correction_between(given, trial.poses),
                weights_of_prior,
            )
            if after < before or damping > 1e8:
                break
            damping *= 10.0
        if not after < before:
            break
        views, points, errors = trial, moved, trial_errors
        damping = max(0.1 * damping, 1e-9)
        if before - after < _ENOUGH * before:
            break
    noise = _typical(errors)
    system = _linearise(views, points, seen, max(_SCALE * noise, _LEAST_SCALE), noise)
    reduced, _, _ = _reduce(system, np.zeros((len(given), 6)), weights_of_prior, 0.0)
    deviations = np.sqrt(np.diag(np.linalg.inv(reduced))).reshape(-1, 6)
    return Solution(views, points, errors, deviations)


class _System(NamedTuple):
    """Normal equations of one step, in blocks: views, points, and what links them."""

    views: np.ndarray
    points: np.ndarray
    links: scipy.sparse.csr_array
    by_views: np.ndarray
    by_points: np.ndarray


def _linearise(
    views: Views, points: np.ndarray, seen: Sightings, scale: float, noise: float
) -> _System:
    images, _ = project(views, points[seen.point], seen.view)
    by_view, by_point = derivatives(views, points[seen.point], seen.view)
    error = images - seen.places
    weight = (1.0 + (error**2).sum(axis=1) / scale**2) ** -2.0 / noise**2
    count, total = len(views.poses), len(points)
    a, b = np.zeros((count, 6, 6)), np.zeros((total, 3, 3))
    weighted = weight[:, None, None] * by_view
    np.add.at(a, seen.view, weighted.transpose(0, 2, 1) @ by_view)
    np.add.at(b, seen.point, weight[:, None, None] * by_point.transpose(0, 2, 1) @ by_point)
    blocks = weighted.transpose(0, 2, 1) @ by_point
    rows = (6 * seen.view[:, None, None] + np.arange(6)[:, None]) + np.zeros((1, 1, 3), np.int64)
    columns = (3 * seen.point[:, None, None] + np.arange(3)) + np.zeros((1, 6, 1), np.int64)
    shape = (6 * count, 3 * total)
    links = scipy.sparse.csr_array((blocks.ravel(), (rows.ravel(), columns.ravel())), shape)
    by_views, by_points = np.zeros((count, 6)), np.zeros((total, 3))
    np.add.at(by_views, seen.view, np.einsum("nji,nj->ni", weighted, error))
    pulled = weight[:, None] * np.einsum("nji,nj->ni", by_point, error)
    np.add.at(by_points, seen.point, pulled)
    return _System(a, b, links, by_views, by_points)


def _reduce(
    system: _System, correction: np.ndarray, weights: np.ndarray, damping: float
) -> tuple[np.ndarray, np.ndarray, scipy.sparse.csr_array]:
    """Returns the equations of the views alone, and the inverse of the points' blocks."""
    count, total = len(system.views), len(system.points)
    diagonal = np.einsum("nii->ni", system.points)
    damped = system.points + ((damping * diagonal + 1e-9)[..., None] * np.eye(3))
    starts = np.arange(total + 1)
    blocks = (np.linalg.inv(damped), np.arange(total), starts)
    inverse = scipy.sparse.bsr_array(blocks, shape=(3 * total, 3 * total)).tocsr()
    through = system.links @ inverse
    full = np.zeros((count, 6, count, 6))
    number = np.arange(count)
    own = system.views + np.diag(weights)
    full[number, :, number] = own + damping * np.einsum("nii->ni", own)[..., None] * np.eye(6)
    reduced = full.reshape(6 * count, 6 * count) - (through @ system.links.T).toarray()
    right = system.by_views + weights * correction
    return reduced, right.ravel() - through @ system.by_points.ravel(), inverse


def _step(
    system: _System, correction: np.ndarray, weights: np.ndarray, damping: float
) -> tuple[np.ndarray, np.ndarray]:
    reduced, right, inverse = _reduce(system, correction, weights, damping)
    by_view = -np.linalg.solve(reduced, right)
    by_point = -(inverse @ (system.by_points.ravel() + system.links.T @ by_view))
    return by_view.reshape(-1, 6), by_point.reshape(-1, 3)


def _errors(views: Views, points: np.ndarray, seen: Sightings) -> np.ndarray:
    images, depths = project(views, points[seen.point], seen.view)
    error = np.linalg.norm(images - seen.places, axis=1)
    return np.where(depths > 0.0, error, np.inf)


def _typical(errors: np.ndarray) -> float:
    """Returns the standard deviation per axis of errors, from their median."""
    # The median of a Rayleigh distribution is 1.1774 standard deviations.
    return max(float(np.median(errors)) / 1.1774, 1e-3)


def _cost(
    errors: np.ndarray, scale: float, noise: float, correction: np.ndarray, weights: np.ndarray
) -> float:
    share = np.where(np.isfinite(errors), errors / scale, 1e6) ** 2
    robust = (scale / noise) ** 2 * share / (1.0 + share)
    return float(robust.sum() + (weights * correction**2).sum())


class Similarity(NamedTuple):
    """A change of the world: `x -> scale rotation x + shift`."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]


def similarity(
    poses: Float[np.ndarray, "views 3 4"], wanted: Float[np.ndarray, "views 3 4"]
) -> Similarity:
    """Returns the similarity that brings poses nearest to wanted ones, by least squares.

    Its rotation is that of the cameras' axes, which a short path of cameras shows better than their
    positions do; scale and shift follow from the positions.

    Raises:
      ValueError: if all cameras are at the same place.
    """
    start, end = poses[..., 3], wanted[..., 3]
    first, second = start - start.mean(axis=0), end - end.mean(axis=0)
    spread = float((first**2).sum())
    if spread == 0.0:
        raise ValueError("All cameras are at the same place. Give cameras around the scene.")
    u, _, v = np.linalg.svd((wanted[..., :3] @ poses[..., :3].transpose(0, 2, 1)).sum(axis=0))
    rotation = (u * [1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v
    scale = float((second * (first @ rotation.T)).sum()) / spread
    return Similarity(scale, rotation, end.mean(axis=0) - scale * rotation @ start.mean(axis=0))


def moved(
    poses: Float[np.ndarray, "views 3 4"], change: Similarity
) -> Float[np.ndarray, "views 3 4"]:
    """Returns poses in the changed world."""
    positions = change.scale * poses[..., 3] @ change.rotation.T + change.shift
    return np.concatenate([change.rotation @ poses[..., :3], positions[..., None]], axis=-1)


def _in_camera(
    views: Views, points: Float[np.ndarray, "n 3"], view: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    pose = views.poses[view]
    return np.einsum("nji,nj->ni", pose[..., :3], points - pose[..., 3])
