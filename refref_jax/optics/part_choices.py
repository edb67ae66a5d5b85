"""What may be said of a part: its colours, and what lies outside it (standard library only).

`interface_rules` says what the rules mean.
"""

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
"""All rules for what lies outside a part."""

KnownTints = Literal["given", "learned"]
"""Where colours come from, of parts that have some."""

Tints = Literal["none", KnownTints]
"""Where colours come from; `none` if no part has any."""
