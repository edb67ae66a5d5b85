"""Which of several fitted models to keep: the smallest one that held-out views do not reject.

A `Trial` is a model that was fitted, with the errors of pixels that it was not fitted to. Errors of
one view are alike, so views are what is counted: one trial is worse than another if the mean of the
differences of their views' errors is above two standard errors.

`shape_from_outlines` fits families to the outlines of masks alone, for objects that no light can
refine. Masks that are wrong by a pixel or two carve a body that is too small and rough; a family
has so few unknowns that their errors average out, and it knows the side that no view shows. A
family that lacks a part which the masks show, such as a handle, is rejected.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt

from refref_jax.geometry.triangle_meshes import Mesh, pieces
from refref_jax.reconstruct import families, gauss_newton
from refref_jax.reconstruct.gauss_newton import Candidate, Fit, Model
from refref_jax.reconstruct.masks import Views, overlaps, views_at
from refref_jax.reconstruct.mesh_distance import silhouettes
from refref_jax.reconstruct.outlines import Outlines
from refref_jax.reconstruct.photometry import Backdrop, Photographs
from refref_jax.reconstruct.polyhedra import fit_polyhedron, with_right_angles
from refref_jax.reconstruct.polytope_fit import fit_polytope
from refref_jax.reconstruct.shapes import FixedShape, Shape, Unknowns, mesh_of

# Number of normals whose deviations are found at once.
_NORMALS = 4096

# Standard errors by which a trial must be worse than the best to lose.
_WORSE = 2.0

# Differences below a quarter of an 8-bit level say nothing, sRGB: light that is not followed makes
# as much.
_LEVEL = 0.25 / 255.0

# Largest rms distance of a mesh from a family that may explain its outlines, as a share of its
# diameter: the body that masks carve reaches far below an object that no view shows from below.
_NEAR_OUTLINES = 0.12

# Pixels by which corners of a polyhedron stick out.
_TOLERANCES = (4.0, 2.0, 1.0)

# Largest distance of silhouette and mask in the median view, in pixels: the smaller of a fixed one
# and of 1.5 times that of the mesh from masks plus 1.
_MOST_APART, _APART_SHARE, _APART_MORE = 4.0, 1.5, 1.0

# One view in this many judges shapes that are fitted to outlines. Distances beyond which outlines
# are ignored, in pixels, and steps with each. Largest error of a shape, as a share of the least.
_JUDGE_EVERY, _REACHES, _OUTLINE_STEPS, _AS_GOOD = 5, (6.0, 3.0), 8, 1.05

# Largest error of a hypothesis that might be true as well, relative to that of the chosen one.
_CLOSE = 1.25


@runtime_checkable
class ObjectModel(Model, Protocol):
    """A model whose outermost part has an index of refraction."""

    def index_of(self, x: Float[np.ndarray, " unknowns"]) -> float:
        """Returns that index at given unknowns."""


@runtime_checkable
class Judged(Protocol):
    """What was fitted, and its errors in views that judge it."""

    @property
    def unknowns(self) -> int:
        """Number of its unknowns."""

    @property
    def by_view(self) -> Float[np.ndarray, " views"]:
        """Error of each view."""


AnyJudged = TypeVar("AnyJudged", bound=Judged)


class Trial(NamedTuple):
    """One model, fitted.

    Attributes:
      name: kind of the model, in words.
      model: the model.
      fit: its unknowns, their covariance, and what the steps did.
      by_view: mean robust error of the judges of each view, sRGB.
    """

    name: str
    model: ObjectModel
    fit: Fit
    by_view: Float[np.ndarray, " views"]

    @property
    def error(self) -> float:
        """Mean error of the judges."""
        return float(self.by_view.mean())

    @property
    def unknowns(self) -> int:
        """Number of unknowns."""
        return len(self.fit.x)

    @property
    def candidate(self) -> Candidate:
        """The scene at the fitted unknowns."""
        return self.model.pose(self.fit.x)

    @property
    def outer_index(self) -> float:
        """Index of refraction of the outermost part."""
        return self.model.index_of(self.fit.x)

    @property
    def index_deviation(self) -> float:
        """Standard deviation of this index."""
        by: Any = self.candidate.by_indices
        row = (by.toarray() if scipy.sparse.issparse(by) else np.asarray(by))[0]
        return math.sqrt(max(float(row @ self.fit.covariance @ row), 0.0))

    @property
    def mesh(self) -> Mesh:
        """Surface of the outermost part."""
        return mesh_of(self.candidate.parts[0])


def judged(
    name: str, model: ObjectModel, fit: Fit, surface: Backdrop, judges: Photographs
) -> Trial:
    """Returns a fitted model with the errors of the judges.

    Args:
      name: kind of the model, in words.
      model: the model.
      fit: its unknowns.
      surface: backdrop.
      judges: pixels that it was not fitted to.
    """
    traced = gauss_newton.traced_object(model.pose(fit.x))
    errors = gauss_newton.errors_of(traced, surface, judges)
    _, views = np.unique(judges.views, return_inverse=True)
    return Trial(name, model, fit, np.bincount(views, errors) / np.bincount(views))


class Comparison(NamedTuple):
    """How much worse one trial is than another.

    Attributes:
      mean: mean difference of the errors of views, sRGB.
      error: standard error of the mean.
    """

    mean: float
    error: float


def compare(trial: Judged, best: Judged) -> Comparison:
    """Returns how much worse a trial is than the best, by the judges of each view."""
    difference = trial.by_view - best.by_view
    count = len(difference)
    error = float(difference.std(ddof=1)) / math.sqrt(count) if count > 1 else 0.0
    return Comparison(float(difference.mean()), error)


def choose(trials: Sequence[AnyJudged], *, level: float = _LEVEL) -> AnyJudged:
    """Returns the trial of fewest unknowns that is not worse than the best by two standard errors.

    Of trials with as many unknowns, the better one comes first.

    Args:
      trials: one or more trials.
      level: difference that does not count; a quarter of an 8-bit level by default.
    """
    best = min(trials, key=lambda trial: trial.by_view.mean())
    for trial in sorted(trials, key=lambda trial: (trial.unknowns, trial.by_view.mean())):
        worse = compare(trial, best)
        if worse.mean <= max(_WORSE * worse.error, level):
            return trial
    return best


def index_deviation(chosen: Trial, rivals: Sequence[Trial]) -> float:
    """Returns the standard deviation of the index of a trial, with what pixels do not tell.

    Vessels have errors of the model that all views share: the covariance knows nothing of them, but
    other hypotheses that explain the judges nearly as well have other indices. The largest
    difference from those whose error is at most a quarter larger is added, in squares.

    Args:
      chosen: the trial that was kept.
      rivals: other hypotheses of the same kind; the trial itself may be among them.
    """
    close = [each for each in rivals if each.error <= _CLOSE * chosen.error]
    most = max((abs(each.outer_index - chosen.outer_index) for each in close), default=0.0)
    return math.hypot(chosen.index_deviation, most)


def normal_deviations(trial: Trial) -> Float[np.ndarray, " normals"]:
    """Returns the standard deviation of each normal of the outermost part, in degrees."""
    by: Any = trial.candidate.parts[0].by_normals
    found = []
    for start in range(0, by.shape[0], 3 * _NORMALS):
        some = by[start : start + 3 * _NORMALS]
        spread = some @ trial.fit.covariance
        both = some.multiply(spread) if scipy.sparse.issparse(some) else np.asarray(some) * spread
        found.append(np.asarray(both.sum(axis=1)).reshape(-1, 3).sum(axis=1))
    return np.degrees(np.sqrt(np.maximum(np.concatenate(found), 0.0)))


class OutlineTrial(NamedTuple):
    """A shape that was fitted to the outlines of masks.

    Attributes:
      shape: the shape.
      unknowns: their number; that of the coordinates for a mesh from masks.
      by_view: share of mask and silhouette of each judging view that is not in both.
      apart: median over these views of the largest distance, in pixels, of a pixel of the mask from
        the silhouette, or the reverse.
    """

    shape: Shape
    unknowns: int
    by_view: Float[np.ndarray, " views"]
    apart: float


class FamilyFit(NamedTuple):
    """A family of shapes (`families`) by its name, and its surface."""

    name: str
    mesh: Mesh


def shape_from_outlines(
    mesh: Mesh,
    views: Views,
    *,
    carved: Mesh | None = None,
    seed: int = 0,
    progress: Callable[[int, int, str], None] = lambda done, total, text: None,
) -> FamilyFit | None:
    """Returns the smallest family of shapes that the outlines of masks do not reject.

    The families are fitted to four views in five; the others judge them and the mesh, by how much
    of mask and silhouette is not in both (`choose`, of those within 5 % of the best). The mesh was
    made of all masks, which is to its advantage. The family that is kept is fitted to all views.
    Polyhedra have the corners that stick out of the outlines.

    Args:
      mesh: closed mesh of the object, from masks.
      views: masks and their cameras.
      carved: the mesh before it was smoothed, which rounds its corners.
      seed: seed of the draws of points.
      progress: function called with the number of fits done, their total, and a line of text.

    Returns:
      `None` if the mesh is better than any family, if it has several pieces, or if there are too
      few masks with an outline.

    Raises:
      ReconstructionError: if the mesh is empty, flat, inside out or not finite, or
        scikit-image is not installed.
    """
    carved = mesh if carved is None else carved
    outlined = np.flatnonzero([mask.any() and not mask.all() for mask in views.masks])
    views = views_at(views, outlined)
    judging = np.arange(len(views.masks)) % _JUDGE_EVERY == 0
    fitted, judges = (views_at(views, each) for each in (~judging, judging))
    if not len(fitted.masks) or len(np.unique(pieces(mesh.faces, len(mesh.vertices)))) > 1:
        return None
    whole = _judged_by_masks(FixedShape(mesh), mesh, judges)
    allowed = min(_MOST_APART, _APART_SHARE * whole.apart + _APART_MORE)
    trials, shapes = [whole], _near_outlines(carved, fitted)
    total = len(shapes) + 1
    for number, shape in enumerate(shapes):
        progress(number, total, shape.name)
        found = mesh_of(shape.pose(fit_to_outlines(shape, fitted, seed=seed)))
        trial = _judged_by_masks(shape, found, judges)
        trials += [trial] if trial.apart <= allowed else []
    most = _AS_GOOD * min(each.by_view.mean() for each in trials)  # few views cannot tell
    chosen = choose([each for each in trials if each.by_view.mean() <= most], level=0.0)
    if chosen is whole:
        progress(total, total, "no family is as good as the mesh")
        return None
    x = fit_to_outlines(chosen.shape, views, seed=seed)
    progress(total, total, chosen.shape.name)
    return FamilyFit(chosen.shape.name, mesh_of(chosen.shape.pose(x)))


def _near_outlines(carved: Mesh, views: Views) -> list[Shape]:
    """Returns the families that may explain the outlines of an object."""
    *near, _ = families.candidates(carved, furthest=_NEAR_OUTLINES)
    bodies = (fit_polytope(carved, views, tolerance=each) for each in _TOLERANCES)
    polyhedra = [fit_polyhedron(body) for body in bodies if body is not None]
    found = [each for each in polyhedra if each is not None]
    angled = (with_right_angles(each) for each in found)
    return [*near, *found, *(each for each in angled if each is not None)]


def _judged_by_masks(shape: Shape, mesh: Mesh, judges: Views) -> OutlineTrial:
    """Returns a shape whose surface is `mesh`, with its errors in views that judge it."""
    seen = silhouettes(mesh, judges.cameras)
    unknowns = mesh.vertices.size if isinstance(shape, FixedShape) else len(shape.start())
    apart = [_distance_between(*pair) for pair in zip(seen, judges.masks, strict=True)]
    missed = 1.0 - overlaps(seen, judges.masks)
    return OutlineTrial(shape, unknowns, missed, float(np.median(apart)))


def _distance_between(seen: Bool[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"]) -> float:
    """Returns the largest distance of a pixel of one area from the other, in pixels."""
    if not seen.any() or not mask.any():
        return math.inf
    return max(
        float(distance_transform_edt(~area)[other].max())
        for area, other in ((seen, mask), (mask, seen))
    )


def fit_to_outlines(shape: Shape, views: Views, *, seed: int = 0) -> Unknowns:
    """Fits the unknowns of a shape to the outlines of masks, by Gauss-Newton steps.

    Args:
      shape: a shape near the outlines.
      views: masks and their cameras.
      seed: seed of the draws of points.
    """
    x, scales = shape.start(), shape.scales()
    for reach in _REACHES if len(x) else ():
        outlines = Outlines(views, seed=seed, reach=reach, creased=True)
        for _ in range(_OUTLINE_STEPS):
            rows = outlines.of_surface(shape.pose(x))
            weighted = rows.weights[:, None] * rows.derivatives
            precision, gradient = shape.prior(x)
            matrix = weighted.T @ rows.derivatives + precision
            step = -np.linalg.solve(matrix, weighted.T @ rows.errors + gradient)
            x = x + step / max(1.0, float(np.max(np.abs(step) / scales)))
    return x
