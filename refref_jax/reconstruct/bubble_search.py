"""Finds bubbles of air in a solid glass object, from photographs of light refracted by it.

Every light path that passes a bubble predicts a wrong colour. So the errors of pixels are projected
back along the segments of their main paths inside the object, as it was fitted without bubbles, and
averaged in the cells of a coarse grid. Peaks of the mean error are where a bubble may be. The
sphere there that best separates paths of large errors from those of small ones gives an initial
centre and radius, without tracing light again. A few radii about it are tried with a blurred
backdrop, the best is improved by Gauss-Newton steps, with ever less blur, and held-out pixels whose
paths pass it decide whether it is kept. Then the search is repeated for the next one. At the end,
all unknowns are fitted together.

What this cannot find: bubbles that are not spherical, or smaller than about a pixel; those in
vessels, and inclusions that are not air; anything in front of a plain wall.

Sources: Kak and Slaney, Principles of Computerized Tomographic Imaging (1988), for back-projection;
Otsu, A Threshold Selection Method from Gray-Level Histograms (1979), for the best
separation of errors. Back-projection along bent paths, and separation by spheres, are ours.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Float
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.optimize import minimize

from refref_jax.geometry.triangle_meshes import diameter
from refref_jax.reconstruct import ReconstructionError, gauss_newton, photometry
from refref_jax.reconstruct.bubbles import Bubble, ObjectWithBubbles, depth_inside
from refref_jax.reconstruct.gauss_newton import Candidate, Fit, Rows, Steps
from refref_jax.reconstruct.interior_search import Few
from refref_jax.reconstruct.model_selection import Trial, choose, judged
from refref_jax.reconstruct.photometry import Backdrop, InnerSegments, Photographs
from refref_jax.reconstruct.shape_from_refraction import first_blur

# Smoothing of the grid, in cells; lines that a cell needs; cells between the middle of a peak and
# the surface.
_SMOOTHING, _LINES, _DEPTH = 0.7, 6.0, 0.7

# A peak is above the median of the cells by this many times their usual scatter, and by this much
# in sRGB: a level of 8 bits.
_ABOVE, _LEVEL = 4.0, 1.0 / 255.0

# Pixels belong to a bubble if their paths pass within this many radii of its middle.
_NEAR, _JUDGED = 2.5, 1.3

# Paths that may pass a bubble pass its peak within this share of the diameter, and the
# number of centres that are tried.
_REACH, _EVALUATIONS = 0.12, 120

# Most blur of the first step.
_MOST_BLUR = 4

# Least gain of a look, sRGB, and share of the pixels that pass bubbles, whose derivatives are the
# largest, that the last steps leave out.
_GAIN, _OUTLIERS = 1e-3, 0.02

# Share of the error beyond the level of other pixels that a bubble must explain.
_EXPLAINED = 0.5


@dataclasses.dataclass(frozen=True)
class BubbleSettings:
    """Settings of a search for bubbles.

    Attributes:
      most: largest number of bubbles.
      rays: number of pixels that are projected back, and that steps draw from.
      cells: number of cells of the grid along the longest side of the object.
      peaks: number of peaks that are looked at for each bubble.
      radii: radii that are looked at, as shares of the initial one.
      blur: halvings of the resolution of the backdrop in looks.
      looked: largest number of pixels of a look.
      few: number of steps of one bubble without blur.
      all: number of steps of all unknowns at the end.
    """

    most: int = 8
    rays: int = 65_536
    cells: int = 32
    peaks: int = 3
    radii: tuple[float, ...] = (0.7, 1.0, 1.4)
    blur: int = 2
    looked: int = 4096
    few: int = 5
    all: int = 4


class Peak(NamedTuple):
    """A place inside an object that paths with large errors pass.

    Attributes:
      centre: position, world units.
      error: mean robust error of the pixels whose paths pass, sRGB.
      level: median of the same over all places.
      scatter: usual scatter of the same between places.
    """

    centre: Float[np.ndarray, "3"]
    error: float
    level: float
    scatter: float


def find_bubbles(
    trial: Trial,
    surface: Backdrop,
    pixels: Photographs,
    judges: Photographs,
    *,
    settings: BubbleSettings = BubbleSettings(),
    outlines: Callable[[Candidate], Rows] | None = None,
    seed: int = 0,
    progress: Callable[[float, str], None] = lambda share, text: None,
) -> Trial:
    """Finds bubbles of air in a solid object that was fitted.

    Args:
      trial: the object, of one part.
      surface: backdrop.
      pixels: pixels that see the object, of photographs to fit to.
      judges: pixels of other photographs, which decide whether a bubble is kept.
      settings: settings of the search.
      outlines: equations of the masks' outlines, for the last steps.
      seed: seed of the draws.
      progress: function called with the share of the work that is done, and a line of text.

    Returns:
      The object with its bubbles, or the trial itself if none was found.

    Raises:
      ReconstructionError: if there are no pixels, or no judges.
    """
    if not len(pixels.views) or not len(judges.views):
        raise ReconstructionError("No pixel sees the object. Check the masks and the cameras.")
    some = pixels.drawn(np.random.default_rng(seed), settings.rays)
    task = _Task(surface, some, judges, settings, seed, trial)
    found = trial
    for number in range(settings.most):
        progress(number / (settings.most + 1), f"looking for bubble {number + 1}")
        better = task.next_bubble(found)
        if better is None:
            break
        found = better
    if found is not trial:
        progress(settings.most / (settings.most + 1), f"{found.name}: error {found.error:.4f}")
        found = task.all_unknowns(found, outlines)
    progress(1.0, f"{found.name}: error {found.error:.4f}")
    return found


class _Task(NamedTuple):
    """What bubbles are looked for in."""

    surface: Backdrop
    pixels: Photographs
    judges: Photographs
    settings: BubbleSettings
    seed: int
    trial: Trial

    def next_bubble(self, found: Trial) -> Trial | None:
        """Returns the object with one bubble more, or `None` if the judges refuse it."""
        traced = gauss_newton.traced_object(found.candidate)
        errors = gauss_newton.errors_of(traced, self.surface, self.pixels)
        segments = photometry.inner_segments(traced, self.pixels.rays)
        looks = [
            look
            for peak in peaks(found, segments, errors, settings=self.settings)
            if (look := self.look(found, peak, segments, errors)) is not None
        ]
        for _, bubble in sorted(looks, key=lambda look: -look[0]):
            begun = self.with_bubbles(found, [*_bubbles(found), bubble])
            near = _distances(segments, bubble.centre) <= _NEAR * bubble.radius
            fitted = self.fitted(found, begun, self.pixels.chosen(np.flatnonzero(near)))
            if self.is_better(fitted, found, traced, float(np.median(errors))):
                return fitted
        return None

    def with_bubbles(self, found: Trial, bubbles: Sequence[Bubble]) -> ObjectWithBubbles:
        """Returns the model of the object of a trial, with these bubbles."""
        own = found.fit.x[: len(self.trial.fit.x)]
        return ObjectWithBubbles(self.trial.model, own, bubbles)

    def look(
        self,
        found: Trial,
        peak: Peak,
        segments: InnerSegments,
        errors: Float[np.ndarray, " rays"],
    ) -> tuple[float, Bubble] | None:
        """Returns the best of a few radii and its gain, `None` if none helps."""
        settings, size = self.settings, diameter(found.mesh.vertices)
        guess = _best_sphere(segments, errors, peak.centre, _REACH * size)
        if not depth_inside(guess.centre, found.candidate.parts[0]).distance > 0.0:
            return None
        radii = [share * guess.radius for share in settings.radii]
        near = np.flatnonzero(_distances(segments, guess.centre) <= 1.5 * max(radii))
        near = np.random.default_rng(self.seed).permutation(near)[: settings.looked]
        pixels, blurred = self.pixels.chosen(near), photometry.blurred(self.surface, settings.blur)

        def error(candidate: Candidate) -> float:
            traced = gauss_newton.traced_object(candidate)
            return float(gauss_newton.errors_of(traced, blurred, pixels).mean())

        looks, without = [], error(found.candidate)
        for radius in radii:
            model = self.with_bubbles(found, [*_bubbles(found), Bubble(guess.centre, radius)])
            x = model.start()
            looks.append((without - error(model.pose(x)), model.bubbles(x)[-1]))
        best = max(looks, key=lambda look: look[0])
        return best if best[0] > _GAIN else None

    def fitted(self, found: Trial, model: ObjectWithBubbles, near: Photographs) -> Trial:
        """Returns the object after steps of its last bubble."""
        x, settings = model.start(), self.settings
        blur = min(first_blur(model.pose(x), self.surface, near), _MOST_BLUR)
        steps = Steps((*range(blur, 0, -1), *[0] * settings.few), seed=self.seed)
        few = Few(model, x, np.eye(len(x))[:, -4:])
        fit = gauss_newton.fit(few, few.start(), self.surface, near, settings=steps)
        whole = scipy.linalg.block_diag(found.fit.covariance, fit.covariance)
        return self.judged(model, Fit(few.whole(fit.x), whole, fit.steps))

    def judged(self, model: ObjectWithBubbles, fit: Fit) -> Trial:
        """Returns an object with the errors of the judges."""
        count = (len(fit.x) - model.own) // 4
        name = f"{self.trial.name} with {count} bubble{'s' if count > 1 else ''}"
        return judged(name, model, fit, self.surface, self.judges)

    def is_better(
        self, fitted: Trial, found: Trial, traced: photometry.TracedObject, level: float
    ) -> bool:
        """Returns whether judges whose paths pass the last bubble are explained better with it."""
        centre, radius = _bubbles(fitted)[-1]
        segments = photometry.inner_segments(traced, self.judges.rays)
        near = np.flatnonzero(_distances(segments, centre) <= _JUDGED * radius)
        if not len(near):
            return False
        local = self.judges.chosen(near)
        after, before = (
            judged(each.name, each.model, each.fit, self.surface, local) for each in (fitted, found)
        )
        explained = before.error - after.error > _EXPLAINED * (before.error - level)
        return explained and choose([before, after]) is after

    def all_unknowns(self, found: Trial, outlines: Callable[[Candidate], Rows] | None) -> Trial:
        """Returns the object after steps of all unknowns, unless the judges find it worse.

        The largest derivatives are those of pixels that pass a bubble, so that the share of pixels
        left out is one of these.
        """
        before = _bubbles(found)
        model = self.with_bubbles(found, before)
        inside = photometry.inner_segments(
            gauss_newton.traced_object(self.trial.candidate), self.pixels.rays
        )
        near = np.zeros(len(self.pixels.views), bool)
        for bubble in before:
            near |= _distances(inside, bubble.centre) <= bubble.radius
        steps = Steps(
            (0,) * self.settings.all, outliers=_OUTLIERS * float(near.mean()), seed=self.seed + 1
        )
        fit = gauss_newton.fit(
            model, model.start(), self.surface, self.pixels, settings=steps, outlines=outlines
        )
        return choose([self.judged(model, fit), found])


def _bubbles(found: Trial) -> tuple[Bubble, ...]:
    """Returns the bubbles of an object."""
    model = found.model
    return model.bubbles(found.fit.x) if isinstance(model, ObjectWithBubbles) else ()


def peaks(
    trial: Trial,
    segments: InnerSegments,
    errors: Float[np.ndarray, " rays"],
    *,
    settings: BubbleSettings = BubbleSettings(),
) -> list[Peak]:
    """Returns the places in an object where errors along all paths are large.

    The error of each pixel is spread along its segments over the cells of a grid.

    Args:
      trial: the object.
      segments: segments of the pixels' main paths inside the object.
      errors: robust error of each pixel, sRGB.
      settings: settings of the search.

    Returns:
      The places, that of the largest error first; none if no place is special.
    """
    outer = trial.candidate.parts[0]
    low, extents = outer.vertices.min(axis=0), np.ptp(outer.vertices, axis=0)
    cell = float(extents.max()) / settings.cells
    shape = np.ceil(extents / cell).astype(int) + 1
    ray, number = np.nonzero(segments.inside)
    if not len(ray):
        return []
    starts, ends = (np.asarray(each[ray, number], np.float64) for each in segments[:2])
    lengths = np.linalg.norm(ends - starts, axis=-1)
    steps = int(np.ceil(np.linalg.norm(extents) / cell))
    shares = ((np.arange(steps) + 0.5) / steps)[:, None, None]
    at = ((starts + shares * (ends - starts) - low) / cell).astype(np.int32)
    at = np.clip(at, 0, shape - 1)
    cells = np.ravel_multi_index(tuple(np.moveaxis(at, -1, 0)), tuple(shape)).ravel()

    def spread(weights: Float[np.ndarray, " segments"]) -> Float[np.ndarray, "x y z"]:
        every = np.broadcast_to(weights / steps, at.shape[:2]).ravel()
        total = np.bincount(cells, every, int(np.prod(shape))).reshape(shape)
        return gaussian_filter(total, _SMOOTHING)

    lines = spread(lengths / cell)
    seen = lines > _LINES
    mean = np.where(seen, spread(errors[ray] * lengths / cell) / np.where(seen, lines, 1.0), 0.0)
    if not seen.any():
        return []
    level = float(np.median(mean[seen]))
    scatter = 1.4826 * float(np.median(np.abs(mean[seen] - level)))
    high = mean > level + max(_ABOVE * scatter, _LEVEL)
    places = np.argwhere(high & (mean == maximum_filter(mean, 3)))
    found = []
    for place in sorted(places, key=lambda place: -mean[tuple(place)]):
        centre = low + (place + 0.5) * cell
        if depth_inside(centre, outer).distance > _DEPTH * cell:
            found.append(Peak(centre, float(mean[tuple(place)]), level, scatter))
        if len(found) == settings.peaks:
            break
    return found


def _distances(
    segments: InnerSegments, point: Float[np.ndarray, "3"]
) -> Float[np.ndarray, " rays"]:
    """Returns the least distance of each path from a point, infinite without segments."""
    along = segments.ends - segments.starts
    squares = np.sum(along**2, axis=-1)
    share = np.sum((point - segments.starts) * along, axis=-1) / np.where(squares > 0, squares, 1.0)
    nearest = segments.starts + np.clip(share, 0.0, 1.0)[..., None] * along
    away = np.linalg.norm(nearest - point, axis=-1)
    return np.min(np.where(segments.inside, away, np.inf), axis=1).astype(np.float64)


def _best_sphere(
    segments: InnerSegments,
    errors: Float[np.ndarray, " rays"],
    point: Float[np.ndarray, "3"],
    reach: float,
) -> Bubble:
    """Returns the sphere near a point that best separates paths of large and of small errors.

    A sphere separates paths that pass it from the others. The best one leaves the least variance of
    the errors in both sets, as Otsu's threshold does (1979).
    """
    near = np.flatnonzero(_distances(segments, point) <= reach)
    if len(near) < 2:
        return Bubble(point, reach)
    some = InnerSegments(*(each[near] for each in segments))
    count = np.arange(1, len(near))

    def separation(centre: Float[np.ndarray, "3"]) -> tuple[float, float]:
        away = _distances(some, centre)
        order = np.argsort(away)
        total = np.cumsum(errors[near][order])
        contrast = total[:-1] / count - (total[-1] - total[:-1]) / (len(near) - count)
        between = count * (len(near) - count) / len(near) ** 2 * np.maximum(contrast, 0.0) ** 2
        best = int(np.argmax(between))
        return float(between[best]), float(0.5 * (away[order[best]] + away[order[best + 1]]))

    simplex = point + 0.15 * reach * np.concatenate([np.zeros((1, 3)), np.eye(3)])
    options = {"initial_simplex": simplex, "maxfev": _EVALUATIONS, "xatol": 1e-3 * reach}
    centre = minimize(lambda c: -separation(c)[0], point, method="Nelder-Mead", options=options).x
    return Bubble(centre, separation(centre)[1])
