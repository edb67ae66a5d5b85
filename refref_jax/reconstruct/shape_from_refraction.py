"""Shape and index of refraction of one clear object, from photographs of light refracted by it.

`find_index` looks for the index of an object of known shape. `SingleObject` has the unknowns of a
shape and the index; `fit_shapes` fits shapes of several families, of which `model_selection.choose`
keeps the smallest that held-out pixels do not find significantly worse than the best.

Source: ours; the paper (arXiv 2505.05848) smooths by hand, and trains the index with the field.
"""

import dataclasses
import functools
import itertools
import math
import threading
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse
from jaxtyping import Float

from refref_jax.compilation import at_once
from refref_jax.geometry.triangle_meshes import Mesh, diameter, smooth_groups, with_short_edges
from refref_jax.optics.interface_rules import NO_PARENT, nested
from refref_jax.optics.media import INDEX_OF_AIR
from refref_jax.reconstruct import ReconstructionError, families, gauss_newton, photometry
from refref_jax.reconstruct.gauss_newton import Candidate, Fit, Matrix, Rows, StepFacts, Steps
from refref_jax.reconstruct.model_selection import Trial, judged
from refref_jax.reconstruct.photometry import Backdrop, Photographs, TracedObject
from refref_jax.reconstruct.refractive_index import (
    Descent,
    IndexEstimate,
    IndexSearch,
    lowest_rungs,
    rungs,
    scatter_of_bottoms,
)
from refref_jax.reconstruct.shapes import FixedShape, FreeSurface, Posed, Shape, mesh_of
from refref_jax.reconstruct.smoothing import diffuse

Outlines = Callable[[Candidate], Rows]

_USUAL_SEARCH = IndexSearch(descents=2)

# Standard deviation of the prior of an index that was found for the mesh from masks, and largest
# change in one step.
_INDEX_DEVIATION, _INDEX_STEP = 0.02, 0.02

# The same of the logarithm of a tint.
_TINT_DEVIATION, _TINT_STEP = 1.0, 0.3

# Pixels of a look at one index, blur of the backdrop for these, and of the steps from the best.
# Steps have twice as many pixels, the standard error has four times as many.
_LOOK, _LOOK_BLUR, _INDEX_BLURS = 4096, 2, (2, 1, 0, 0)

# Half-width of the parabola for the standard error of an index.
_APART = 0.01

# Share of the vertices that have several normals, above which a mesh has creases.
_CREASED = 0.02

# Steps of families with few unknowns, without blur, the pixels of each, and the error of such a
# step above which a family will explain nothing, sRGB.
_FAMILY_STEPS, _FAMILY_RAYS, _HOPELESS = 4, 20_000, 0.1

# A blur is enough if errors are at most this many times what the blur alone adds, and number of
# pixels that tell.
_ENOUGH, _TELLING = 2.5, 4096

# Longest edge of a mesh whose vertices are to be moved, which is the mean distance of handles, as a
# share of its diameter; and how many times as long edges may be before they are divided.
_LONGEST, _LONG = 1.0 / 44.0, 2.6

# Lengths are stated for bodies of this diameter, world units.
_STATED_FOR = 2.6


@dataclasses.dataclass(frozen=True)
class FreeSurfaceSettings:
    """Settings of the fit of a free surface, in groups of steps.

    Attributes:
      smoothings: lengths over which the surface is smoothed before each group: noise that the
        handles cannot remove; world units of a body of diameter 2.6.
      counts: number of steps of each group, without blur.
      widest: scale of the robust weights in the first step of each group, sRGB: wide ones find
        faults that few pixels see; narrow ones, at the end, are more precise.
      gain: gain of two steps in a row below which a group ends. Where no group is smoothed, a group
        without a step of this gain is the last one.
    """

    smoothings: tuple[float, ...] = (0.05, 0.02, 0.02, 0.0)
    counts: tuple[int, ...] = (2, 2, 10, 3)
    widest: tuple[float, ...] = (0.0, 0.0, 0.3, 0.0)
    gain: float = 0.01


