"""Finds bubbles of air in a solid glass object, from photographs of light refracted by it.

Where a bubble is, every line of sight that passes it is wrong. So the errors of pixels are
projected back along the segments of their main paths inside the object, as it was fitted without
bubbles, and averaged in the cells of a coarse grid. Peaks of the mean error are where a bubble may
be. A few radii are looked at for each through a blurred backdrop, the best one is improved by
Gauss-Newton steps, with ever less blur, and held-out pixels whose paths pass it decide whether it
is kept. Then the next one is looked for. At the end, all unknowns are fitted together.

`ObjectWithBubbles` is a `gauss_newton.Model`: an object, and balls inside it. A ball that would
reach through the surface, or into an earlier ball, is held inside: its centre moves inwards until
the smallest ball has room, and its radius shrinks until it fits.

What this cannot find: bubbles that are no balls; those smaller than the least radius, or than about
a pixel; bubbles that touch each other or the surface (a small gap is left); those in vessels, and
inclusions that are not air.

Sources: Laurentini (1994) for what silhouettes enclose, and Kak and Slaney, Principles of
Computerized Tomographic Imaging (1988), for back-projection; along bent paths, it is ours.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse
from jaxtyping import Float
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.optimize import minimize
from trimesh.triangles import closest_point, points_to_barycentric

from refref_jax.geometry.triangle_meshes import diameter, face_normals, unit_vectors
from refref_jax.optics.interface_rules import NO_PARENT, nested
from refref_jax.optics.media import INDEX_OF_AIR
from refref_jax.reconstruct import ReconstructionError, gauss_newton, model_selection, photometry
from refref_jax.reconstruct.families import Sphere
from refref_jax.reconstruct.gauss_newton import Candidate, Fit, Matrix, Rows, Steps
from refref_jax.reconstruct.interior_search import Few
from refref_jax.reconstruct.interiors import Solid
from refref_jax.reconstruct.model_selection import ObjectModel, Trial, judged
from refref_jax.reconstruct.photometry import Backdrop, InnerSegments, Photographs
from refref_jax.reconstruct.shape_from_refraction import first_blur
from refref_jax.reconstruct.shapes import Posed, mesh_of

# Least radius of a bubble, and least distance from the surface and from other bubbles, as shares
# of the diameter of the object.
_LEAST, _GAP = 0.003, 0.001

# Standard deviations of the priors, and largest changes in a step, of centre and radius, as shares
# of the radius.
_DEVIATIONS, _STEPS = (1.0, 1.0, 1.0, 0.7), 0.25

# Mesh of a bubble, and number of interfaces of an object of few bubbles: those without faces let
# all share one compiled program.
_SUBDIVISIONS, _PARTS = 4, 9

# Smoothing of the grid, in cells; lines that a cell needs; cells between the middle of a peak and
# the surface.
_SMOOTHING, _LINES, _DEPTH = 0.7, 6.0, 0.7

# A peak is above the median of the cells by this many times their usual scatter, and by this much
# in sRGB: a level of 8 bits.
_ABOVE, _LEVEL = 4.0, 1.0 / 255.0

# Pixels belong to a bubble if their paths pass within this many radii of its middle.
_NEAR, _JUDGED = 2.5, 1.3

# Paths that may be in the shadow of a bubble pass a peak within this share of the diameter, and the
# number of centres that are tried.
_REACH, _EVALUATIONS = 0.12, 120

# Most blur of the first step.
_MOST_BLUR = 4

# Share of the error beyond the level of other pixels that a bubble must explain.
_EXPLAINED = 0.5


class Bubble(NamedTuple):
    """A ball.

    Attributes:
      centre: world units.
      radius: world units.
    """

    centre: Float[np.ndarray, "3"]
    radius: float


@dataclasses.dataclass(frozen=True)
class BubbleSettings:
    """Settings of a search for bubbles.

    Attributes:
      most: largest number of bubbles.
      rays: number of pixels that are projected back, and that steps draw from.
      cells: number of cells of the grid along the longest side of the object.
      peaks: number of peaks that are looked at for each bubble.
      radii: radii that are looked at, as shares of that of the shadow.
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


