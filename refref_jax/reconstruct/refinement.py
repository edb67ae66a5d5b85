"""Cleans, smooths and remeshes a reconstructed mesh, so that rays can be traced through it.

All stages are automatic. Small pieces are removed; ripples are smoothed; an object that is convex
up to noise is made convex; a convex object with few corners is fitted to the outlines of the masks;
edges are rounded; the surface is remeshed from its signed distances. All lengths are in world
units, so that a finer grid only adds detail. A stage is skipped if it would empty the mesh, turn it
inside out, tear it or change its volume too much. Runs on the host.

The paper's manual recipe (arXiv 2505.05848, section on R3F): convex hull if no vertex lies further
from it than an unstated threshold; MeshLab's removal of pieces below 90 % of the diameter, which
can remove the object; in Blender a bevel of 0.015, 100 smoothings of factor 1.0, which shrink the
object by a length that depends on its edges, and a remesh at octree depth 8.
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


def check_mesh(mesh: Mesh) -> None:
    """Checks that a mesh bounds a volume.

    Raises:
      ReconstructionError: if it is empty, open or inside out.
    """
    if len(mesh.faces) == 0:
        raise ReconstructionError("The mesh is empty. Check the masks and the level of the grid.")
    if not is_closed(mesh.faces):
        raise ReconstructionError(
            "The mesh is not closed. Extract it from a grid whose border is outside the object."
        )
    if volume(mesh.vertices, mesh.faces) <= 0.0:
        raise ReconstructionError(
            "The mesh is inside out. Swap two corners of every face, or negate the grid."
        )


def objection(before: Mesh, after: Mesh, most: float) -> str:
    """Returns why a stage's result is unusable, or an empty string.

    Args:
      before: mesh before the stage.
      after: mesh after the stage.
      most: largest relative change of the volume.
    """
    if len(after.faces) == 0:
        return "nothing would be left"
    if not is_closed(after.faces) or not np.all(np.isfinite(after.vertices)):
        return "the surface would be torn"
    old, new = (volume(mesh.vertices, mesh.faces) for mesh in (before, after))
    if not math.isclose(new, old, rel_tol=most):
        return f"the volume would go from {old:.4g} to {new:.4g}"
    if _count_pieces(after) > _count_pieces(before):
        return "the object would fall apart"
    return ""


def _count_pieces(mesh: Mesh) -> int:
    return len(np.unique(pieces(mesh.faces, len(mesh.vertices))[mesh.faces[:, 0]]))


# Margin around a sampled mesh, in spacings.
_RIM = 3

# Refined distance from the surface for exact distances, including the neighbours that a gradient
# needs.
_NEAR = 1.1

# Factor on the allowed change of volume if corners are fitted to the masks, because the hull of few
# views is far too large.
_HELD = 4.0

# Finest sampling of a mesh, as spacings per diameter.
_FINEST = 400


@dataclass(frozen=True)
class Refinement:
    """Settings of the refinement. A length of 0 skips its stage.

    Attributes:
      smallest_piece: share of the total volume above which a piece is kept in addition to the
        largest.
      denoising: diffusion length of the normals, which stops at creases, world units; halved or
        quartered if the masks show that it would move outlines.
      crease: angle between neighbouring faces at which denoising stops, radians.
      smoothing: diffusion length of the vertices, which also rounds creases, world units.
      convex_depth: largest depth below its hull at which an object is made convex, world units.
      corners: largest number of corners of a convex object fitted to masks; 0 skips the stage.
      rounding: radius to which convex edges are rounded, world units.
      spacing: spacing of the signed distance grid from which the surface is remeshed, world units.
      volume_change: largest relative change of the volume per stage; four times as much where
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
"""The paper's recipe in lengths, without its shrinking: 100 steps on edges of 0.03 diffuse 0.3."""


class Stage(NamedTuple):
    """Result of a stage.

    Attributes:
      name: name of the stage.
      mesh: mesh after the stage; unchanged if the stage was skipped.
      refused: reason for skipping the stage, or an empty string.
    """

    name: str
    mesh: Mesh
    refused: str


def refine(mesh: Mesh, settings: Refinement, *, views: Views | None = None) -> tuple[Stage, ...]:
    """Returns the mesh after each enabled stage; the last one is the result.

    Args:
      mesh: closed mesh with outward faces, such as `grids.find_isosurface` returns.
      settings: settings of the stages.
      views: masks from which the mesh was made; without them no corners are fitted, and denoising
        is not limited.

    Raises:
      ReconstructionError: if the mesh is empty, open or inside out; if it is to be remeshed and
        scikit-image is not installed; or if masks and cameras do not match.
    """
    check_mesh(mesh)
    if max(settings.rounding, settings.spacing) > 0.0:
        import_skimage()
    first = keep_pieces(mesh, smallest=settings.smallest_piece)
    stages = [Stage("pieces", first, "")]
    for name, change in _changes(settings, first, views).items():
        most = settings.volume_change * (_HELD if name == "corners" else 1.0)
        stages.append(_stage(name, stages[-1].mesh, change, most))
    return tuple(stages)


def keep_pieces(mesh: Mesh, *, smallest: float) -> Mesh:
    """Keeps the largest piece by volume, and those above a share of the total volume.

    Cavities, which are pieces turned inwards, count with the volume that they enclose.
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
    """Rounds convex edges to a radius by moving the surface inwards and back outwards.

    Parts thinner than twice the radius vanish; flat and concave parts are unchanged. The grid cuts
    off the edges of the inner surface, so slightly more than the rounding is removed.

    Args:
      mesh: closed mesh.
      radius: radius of the rounded edges, world units.
      spacing: spacing of the signed distance grids; half the radius if `None`, but at least a 400th
        of the diameter.

    Raises:
      ReconstructionError: if no part is thick enough, or scikit-image is not installed.
    """
    finest = diameter(mesh.vertices) / _FINEST
    spacing = max(0.5 * radius, finest) if spacing is None else spacing
    return remesh(remesh(mesh, spacing, level=-radius), spacing, level=radius)


def remesh(mesh: Mesh, spacing: float, *, level: float = 0.0) -> Mesh:
    """Extracts the surface at a signed distance from a mesh, with the field's gradients as normals.

    Args:
      mesh: closed mesh.
      spacing: spacing of the grid, about the length of the new edges, world units.
      level: signed distance of the surface, negative inside.

    Raises:
      ReconstructionError: if no part is that deep, or scikit-image is not installed.
    """
    field = signed_distance(mesh)
    rim = _RIM * spacing + max(level, 0.0)
    box = Box(mesh.vertices.min(axis=0) - rim, mesh.vertices.max(axis=0) + rim)
    grid = sample(field, box, spacing=spacing, level=level, near=_NEAR)
    return find_isosurface(grid, level=level)


def _changes(
    settings: Refinement, first: Mesh, views: Views | None
) -> dict[str, Callable[[Mesh], Mesh]]:
    """Returns the changes of all stages after the first, by name and in order.

    Args:
      settings: settings of the stages.
      first: mesh after the first stage.
      views: masks from which the mesh was made, if any.
    """
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
        # Smoothing moves outlines, so corners are selected on the mesh before smoothing.
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
    """Returns the changed mesh, or the unchanged mesh and the reason for skipping the stage."""
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
    """Returns the changed mesh, or an empty one if the change fails."""
    try:
        return change()
    except ReconstructionError:
        return Mesh(mesh.vertices[:0], mesh.faces[:0], mesh.normals[:0])
