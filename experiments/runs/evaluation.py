"""Shared by commands that render and measure views: which are compared, and lost light."""

import numpy as np

# Views that a comparison shows.
_SHOWN = 4

# A share of light that 8 bits may show.
_WORTH_A_WARNING = 1e-3


def shown_views(count: int) -> list[int]:
    """Returns which of so many views a comparison shows: some, evenly spread.

    Args:
      count: number of views.
    """
    return np.unique(np.linspace(0, count - 1, _SHOWN).astype(int)).tolist()


def warn_of_lost_light(lost: float, *, advice: str) -> None:
    """Prints a warning if so much light was lost for want of room that it may be seen.

    Args:
      lost: share of the light.
      advice: sentence that says what to do.
    """
    if lost > _WORTH_A_WARNING:
        print(f"warning: some light found no room, and is missing from the pictures. {advice}")
