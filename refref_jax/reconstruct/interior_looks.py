"""Looks at hypotheses of what is inside a vessel, through a blurred backdrop.

A look predicts a few thousand pixels. Tints come first, because they remove most of the error, and
are found without tracing light again. Hypotheses start from the thickness of the wall, what is
inside and the level; other gaps, liquids, an open mouth and stained glass are tried for the best of
them.

Vessels of any shape (`free_vessels`) are full of air or of liquid. Their inner wall is a level set
of the distance from the outer one, whose edges may be rounded, above a flat base. All contents of a
wall share one tree.

Source: ours.
"""

import contextlib
import dataclasses
import math
from collections.abc import Sequence
from itertools import product
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter

from refref_jax.compilation import at_once
from refref_jax.geometry.triangle_meshes import Mesh, diameter, keep_faces, pieces
from refref_jax.reconstruct import ReconstructionError, gauss_newton, photometry
from refref_jax.reconstruct.contents import (
    COARSE,
    GLASS_DEVIATION,
    Contents,
    Detail,
    Interior,
    Layout,
    interfaces_of,
    media_of,
)
from refref_jax.reconstruct.families import Revolution
from refref_jax.reconstruct.grids import Grid, find_isosurface
from refref_jax.reconstruct.interiors import Vessel
from refref_jax.reconstruct.mesh_distance import distance_grid
from refref_jax.reconstruct.photometry import Backdrop, Photographs, TracedObject

# Errors of a channel beyond this, in sRGB, do not grow while a tint is found.
_CAP = 0.15

# Error of stained glass, as a share of that of clear glass, below which its tint is worth while.
_STAIN = 0.95

# Logarithms of the tints tried, and the one that counts the crossings.
_LOG_TINTS = np.linspace(0.05, -2.5, 103)
_COUNTING = np.log(0.5)

# Distance between the points of the grid of distances, and its margin around the surface (three
# widths of the widest rounding), as shares of the diameter.
_SPACING, _MARGIN = 1.0 / 150.0, 0.075

# Walls, bases and widths of the roundings of free vessels that are looked at, as shares of the
# diameter; number of pixels of a look, and the blur of its backdrop, in halvings.
_WALLS, _BASES, _ROUNDINGS = (0.008, 0.014, 0.022, 0.035, 0.055), (0.0, 0.045), (0.0, 0.012, 0.024)
_PIXELS, _BLUR = 3000, 1

# Least diameters of a piece of an inside, and of all of it, as shares of the vessel's: smaller
# pieces have no handle of their own, and what has less space inside is next to solid.
_LEAST_PIECE, _LEAST_INSIDE = 0.05, 0.15

# Products of absorption and diameter, and minus logarithms of the tint of stained glass, that are
# looked at.
_DENSITIES = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
_STAINS = (0.0, 0.05, 0.1, 0.2, 0.3, 0.45, 0.7)


