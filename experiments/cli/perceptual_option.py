"""What commands measure with as eyes do: the option of LPIPS's weights, and what is installed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from absl import flags

from experiments.cli.late_imports import late

if TYPE_CHECKING:
    from refref_jax import metrics
    from refref_jax.training import evaluation as measures
else:
    measures = late("refref_jax.training.evaluation")
    metrics = late("refref_jax.metrics")

LPIPS_WEIGHTS = flags.DEFINE_string(
    "lpips_weights",
    None,
    "File of the weights of LPIPS, made by experiments.convert_lpips, see docs/metrics.md. LPIPS "
    "is not measured without it.",
)


def chosen() -> measures.Perceptual:
    """Returns what is at hand, and warns of what is not, once.

    Raises:
      ValueError: if the file is not one of weights.
    """
    path = _named()
    lpips = None if path is None else metrics.load_lpips(path)
    return measures.Perceptual(lpips, metrics.flip if _has_flip() else None)


def checked() -> Path | None:
    """Returns the file of LPIPS's weights, if one is given, and warns as `chosen` does.

    For a command that leaves measuring to others, and takes no device from them.

    Raises:
      ValueError: if the file is not one of weights.
    """
    path = _named()
    if path is not None:
        metrics.read_lpips(path)
    _has_flip()
    return path


def _named() -> Path | None:
    if LPIPS_WEIGHTS.value is not None:
        return Path(LPIPS_WEIGHTS.value)
    print(
        "warning: LPIPS is not measured, for it needs weights that are published elsewhere. "
        "docs/metrics.md tells how to get them, and --lpips_weights takes them."
    )
    return None


def _has_flip() -> bool:
    try:
        metrics.import_flip()
    except ValueError as error:
        print(f"warning: {error}")
        return False
    return True
