"""What an examination of a scene's meshes has found."""

from typing import Literal, NamedTuple


class Finding(NamedTuple):
    """Something about a mesh that a user should know.

    Attributes:
      severity: an `error` makes light paths wrong; a `warning` may; a `note` does not.
      part: name of the part.
      message: what it is, and what to do.
    """

    severity: Literal["error", "warning", "note"]
    part: str
    message: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.part}: {self.message}"