@dataclasses.dataclass(frozen=True)
class SearchSettings:
    """Settings of a search.

    Attributes:
      thicknesses: thicknesses of the wall, as shares of the height.
      levels: number of heights of the liquid's surface.
      gaps: heights of the glass between liquid and air, as shares of the height.
      indices: indices of refraction of the liquid.
      glass: index of refraction of the glass.
      glass_deviation: standard deviation of its prior; 0 keeps it.
      mouths: whether vessels may be closed, open, or both.
      stained: whether all glass may have a tint; otherwise that of vessels without liquid alone.
      blur: halvings of the backdrop's resolution in looks.
      pixels: number of pixels of a look.
      finalists: number of hypotheses of each kind that are improved.
      few: blurs of the steps of the few numbers of a hypothesis.
      all: blurs of the steps of all unknowns, of each kind.
      level_shifts: shifts of the level, as shares of the height, with which the best finding is
        fitted once more; walls can hide a wrong level.
      last: blurs of the further steps of the best findings.
      finest: blurs of the final steps of the best finding, if its outside has ridges or a relief.
      rays: number of pixels that judge a step of all unknowns; steps of the few numbers take half
        as many, and are judged by half as many.
      last_rays: number of pixels of a step of all unknowns; twice as many of the finest steps.
      rivals: hypotheses whose error is above that of the best by more than this factor are left
        out before all unknowns are fitted.
      close: the same factor before these further steps; steps from another level are given up above
        it.
      seed: seed of the draws.
    """

    thicknesses: tuple[float, ...] = (0.0125, 0.025, 0.05, 0.1, 0.15)
    levels: int = 10
    gaps: tuple[float, ...] = (0.004, 0.04)
    indices: tuple[float, ...] = (1.36, 1.333, 1.47)
    glass: float = 1.5
    glass_deviation: float = GLASS_DEVIATION
    mouths: tuple[bool, ...] = (False, True)
    stained: bool = False
    blur: int = 3
    pixels: int = 1500
    finalists: int = 2
    few: tuple[int, ...] = (3, 3, 3, 2, 2, 2, 1, 1, 1)
    all: tuple[int, ...] = (2, 2, 1, 1, 0, 0, 0)
    level_shifts: tuple[float, ...] = (0.04, -0.04)
    last: tuple[int, ...] = (1, 0, 0, 0, 0, 0, 0, 0, 0, 0)
    finest: tuple[int, ...] = (1, *((0,) * 15))
    rays: int = 8192
    last_rays: int = 16384
    rivals: float = 1.25
    close: float = 1.05
    seed: int = 0


class Look(NamedTuple):
    """A hypothesis and its error.

    Attributes:
      interior: the hypothesis, with the tint that suits it best.
      error: mean robust error of the pixels in sRGB.
    """

    interior: Interior
    error: float


def hypotheses(outer: Revolution, *, settings: SearchSettings = SearchSettings()) -> list[Interior]:
    """Returns what may be inside an outer surface, the simplest first.

    Indices other than the first, and open vessels, are tried later, for the best of these.
    """
    size, low = extent(outer)
    kinds: tuple[Contents, ...] = ("none", "air", "liquid", "liquid and air")
    found = []
    for contents in kinds:
        for wall in settings.thicknesses if contents != "none" else settings.thicknesses[:1]:
            at = Interior(
                contents,
                wall=wall * size,
                gap=settings.gaps[-1] * size,
                glass=settings.glass,
                glass_deviation=settings.glass_deviation,
                liquid=settings.indices[0],
                stained=settings.stained,
            )
            if not at.level_unknown:
                found.append(at)
                continue
            inside = (1.0 - 2.0 * wall) * size
            steps = (np.arange(settings.levels) + 0.5) / settings.levels
            levels = low + wall * size + inside * steps
            found += [dataclasses.replace(at, level=float(level)) for level in levels]
    return found


def extent(outer: Revolution) -> tuple[float, float]:
    """Returns the height of a surface and its lower end."""
    heights = outer.points[:, 1]
    return float(heights.max() - heights.min()), float(heights.min())


def look(
    outer: Revolution,
    interior: Interior,
    surface: Backdrop,
    pixels: Photographs,
    *,
    detail: Detail = COARSE,
) -> Look:
    """Predicts some pixels for a hypothesis, with the tint that suits it best.

    Light that crosses tinted surfaces n times fades with the nth power of the tint. Prediction with
    another tint gives n, a mean over the light of the pixel, and the tint follows without tracing.

    Raises:
      ReconstructionError: if the wall leaves no space inside.
    """
    solid = interior.contents == "none"
    # Solid glass is looked at as if it had an inside of glass: one compiled program serves all.
    seen = dataclasses.replace(interior, contents="liquid", liquid=interior.glass)
    vessel = Vessel(outer, seen if solid else interior, detail)
    x, layout = vessel.start(), vessel.layout
    where = layout.tint if interior.filled else layout.glass_tint
    scene = gauss_newton.traced_object(vessel.pose(x))
    clear = photometry.predict(scene, surface, pixels.rays)
    linear = clear.linear
    if where.stop > where.start:
        darker = x.copy()
        darker[where] += _COUNTING
        scene = scene.with_interfaces(vessel.interfaces(darker))
        dark = photometry.predict(scene, surface, pixels.rays)
        crossings = np.log(np.maximum(dark.linear, 1e-9) / np.maximum(linear, 1e-9)) / _COUNTING
        change = _best_tint(linear, np.maximum(crossings, 0.0), pixels.rgb)
        x[where] += change
        linear = linear * np.exp(change * crossings)
    found = vessel.interior(x)
    if solid:
        found = dataclasses.replace(found, contents="none", liquid=interior.liquid)
    return Look(
        found, float(gauss_newton.robust_errors(clear._replace(linear=linear), pixels.rgb).mean())
    )