class _Ball(NamedTuple):
    """Centre and radius that a ball has within its limits, and their derivatives."""

    values: Float[np.ndarray, "4"]
    by: scipy.sparse.csr_array


class _Room(NamedTuple):
    """How far a point is from the nearest obstacle.

    Attributes:
      depth: distance, world units; negative beyond the obstacle.
      away: unit direction in which it grows.
      by_obstacle: derivatives of the depth by the unknowns of the obstacle.
      curvature: derivatives of the direction as the point moves across it, per world unit.
      other: derivatives of the place of the obstacle, for the same.
    """

    depth: float
    away: Float[np.ndarray, "3"]
    by_obstacle: scipy.sparse.csr_array
    curvature: float = 0.0
    other: scipy.sparse.csr_array | None = None


class ObjectWithBubbles:
    """A solid object with balls of another medium inside.

    The unknowns are those of the object, then centre and radius of each ball, world units.

    Example:
      >>> model = ObjectWithBubbles(trial.model, trial.fit.x, [Bubble(np.zeros(3), 0.1)])
      >>> fit = gauss_newton.fit(model, model.start(), surface, pixels)
      >>> model.bubbles(fit.x)[0].radius

    Attributes:
      solid: model of the object, of one part.
      own: number of its unknowns.
      index: index of refraction in the balls.
    """

    def __init__(
        self,
        solid: ObjectModel,
        x: Float[np.ndarray, " own"],
        bubbles: Sequence[Bubble],
        *,
        index: float = INDEX_OF_AIR,
    ) -> None:
        """Takes the object at rest, and the balls at rest.

        Raises:
          ReconstructionError: if a radius is not positive, or a centre is not inside the object.
        """
        self.solid, self.own, self.index = solid, len(x), index
        self._at_rest = tuple(bubbles)
        self._rest = np.concatenate([x, *(np.append(each.centre, each.radius) for each in bubbles)])
        self._ball = Sphere(np.zeros(3), 1.0, subdivisions=_SUBDIVISIONS)
        outer = solid.pose(x).parts[0]
        self._size = diameter(outer.vertices)
        for each in bubbles:
            if not each.radius > 0.0 or not _room(each.centre, outer).depth > 0.0:
                raise ReconstructionError(
                    f"A bubble of radius {each.radius:g} at {each.centre} is not inside the "
                    "object. Pass a centre inside and a positive radius."
                )

    def start(self) -> Float[np.ndarray, " unknowns"]:
        """Returns the unknowns at rest."""
        return self._rest.copy()

    def pose(self, x: Float[np.ndarray, " unknowns"]) -> Candidate:
        """Returns the object and the balls within their limits."""
        at_rest = self.solid.pose(x[: self.own])
        outer = at_rest.parts[0]
        outer = outer._replace(
            by_vertices=_widened(outer.by_vertices, len(x)),
            by_normals=_widened(outer.by_normals, len(x)),
        )
        balls = [self._posed(ball) for ball in self._balls(x, outer)]
        count = max(_PARTS, 1 + len(balls))
        tint = np.asarray(at_rest.interfaces.tint, np.float64)[0].tolist()
        interfaces = nested(
            [self.solid.index_of(x[: self.own])] + [self.index] * (count - 1),
            [NO_PARENT] + [0] * (count - 1),
            tints=[tint] + [[1.0, 1.0, 1.0]] * (count - 1),
        )
        tinted = 3 * count if at_rest.by_tints.shape[0] else 0
        return Candidate(
            (outer, *balls),
            interfaces,
            _widened(at_rest.by_indices, len(x), rows=count),
            _widened(at_rest.by_tints, len(x), rows=tinted),
        )

    def _posed(self, ball: _Ball) -> Posed:
        posed = self._ball.pose(ball.values)
        by_vertices = scipy.sparse.csr_array(posed.by_vertices) @ ball.by
        nothing = scipy.sparse.csr_array((3 * len(posed.normals), ball.by.shape[1]))
        return posed._replace(by_vertices=by_vertices, by_normals=nothing)

    def _balls(self, x: Float[np.ndarray, " unknowns"], outer: Posed) -> list[_Ball]:
        """Returns the balls within their limits, each apart from the surface and earlier ones."""
        least, gap = _LEAST * self._size, _GAP * self._size
        found: list[_Ball] = []
        for first in range(self.own, len(x), 4):
            by = scipy.sparse.eye_array(len(x)).tocsr()[first : first + 4]
            rooms = [_room(x[first : first + 3], outer)]
            rooms += [_room_beside(x[first : first + 3], ball) for ball in found]
            tightest = min(rooms, key=lambda room: room.depth)
            found.append(_limited(x[first : first + 4], by, tightest, least, gap))
        return found

    def bubbles(self, x: Float[np.ndarray, " unknowns"]) -> tuple[Bubble, ...]:
        """Returns the balls within their limits."""
        outer = self.solid.pose(x[: self.own]).parts[0]
        outer = outer._replace(by_vertices=_widened(outer.by_vertices, len(x)))
        balls = self._balls(x, outer)
        return tuple(Bubble(ball.values[:3], float(ball.values[3])) for ball in balls)

    def index_of(self, x: Float[np.ndarray, " unknowns"]) -> float:
        """Returns the index of refraction of the glass."""
        return self.solid.index_of(x[: self.own])

    def solids(self, x: Float[np.ndarray, " unknowns"]) -> list[Solid]:
        """Returns the parts, as those of an ordinary scene; `glass` contains the bubbles."""
        candidate = self.pose(x)
        red, green, blue = np.asarray(candidate.interfaces.tint, np.float64)[0].tolist()
        outer, *balls = (mesh_of(part) for part in candidate.parts)
        glass = Solid("glass", outer, self.index_of(x), NO_PARENT, (red, green, blue))
        return [glass] + [
            Solid(f"bubble{number}", ball, self.index, 0, (1.0, 1.0, 1.0))
            for number, ball in enumerate(balls, 1)
        ]

    def prior(
        self, x: Float[np.ndarray, " unknowns"]
    ) -> tuple[Float[np.ndarray, "unknowns unknowns"], Float[np.ndarray, " unknowns"]]:
        """Returns the prior of the object, and that of balls near those at rest."""
        precision, pull = self.solid.prior(x[: self.own])
        whole = np.zeros((len(x), len(x)))
        whole[: self.own, : self.own] = precision
        deviations = [each.radius * np.array(_DEVIATIONS) for each in self._at_rest]
        weights = np.concatenate([np.zeros(0), *deviations]) ** -2.0
        rows = np.arange(self.own, len(x))
        whole[rows, rows] = weights
        return whole, np.concatenate([pull, weights * (x - self._rest)[self.own :]])

    def scales(self) -> Float[np.ndarray, " unknowns"]:
        """Returns the scales of the object, and a quarter of the radius of each ball."""
        radii = np.array([each.radius for each in self._at_rest])
        return np.concatenate([self.solid.scales(), np.repeat(_STEPS * radii, 4)])


