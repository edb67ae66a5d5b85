"""Metrics of rendered images and distances against ground truth.

All metrics are computed per image; tables contain their means over images. `docs/metrics.md` lists
the metrics and their undefined values.
"""

from refref_jax.metrics.colours import SMALLEST_FOR_SSIM as SMALLEST_FOR_SSIM
from refref_jax.metrics.colours import psnr as psnr
from refref_jax.metrics.colours import psnr_masked as psnr_masked
from refref_jax.metrics.colours import ssim as ssim
from refref_jax.metrics.distances import mean_absolute_error as mean_absolute_error
from refref_jax.metrics.distances import root_mean_square_error as root_mean_square_error
from refref_jax.metrics.flip_error import flip as flip
from refref_jax.metrics.flip_error import import_flip as import_flip
from refref_jax.metrics.lpips_network import SMALLEST_FOR_LPIPS as SMALLEST_FOR_LPIPS
from refref_jax.metrics.lpips_network import LpipsParams as LpipsParams
from refref_jax.metrics.lpips_network import lpips as lpips
from refref_jax.metrics.lpips_weights import load_lpips as load_lpips
from refref_jax.metrics.lpips_weights import read_lpips as read_lpips
