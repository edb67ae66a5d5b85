"""Vessels of any shape that are full of air or of liquid: two free surfaces, as unknowns of a fit.

The inner wall begins as the best one that `interior_looks` finds. Both walls are free surfaces
(`shapes.FreeSurface`). The inner one follows the outer one, so that the wall keeps its thickness
where light says nothing, and has handles of its own, fewer. Where it would come out of the outer
one, it stays a little below it. In the last steps, handles are half as far apart: at 1/44 of the
diameter they cannot represent the normals of a figure with limbs to better than 3 degrees.

What this cannot represent: the surface of a liquid, and open mouths.

Source: ours.
"""

import contextlib
import dataclasses
import math
import operator
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse
from jaxtyping import Float
from scipy.spatial import KDTree

from refref_jax.data.mesh_queries import winding_number
from refref_jax.geometry.triangle_meshes import (
    Mesh,
    diameter,
    face_normals,
    unit_vectors,
    with_short_edges,
)
from refref_jax.reconstruct import ReconstructionError, gauss_newton
from refref_jax.reconstruct.contents import GLASS_DEVIATION, Interior, Layout
from refref_jax.reconstruct.gauss_newton import Candidate, Rows, Steps
from refref_jax.reconstruct.interior_looks import best_free_looks
from refref_jax.reconstruct.interiors import Vessel
from refref_jax.reconstruct.mesh_distance import ClosestSearch, signed_distance
from refref_jax.reconstruct.model_selection import Trial, judged
from refref_jax.reconstruct.photometry import Backdrop, Photographs
from refref_jax.reconstruct.shapes import FreeSurface, Posed, mesh_of, vertex_normals_of
from refref_jax.reconstruct.smoothing import diffuse

# Distances between the handles of the outer and of the inner wall, as shares of the diameter, in
# all steps but the finest ones, and in these. Beyond this number of unknowns (0.3 GB a matrix) they
# are further apart.
_COARSE, _FINE = (1.0 / 44.0, 1.0 / 24.0), (1.0 / 88.0, 1.0 / 44.0)
_MOST = 6000

# Least depth of the inner wall below the outer one, as a share of the diameter, and distance from a
# vertex within which depths are exact, as a multiple of it.
_THINNEST, _NEAR = 0.002, 10.0

# Largest shares of the vertices of the inner wall that may be outside the outer one: by any height,
# and by more than they are kept below it; largest number whose winding numbers are computed.
_OUTSIDE, _FAR_OUTSIDE, _MOST_SUSPECTS = 1.0 / 100.0, 1.0 / 2000.0, 1000

# Barycentric coordinate below which a point is on the edge of a face.
_ON_EDGE = 1e-6

# Standard deviations of the inner wall's own handles: minus the mean of their neighbours, and in
# all, in the units of `FreeSurface`.
_ROUGHNESS, _OFFSET = 0.006, 0.04

# Indices of refraction of the liquids that are begun with: near those of water and of oil.
_LIQUIDS = (1.36, 1.45)

# Blurs of the first steps, which choose the contents, of the others, and of the finest ones; number
# of pixels of a step. The finest steps are taken in rounds: before each, both walls are smoothed,
# and robust weights begin wide again.
_FIRST, _OTHERS, _FINEST = (2, 2, 1), (1, *[0] * 15), ((0,) * 8, (0,) * 8, (0,) * 7, (0,))
_FIRST_RAYS, _RAYS, _FINEST_RAYS, _JUDGES = 12_000, 24_000, 48_000, 8192

# Lengths over which the outer and the inner wall are smoothed, as shares of the diameter.
_SMOOTHINGS = (0.006, 0.010)

# What all steps share: pixels of the largest derivatives are left out, robust weights are wide at
# first, and a fit ends after two steps of little gain.
_STEPS = Steps(judges=_JUDGES, outliers=0.02, widest=0.3, gain=0.002)

# Ratio of its error after the first steps to that of the best other shape beyond which a vessel is
# given up; and to that of the other contents. While normals are far off, air has the advantage that
# it bends light least.
_HOPELESS, _WORSE = 1.25, 1.1