def _widened(matrix: Matrix, columns: int, *, rows: int | None = None) -> scipy.sparse.csr_array:
    """Returns a matrix with zeros to the right, and below."""
    found = scipy.sparse.coo_array(matrix)
    shape = (found.shape[0] if rows is None else rows, columns)
    return scipy.sparse.csr_array((found.data, (found.row, found.col)), shape=shape)


def _room(point: Float[np.ndarray, "3"], outer: Posed) -> _Room:
    """Returns how deep a point is inside a surface.

    The direction is that away from the closest point; its turn is left out.
    """
    corners = outer.vertices[outer.faces]
    near = np.linalg.norm(outer.vertices - point, axis=-1)[outer.faces].min(axis=1)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max()
    some = np.flatnonzero(near <= near.min() + longest)
    on = closest_point(corners[some], np.broadcast_to(point, (len(some), 3)))
    distance = np.linalg.norm(on - point, axis=-1)
    nearest = np.flatnonzero(distance <= distance.min() + 1e-9 * longest)
    outward = unit_vectors(face_normals(corners[some[nearest]]).sum(axis=0)[None])[0]
    best = nearest[0]
    side = 1.0 if (point - on[best]) @ outward <= 0.0 else -1.0
    away = side * (point - on[best])
    length = float(np.linalg.norm(away))
    away = away / length if length > 1e-9 * longest else -outward
    shares = points_to_barycentric(corners[some[best]][None], on[best][None])[0]
    rows = 3 * outer.faces[some[best]][:, None] + np.arange(3)
    weights = -(shares[:, None] * away)
    by_vertices = scipy.sparse.csr_array(outer.by_vertices)[rows.ravel()]
    by = scipy.sparse.csr_array(weights.reshape(1, -1)) @ by_vertices
    return _Room(side * length, away, by)


