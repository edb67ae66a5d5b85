"""Shape and index of refraction of one clear object, from photographs of light refracted by it.

`find_index` looks for the index of an object of known shape. `SingleObject` has the unknowns of a
shape and the index; `fit_best` fits shapes of several families and chooses the smallest one that
explains held-out pixels not significantly worse than the best.

Source: ours; the paper (arXiv 2505.05848) smooths by hand, and trains the index with the field.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
import scipy.sparse
from jaxtyping import Float

from refref_jax.geometry.triangle_meshes import Mesh
from refref_jax.optics.interface_rules import NO_PARENT, nested
from refref_jax.reconstruct import ReconstructionError, gauss_newton, photometry
from refref_jax.reconstruct.gauss_newton import Candidate, Fit, Matrix, Rows, StepFacts, Steps
from refref_jax.reconstruct.photometry import Backdrop, Photographs
from refref_jax.reconstruct.shapes import Posed, Shape, mesh_of

# Standard deviation of the prior of an index that was found for the mesh from masks, and largest
# change in one step.
_INDEX_DEVIATION, _INDEX_STEP = 0.02, 0.02

# The same of the logarithm of a tint.
_TINT_DEVIATION, _TINT_STEP = 1.0, 0.3


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
        padded = Posed(
            *posed[:4], *(_widened(each, self._extra) for each in (posed[4], posed[5]))
        )
        by_index, by_tint = np.zeros((1, len(x))), np.zeros((3, len(x)))
        by_index[0, -self._extra] = 1.0
        tint = np.ones(3)
        if self.tinted:
            by_tint[:, -3:] = np.eye(3)
            tint = np.exp(x[-3:])
        interfaces = nested([self.index_of(x)], [NO_PARENT], tints=tint[None])
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