_USUAL_FREE_SURFACE = FreeSurfaceSettings()
_FROM_FAMILY = FreeSurfaceSettings(smoothings=(0.0, 0.0), counts=(10, 3), widest=(0.3, 0.0))


class SingleObject:
    """One object: the unknowns of its shape, its index, and the logarithm of its tint if learned.

    Attributes:
      shape: its shape.
      index: index that the prior expects.
      deviation: standard deviation of that prior; 0 keeps the index as it is.
      tinted: whether each crossing of the surface takes light of each channel.
    """

    def __init__(
        self,
        shape: Shape,
        index: float,
        *,
        deviation: float = _INDEX_DEVIATION,
        tinted: bool = False,
    ) -> None:
        """Takes a shape and what is known of the index."""
        self.shape, self.index, self.deviation, self.tinted = shape, index, deviation, tinted
        self._extra = 4 if tinted else 1

    def start(self) -> Float[np.ndarray, " unknowns"]:
        """Returns the unknowns of the shape, the index, and no tint."""
        return np.concatenate([self.shape.start(), [self.index], np.zeros(self._extra - 1)])

    def pose(self, x: Float[np.ndarray, " unknowns"]) -> Candidate:
        """Returns the object in air."""
        posed = self.shape.pose(x[: -self._extra])
        padded = Posed(*posed[:4], *(_widened(each, self._extra) for each in (posed[4], posed[5])))
        by_index, by_tint = np.zeros((1, len(x))), np.zeros((3, len(x)))
        by_index[0, -self._extra] = 1.0
        tint = np.ones(3)
        if self.tinted:
            by_tint[:, -3:] = np.eye(3)
            tint = np.exp(x[-3:])
        interfaces = nested([self.index_of(x)], [NO_PARENT], tints=[tint.tolist()])
        derivatives = (scipy.sparse.csr_array(each) for each in (by_index, by_tint))
        index, tints = derivatives
        return Candidate((padded,), interfaces, index, tints if self.tinted else tints[:0])

    def index_of(self, x: Float[np.ndarray, " unknowns"]) -> float:
        """Returns the index of refraction."""
        return float(x[-self._extra])

    def mesh(self, x: Float[np.ndarray, " unknowns"]) -> Mesh:
        """Returns the surface."""
        return mesh_of(self.shape.pose(x[: -self._extra]))

    def prior(
        self, x: Float[np.ndarray, " unknowns"]
    ) -> tuple[Float[np.ndarray, "unknowns unknowns"], Float[np.ndarray, " unknowns"]]:
        """Returns the prior of the shape, the index and the tint, which are independent."""
        precision, gradient = self.shape.prior(x[: -self._extra])
        extra = np.full(self._extra, _TINT_DEVIATION)
        extra[0] = self.deviation or 1e-9
        away = x[-self._extra :].copy()
        away[0] -= self.index
        whole = scipy.sparse.block_diag([precision, np.diag(extra**-2.0)])
        return whole.toarray(), np.concatenate([gradient, away / extra**2])

    def scales(self) -> Float[np.ndarray, " unknowns"]:
        """Returns the scales of the shape, the index and the tint."""
        extra = np.full(self._extra, _TINT_STEP)
        extra[0] = _INDEX_STEP
        return np.concatenate([self.shape.scales(), extra])


def _widened(matrix: Matrix, columns: int) -> Matrix:
    """Returns a matrix with more columns, of zeros."""
    if not scipy.sparse.issparse(matrix):
        return np.concatenate([matrix, np.zeros((matrix.shape[0], columns))], axis=1)
    nothing = scipy.sparse.csr_array((matrix.shape[0], columns))
    return scipy.sparse.hstack([matrix, nothing]).tocsr()


