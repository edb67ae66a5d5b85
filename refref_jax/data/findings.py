"""What an examination of a scene's meshes has found."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

from refref_jax.data.errors import SceneError


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


def refuse_errors(findings: Sequence[Finding]) -> None:
    """Stops at meshes whose light paths would be wrong.

    Raises:
      SceneError: if there is an error among the findings; it tells all of them.
    """
    errors = [finding for finding in findings if finding.severity == "error"]
    if errors:
        told = "\n".join(f"  {finding.part}: {finding.message}" for finding in errors)
        raise SceneError(f"the meshes must be mended first.\n{told}")