def _room_beside(point: Float[np.ndarray, "3"], ball: _Ball) -> _Room:
    """Returns how far a point is outside another ball."""
    away = point - ball.values[:3]
    length = float(np.linalg.norm(away))
    away = away / length if length > 0.0 else np.array([1.0, 0.0, 0.0])
    row = scipy.sparse.csr_array(np.append(-away, -1.0)[None])
    curvature = 1.0 / length if length > 0.0 else 0.0
    return _Room(length - float(ball.values[3]), away, row @ ball.by, curvature, ball.by[:3])


def _limited(
    values: Float[np.ndarray, "4"],
    by: scipy.sparse.csr_array,
    room: _Room,
    least: float,
    gap: float,
) -> _Ball:
    """Returns a ball that leaves a gap to an obstacle and has at least a radius."""
    centre, radius, away = values[:3], float(values[3]), room.away[:, None]
    by_centre, by_radius = by[:3], by[3:]
    by_depth = scipy.sparse.csr_array(away.T) @ by_centre + room.by_obstacle
    most, missing = room.depth - gap, least + gap - room.depth
    if missing > 0.0:
        centre = centre + missing * room.away
        if room.other is not None:
            across = scipy.sparse.csr_array(np.eye(3) - away @ away.T)
            by_centre = by_centre + missing * room.curvature * (across @ (by[:3] - room.other))
        by_centre = by_centre - scipy.sparse.csr_array(away) @ by_depth
        most, by_depth = least, 0.0 * by_depth
    if radius > most:
        radius, by_radius = most, by_depth
    elif radius < least:
        radius, by_radius = least, 0.0 * by_radius
    whole = scipy.sparse.vstack([by_centre, by_radius]).tocsr()
    return _Ball(np.append(centre, radius), whole)


