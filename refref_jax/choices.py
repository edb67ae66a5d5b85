"""The choices of the configuration, each defined once. Imports nothing, least of all JAX."""

from typing import Literal

Split = Literal["train", "val", "test"]

Rule = Literal["nested", "facing", "priority"]
"""What lies outside each mesh; see `optics.interface_rules`."""

Space = Literal["bounded", "spherical", "unbounded"]
"""Where the background stands: on a cube, on a sphere, or infinitely far away."""

Pixels = Literal["all", "background"]

Paths = Literal["straight", "paper", "tree", "paper_no_reflection", "paper_no_tir"]
"""Names of budgets of light paths; see `optics.budgets.BUDGETS`."""

Reentry = Literal["possible", "impossible"]

PresetName = Literal["tiny", "small", "paper", "best"]

FieldName = Literal["zipnerf", "nerfacto"]
"""Kinds of field, the usual one first; see `fields.registry`."""

Interior = Literal["field", "clear", "absorbing"]

Tints = Literal["none", "given", "learned"]
"""Colours of interfaces and media: there are none, those of scene.json, or learned."""

Footprint = Literal["cone", "differential"]

Precision = Literal["float32", "bfloat16"]

DataLoss = Literal["mse", "charbonnier"]

DistortionOver = Literal["outside", "everywhere"]