def _best_tint(
    linear: Float[np.ndarray, "rays 3"],
    crossings: Float[np.ndarray, "rays 3"],
    rgb: Float[np.ndarray, "rays 3"],
) -> Float[np.ndarray, "3"]:
    """Returns the logarithm of the tint of least robust error, by channel."""
    tinted = linear * np.exp(_LOG_TINTS[:, None, None] * crossings)
    errors = np.minimum(np.abs(photometry.residuals(tinted, rgb)), _CAP).mean(axis=1)
    return _LOG_TINTS[np.argmin(errors, axis=0)]


def looks_at(
    interiors: Sequence[Interior], outer: Revolution, surface: Backdrop, pixels: Photographs
) -> list[Look]:
    """Returns looks at the hypotheses that fit into an outer surface, in order; two at once."""

    def look_at(interior: Interior) -> list[Look]:
        with contextlib.suppress(ReconstructionError):
            return [look(outer, interior, surface, pixels)]
        return []

    return [each for found in at_once(look_at, interiors) for each in found]


def looks_at_all(
    outer: Revolution, surface: Backdrop, pixels: Photographs, settings: SearchSettings
) -> list[Look]:
    """Returns the looks at all hypotheses, the best first.

    Raises:
      ReconstructionError: if there are no pixels, or no hypothesis fits into the object.
    """
    if not len(pixels.views):
        raise ReconstructionError("No pixel sees the object. Check the masks and the cameras.")
    generator = np.random.default_rng(settings.seed)
    some = pixels.drawn(generator, settings.pixels)
    blurred = photometry.blurred(surface, settings.blur)

    looks = looks_at(hypotheses(outer, settings=settings), outer, blurred, some)
    if not looks:
        raise ReconstructionError(
            "No wall leaves space inside the object. Pass smaller `thicknesses`."
        )
    for variants in (_other_gaps, _other_indices, _other_mouths, _other_glass):
        best = _best_looks(looks, settings)
        others = [other for each in best for other in variants(each.interior, outer, settings)]
        looks += _worth_their_tint(looks_at(others, outer, blurred, some), looks)
    return sorted(looks, key=lambda each: each.error)


def finalists(looks: Sequence[Look], settings: SearchSettings) -> list[Look]:
    """Returns the best looks of each kind, without those that are far worse than the best."""
    best = min(each.error for each in looks)
    return [each for each in _best_looks(looks, settings) if each.error < settings.rivals * best]


def _other_gaps(at: Interior, outer: Revolution, settings: SearchSettings) -> list[Interior]:
    """Returns the same with other gaps, whose middle stays where it is."""
    size = extent(outer)[0]
    if not at.level_unknown:
        return []
    gaps = [gap * size for gap in settings.gaps]
    return [
        dataclasses.replace(at, gap=gap, level=at.level + 0.5 * (at.gap - gap))
        for gap in gaps
        if gap != at.gap
    ]


def _other_indices(at: Interior, outer: Revolution, settings: SearchSettings) -> list[Interior]:
    """Returns the same with other liquids."""
    del outer
    others = [index for index in settings.indices if index != at.liquid]
    return [dataclasses.replace(at, liquid=index) for index in others if at.filled]


def _other_mouths(at: Interior, outer: Revolution, settings: SearchSettings) -> list[Interior]:
    """Returns the same with an open mouth."""
    del outer
    fits = at.contents in ("air", "liquid and air") and True in settings.mouths
    return [dataclasses.replace(at, mouth=True)] if fits else []