class Peak(NamedTuple):
    """A place inside an object that lines of sight with large errors pass.

    Attributes:
      centre: world units.
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
      progress: called with the share of the work that is done, and a line of text.

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
            begun = self.with_bubble(found, bubble)
            near = _distances(segments, bubble.centre) <= _NEAR * bubble.radius
            fitted = self.fitted(found, begun, self.pixels.chosen(np.flatnonzero(near)))
            if self.is_better(fitted, found, traced, float(np.median(errors))):
                return fitted
        return None

    def with_bubble(self, found: Trial, bubble: Bubble) -> ObjectWithBubbles:
        """Returns the model of an object with one bubble more."""
        x = found.fit.x
        if isinstance(found.model, ObjectWithBubbles):
            solid, own = found.model.solid, found.model.own
            return ObjectWithBubbles(solid, x[:own], [*found.model.bubbles(x), bubble])
        return ObjectWithBubbles(found.model, x, [bubble])

    def look(
        self,
        found: Trial,
        peak: Peak,
        segments: InnerSegments,
        errors: Float[np.ndarray, " rays"],
    ) -> tuple[float, Bubble] | None:
        """Returns the best of a few radii and its gain, `None` if all make pixels worse."""
        settings, size = self.settings, diameter(found.mesh.vertices)
        guess = _shadow(segments, errors, peak.centre, _REACH * size)
        if not _room(guess.centre, found.candidate.parts[0]).depth > 0.0:
            return None
        radii = [max(share * guess.radius, _LEAST * size) for share in settings.radii]
        near = np.flatnonzero(_distances(segments, guess.centre) <= 1.5 * max(radii))
        near = np.random.default_rng(self.seed).permutation(near)[: settings.looked]
        pixels, blurred = self.pixels.chosen(near), photometry.blurred(self.surface, settings.blur)

        def error(candidate: Candidate) -> float:
            traced = gauss_newton.traced_object(candidate)
            return float(gauss_newton.errors_of(traced, blurred, pixels).mean())

        looks, without = [], error(found.candidate)
        for radius in radii:
            model = self.with_bubble(found, Bubble(guess.centre, radius))
            x = model.start()
            looks.append((without - error(model.pose(x)), model.bubbles(x)[-1]))
        best = max(looks, key=lambda look: look[0])
        return best if best[0] > 0.0 else None

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
        model = fitted.model
        assert isinstance(model, ObjectWithBubbles)
        centre, radius = model.bubbles(fitted.fit.x)[-1]
        segments = photometry.inner_segments(traced, self.judges.rays)
        near = np.flatnonzero(_distances(segments, centre) <= _JUDGED * radius)
        if not len(near):
            return False
        local = self.judges.chosen(near)
        after, before = (
            judged(each.name, each.model, each.fit, self.surface, local) for each in (fitted, found)
        )
        explained = before.error - after.error > _EXPLAINED * (before.error - level)
        return explained and model_selection.choose([before, after]) is after

    def all_unknowns(self, found: Trial, outlines: Callable[[Candidate], Rows] | None) -> Trial:
        """Returns the object after steps of all unknowns, if the judges find it no worse."""
        model, x = found.model, found.fit.x
        assert isinstance(model, ObjectWithBubbles)
        model = ObjectWithBubbles(model.solid, x[: model.own], model.bubbles(x))
        steps = Steps((0,) * self.settings.all, seed=self.seed + 1)
        fit = gauss_newton.fit(
            model, model.start(), self.surface, self.pixels, settings=steps, outlines=outlines
        )
        together = self.judged(model, fit)
        return together if together.error <= found.error else found


def peaks(
    trial: Trial,
    segments: InnerSegments,
    errors: Float[np.ndarray, " rays"],
    *,
    settings: BubbleSettings = BubbleSettings(),
) -> list[Peak]:
    """Returns the places in an object where errors along all lines of sight are large.

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
    steps = int(np.ceil(2.0 * np.linalg.norm(extents) / cell))
    shares = ((np.arange(steps) + 0.5) / steps)[:, None, None]
    at = ((starts + shares * (ends - starts) - low) / cell).astype(int)
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
        if _room(centre, outer).depth > _DEPTH * cell:
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


def _shadow(
    segments: InnerSegments,
    errors: Float[np.ndarray, " rays"],
    point: Float[np.ndarray, "3"],
    reach: float,
) -> Bubble:
    """Returns the ball near a point that best parts paths of large errors from those of small.

    A ball parts paths into those that pass it and the others. The best one leaves the least
    variance of the errors in both sets, as Otsu's threshold does (1979).
    """
    near = np.flatnonzero(_distances(segments, point) <= reach)
    some = InnerSegments(*(each[near] for each in segments))
    count = np.arange(1, len(near))

    def parted(centre: Float[np.ndarray, "3"]) -> tuple[float, float]:
        away = _distances(some, centre)
        order = np.argsort(away)
        total = np.cumsum(errors[near][order])
        contrast = total[:-1] / count - (total[-1] - total[:-1]) / (len(near) - count)
        between = count * (len(near) - count) / len(near) ** 2 * np.maximum(contrast, 0.0) ** 2
        best = int(np.argmax(between))
        return float(between[best]), float(0.5 * (away[order[best]] + away[order[best + 1]]))

    simplex = point + 0.15 * reach * np.concatenate([np.zeros((1, 3)), np.eye(3)])
    options = {"initial_simplex": simplex, "maxfev": _EVALUATIONS, "xatol": 1e-3 * reach}
    centre = minimize(lambda c: -parted(c)[0], point, method="Nelder-Mead", options=options).x
    return Bubble(centre, parted(centre)[1])
