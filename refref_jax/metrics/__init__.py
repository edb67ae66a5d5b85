"""Metrics of rendered images and distances against ground truth.

All metrics are computed per image; tables contain their means over images. `docs/metrics.md` lists
the metrics and their undefined values.
"""

from refref_jax.metrics.images import SMALLEST_FOR_LPIPS as SMALLEST_FOR_LPIPS
from refref_jax.metrics.images import SMALLEST_FOR_SSIM as SMALLEST_FOR_SSIM
from refref_jax.metrics.images import LpipsParams as LpipsParams
from refref_jax.metrics.images import flip as flip
from refref_jax.metrics.images import import_flip as import_flip
from refref_jax.metrics.images import load_lpips as load_lpips
from refref_jax.metrics.images import lpips as lpips
from refref_jax.metrics.images import mean_absolute_error as mean_absolute_error
from refref_jax.metrics.images import psnr as psnr
from refref_jax.metrics.images import psnr_masked as psnr_masked
from refref_jax.metrics.images import read_lpips as read_lpips
from refref_jax.metrics.images import root_mean_square_error as root_mean_square_error
from refref_jax.metrics.images import ssim as ssim
