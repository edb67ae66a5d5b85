"""Fits shapes and indices of refraction to photographs of refracted light, by Gauss-Newton steps.

A `Model` turns a vector of unknowns into a scene of nested dielectrics, with the derivatives of its
vertices, normals, indices and tints. Each step draws fresh pixels, traces them through the scene as
it is now, and solves

    (J^T W J / s^2 + P + mu diag) dx = -J^T W r / s^2 - p

for the change of the unknowns: `r` are errors of pixels in sRGB, `J` their derivatives, sparse ray
by ray (`photometry`), `W` robust weights, `s` the typical error, and `P`, `p` the precision and the
gradient of the prior. A step is taken if it explains other, fresh pixels better; otherwise `mu`
grows. The backdrop is blurred at first: steps find their way only within its detail.

The inverse of the matrix is the covariance of the unknowns, if errors of pixels are independent.
Those of one view are not: a backdrop that is a little off shifts them alike. The scatter of the
gradients of whole views says by how much the covariance is too small.

Sources: Geman and McClure (1987), robust weights; Blake and Zisserman (1987) and Black and
Rangarajan (1996), weights that are wide at first; Levenberg (1944) and Marquardt (1963), damping;
Liang and Zeger (1986), covariance from clusters of errors, here views; Wu et al.: Full 3D
Reconstruction of Transparent Objects (2018), for shape from refracted light; the sparse Jacobian
through traced triangles is ours.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, TypeAlias, runtime_checkable

import numpy as np
import scipy.linalg
import scipy.sparse
from jaxtyping import Bool, Float, Int, Num

from refref_jax.choices import SATURATED
from refref_jax.compilation import at_once
from refref_jax.geometry.bvh import NO_PRIMITIVE
from refref_jax.optics.media import Interfaces
from refref_jax.reconstruct import ReconstructionError, photometry
from refref_jax.reconstruct.photometry import Backdrop, Photographs, TracedObject
from refref_jax.reconstruct.shapes import Posed

Matrix: TypeAlias = Float[np.ndarray, "_ _"] | scipy.sparse.csr_array
"""A matrix of derivatives, dense or sparse."""

# Errors of pixels beyond this, in sRGB, do not grow in the robust error.
_CAP = 0.15

# Smallest scale of the robust weights, in sRGB, its ratio to the median error, and its factor from
# step to step; smallest typical error, near the rounding of 8 bits.
_LEAST_SCALE, _SCALE, _NARROWING, _LEAST_NOISE = 0.02, 1.5, 0.9, 0.005

# Linear RGB below which the slope of sRGB is held: dark noise would weigh most. Share of non-zero
# entries from which on a Jacobian is a dense matrix.
_DARK, _FULL = 2e-3, 0.1

# Pixels where less of the light was followed, or that end where fewer pixels saw the backdrop
# directly, do not count. Unknowns above which a sample estimates their covariance's size. Number of
# first steps, which no limit ends. Ratio of errors below which a step may be doubled.
_FOLLOWED, _SEEN, _MANY, _FIRST, _WORTH = 0.7, 0.5, 1000, 2, 0.995


class Candidate(NamedTuple):
    """A scene at given unknowns, and its derivatives.

    Attributes:
      parts: surfaces of the parts; their derivatives are by all unknowns.
      interfaces: interfaces of the parts, under the rule `nested`.
      by_indices: derivatives of the index of each part.
      by_tints: derivatives of the logarithm of the tint of each part and channel.
      by_absorptions: derivatives of the absorption of each part's medium and channel.
    """

    parts: Sequence[Posed]
    interfaces: Interfaces
    by_indices: Matrix
    by_tints: Matrix
    by_absorptions: Matrix | None = None


@runtime_checkable
class Model(Protocol):
    """What a vector of unknowns means."""

    def start(self) -> Float[np.ndarray, " unknowns"]:
        """Returns the unknowns to begin with."""

    def pose(self, x: Float[np.ndarray, " unknowns"]) -> Candidate:
        """Returns the scene at given unknowns."""

    def prior(
        self, x: Float[np.ndarray, " unknowns"]
    ) -> tuple[Float[np.ndarray, "unknowns unknowns"], Float[np.ndarray, " unknowns"]]:
        """Returns precision and gradient of the negative logarithm of the prior."""

    def scales(self) -> Float[np.ndarray, " unknowns"]:
        """Returns the largest change of each unknown in one step."""


class Rows(NamedTuple):
    """Further linear equations, such as those of outlines: `derivatives dx = -errors`.

    Attributes:
      errors: errors, in units of their standard deviation.
      derivatives: their derivatives by the unknowns.
      weights: robust weight of each.
      common: standard deviation of an error that all rows share, in the same units.
    """

    errors: Float[np.ndarray, " rows"]
    derivatives: Matrix
    weights: Float[np.ndarray, " rows"]
    common: float = 0.0


@dataclasses.dataclass(frozen=True)
class Steps:
    """Settings of a fit.

    Attributes:
      blurs: blur of the backdrop in each step, in halvings of its resolution.
      rays: number of pixels of a step.
      judges: number of fresh pixels that decide whether a step is taken.
      outliers: share of the pixels of largest derivatives that are left out.
      least: largest change of an unknown, relative to its scale, below which the fit has ended.
      seed: seed of the draws.
      widest: least scale of the robust weights in the first step, sRGB; it falls by a tenth in
        each. Without it, a fault that few pixels see has no weight.
      gain: least relative gain; the fit ends after two steps in a row, without blur, of less.
      limits: largest error of the judges of each step, sRGB; a fit above it is given up, but not in
        its first two steps.
    """

    blurs: tuple[int, ...] = (2, 1, 0, 0, 0, 0)
    rays: int = 40_000
    judges: int = 8192
    outliers: float = 0.01
    least: float = 1e-3
    seed: int = 0
    widest: float = 0.0
    gain: float = 0.0
    limits: tuple[float, ...] = ()


class StepFacts(NamedTuple):
    """What one step did.

    Attributes:
      blur: halvings of the backdrop.
      before: robust error of the fresh pixels before, sRGB.
      after: the same after the step.
      damping: damping of the step.
      taken: whether the step was taken.
      change: root mean square of the change, relative to the scales of the unknowns.
    """

    blur: int
    before: float
    after: float
    damping: float
    taken: bool
    change: float


class Fit(NamedTuple):
    """Result of a fit.

    Attributes:
      x: unknowns.
      covariance: their covariance: that of the prior where light says nothing.
      steps: records of the steps.
    """

    x: Float[np.ndarray, " unknowns"]
    covariance: Float[np.ndarray, "unknowns unknowns"]
    steps: tuple[StepFacts, ...]

    @property
    def taken(self) -> int:
        """Number of steps that were taken."""
        return sum(step.taken for step in self.steps)


class Equations(NamedTuple):
    """Normal equations of a linearisation, without the prior.

    Attributes:
      matrix: `J^T W J / s^2`.
      gradient: `J^T W r / s^2`.
      by_view: the share of each view in the gradient of the pixels.
      of_pixels: the part of the matrix that comes from pixels.
    """

    matrix: Float[np.ndarray, "unknowns unknowns"]
    gradient: Float[np.ndarray, " unknowns"]
    by_view: Float[np.ndarray, "views unknowns"]
    of_pixels: Float[np.ndarray, "unknowns unknowns"]


def traced_object(candidate: Candidate, *, like: TracedObject | None = None) -> TracedObject:
    """Returns the scene of a candidate on the device, its tree divided like that of another."""
    parts = candidate.parts
    return photometry.assemble(
        np.concatenate([part.vertices[part.faces] for part in parts]),
        np.concatenate([part.normals[part.normal_ids] for part in parts]),
        np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts]),
        candidate.interfaces,
        like=like,
    )


def errors_of(
    traced: TracedObject, surface: Backdrop, pixels: Photographs
) -> Float[np.ndarray, " rays"]:
    """Returns the robust error of each pixel in sRGB: root mean square of channels, capped."""
    return robust_errors(photometry.predict(traced, surface, pixels.rays), pixels.rgb)


def robust_errors(
    predicted: photometry.Prediction, rgb: Float[np.ndarray, "rays 3"]
) -> Float[np.ndarray, " rays"]:
    """Returns the same of a prediction."""
    errors = np.sqrt(np.mean(photometry.residuals(predicted.linear, rgb) ** 2, axis=1))
    return np.where(predicted.dropped < 1.0 - _FOLLOWED, np.minimum(errors, _CAP), _CAP)


def fit(
    model: Model,
    x: Float[np.ndarray, " unknowns"],
    surface: Backdrop,
    pixels: Photographs,
    *,
    settings: Steps = Steps(),
    outlines: Callable[[Candidate], Rows] | None = None,
    progress: Callable[[int, StepFacts], None] | None = None,
) -> Fit:
    """Fits the unknowns of a model to photographs.

    Args:
      model: meaning of the unknowns.
      x: unknowns to begin with.
      surface: backdrop.
      pixels: all pixels that may be drawn, none of which may judge the result.
      settings: settings of the fit.
      outlines: further equations at a candidate.
      progress: function called with the number of steps, and what the last one did.

    Raises:
      ReconstructionError: if there are no pixels.
    """
    if not len(pixels.views):
        raise ReconstructionError("No pixel sees the object. Check the masks and the cameras.")
    generator = np.random.default_rng(settings.seed)
    draw = functools.partial(pixels.drawn, generator)
    damping, facts, now = 1e-3, [], _place(model, x, None)
    for number, blur in enumerate(settings.blurs):
        seen = photometry.blurred(surface, blur)
        wide = settings.widest * _NARROWING**number
        drawn = draw(settings.rays)
        light = linearise(now.candidate, now.traced, seen, drawn, settings, least_scale=wide)
        if outlines is not None:
            light = _with_rows(light, outlines(now.candidate))
        now, damping, fact = _step(model, now, light, seen, draw(settings.judges), damping, blur)
        facts.append(fact)
        if progress is not None:
            progress(number + 1, fact)
        if _has_ended(facts, settings):
            break
    precision, _ = model.prior(now.x)
    return Fit(now.x, _covariance(light, precision), tuple(facts))


def _has_ended(facts: Sequence[StepFacts], settings: Steps) -> bool:
    """Returns whether further steps would change little, or the fit has failed."""
    last, limited = facts[-1], _FIRST < len(facts) <= len(settings.limits)
    if limited and min(last.before, last.after) > settings.limits[len(facts) - 1]:
        return True
    if last.blur == 0 and last.taken and last.change < settings.least:
        return True
    slow = [each.blur == 0 and each.after > (1.0 - settings.gain) * each.before for each in facts]
    return settings.gain > 0.0 and len(slow) > 1 and all(slow[-2:])


class _Place(NamedTuple):
    """Unknowns, and the scene that they give."""

    x: Float[np.ndarray, " unknowns"]
    candidate: Candidate
    traced: TracedObject


def _place(model: Model, x: Float[np.ndarray, " unknowns"], like: TracedObject | None) -> _Place:
    candidate = model.pose(x)
    return _Place(x, candidate, traced_object(candidate, like=like))


def _step(
    model: Model,
    now: _Place,
    light: Equations,
    surface: Backdrop,
    judges: Photographs,
    damping: float,
    blur: int,
) -> tuple[_Place, float, StepFacts]:
    """Tries steps of growing damping until one explains the judges better."""
    precision, pull = model.prior(now.x)
    matrix, gradient = light.matrix + precision, light.gradient + pull
    scales = model.scales()
    before = float(errors_of(now.traced, surface, judges).mean())

    def after(change: Float[np.ndarray, " unknowns"]) -> tuple[float, _Place]:
        there = _place(model, now.x + change, now.traced)
        return float(errors_of(there.traced, surface, judges).mean()), there

    for _ in range(3):
        damped = matrix + damping * np.diag(np.diag(light.matrix) + np.diag(precision))
        change = -scipy.linalg.solve(damped, gradient, assume_a="pos")
        change *= min(1.0, 1.0 / max(float(np.max(np.abs(change) / scales)), 1e-12))
        error, there = after(change)
        # Far from the solution, slopes promise too little: steps are doubled as long as that helps.
        while error < _WORTH * before and float(np.max(np.abs(change) / scales)) < 0.5:
            further = after(2.0 * change)
            if further[0] >= error:
                break
            change, (error, there) = 2.0 * change, further
        rms = float(np.sqrt(np.mean((change / scales) ** 2)))
        if error < before:
            facts = StepFacts(blur, before, error, damping, True, rms)
            return there, max(0.1 * damping, 1e-6), facts
        damping = max(10.0 * damping, 1e-2)
    return now, damping, StepFacts(blur, before, error, damping, False, rms)


def _with_rows(light: Equations, rows: Rows) -> Equations:
    """Returns the equations with further ones, whose common error is eliminated."""
    weighted = scipy.sparse.diags_array(rows.weights) @ rows.derivatives
    dense = _dense(rows.derivatives.T @ weighted)
    gradient = weighted.T @ rows.errors
    if rows.common:
        together = weighted.T @ np.ones(len(rows.errors))
        total = np.sum(rows.weights) + rows.common**-2.0
        dense = dense - np.outer(together, together) / total
        gradient = gradient - together * (rows.weights @ rows.errors) / total
    return light._replace(matrix=light.matrix + dense, gradient=light.gradient + gradient)


def linearise(
    candidate: Candidate,
    traced: TracedObject,
    surface: Backdrop,
    pixels: Photographs,
    settings: Steps,
    *,
    least_scale: float = 0.0,
) -> Equations:
    """Returns the normal equations of some pixels.

    Args:
      candidate: scene with derivatives.
      traced: the same scene on the device.
      surface: backdrop.
      pixels: some pixels.
      settings: settings of the fit, of which the share of outliers counts.
      least_scale: least scale of the robust weights, sRGB.
    """
    predicted = photometry.predict(traced, surface, pixels.rays)
    found = photometry.sensitivities(traced, surface, pixels.rays, predicted)
    error = photometry.residuals(predicted.linear, pixels.rgb)
    encode = 1.055 / 2.4 * np.maximum(predicted.linear, _DARK) ** (1.0 / 2.4 - 1.0)
    slopes = found.slopes * encode[:, None]
    coordinates = _by_unknowns(candidate, traced, found)
    usable = found.usable & (predicted.dropped < 1.0 - _FOLLOWED) & (found.coverage > _SEEN)
    weights = _robust_weights(error, usable, max(least_scale, _LEAST_SCALE))
    weights = weights * ((pixels.rgb < SATURATED) | (predicted.linear < 1.0))
    jacobian = _block_diagonal(np.swapaxes(slopes, 1, 2)) @ coordinates
    light = found.light * encode
    if candidate.by_tints.shape[0]:
        jacobian = jacobian + _by_channels(light, found.crossings) @ candidate.by_tints
    if candidate.by_absorptions is not None:
        jacobian = jacobian - _by_channels(light, found.lengths) @ candidate.by_absorptions
    weights *= _without_largest(jacobian, weights, settings.outliers)[:, None]
    flat = weights.reshape(-1)
    root = scipy.sparse.diags_array(np.sqrt(flat))
    weighted = _dense(root @ jacobian, least=_FULL)
    squared = float(np.sum(flat * error.reshape(-1) ** 2) / max(np.sum(flat), 1.0))
    matrix = _dense(weighted.T @ weighted)
    scale = max(squared, _LEAST_NOISE**2)
    names, views = np.unique(pixels.views, return_inverse=True)
    each = scipy.sparse.csr_array(
        (error.reshape(-1) / scale, (np.repeat(views, 3), np.arange(error.size))),
        shape=(len(names), error.size),
    )
    by_view = _dense(each @ root @ weighted)
    return Equations(matrix / scale, by_view.sum(axis=0), by_view, matrix / scale)


def _dense(matrix: Any, *, least: float = 0.0) -> Any:
    """Returns a dense matrix, if at least this share of its entries is not zero."""
    full = scipy.sparse.issparse(matrix) and matrix.nnz >= least * math.prod(matrix.shape)
    return matrix.toarray() if full else matrix


def _covariance(
    light: Equations, precision: Float[np.ndarray, "unknowns unknowns"]
) -> Float[np.ndarray, "unknowns unknowns"]:
    """Returns the covariance of the unknowns, with errors of a view that are alike."""
    inverse = np.linalg.inv(light.matrix + precision)
    views = light.by_view - light.by_view.mean(axis=0)
    some = inverse[:: math.ceil(len(inverse) / _MANY)]
    scatter = np.sum((views @ some.T) ** 2, axis=0)
    independent = np.sum((some @ light.of_pixels) * some, axis=1)
    alike = float(np.median(scatter / np.maximum(independent, 1e-300)))
    return inverse * max(1.0, alike)


def _by_unknowns(
    candidate: Candidate, traced: TracedObject, found: photometry.Sensitivities
) -> Matrix:
    """Returns the derivatives of the coordinates of all rays by the unknowns, ray-major."""
    parts = candidate.parts
    first = np.cumsum([0] + [len(part.vertices) for part in parts]).tolist()
    first_normal = np.cumsum([0] + [len(part.normals) for part in parts]).tolist()
    vertices = np.concatenate([p.faces + n for p, n in zip(parts, first, strict=False)])
    normals = np.concatenate([p.normal_ids + n for p, n in zip(parts, first_normal, strict=False)])
    derivatives = [p.by_vertices for p in parts], [p.by_normals for p in parts]
    by_vertices, by_normals = at_once(_stacked, derivatives)
    met = found.primitives != NO_PRIMITIVE
    face = traced.faces[np.where(met, found.primitives, 0)]

    def of_rays(some: Int[np.ndarray, " some"]) -> Matrix:
        at, hit = face[some], met[some]
        moved = _scattered(found.by_corners[some], hit, vertices[at], first[-1])
        turned = _scattered(found.by_normals[some], hit, normals[at], first_normal[-1])
        by_index = found.by_indices[some].reshape(3 * len(some), -1).astype(np.float64)
        bent = scipy.sparse.csr_array(by_index) @ candidate.by_indices
        return moved @ by_vertices + turned @ by_normals + bent

    return _stacked(at_once(of_rays, np.array_split(np.arange(len(met)), min(2, len(met)))))


def _scattered(
    blocks: Float[np.ndarray, "rays 3 bends 3 3"],
    met: Bool[np.ndarray, "rays bends"],
    columns: Int[np.ndarray, "rays bends 3"],
    count: int,
) -> scipy.sparse.csr_array:
    """Returns a sparse matrix `[3 rays, 3 count]` of blocks of coordinate, corner and axis."""
    kept = np.broadcast_to(met[:, None], blocks.shape[:3])
    places = np.broadcast_to(3 * columns[:, None, ..., None] + np.arange(3), blocks.shape)
    starts = np.append(0, np.cumsum(np.repeat(9 * met.sum(axis=1), 3)))
    entries = blocks[kept].astype(np.float64).reshape(-1), places[kept].reshape(-1), starts
    return scipy.sparse.csr_array(entries, shape=(len(starts) - 1, 3 * count))


def _stacked(matrices: Sequence[Matrix]) -> Matrix:
    if len(matrices) == 1:
        return matrices[0]
    if any(scipy.sparse.issparse(each) for each in matrices):
        return scipy.sparse.vstack([scipy.sparse.csr_array(each) for each in matrices]).tocsr()
    return np.concatenate(matrices)


def _block_diagonal(blocks: Float[np.ndarray, "rays 3 3"]) -> scipy.sparse.csr_array:
    count = len(blocks)
    data = (blocks.astype(np.float64), np.arange(count), np.arange(count + 1))
    return scipy.sparse.bsr_array(data, shape=(3 * count, 3 * count)).tocsr()


def _by_channels(
    light: Float[np.ndarray, "rays 3"], counts: Num[np.ndarray, "rays parts"]
) -> scipy.sparse.csr_array:
    """Returns derivatives by numbers of each part and channel, such as the logarithms of tints."""
    rows, parts = counts.shape
    blocks = counts[:, None, :, None] * light[:, :, None, None] * np.eye(3)[None, :, None, :]
    return scipy.sparse.csr_array(blocks.reshape(3 * rows, 3 * parts))


def _robust_weights(
    error: Float[np.ndarray, "rays 3"], usable: np.ndarray, least: float
) -> Float[np.ndarray, "rays 3"]:
    """Returns Geman-McClure weights: pixels that something else explains lose theirs."""
    size = np.sqrt(np.mean(error**2, axis=1))
    scale = max(least, _SCALE * float(np.median(size[usable]))) if usable.any() else 1.0
    weight = usable / (1.0 + (size / scale) ** 2) ** 2
    return np.repeat(weight[:, None], 3, axis=1)


def _without_largest(
    jacobian: Matrix, weights: Float[np.ndarray, "rays 3"], share: float
) -> np.ndarray:
    """Returns which rays do not have one of the largest derivatives, as near the critical angle."""
    matrix: Any = jacobian
    squares = matrix.multiply(matrix) if scipy.sparse.issparse(matrix) else matrix**2
    size = np.asarray(squares.sum(axis=1)).reshape(-1, 3).sum(axis=1)
    counted = weights[:, 0] > 0.0
    if not counted.any():
        return counted
    return size <= np.quantile(size[counted], 1.0 - share)
