"""Metrics that measure as eyes do: LPIPS, with weights that a flag names, and FLIP."""

from pathlib import Path

from refref_jax import metrics
from refref_jax.training import evaluation


def chosen(weights: str | None) -> evaluation.Perceptual:
    """Returns the metrics at hand, and warns of what is not, once.

    Args:
      weights: value of `--lpips_weights`.

    Raises:
      ValueError: if the file is not one of weights.
    """
    path = _named(weights)
    lpips = None if path is None else metrics.load_lpips(path)
    return evaluation.Perceptual(lpips, metrics.flip if _has_flip() else None)


def checked(weights: str | None) -> Path | None:
    """Returns the file of LPIPS's weights, if one is given, and warns as `chosen` does.

    For a command that leaves measuring to others, and takes no device from them.

    Args:
      weights: value of `--lpips_weights`.

    Raises:
      ValueError: if the file is not one of weights.
    """
    path = _named(weights)
    if path is not None:
        metrics.read_lpips(path)
    _has_flip()
    return path


def _named(weights: str | None) -> Path | None:
    if weights is not None:
        return Path(weights)
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
