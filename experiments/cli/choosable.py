"""Names that options take, of things whose definition imports JAX.

Options are read, and wrong names refused, before that; a test holds these equal to the definitions.
"""

from typing import get_args

from refref_jax.choices import RuleName
from refref_jax.data.file_names import SPLITS

__all__ = ["FIELDS", "GEOMETRIES", "PRESETS", "RULES", "SPLITS"]

PRESETS = ("tiny", "small", "paper", "best")
"""Of `refref_jax.training.presets.PRESETS`."""

FIELDS = ("zipnerf", "nerfacto")
"""Of `fields.registry.KINDS`, the usual one first."""

RULES: tuple[RuleName, ...] = get_args(RuleName)
"""Of `optics.interface_rules.RULES`."""

GEOMETRIES = ("hull", "occupancy")
"""Of `experiments.r3f.geometry_stage.GEOMETRIES`."""
