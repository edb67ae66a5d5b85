"""Which of several fitted models to keep: the smallest one that held-out pixels do not refuse.

A `Trial` is a model that was fitted, with the errors of pixels that it was not fitted to. Errors of
one view are alike, so views are what is counted: one trial is worse than another if the mean of the
differences of their views' errors is above two standard errors.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import scipy.sparse
from jaxtyping import Float

from refref_jax.geometry.triangle_meshes import Mesh
from refref_jax.reconstruct import gauss_newton
from refref_jax.reconstruct.gauss_newton import Candidate, Fit, Model
from refref_jax.reconstruct.photometry import Backdrop, Photographs
from refref_jax.reconstruct.shapes import mesh_of

# Number of normals whose deviations are found at once.
_NORMALS = 4096

# Standard errors by which a trial must be worse than the best to lose.
_WORSE = 2.0

# Differences below a quarter of an 8-bit level say nothing, sRGB: light that is not followed makes
# as much.
_LEVEL = 0.25 / 255.0

# Largest error of a hypothesis that might be true as well, relative to that of the chosen one.
_CLOSE = 1.25


@runtime_checkable
class ObjectModel(Model, Protocol):
    """A model whose outermost part has an index of refraction."""

    def index_of(self, x: Float[np.ndarray, " unknowns"]) -> float:
        """Returns that index at given unknowns."""


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


def compare(trial: Trial, best: Trial) -> Comparison:
    """Returns how much worse a trial is than the best, by the judges of each view."""
    difference = trial.by_view - best.by_view
    count = len(difference)
    error = float(difference.std(ddof=1)) / math.sqrt(count) if count > 1 else 0.0
    return Comparison(float(difference.mean()), error)


def choose(trials: Sequence[Trial]) -> Trial:
    """Returns the trial of fewest unknowns that is not worse than the best by two standard errors.

    A difference of less than a quarter of an 8-bit level does not count. Of trials with as many
    unknowns, the better one comes first.

    Args:
      trials: one or more trials.
    """
    best = min(trials, key=lambda trial: trial.error)
    for trial in sorted(trials, key=lambda trial: (len(trial.fit.x), trial.error)):
        worse = compare(trial, best)
        if worse.mean <= max(_WORSE * worse.error, _LEVEL):
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
