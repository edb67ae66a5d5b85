"""The second stage of R3F: the index of refraction, from images."""

from pathlib import Path
from typing import NamedTuple

from refref_jax.reconstruct.triangles import Mesh


class IndexEstimate(NamedTuple):
    """An estimate.

    Attributes:
      index: of refraction, relative to air.
      error: one standard deviation.
      loss: photometric loss.
    """

    index: float
    error: float
    loss: float


def run(scene: Path, mesh: Mesh, folder: Path, *, seed: int) -> IndexEstimate:
    """Estimates the index of a body.

    Args:
      scene: folder of the scene.
      mesh: the body.
      folder: for what it keeps.
      seed: of everything random.

    Raises:
      ValueError: always, until there is an estimation.
    """
    del scene, mesh, folder, seed
    raise ValueError("The index of refraction can not be estimated yet. Give it, as in --ior=1.5.")
