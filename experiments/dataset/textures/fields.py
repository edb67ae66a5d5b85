"""Random fields on the unit square.

A field has `[n, n]` samples of the unit square: row 0 at the top, `x` to the right and `y` down,
both from 0 to 1, sample `i` at `(i + 0.5) / n`. Noise is periodic: cubic B-splines through normal
random numbers on a lattice of `frequency` nodes a side, with mean 0 and variance 1. A field depends
on its seed and not on `n`: more samples only add detail.
"""

import math

import numpy as np
import scipy.ndimage
import scipy.sparse
from jaxtyping import Float, Int

Field = Float[np.ndarray, "h w"]
Picture = Float[np.ndarray, "h w 3"]

# Mean square of a cubic B-spline's four weights.
_SPLINE_VARIANCE = 151.0 / 315.0


def coordinates(n: int) -> tuple[Field, Field]:
    """Returns `x` and `y` of all samples."""
    ticks = ((np.arange(n) + 0.5) / n).astype(np.float32)
    return tuple(np.ascontiguousarray(each) for each in np.meshgrid(ticks, ticks))


def noise(n: int, frequency: int | tuple[int, int], seed: int) -> Field:
    """Returns one octave of noise.

    Args:
      n: number of samples a side.
      frequency: nodes of the lattice a side, or along x and along y.
      seed: seed of the nodes.
    """
    along_x, along_y = (frequency, frequency) if isinstance(frequency, int) else frequency
    nodes = np.random.default_rng(seed).standard_normal((along_y, along_x), np.float32)
    rows = _splines(n, along_y) @ nodes
    return (_splines(n, along_x) @ rows.T).T / np.float32(_SPLINE_VARIANCE)


def fbm(
    n: int,
    frequency: int | tuple[int, int],
    seed: int,
    *,
    octaves: int = 6,
    gain: float = 0.5,
) -> Field:
    """Returns octaves of noise, each of twice the frequency and `gain` times as strong.

    Octaves above the sampling limit are omitted. All octaves together have variance 1.
    """
    total = np.zeros((n, n), np.float32)
    for octave, lattice, weight in _octaves(n, frequency, octaves, gain):
        total += np.float32(weight) * noise(n, lattice, seed + octave)
    return total


def lookup(field: Float[np.ndarray, "h w *channels"], u: Field, v: Field) -> np.ndarray:
    """Returns a periodic field at `x = u`, `y = v`, bilinearly interpolated; `u` has any shape."""
    height, width = field.shape[:2]
    at = np.stack([v * height - 0.5, u * width - 0.5])
    options = {"order": 1, "mode": "grid-wrap", "prefilter": False}
    if field.ndim == 2:
        return scipy.ndimage.map_coordinates(field, at, **options)
    channels = [
        scipy.ndimage.map_coordinates(field[..., each], at, **options)
        for each in range(field.shape[2])
    ]
    return np.stack(channels, -1)


def reflected(position: np.ndarray) -> np.ndarray:
    """Returns positions from 0 to 1, reflected at both ends: for images that do not repeat."""
    return 1.0 - np.abs(position % 2.0 - 1.0)


def smooth(low: float, high: float, values: np.ndarray) -> np.ndarray:
    """Returns a smooth step from 0 at `low` to 1 at `high`; `low` may be the larger."""
    t = np.clip((values - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def blend(low: np.ndarray, high: np.ndarray, share: np.ndarray | float) -> np.ndarray:
    """Returns colours blended from `low` at share 0 to `high` at share 1."""
    return low + np.asarray(share, np.float32)[..., None] * (high - low)


def random_of(index: Int[np.ndarray, "*shape"], seed: int) -> Float[np.ndarray, "*shape"]:
    """Returns a random number from 0 to 1 for each index; equal indices give equal numbers."""
    table = np.random.default_rng(seed).random(4093, np.float32)
    return table[index % table.size]


def _octaves(
    n: int, frequency: int | tuple[int, int], octaves: int, gain: float
) -> list[tuple[int, tuple[int, int], float]]:
    """Returns number, lattice and weight of the octaves below the sampling limit of `n` samples."""
    along_x, along_y = (frequency, frequency) if isinstance(frequency, int) else frequency
    return [
        (octave, (along_x << octave, along_y << octave), gain**octave / _norm(octaves, gain))
        for octave in range(octaves)
        if max(along_x, along_y) << octave <= n // 2
    ]


def _norm(octaves: int, gain: float) -> float:
    return math.sqrt(sum(gain ** (2 * octave) for octave in range(octaves)))


def _splines(n: int, nodes: int) -> scipy.sparse.csr_matrix:
    """Returns the weights of periodic nodes in each of `n` samples."""
    at = (np.arange(n) + 0.5) / n * nodes
    first = np.floor(at)
    t = at - first
    weights = np.stack(
        [(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3], -1
    )
    columns = (first[:, None] + np.arange(-1, 3)).astype(int) % nodes
    rows = np.repeat(np.arange(n), 4)
    entries = ((weights / 6.0).ravel().astype(np.float32), (rows, columns.ravel()))
    return scipy.sparse.csr_matrix(entries, shape=(n, nodes))
