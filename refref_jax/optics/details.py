"""Selects which segments of traced paths are stored, to save memory."""

import dataclasses
from typing import Literal

from refref_jax.choices import Footprint


@dataclasses.dataclass(frozen=True)
class Detail:
    """Contents of stored light paths.

    Attributes:
      segments: `all` segments, or only those `outside` the objects and the last one.
      most: maximum number of segments per path; `all` needs max bends + 1. Of a longer path, the
        first segment and the last ones are kept.
      footprint: `differential` carries derivatives across the pixel (see `footprints`).
      tally: `parts` stores each path's hit counts and path lengths per part.
    """

    segments: Literal["all", "outside"]
    most: int
    footprint: Footprint = "cone"
    tally: Literal["none", "parts"] = "none"

    def __post_init__(self) -> None:
        """Validates the number of segments."""
        if self.most < 1:
            raise ValueError(f"most is {self.most}; a path has at least one segment. Give >= 1.")


def everything(bends: int) -> Detail:
    """Returns the settings that store complete paths."""
    return Detail("all", bends + 1)