class FreeVessel(Vessel):
    """A vessel as a `gauss_newton.Model`, full of air or of liquid.

    The unknowns (`layout`) are the displacements of the handles of both walls, the indices of glass
    and liquid, the logarithms of the tints, and the absorption of the liquid.

    Attributes:
      interior_at_start: contents at the start; heights are along the z axis.
      layout: places of the unknowns; there is no axis.
      size: diameter, world units.
    """

    def __init__(
        self,
        outer: Mesh,
        inner: Mesh,
        interior: Interior,
        *,
        spacings: tuple[float, float] = _COARSE,
        expected: Interior | None = None,
    ) -> None:
        """Places the handles.

        Args:
          outer: outer wall.
          inner: inner wall.
          interior: contents to begin with.
          spacings: distances between the handles of both walls, as shares of the diameter.
          expected: contents whose indices of refraction the prior expects; `interior` by default.

        Raises:
          ReconstructionError: if the contents have a surface.
        """
        if interior.contents not in ("air", "liquid") or interior.mouth:
            raise ReconstructionError(
                f"A free vessel is full of air or of liquid, not of {interior.name}. Pass one of "
                "these, or a body of revolution."
            )
        self.interior_at_start, self.size = interior, diameter(outer.vertices)
        self._expected = interior if expected is None else expected
        outer_spacing, inner_spacing = (spacing * self.size for spacing in spacings)
        self._outer_surface = FreeSurface(outer, outer_spacing)
        self._inner_surface = FreeSurface(inner, inner_spacing, roughness=_ROUGHNESS, size=_OFFSET)
        nearest = KDTree(outer.vertices).query(inner.vertices)[1]
        weights = [self._outer_surface.weights[nearest], self._inner_surface.weights]
        self.layout = Layout(
            interior, weights[0].shape[1], len(self._inner_surface.handles), axis=0
        )
        self._inner_surface.weights = scipy.sparse.hstack(weights).tocsr()

    def finer(self, x: Float[np.ndarray, " unknowns"]) -> "FreeVessel":
        """Returns the vessel of given unknowns as one at rest that has more handles.

        Its prior expects no displacements from there, and the same indices of refraction. Both
        walls are smoothed: ripples as narrow as the distance between handles come from the masks
        and from the handles themselves, and neither light nor the prior takes them away. Thin limbs
        of the inside become shorter.

        Raises:
          ReconstructionError: if a smoothed wall is inside out or encloses nothing.
        """
        outer, inner = (
            diffuse(mesh_of(wall), length * self.size)
            for wall, length in zip(self._surfaces(x), _SMOOTHINGS, strict=True)
        )
        now, known = self.interior(x), self._expected
        found = FreeVessel(outer, inner, now, spacings=_FINE, expected=known)
        if found.layout.count <= _MOST:
            return found
        wider = math.sqrt(found.layout.count / _MOST)
        spacings = (wider * _FINE[0], wider * _FINE[1])
        return FreeVessel(outer, inner, now, spacings=spacings, expected=known)

    def _surfaces(self, x: Float[np.ndarray, " unknowns"]) -> list[Posed]:
        """Returns the surfaces of both walls, with columns for all unknowns."""
        outer = self._outer_surface.pose(x[self.layout.outer])
        inner = self._inner_surface.pose(x[: self.layout.inner.stop])
        outer, inner = (
            wall._replace(
                by_vertices=_widened(wall.by_vertices, len(x)),
                by_normals=_widened(wall.by_normals, len(x)),
            )
            for wall in (outer, inner)
        )
        return [outer, _kept_below(inner, outer, _THINNEST * self.size)]

    def _unfolded(self, x: Float[np.ndarray, " unknowns"]) -> list[Posed]:
        """Returns the surfaces of the parts, which are no profiles."""
        return self._surfaces(x)

    def prior(
        self, x: Float[np.ndarray, " unknowns"]
    ) -> tuple[Float[np.ndarray, "unknowns unknowns"], Float[np.ndarray, " unknowns"]]:
        """Returns the prior: near the start, and handles that move like their neighbours."""
        layout = self.layout
        deviations = np.ones(layout.count)
        for where, deviation in self._deviations_of_media():
            deviations[where] = deviation
        precision = np.diag(deviations**-2.0)
        for where, surface in (
            (layout.outer, self._outer_surface),
            (layout.inner, self._inner_surface),
        ):
            own, _ = surface.prior(x[where])
            precision[where, where] = scipy.sparse.csr_array(own).toarray()
        return precision, precision @ self._away(x)

    def _away(self, x: Float[np.ndarray, " unknowns"]) -> Float[np.ndarray, " unknowns"]:
        """Returns how far unknowns are from those that the prior expects."""
        away, at = super()._away(x), self.layout
        away[at.glass], away[at.liquid] = (
            x[at.glass] - self._expected.glass,
            x[at.liquid] - self._expected.liquid,
        )
        return away

    def surfaces_cross(self, x: Float[np.ndarray, " unknowns"]) -> bool:
        """Returns whether more than a few vertices of the inner wall are outside the outer one.

        In a crease, a vertex that is kept below one face may come out of another, but by less than
        it is kept below: 1 in 100 may. Where a face of the outer wall is folded over, signed
        distances have the wrong sign, and nothing keeps the few vertices beside it inside: winding
        numbers decide, and 1 in 2000 may be further outside.
        """
        outer, inner = (mesh_of(wall) for wall in self._surfaces(x))
        heights = signed_distance(outer)(inner.vertices)
        for least, share in ((0.0, _OUTSIDE), (_THINNEST * self.size, _FAR_OUTSIDE)):
            suspects = inner.vertices[heights >= least]
            some = suspects[:: math.ceil(len(suspects) / _MOST_SUSPECTS) or 1]
            outside = np.sum(winding_number(outer, some) < 0.5)
            if outside * len(suspects) > share * len(inner.vertices) * len(some):
                return True
        return False


