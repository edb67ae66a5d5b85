"""Finds out whether a training has a field or a backdrop: from options, a table, or the scene."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from experiments.runs import config_flags
from experiments.sweeps import table
from experiments.sweeps.options import OF_EVALUATION
from refref_jax.choices import FarField
from refref_jax.optics.media import Scene
from refref_jax.render.model import has_foreground
from refref_jax.training import fit
from refref_jax.training.config import BACKDROP_ONLY, FIELD_ONLY, TrainConfig
from refref_jax.training.resolve import Resolved


def of_options(names: Sequence[str]) -> FarField | None:
    """Returns the far field that reads the first of some options that only one of both reads."""
    given = [name for name in names if name in (*FIELD_ONLY, *BACKDROP_ONLY)]
    if not given:
        return None
    return "backdrop" if given[0] in BACKDROP_ONLY else "field"


def of_table(out: Path) -> FarField | None:
    """Returns the far field of the base of a sweep's folder, or `None` if there is no table yet."""
    path = out / "trade_off.csv"
    if not path.exists():
        return None
    return "backdrop" if table.base_of(table.read(path)).has_backdrop else "field"


def prepare(scene: Path, options: Mapping[str, str]) -> tuple[Resolved, Scene]:
    """Resolves a training of a scene, which decides between a field and a backdrop.

    A scene that needs a field in front of its backdrop gets a field for everything.

    Args:
      scene: folder of the scene.
      options: further options of the training, as text; those of evaluation are ignored.

    Raises:
      ValueError: if such a scene is to have a backdrop.
    """
    values = {
        name: config_flags.parse_text(name, text)
        for name, text in options.items()
        if name not in OF_EVALUATION
    }
    config = TrainConfig().override(scene=str(scene), **values)
    resolved, objects = fit.prepare(config, report=lambda line: None)
    if not has_foreground(resolved.model.config):
        return resolved, objects
    if config.model.far_field == "backdrop":
        raise ValueError(
            f"{scene} needs a field in front of its backdrop, whose options no sweep varies. Use "
            "--far_field=field."
        )
    return fit.prepare(config.override(far_field="field"), report=lambda line: None)


def describe(resolved: Resolved) -> str:
    """Returns the far field of a training, and the reason, as a line of text."""
    why = resolved.reasons["far_field"]
    return f"Far field: {resolved.config.model.far_field} ({why}); --far_field overrides it."
