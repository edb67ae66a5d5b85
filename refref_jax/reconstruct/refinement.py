"""Whether a mesh bounds a body, and whether that is still the same one (NumPy only).

From a mesh cut out of a grid to one that light can be traced through (host).

The stages, none of which needs a hand: all pieces but the largest go, unless they are large;
ripples are smoothed; a body that is convex but for noise becomes so; a convex body that few corners
describe is fitted to the outlines of the masks; edges are rounded; the surface is meshed anew from
its signed distances. All lengths are in world units, so that a finer grid changes nothing but
detail. A stage that would empty the body, turn it inside out, tear it or change its volume much is
left out.

The paper's recipe, by hand (arXiv 2505.05848, section on R3F): convex hull if no vertex lies
further from it than an unstated threshold; MeshLab's removal of pieces below 90 % of the diameter,
which can remove the body; in Blender a bevel of 0.015, 100 smoothings of factor 1.0, which shrink
the body by a length that depends on its edges, and a remesh at octree depth 8.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from refref_jax.geometry.triangle_meshes import (
    Mesh,
    diameter,
    face_vectors,
    is_closed,
    keep_faces,
    pieces,
    volume,
)
from refref_jax.reconstruct import ReconstructionError
from refref_jax.reconstruct.convex import depth_below_hull, from_tangents, is_convex
from refref_jax.reconstruct.grids import Box, find_isosurface, import_skimage, sample
from refref_jax.reconstruct.masks import Views, check_masks
from refref_jax.reconstruct.mesh_distance import signed_distance
from refref_jax.reconstruct.polytope_fit import MOST, fit_corners
from refref_jax.reconstruct.smoothing import CREASE, denoise_within, diffuse


def check_body(mesh: Mesh) -> None:
    """Checks that a mesh bounds a body.

    Raises:
      ReconstructionError: if it is empty, open or turned inwards.
    """
    if len(mesh.faces) == 0:
        raise ReconstructionError("The mesh is empty. Check the masks and the level of the grid.")
    if not is_closed(mesh.faces):
        raise ReconstructionError(
            "The mesh is not closed. Cut it from a grid whose border is outside the body."
        )
    if volume(mesh.vertices, mesh.faces) <= 0.0:
        raise ReconstructionError(
            "The mesh is turned inwards. Exchange two corners of every face, or negate the grid."
        )


def objection(before: Mesh, after: Mesh, most: float) -> str:
    """Returns why what was made of a body is no body, or another one; or nothing.

    Args:
      before: a body.
      after: what was made of it.
      most: share of the volume by which the two may differ.
    """
    if len(after.faces) == 0:
        return "nothing would be left"
    if not is_closed(after.faces) or not np.all(np.isfinite(after.vertices)):
        return "the surface would be torn"
    old, new = (volume(mesh.vertices, mesh.faces) for mesh in (before, after))
    if not math.isclose(new, old, rel_tol=most):
        return f"the volume would go from {old:.4g} to {new:.4g}"
    if _count_pieces(after) > _count_pieces(before):
        return "the body would fall apart"
    return ""


def _count_pieces(mesh: Mesh) -> int:
    return len(np.unique(pieces(mesh.faces, len(mesh.vertices))[mesh.faces[:, 0]]))


# Spacings around a mesh that is sampled.
_RIM = 3

# As exact distances ask for, with the neighbours that a gradient looks at.
_NEAR = 1.1

# How many times more the volume may change where outlines are held to the masks: that of a hull of
# few views is far too large.
_HELD = 4.0

# A mesh is sampled at most this finely, in spacings along its diameter.
_FINEST = 400


@dataclass(frozen=True)
class Refinement:
    """What is done to a mesh. A length of 0 leaves its stage out.

    Attributes:
      smallest_piece: share of the whole volume from which a piece is kept besides the largest.
      denoising: diffusion length of the normals, which stops at creases, world units; a half or a
        quarter of it where masks show that more would move outlines.
      crease: angle between neighbouring faces at which it stops, radians.
      smoothing: diffusion length of the vertices, which rounds creases too, world units.
      convex_depth: a body is made convex if no vertex lies deeper below its hull, world units.
      corners: as many as a convex body may have to be fitted to masks; 0 leaves the stage out.
      rounding: radius to which convex edges are rounded, world units.
      spacing: of the grid of signed distances from which the surface is meshed anew, world units.
      volume_change: share of the volume that any stage may change; four times as much where
        corners are fitted to masks.
    """

    smallest_piece: float = 0.02
    denoising: float = 0.1
    crease: float = CREASE
    smoothing: float = 0.0
    convex_depth: float = 0.04
    corners: int = MOST
    rounding: float = 0.0
    spacing: float = 0.0
    volume_change: float = 0.05


PAPER = Refinement(
    denoising=0.0,
    smoothing=0.3,
    convex_depth=0.02,
    corners=0,
    rounding=0.015,
    spacing=2.0 * 2.1 / 2**8,
)
"""The paper's recipe in lengths, without its shrinking: 100 steps of edges of 0.03 diffuse 0.3."""


class Stage(NamedTuple):
    """A mesh after a stage.

    Attributes:
      name: of the stage.
      mesh: what it made, or what it was given if that would not do.
      refused: why it was left out, or empty.
    """

    name: str
    mesh: Mesh
    refused: str