def find_index(
    mesh: Mesh,
    surface: Backdrop,
    pixels: Photographs,
    *,
    search: IndexSearch = _USUAL_SEARCH,
    start: float | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    seed: int = 0,
) -> IndexEstimate:
    """Estimates the index of refraction of an object of known shape.

    The error of few pixels is looked at on a ladder of indices, in front of a blurred backdrop,
    where valleys are wide. Gauss-Newton steps with ever less blur begin at the best rungs.

    Args:
      mesh: mesh of the object.
      surface: backdrop.
      pixels: pixels that see the object.
      search: ladder, and number of rungs from which to begin.
      start: index that the user expects, from which steps begin, too.
      progress: function called with the number of looks and steps done, and their number; by one
        thread at a time.
      seed: seed of the draws.

    Raises:
      ReconstructionError: if there are no pixels.
    """
    if not len(pixels.views):
        raise ReconstructionError("No pixel sees the object. Check the masks and the cameras.")
    glass = _Glass(mesh, surface, pixels, seed)
    ladder = rungs(search)
    total = most_looks_at_backdrop(search, start=start)
    done, lock = itertools.count(1), threading.Lock()

    def look(rung: float) -> float:
        error = glass.look(rung)
        with lock:
            progress(next(done), total)
        return error

    heights = at_once(look, ladder)
    starts = [ladder[i] for i in lowest_rungs(heights, search.descents)]
    starts += [] if start is None else [start]
    ways = []
    for number, begin in enumerate(starts):
        ways.append(glass.descend(begin, search))
        progress(len(ladder) + (number + 1) * len(_INDEX_BLURS), total)
    ways.sort(key=lambda way: way.errors[-1])
    best = ways[0].indices[-1]
    deviation = glass.deviation(best)
    progress(total, total)
    seen = Descent(ladder, tuple(heights))
    return IndexEstimate(best, deviation, ways[0].errors[-1], seen, tuple(ways))


def most_looks_at_backdrop(search: IndexSearch, *, start: float | None = None) -> int:
    """Returns the number of looks and steps of `find_index`."""
    begins = search.descents + (start is not None)
    return len(rungs(search)) + begins * len(_INDEX_BLURS) + 3


class _Glass:
    """An object of known shape, whose index is looked for."""

    def __init__(self, mesh: Mesh, surface: Backdrop, pixels: Photographs, seed: int) -> None:
        """Builds the scene once, for all indices."""
        self.model = SingleObject(FixedShape(mesh), INDEX_OF_AIR, deviation=1.0)
        self.traced = gauss_newton.traced_object(self.model.pose(self.model.start()))
        self.surface, self.blurred = surface, photometry.blurred(surface, _LOOK_BLUR)
        some = pixels.drawn(np.random.default_rng(seed), 4 * _LOOK)
        few, more = (np.arange(min(n * _LOOK, len(some.views))) for n in (1, 2))
        self.few, self.more, self.most = some.chosen(few), some.chosen(more), some

    def at(self, index: float) -> TracedObject:
        """Returns the scene with an index."""
        return self.traced.with_interfaces(self.model.pose(np.array([index])).interfaces)

    def look(self, index: float) -> float:
        """Returns the mean error at an index, of few pixels before a blurred backdrop."""
        return float(gauss_newton.errors_of(self.at(index), self.blurred, self.few).mean())

    def error(self, index: float) -> float:
        """Returns the mean error at an index."""
        return float(gauss_newton.errors_of(self.at(index), self.surface, self.more).mean())

    def descend(self, begin: float, search: IndexSearch) -> Descent:
        """Takes Gauss-Newton steps, none longer than a rung."""
        indices, errors = [begin], [self.error(begin)]
        for blur in _INDEX_BLURS:
            x, seen = np.array([indices[-1]]), photometry.blurred(self.surface, blur)
            light = gauss_newton.linearise(
                self.model.pose(x), self.at(x[0]), seen, self.more, Steps()
            )
            step = -float(light.gradient[0] / max(light.matrix[0, 0], 1e-30))
            step = min(max(step, -search.spacing), search.spacing)
            indices.append(min(max(indices[-1] + step, search.lowest), search.highest))
            errors.append(self.error(indices[-1]))
        return Descent(tuple(indices), tuple(errors))

    def deviation(self, index: float) -> float:
        """Returns the standard deviation of the minimum."""
        triple = [
            gauss_newton.errors_of(self.at(index + side * _APART), self.surface, self.most)
            for side in (-1.0, 0.0, 1.0)
        ]
        return scatter_of_bottoms(np.stack(triple), self.most.views, _APART)


