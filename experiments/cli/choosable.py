"""Names that options take, of things whose definition imports JAX.

Options are read, and wrong names refused, before that; a test holds these equal to the definitions.
"""

SPLITS = ("train", "val", "test")
"""`data.local_layout.SPLITS`."""

PRESETS = ("tiny", "small", "paper", "best")
"""Of `refref_jax.training.presets.PRESETS`."""

FIELDS = ("zipnerf", "nerfacto")
"""Of `fields.registry.KINDS`, the usual one first."""

RULES = ("nested", "facing", "priority")
"""Of `optics.interface_rules.RULES`."""

GEOMETRIES = ("hull", "occupancy")
"""Of `experiments.r3f.geometry_stage.GEOMETRIES`."""
