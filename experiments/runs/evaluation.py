"""Selects the views of a comparison and warns of dropped throughput, for several commands."""

import numpy as np

# Number of views that a comparison shows.
_SHOWN = 4

# Dropped share of the throughput that may be visible in 8 bits.
_WORTH_A_WARNING = 1e-3


def shown_views(count: int) -> list[int]:
    """Returns the numbers of the views that a comparison shows, evenly spread.

    Args:
      count: number of views in the split.
    """
    return np.unique(np.linspace(0, count - 1, _SHOWN).astype(int)).tolist()


def warn_of_dropped(dropped: float, *, advice: str) -> None:
    """Prints a warning if path buffers overflowed and dropped a visible share of the throughput.

    Args:
      dropped: dropped share of the throughput.
      advice: sentence that suggests a fix.
    """
    if dropped > _WORTH_A_WARNING:
        print(
            f"warning: path buffer overflow: {100 * dropped:.1f} % of the throughput was dropped, "
            f"images are too dark. {advice}"
        )