def fit_shapes(
    mesh: Mesh,
    index: float,
    surface: Backdrop,
    pixels: Photographs,
    judges: Photographs,
    *,
    deviation: float = _INDEX_DEVIATION,
    outlines: Outlines | None = None,
    seed: int = 0,
    is_enough: Callable[[Sequence[Trial]], bool] = lambda trials: False,
    progress: Callable[[float, str], None] = lambda share, text: None,
) -> tuple[Trial, ...]:
    """Fits the families that come near a mesh to photographs, the fewest unknowns first.

    The first trial is the mesh as it is. The free surface begins at the better of the mesh and the
    best family.

    Args:
      mesh: mesh of the object, from masks.
      index: its index of refraction, as far as it is known.
      surface: backdrop.
      pixels: pixels to fit.
      judges: other pixels.
      deviation: standard deviation of the index; 0 keeps it.
      outlines: equations of the masks' outlines.
      seed: seed of the draws.
      is_enough: function of the trials before the free surface, which is left out if it is true.
      progress: function called with the share of the work that is done, and a line of text.
    """
    task = _Task(surface, pixels, judges, outlines, deviation, seed)
    fixed = SingleObject(FixedShape(mesh), index, deviation=deviation)
    nothing = Fit(fixed.start(), np.full((1, 1), deviation**2), ())
    trials = [task.judged("masks", fixed, nothing)]
    blur = first_blur(fixed.pose(nothing.x), surface, judges)
    *few, free = families.candidates(mesh)
    count = blur + _FAMILY_STEPS
    total, done = (count + 2) * len(few) + blur + sum(_USUAL_FREE_SURFACE.counts) + 4, 0
    for shape in few:
        begin, label = done, shape.name
        blurs = (*range(blur, 0, -1), *[0] * _FAMILY_STEPS)
        limits = (math.inf,) * blur + (_HOPELESS,) * _FAMILY_STEPS  # a blur alone makes errors
        model = SingleObject(shape, index, deviation=deviation)
        fit = task.fit(
            model,
            Steps(blurs, _FAMILY_RAYS, seed=seed, limits=limits),
            functools.partial(_report, progress, label, begin, total),
        )
        trials.append(task.judged(shape.name, model, fit))
        done += count + 2
    if is_enough(trials):
        return tuple(trials)
    best = min(trials, key=lambda trial: trial.error)
    from_masks = best is trials[0]
    trials.append(
        fit_free_surface(
            best.mesh,
            best.outer_index,
            surface,
            pixels,
            judges,
            settings=_USUAL_FREE_SURFACE if from_masks else _FROM_FAMILY,
            blur=blur if from_masks else 0,
            deviation=deviation,
            outlines=outlines,
            seed=seed,
            progress=functools.partial(_report, progress, free.name, done, total),
        )
    )
    progress(1.0, "done")
    return tuple(trials)


def _report(
    progress: Callable[[float, str], None],
    name: str,
    before: int,
    total: int,
    step: int,
    facts: StepFacts,
) -> None:
    """Reports a step of one shape as a share of all."""
    error = min(facts.before, facts.after)
    progress(min((before + step) / total, 1.0), f"{name}: error {error:.4f}")


def _later(
    progress: Callable[[int, StepFacts], None], before: int, step: int, facts: StepFacts
) -> None:
    """Reports a step after others."""
    progress(before + step, facts)


class _Task(NamedTuple):
    """What all shapes are fitted to."""

    surface: Backdrop
    pixels: Photographs
    judges: Photographs
    outlines: Outlines | None
    deviation: float
    seed: int

    def fit(
        self, model: SingleObject, settings: Steps, progress: Callable[[int, StepFacts], None]
    ) -> Fit:
        """Fits one model."""
        return gauss_newton.fit(
            model,
            model.start(),
            self.surface,
            self.pixels,
            settings=settings,
            outlines=self.outlines,
            progress=progress,
        )

    def judged(self, name: str, model: SingleObject, fit: Fit) -> Trial:
        """Returns a fitted model with the errors of the judges."""
        return judged(name, model, fit, self.surface, self.judges)


