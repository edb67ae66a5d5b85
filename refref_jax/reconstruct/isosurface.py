"""The surface of a grid as triangles (NumPy only), by marching cubes of scikit-image."""

from typing import Any

import numpy as np

from refref_jax.geometry.corner_normals import CREASE_ANGLE, corner_normals
from refref_jax.geometry.triangle_meshes import Faces, Mesh, Vertices
from refref_jax.reconstruct.errors import ReconstructionError
from refref_jax.reconstruct.grids import Grid, Points, gradient, interpolate

# Values this close to zero, in cells, are pushed away from it, so that no two vertices of marching
# cubes meet in a corner of the grid and no face is degenerate.
CLEARANCE = 0.1

# Steps back to the zero set, the longest one in cells, and the flattest slope that gives one.
_NEWTON_STEPS = 3
_LONGEST = 0.3
_FLATTEST = 0.1


def find_isosurface(grid: Grid, *, level: float = 0.0) -> Mesh:
    """Returns the level set of a grid: closed, outward, normals from the grid's gradient.

    The grid ends outside: where the body reaches its border it is closed there. Where the gradient
    strays from a smooth patch (at an edge, which differences run across) the normals are those of
    the faces, averaged within the crease angle.

    Args:
      grid: negative inside.
      level: the value on the surface.

    Raises:
      ReconstructionError: if no value is below the level, or scikit-image is not installed.
    """
    values = np.pad(grid.values - level, 1, constant_values=grid.spacing)
    if not np.any(values < 0.0):
        raise ReconstructionError(
            f"No value of the grid is below {level:g}, so it holds no surface. Check that the "
            "field is negative inside, or sample it more finely."
        )
    padded = Grid(values, grid.low - grid.spacing, grid.spacing)
    vertices, faces = march(values, grid.spacing)
    vertices = _settle(padded, padded.low + vertices)
    slopes = gradient(padded, vertices)
    return Mesh(vertices, faces, _normals(slopes, vertices, faces))


def march(values: np.ndarray, spacing: float) -> tuple[Vertices, Faces]:
    """Returns the triangles between negative and positive values, without degenerate ones.

    Vertices are as far as `CLEARANCE` of a cell from where the values cross zero.

    Args:
      values: at grid points, with a positive border.
      spacing: between them.

    Raises:
      ReconstructionError: if scikit-image is not installed.
    """
    clearance = CLEARANCE * spacing
    cleared = np.copysign(np.maximum(np.abs(values), clearance), values)
    vertices, faces, _, _ = import_skimage().marching_cubes(
        cleared, 0.0, gradient_direction="descent"
    )
    return spacing * vertices.astype(np.float64), faces.astype(np.int64)


def _settle(grid: Grid, vertices: Points) -> Points:
    """Returns vertices moved along the gradient to where the grid is zero."""
    for _ in range(_NEWTON_STEPS):
        value, slope = interpolate(grid, vertices), gradient(grid, vertices)
        squared = np.sum(slope**2, axis=-1)
        # At a kink the differences may cancel; such a vertex stays.
        step = -np.where(squared > _FLATTEST, value, 0.0)[:, None] * slope
        step /= np.maximum(squared, _FLATTEST)[:, None]
        length = np.linalg.norm(step, axis=-1, keepdims=True)
        longest = _LONGEST * grid.spacing
        vertices = vertices + step * (longest / np.maximum(length, longest))
    return vertices


def _normals(slopes: Points, vertices: Vertices, faces: Faces) -> np.ndarray:
    """Returns unit gradients at corners, except where they stray from the faces around."""
    averaged = corner_normals(vertices, faces)
    length = np.linalg.norm(slopes, axis=-1, keepdims=True)
    unit = np.divide(slopes, length, out=np.zeros_like(slopes), where=length > 0.0)[faces]
    agrees = np.sum(unit * averaged, axis=-1, keepdims=True) > np.cos(0.5 * CREASE_ANGLE)
    return np.where(agrees, unit, averaged)


def import_skimage() -> Any:
    """Returns scikit-image's `measure`, so that its lack can be told before a grid is made.

    Raises:
      ReconstructionError: if scikit-image is not installed.
    """
    try:
        import skimage.measure
    except ImportError as error:
        raise ReconstructionError(
            "Surfaces are found by scikit-image, which is not installed. Install it: "
            "pip install -e '.[r3f]'."
        ) from error
    return skimage.measure
