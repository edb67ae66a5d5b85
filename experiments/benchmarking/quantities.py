"""What tables show of a result, and in which way it is better.

Distances are told in three kinds, see docs/metrics.md. Those that are substituted, as the first
release of the paper's code had them, are exact inside the mask, by definition, for methods that
know objects: they do not rank. A distance's error is taken inside the mask before a natural
background, which is infinitely far, and over the image elsewhere, as the paper's DMAE is.

The paper does not say over which pixels its DRMSE is. Hardly over the image: the Oracle's is 0.00,
its DMAE there is 0.04 (cubes) and 0.15 (spheres), and no RMSE is below the MAE of the same pixels.
So the one over the mask is beside the paper's, and the one over the image is ours alone.
"""

from collections.abc import Mapping
from typing import Literal, NamedTuple

Better = Literal["higher", "lower"]


class Quantity(NamedTuple):
    """A column.

    Attributes:
      label: of tables.
      latex: the same in LaTeX.
      key: of the metrics, and of the published rows.
      better: `higher` or `lower`; `None` if it says nothing of how good a method is.
      digits: after the point.
      by_mask: whether it is taken inside the mask before a natural background.
      published: its name in published.csv, if the paper has it.
    """

    label: str
    latex: str
    key: str
    better: Better | None
    digits: int
    by_mask: bool = False
    published: str | None = None


PSNR = Quantity("PSNR", "PSNR", "psnr", "higher", 2, published="psnr")
PSNR_MASKED = Quantity(
    "masked PSNR", r"PSNR\textsubscript{M}", "psnr_masked", "higher", 2, published="psnr_masked"
)
SSIM = Quantity("SSIM", "SSIM", "ssim", "higher", 3, published="ssim")
LPIPS = Quantity("LPIPS", "LPIPS", "lpips", "lower", 3, published="lpips")
FLIP = Quantity("FLIP", "FLIP", "flip", "lower", 3)
DMAE = Quantity("DMAE, substituted", "DMAE, substituted", "substituted_mae", None, 3, True, "dmae")
DMAE_SURFACE = Quantity(
    "DMAE, first surface", "DMAE, first surface", "surface_mae", "lower", 3, by_mask=True
)
DMAE_MEDIAN = Quantity("DMAE, median", "DMAE, median", "distance_mae", "lower", 3, by_mask=True)
DRMSE_MASKED = Quantity(
    "DRMSE, substituted, in the mask",
    "DRMSE, substituted, in the mask",
    "substituted_rmse_masked",
    None,
    3,
    published="drmse",
)
DRMSE = Quantity(
    "DRMSE, substituted, of the image",
    "DRMSE, substituted, of the image",
    "substituted_rmse",
    None,
    3,
    by_mask=True,
)
DRMSE_SURFACE = Quantity(
    "DRMSE, first surface", "DRMSE, first surface", "surface_rmse", "lower", 3, by_mask=True
)
DRMSE_MEDIAN = Quantity("DRMSE, median", "DRMSE, median", "distance_rmse", "lower", 3, by_mask=True)

_OF_IMAGES = (PSNR, PSNR_MASKED, SSIM, LPIPS, FLIP)
MAIN = (*_OF_IMAGES, DMAE, DMAE_SURFACE, DMAE_MEDIAN)
TOP_VIEWS = (*_OF_IMAGES, DRMSE_MASKED, DRMSE, DRMSE_SURFACE, DRMSE_MEDIAN)
ABLATIONS = (PSNR, PSNR_MASKED, SSIM, LPIPS, DMAE)


def value(quantity: Quantity, metrics: Mapping[str, float | None], background: str) -> float | None:
    """Returns a quantity of a result's metrics; `None` if it is not known."""
    masked = quantity.by_mask and background == "env"
    return metrics.get(f"{quantity.key}_masked" if masked else quantity.key)
