"""Where the body of a trained run comes from, if not from its scene's meshes: `{run}/body.json`."""

import dataclasses
from pathlib import Path

from refref_jax import configuration

_FILE = "body.json"


@dataclasses.dataclass(frozen=True)
class Provenance:
    """Of a body.

    Attributes:
      reconstruction: the folder that it was reconstructed into.
      index: its index of refraction, as it was trained with.
    """

    reconstruction: str
    index: float


def write(run: Path, provenance: Provenance | None) -> None:
    """Notes it in a run's folder, which is made; or that the body is the scene's own."""
    if provenance is None:
        (run / _FILE).unlink(missing_ok=True)
        return
    run.mkdir(parents=True, exist_ok=True)
    configuration.write(run / _FILE, provenance)


def read(run: Path) -> Provenance | None:
    """Returns it, or `None` where the scene's own meshes bend light."""
    return configuration.read(run / _FILE, Provenance) if (run / _FILE).is_file() else None