def fit_free_vessel(
    mesh: Mesh,
    surface: Backdrop,
    pixels: Photographs,
    judges: Photographs,
    *,
    glass: float = 1.5,
    glass_deviation: float = GLASS_DEVIATION,
    outlines: Callable[[Candidate], Rows] | None = None,
    rival: float = math.inf,
    seed: int = 0,
    progress: Callable[[float, str], None] = lambda share, text: None,
) -> Trial | None:
    """Fits a vessel of any shape that is full of air or of liquid.

    Args:
      mesh: outer surface, from masks only.
      surface: backdrop.
      pixels: pixels to fit.
      judges: other pixels.
      glass: index of refraction of the glass to begin with.
      glass_deviation: standard deviation of its prior; 0 keeps it.
      outlines: equations of the masks' outlines.
      rival: error of the best shape so far; a vessel that is far worse gets no further steps.
      seed: seed of the draws.
      progress: function called with the share of the work that is done, and a line of text.

    Returns:
      The best fit whose walls do not cross; `None` if there is none.
    """
    progress(0.0, "looks")
    mesh = with_short_edges(mesh, 2.0 * _FINE[0] * diameter(mesh.vertices))
    air = Interior("air", glass=glass, glass_deviation=glass_deviation, stained=True)
    liquid = dataclasses.replace(air, contents="liquid", stained=False)
    kinds = [air, *(dataclasses.replace(liquid, liquid=index) for index in _LIQUIDS)]
    looks = best_free_looks(mesh, kinds, surface, judges, seed=seed)
    others, finest = len(_OTHERS) * _RAYS, sum(map(len, _FINEST)) * _FINEST_RAYS
    total, done = len(kinds) * (len(_FIRST) * _FIRST_RAYS + others) + finest, 0

    def fitted(vessel: FreeVessel, x: np.ndarray, blurs: tuple[int, ...], rays: int) -> _Fitted:
        nonlocal done
        begin, name = done, vessel.interior_at_start.name
        done += len(blurs) * rays
        fit = gauss_newton.fit(
            vessel,
            x,
            surface,
            pixels,
            settings=dataclasses.replace(_STEPS, blurs=blurs, rays=rays, seed=seed + len(found)),
            outlines=outlines,
            progress=lambda step, facts: progress(
                (begin + step * rays) / total, f"{name}: {facts.after:.4f}"
            ),
        )
        return _Fitted(vessel, judged(f"free vessel: {name}", vessel, fit, surface, judges))

    found: list[_Fitted] = []
    for vessel in [FreeVessel(mesh, each.inner, each.interior) for each in looks]:
        found.append(fitted(vessel, vessel.start(), _FIRST, _FIRST_RAYS))
    errors = [each.error for each in found]
    if errors and min(errors) < _HOPELESS * rival:
        close = [each for each in found if each.error <= _WORSE * min(errors)]
        found += [fitted(each.vessel, each.trial.fit.x, _OTHERS, _RAYS) for each in close]
        done = total - finest
        for blurs in _FINEST:
            best = _best(found)
            with contextlib.suppress(ReconstructionError):  # smoothed walls may be inside out
                if best is not None:
                    finer = best.vessel.finer(best.trial.fit.x)
                    found.append(fitted(finer, finer.start(), blurs, _FINEST_RAYS))
    best = _best(found)
    return None if best is None else best.trial