def fit_free_surface(
    mesh: Mesh,
    index: float,
    surface: Backdrop,
    pixels: Photographs,
    judges: Photographs,
    *,
    settings: FreeSurfaceSettings = _USUAL_FREE_SURFACE,
    blur: int = 0,
    deviation: float = _INDEX_DEVIATION,
    outlines: Outlines | None = None,
    seed: int = 0,
    progress: Callable[[int, StepFacts], None] = lambda step, facts: None,
) -> Trial:
    """Fits a free surface to photographs.

    Args:
      mesh: mesh to begin with.
      index: its index of refraction, as far as it is known.
      surface: backdrop.
      pixels: pixels to fit.
      judges: other pixels.
      settings: settings of the groups of steps.
      blur: blur of the backdrop in the very first step, in halvings (`first_blur`); one less in
        each that follows.
      deviation: standard deviation of the index; 0 keeps it.
      outlines: equations of the masks' outlines.
      seed: seed of the draws.
      progress: function called with the number of steps, and what the last one did.
    """
    task = _Task(surface, pixels, judges, outlines, deviation, seed)
    mesh, done, smoothed = _with_many_vertices(mesh), 0, max(settings.smoothings)
    groups = zip(settings.smoothings, settings.counts, settings.widest, strict=True)
    for number, (smoothing, count, widest) in enumerate(groups):
        if smoothing and not _has_creases(mesh):
            mesh = diffuse(mesh, smoothing * diameter(mesh.vertices) / _STATED_FOR)
        model = SingleObject(FreeSurface(mesh), index, deviation=deviation)
        steps = Steps(
            (*(range(blur, 0, -1) if number == 0 else ()), *[0] * count),
            seed=seed + number,
            widest=widest,
            gain=settings.gain,
        )
        fit = task.fit(model, steps, functools.partial(_later, progress, done))
        done += len(steps.blurs)
        least = 1.0 - settings.gain
        if smoothed == 0.0 and all(each.after > least * each.before for each in fit.steps):
            break  # what it begins with cannot be improved
        mesh, index = model.mesh(fit.x), model.index_of(fit.x)
    return task.judged(model.shape.name, model, fit)


def _has_creases(mesh: Mesh) -> bool:
    """Returns whether vertices have several normals; smoothing would round these edges."""
    groups = smooth_groups(mesh.vertices, mesh.faces)
    return bool(groups.max() + 1 > (1.0 + _CREASED) * len(np.unique(mesh.faces)))


def _with_many_vertices(mesh: Mesh) -> Mesh:
    """Returns a mesh with short edges, since only vertices can move."""
    corners = mesh.vertices[mesh.faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
    longest = _LONGEST * diameter(mesh.vertices)
    return with_short_edges(mesh, longest) if edges.max() > _LONG * longest else mesh


def first_blur(candidate: Candidate, surface: Backdrop, pixels: Photographs) -> int:
    """Returns the least blur of the backdrop at which steps find their way, in halvings.

    A blur alone makes errors, since photographs are not blurred. Where the shape is so wrong that
    light ends beyond the detail of the backdrop, errors are many times larger.
    """
    traced = gauss_newton.traced_object(candidate)
    pixels = pixels.chosen(np.arange(0, len(pixels.views), math.ceil(len(pixels.views) / _TELLING)))
    sharp = photometry.predict(traced, surface, pixels.rays).linear
    most = len(surface.mips) - 2
    for halvings in range(1, most + 1):
        seen = photometry.predict(traced, photometry.blurred(surface, halvings), pixels.rays).linear
        added = np.abs(photometry.residuals(seen, photometry.encode(sharp))).mean()
        error = np.abs(photometry.residuals(seen, pixels.rgb)).mean()
        if error <= _ENOUGH * added:
            return halvings - 1 if halvings == 1 else halvings
    return most
