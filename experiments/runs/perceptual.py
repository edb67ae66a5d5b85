"""Selects the perceptual metrics: LPIPS, whose weights are set by a flag, and FLIP."""

from pathlib import Path

from refref_jax import metrics
from refref_jax.training import evaluation


def chosen(weights: str | None) -> evaluation.Perceptual:
    """Returns the available metrics, and warns once of those that are missing.

    Args:
      weights: value of `--lpips_weights`.

    Raises:
      ValueError: if the file does not contain the weights.
    """
    path = _named(weights)
    lpips = None if path is None else metrics.load_lpips(path)
    return evaluation.Perceptual(lpips, metrics.flip if _has_flip() else None)


def checked(weights: str | None) -> Path | None:
    """Checks the file of LPIPS's weights and returns it; warns like `chosen`.

    For commands that leave measuring to other processes and must not occupy a device.

    Args:
      weights: value of `--lpips_weights`.

    Raises:
      ValueError: if the file does not contain the weights.
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
        "warning: LPIPS is not measured, because its weights are published separately. See "
        "docs/metrics.md, and pass them with --lpips_weights."
    )
    return None


def _has_flip() -> bool:
    try:
        metrics.import_flip()
    except ValueError as error:
        print(f"warning: {error}")
        return False
    return True