class _Fitted(NamedTuple):
    """A vessel after some steps."""

    vessel: FreeVessel
    trial: Trial

    @property
    def error(self) -> float:
        """Error of the judges."""
        return self.trial.error

    def surfaces_cross(self) -> bool:
        """Returns whether its inner wall is outside the outer one somewhere."""
        return self.vessel.surfaces_cross(self.trial.fit.x)


_error = operator.attrgetter("error")


def _best(found: Sequence[_Fitted]) -> _Fitted | None:
    """Returns the vessel of least error whose walls do not cross."""
    possible = (each for each in sorted(found, key=_error) if not each.surfaces_cross())
    return next(possible, None)


def _kept_below(inner: Posed, outer: Posed, depth: float) -> Posed:
    """Returns the inner wall, whose vertices follow the outer one where they would be less deep."""
    normals = vertex_normals_of(outer)
    heights, distances = _above_nearest(outer, inner.vertices)
    near = np.flatnonzero((heights > -depth) | (distances < _NEAR * depth))
    if not len(near):
        return inner
    on = ClosestSearch(outer.vertices, outer.faces)(inner.vertices[near])
    corners = outer.faces[on.faces]
    # On edges and corners, the normal of one face may point to the wrong side.
    inside_face = on.weights.min(axis=1, keepdims=True) > _ON_EDGE
    between = np.sum(on.weights[..., None] * normals[corners], axis=1)
    towards = np.where(inside_face, face_normals(outer.vertices[corners]), between)
    away = inner.vertices[near] - on.points
    side = np.sign(np.sum(away * towards, axis=-1))
    shallow = side * on.distances > -depth
    follows, corner = np.zeros(len(inner.vertices)), np.zeros(len(inner.vertices), np.int64)
    follows[near[shallow]] = 1.0
    corner[near] = np.take_along_axis(corners, np.argmax(on.weights, axis=1)[:, None], axis=1)[:, 0]
    vertices, outwards = inner.vertices.copy(), side[:, None] * unit_vectors(away)
    vertices[near[shallow]] = (on.points - depth * outwards)[shallow]
    rows, shares = (3 * corner[:, None] + np.arange(3)).ravel(), np.repeat(follows, 3)
    own = scipy.sparse.diags_array(1.0 - shares) @ inner.by_vertices
    followed = scipy.sparse.diags_array(shares) @ scipy.sparse.csr_array(outer.by_vertices)[rows]
    return inner._replace(vertices=vertices, by_vertices=(own + followed).tocsr())


def _above_nearest(
    outer: Posed, points: Float[np.ndarray, "points 3"]
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """Returns heights above the tangent plane of the nearest vertex, and distances to that."""
    distances, nearest = KDTree(outer.vertices).query(points)
    away = points - outer.vertices[nearest]
    return np.sum(away * vertex_normals_of(outer)[nearest], axis=-1), distances


def _widened(matrix: scipy.sparse.csr_array, count: int) -> scipy.sparse.csr_array:
    """Returns a matrix with further columns, of zeros."""
    nothing = scipy.sparse.csr_array((matrix.shape[0], count - matrix.shape[1]))
    return scipy.sparse.hstack([matrix, nothing]).tocsr()