def _other_glass(at: Interior, outer: Revolution, settings: SearchSettings) -> list[Interior]:
    """Returns the same of stained glass, if there is no liquid, whose tint looks much the same."""
    del outer, settings
    return [] if at.filled or at.stained else [dataclasses.replace(at, stained=True)]


def _worth_their_tint(looks: Sequence[Look], others: Sequence[Look]) -> list[Look]:
    """Returns looks without those of stained glass that is hardly better than clear glass."""
    least = {name: min(each.error for each in kind) for name, kind in _kinds(others).items()}

    def is_worth(each: Look) -> bool:
        clear = dataclasses.replace(each.interior, stained=False).name
        return not each.interior.stained or each.error < _STAIN * least.get(clear, math.inf)

    return [each for each in looks if is_worth(each)]


def _kinds(looks: Sequence[Look]) -> dict[str, list[Look]]:
    """Returns the looks of each kind, the best first."""
    found: dict[str, list[Look]] = {}
    for each in sorted(looks, key=lambda each: each.error):
        found.setdefault(each.interior.name, []).append(each)
    return found


def _best_looks(looks: Sequence[Look], settings: SearchSettings) -> list[Look]:
    """Returns the best looks of each kind."""
    kinds = _kinds(looks)
    return [each for name in sorted(kinds) for each in kinds[name][: settings.finalists]]


def inner_wall(outer: Mesh, interior: Interior, distances: Grid, *, rounding: float = 0.0) -> Mesh:
    """Returns the surface at the depth of the wall inside the outer one, above the base.

    On curved walls a rounding adds about its square times the mean curvature to the thickness. The
    edge of the base stays sharp.

    Args:
      outer: outer surface.
      interior: thickness of its wall and of its base.
      distances: distances to the outer surface.
      rounding: standard deviation of the Gaussian by which distances are smoothed, world units: the
        inner surface of blown glass is smooth. It should not exceed a third of the margin of the
        grid.

    Raises:
      ValueError: if the rounding is negative or not finite.
      ReconstructionError: if wall and rounding leave no space inside.
    """
    if not (math.isfinite(rounding) and rounding >= 0.0):
        raise ValueError(f"rounding={rounding:g} is no length. Pass 0 or more.")
    floor = float(outer.vertices[:, 2].min()) + interior.base
    heights = distances.low[2] + distances.spacing * np.arange(distances.values.shape[2])
    width = rounding / distances.spacing
    values = gaussian_filter(distances.values, width, mode="nearest") if width else distances.values
    space = np.maximum(values + interior.wall, floor - heights)
    if not np.any(space < 0.0):
        raise ReconstructionError(
            f"A wall of {interior.wall:g} above a base of {interior.base:g}, rounded by "
            f"{rounding:g}, leaves no space inside. Pass thinner ones."
        )
    return find_isosurface(distances._replace(values=space))


class FreeLook(NamedTuple):
    """A look at a vessel of any shape.

    Attributes:
      error: mean robust error of the pixels in sRGB.
      interior: contents, with the colour that suits them best.
      rounding: rounding of the inner wall, world units.
      inner: inner wall.
    """

    error: float
    interior: Interior
    rounding: float
    inner: Mesh


