"""What commands measure with as eyes do: the option of LPIPS's weights, and what is installed."""

from pathlib import Path

from absl import flags

from experiments.measures import Perceptual
from refref_jax import metrics

LPIPS_WEIGHTS = flags.DEFINE_string(
    "lpips_weights",
    None,
    "File of the weights of LPIPS, made by experiments.convert_lpips, see docs/metrics.md. LPIPS "
    "is not measured without it.",
)


def chosen() -> Perceptual:
    """Returns what is at hand, and warns of what is not, once.

    Raises:
      ValueError: if the file is not one of weights.
    """
    lpips, flip = None, metrics.flip
    if LPIPS_WEIGHTS.value is None:
        print(
            "warning: LPIPS is not measured, for it needs weights that are published elsewhere. "
            "docs/metrics.md tells how to get them, and --lpips_weights takes them."
        )
    else:
        lpips = metrics.load_lpips(Path(LPIPS_WEIGHTS.value))
    try:
        metrics.import_flip()
    except ValueError as error:
        print(f"warning: {error}")
        flip = None
    return Perceptual(lpips, flip)
