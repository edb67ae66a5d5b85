"""How much is kept of the light paths that are traced: what nobody asks for is not stored."""

import dataclasses
from typing import Literal

from refref_jax.choices import Footprint


@dataclasses.dataclass(frozen=True)
class Detail:
    """What a record of light paths holds.

    Attributes:
      segments: `all`, or those `outside` the objects and the last one.
      most: most segments of a path; `all` needs one more than there are bends. Of a path that has
        more the first is kept, and the last ones.
      footprint: whether derivatives across the pixel are carried (see `footprints`).
      tally: `parts` counts how often a path met each part and how far it went in it.
    """

    segments: Literal["all", "outside"]
    most: int
    footprint: Footprint = "cone"
    tally: Literal["none", "parts"] = "none"

    def __post_init__(self) -> None:
        """Checks the room for segments."""
        if self.most < 1:
            raise ValueError(f"A path has at least one segment, not {self.most}. Give 1 or more.")


def everything(bends: int) -> Detail:
    """Returns the detail of a path that is kept in full."""
    return Detail("all", bends + 1)