def best_free_looks(
    outer: Mesh,
    kinds: Sequence[Interior],
    surface: Backdrop,
    pixels: Photographs,
    *,
    seed: int = 0,
) -> list[FreeLook]:
    """Looks at walls inside a surface of any shape, each with several kinds of contents.

    Args:
      outer: outer surface, closed.
      kinds: contents and indices; walls, bases and colours are tried.
      surface: backdrop.
      pixels: pixels that see the vessel, of which some are looked at.
      seed: seed of the draw.

    Returns:
      The look at each kind whose wall, rounding and then base suit it best; none if no wall leaves
      space inside.
    """
    size = diameter(outer.vertices)
    distances = distance_grid(outer, spacing=_SPACING * size, margin=_MARGIN * size)
    some = pixels.drawn(np.random.default_rng(seed), _PIXELS)
    blurred = photometry.blurred(surface, _BLUR)

    def looks_inside(
        some_kinds: Sequence[Interior], wall: float, base: float, rounding: float
    ) -> list[FreeLook]:
        shapes = [dataclasses.replace(each, wall=wall, base=base) for each in some_kinds]
        try:
            inner = inner_wall(outer, shapes[0], distances, rounding=rounding)
        except ReconstructionError:  # it leaves no space
            return []
        inner = _without_specks(inner, _LEAST_PIECE * size)
        if not len(inner.faces) or diameter(inner.vertices) < _LEAST_INSIDE * size:
            return []
        return [
            FreeLook(*_best_colour(traced, blurred, some, shape, size), rounding, inner)
            for traced, shape in zip(_scenes(outer, inner, shapes), shapes, strict=True)
        ]

    error = attrgetter("error")
    walls = [(size * wall, size * rounding) for wall, rounding in product(_WALLS, _ROUNDINGS)]
    looks = at_once(lambda wall: looks_inside(kinds, wall[0], size * _BASES[0], wall[1]), walls)
    best = [min(each, key=error) for each in zip(*filter(None, looks), strict=True)]
    others = at_once(
        lambda kind, each: [
            other
            for base in _BASES[1:]
            for other in looks_inside([kind], each.interior.wall, size * base, each.rounding)
        ],
        kinds[: len(best)],
        best,
    )
    return [min([each, *bases], key=error) for each, bases in zip(best, others, strict=True)]


def _without_specks(mesh: Mesh, least: float) -> Mesh:
    """Returns a mesh without connected pieces whose diameter is below a length."""
    piece = pieces(mesh.faces, len(mesh.vertices))
    low, high = (np.full((piece.max() + 1, 3), sign * np.inf) for sign in (1.0, -1.0))
    np.minimum.at(low, piece, mesh.vertices)
    np.maximum.at(high, piece, mesh.vertices)
    large = np.linalg.norm(high - low, axis=-1) >= least
    return mesh if large.all() else keep_faces(mesh, large[piece[mesh.faces[:, 0]]])


def _scenes(outer: Mesh, inner: Mesh, kinds: Sequence[Interior]) -> list[TracedObject]:
    """Returns two walls with each kind of contents; they share the tree."""
    media = [media_of(kind, Layout(kind, 0, 0, axis=0)) for kind in kinds]
    interfaces = [interfaces_of(each) for each in media]
    traced = photometry.assemble(
        np.concatenate([wall.vertices[wall.faces] for wall in (outer, inner)]),
        np.concatenate([outer.normals, inner.normals]),
        np.repeat(np.arange(2), [len(outer.faces), len(inner.faces)]),
        interfaces[0],
    )
    return [traced.with_interfaces(each) for each in interfaces]


def _best_colour(
    traced: TracedObject, surface: Backdrop, pixels: Photographs, clear: Interior, size: float
) -> tuple[float, Interior]:
    """Returns the robust error of pixels with the colour that suits them best, and such contents.

    It is the absorption of a liquid, or else the tint of the glass. A liquid that bends light like
    the glass around it is seen by its absorption alone. Channels are chosen one by one, by mean
    absolute errors. All light of a pixel is taken to be dimmed like that of its main path.
    """
    seen = photometry.predict(traced, surface, pixels.rays)
    paths = photometry.sensitivities(traced, surface, pixels.rays, seen)
    # The liquid is the second part.
    amounts = paths.lengths[:, 1:2] if clear.filled else paths.crossings[:, :1]
    strengths = np.array(_DENSITIES) / size if clear.filled else np.array(_STAINS)
    dimmed = seen.linear * np.exp(-strengths[:, None, None] * amounts)
    errors = np.abs(photometry.residuals(dimmed, pixels.rgb)).mean(axis=1)
    best = strengths[np.argmin(errors, axis=0)]
    seen = seen._replace(linear=seen.linear * np.exp(-amounts * best))
    error = float(gauss_newton.robust_errors(seen, pixels.rgb).mean())
    red, green, blue = best.tolist() if clear.filled else np.exp(-best).tolist()
    if clear.filled:
        return error, dataclasses.replace(clear, absorption=(red, green, blue))
    return error, dataclasses.replace(clear, glass_tint=(red, green, blue))
