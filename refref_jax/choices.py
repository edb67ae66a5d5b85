"""The choices of scenes and configurations, each defined once (standard library only)."""

import math
from typing import Literal

Colour = tuple[float, float, float]
"""Linear RGB."""

CLEAR: Colour = (1.0, 1.0, 1.0)
"""The tint of an interface that takes no light."""

NO_ABSORPTION: Colour = (0.0, 0.0, 0.0)
"""The absorption of a medium that takes no light."""

TwoSidedRule = Literal["nested", "facing"]
"""Rules under which a part knows the media on both of its sides."""

RuleName = Literal[TwoSidedRule, "priority"]
"""All rules for what lies outside a part; `optics.interface_rules` says what they mean."""

KnownTints = Literal["given", "learned"]
"""Where colours come from, of parts that have some."""

Tints = Literal["none", KnownTints]
"""Where colours come from; `none` if no part has any."""

Space = Literal["bounded", "spherical", "unbounded"]
"""Where the background stands: on a cube, on a sphere, or infinitely far away."""

Split = Literal["train", "val", "test"]
"""Views of a scene."""

Pixels = Literal["all", "background"]
"""Pixels that are learned from."""

Paths = Literal["straight", "paper", "tree", "paper_no_reflection", "paper_no_tir"]
"""Names of budgets of light paths; see `optics.budgets.BUDGETS`."""

PresetName = Literal["tiny", "small", "paper", "best"]
"""Sizes of a model and its training; see `training.presets`."""

FieldName = Literal["zipnerf", "nerfacto"]
"""Kinds of field, the usual one first; see `fields.registry`."""

Interior = Literal["field", "clear", "absorbing"]
"""What is modelled inside the objects; see `render.config.ModelConfig`."""

Footprint = Literal["cone", "differential"]
"""How wide a pixel is along its path; see `render.config.ModelConfig`."""

Precision = Literal["float32", "bfloat16"]
"""Arithmetic of the fields."""

DataLoss = Literal["mse", "charbonnier"]
"""Loss on sRGB colours."""

DistortionOver = Literal["outside", "everywhere"]
"""Samples that the distortion loss counts: those outside the objects, or all."""


def side_of(rays_per_pixel: int) -> int:
    """Returns the number of rays along each edge of a pixel.

    Args:
      rays_per_pixel: number of rays in the pixel.

    Raises:
      ValueError: if they do not make a square grid.
    """
    side = math.isqrt(max(rays_per_pixel, 0))
    if side >= 1 and side**2 == rays_per_pixel:
        return side
    nearest = " or ".join(str(s**2) for s in (side, side + 1) if s)
    raise ValueError(f"{rays_per_pixel} rays a pixel do not make a square grid. Give {nearest}.")