def refine(mesh: Mesh, settings: Refinement, *, views: Views | None = None) -> tuple[Stage, ...]:
    """Returns the mesh after each stage that the settings ask for; the last one is the result.

    Args:
      mesh: closed and outward, such as `grids.find_isosurface` returns.
      settings: see `Refinement`.
      views: masks from which the mesh was made; without them no corners are fitted, and nothing
        holds denoising back.

    Raises:
      ReconstructionError: if the mesh is empty, open or turned inwards; if it is to be meshed anew
        and scikit-image is not installed; or if masks and cameras do not fit each other.
    """
    check_body(mesh)
    if max(settings.rounding, settings.spacing) > 0.0:
        import_skimage()
    first = keep_pieces(mesh, smallest=settings.smallest_piece)
    stages = [Stage("pieces", first, "")]
    for name, change in _changes(settings, first, views).items():
        most = settings.volume_change * (_HELD if name == "corners" else 1.0)
        stages.append(_stage(name, stages[-1].mesh, change, most))
    return tuple(stages)


def keep_pieces(mesh: Mesh, *, smallest: float) -> Mesh:
    """Returns the largest piece by volume, and those not below a share of the whole volume.

    Cavities, which are pieces turned inwards, count by what they enclose.
    """
    label = pieces(mesh.faces, len(mesh.vertices))[mesh.faces[:, 0]]
    moments = np.sum(
        mesh.vertices[mesh.faces[:, 0]] * face_vectors(mesh.vertices, mesh.faces), axis=-1
    )
    enclosed = np.abs(np.bincount(label, moments)) / 3.0
    kept = enclosed >= smallest * enclosed.sum()
    kept[np.argmax(enclosed)] = True
    return keep_faces(mesh, kept[label])


def round_edges(mesh: Mesh, radius: float, *, spacing: float | None = None) -> Mesh:
    """Returns a mesh whose convex edges are rounded to a radius: moved inwards by it, and back out.

    Parts thinner than twice the radius vanish; flat and concave ones stay as they are. The grid
    cuts edges of the inner body off, so that a little more than the rounding is lost.

    Args:
      mesh: closed.
      radius: world units.
      spacing: of the grids of signed distances; half the radius if not given, but no finer than a
        400th of the diameter.

    Raises:
      ReconstructionError: if nothing is that thick, or scikit-image is not installed.
    """
    finest = diameter(mesh.vertices) / _FINEST
    spacing = max(0.5 * radius, finest) if spacing is None else spacing
    return remesh(remesh(mesh, spacing, level=-radius), spacing, level=radius)


def remesh(mesh: Mesh, spacing: float, *, level: float = 0.0) -> Mesh:
    """Returns the surface at a signed distance from a mesh, from a grid; its normals are gradients.

    Args:
      mesh: closed.
      spacing: of the grid, and about the length of the new edges, world units.
      level: the distance, negative inside.

    Raises:
      ReconstructionError: if nothing is that deep inside, or scikit-image is not installed.
    """
    field = signed_distance(mesh)
    rim = _RIM * spacing + max(level, 0.0)
    box = Box(mesh.vertices.min(axis=0) - rim, mesh.vertices.max(axis=0) + rim)
    grid = sample(field, box, spacing=spacing, level=level, near=_NEAR)
    return find_isosurface(grid, level=level)


def _changes(
    settings: Refinement, first: Mesh, views: Views | None
) -> dict[str, Callable[[Mesh], Mesh]]:
    """Returns the stages after the first, whose mesh is given, by name, in their order."""
    changes: dict[str, Callable[[Mesh], Mesh]] = {}
    if settings.denoising > 0.0:
        changes["denoised"] = lambda mesh: denoise_within(
            mesh, settings.denoising, crease_angle=settings.crease, views=views
        )
    if settings.smoothing > 0.0:
        changes["smoothed"] = lambda mesh: diffuse(mesh, settings.smoothing)
    if settings.convex_depth > 0.0:
        changes["convex"] = lambda mesh: _made_convex(mesh, settings)
    if settings.corners > 0 and views is not None:
        check_masks(views.masks, views.cameras)
        # Smoothing moves outlines, so corners are looked for on what was there before it.
        changes["corners"] = lambda mesh: (
            fit_corners(mesh, first, views, most=settings.corners) if is_convex(mesh) else mesh
        )
    if settings.rounding > 0.0:
        changes["rounded"] = lambda mesh: _attempt(
            lambda: round_edges(mesh, settings.rounding), mesh
        )
    if settings.spacing > 0.0:
        changes["remeshed"] = lambda mesh: _attempt(lambda: remesh(mesh, settings.spacing), mesh)
    return changes


def _stage(name: str, before: Mesh, change: Callable[[Mesh], Mesh], most: float) -> Stage:
    """Returns what a change makes of a mesh, or the mesh and why it would not do."""
    try:
        after = change(before)
    except ReconstructionError as error:
        return Stage(name, before, str(error))
    refused = objection(before, after, most)
    return Stage(name, before if refused else after, refused)


def _made_convex(mesh: Mesh, settings: Refinement) -> Mesh:
    several = len(np.unique(pieces(mesh.faces, len(mesh.vertices)))) > 1
    if several or depth_below_hull(mesh) > settings.convex_depth:
        return mesh
    return from_tangents(mesh, crease_angle=settings.crease)


def _attempt(change: Callable[[], Mesh], mesh: Mesh) -> Mesh:
    """Returns what a change makes, or nothing at all where it finds no body."""
    try:
        return change()
    except ReconstructionError:
        return Mesh(mesh.vertices[:0], mesh.faces[:0], mesh.normals[:0])
