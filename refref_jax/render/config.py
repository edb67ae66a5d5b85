"""Static description of a model: what is sampled, how often, and by which fields."""

import dataclasses
import math
from typing import get_args

from refref_jax.choices import Footprint, Interior, Space
from refref_jax.fields.kinds import DensityConfig, RadianceConfig
from refref_jax.optics.budgets import Budget
from refref_jax.optics.details import Detail

# Before a convex body, and after it.
_CONVEX_LEGS = 2

# Between bodies that light leaves and enters again there are more, but few: with four places,
# 0.04 % of the light of a torus has one left out, which is then taken to be empty.
_MOST_LEGS = 4


@dataclasses.dataclass(frozen=True)
class ProposalConfig:
    """One round of proposal sampling.

    Attributes:
      field: its density field, of any kind.
      samples: intervals along a path.
    """

    field: DensityConfig
    samples: int


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """A model of a scene.

    Attributes:
      proposals: rounds of proposal sampling, coarse to fine; at least one.
      field: the radiance field, of any kind.
      samples: intervals of the final round.
      multisamples: points that stand for an interval's cone, 1 or 6.
      interior: `field` also samples inside the objects (the paper); `clear` takes nothing to be
        there, which holds for clear glass and costs no samples; `absorbing` too takes no samples
        there, but light is dimmed on its way by the colours of media and interfaces.
      footprint: `cone` widens a pixel's footprint with arc length as if the path were straight
        (the paper); `differential` follows it through every bend by its derivatives.
      learned_tints: number of parts whose tint and absorption are learned, all of them or 0.
      near: distance of the first sample from the camera, world units; 0 begins at the camera.
      far: distance of the last from the last bend, or from the camera on a straight path; the
        background is opaque there. In a bounded or spherical scene a path ends already where it
        leaves that, and `far` only serves paths that do not meet it.
      radius: half edge of a bounded scene's cube, or radius of a spherical scene or of an
        unbounded scene's uncontracted ball, world units, around the origin. Walls should stand on
        the faces of the cube: between walls and faces the field has to guess.
      space: `bounded` by the cube, `spherical`: by the ball, or `unbounded`: beyond the ball it
        is contracted.
      dilation: widening of a proposal before it is sampled, as a share of its mean bin width; 0
        for none.
    """

    proposals: tuple[ProposalConfig, ...]
    field: RadianceConfig
    samples: int
    multisamples: int
    interior: Interior
    footprint: Footprint
    learned_tints: int
    near: float
    far: float
    radius: float
    space: Space
    dilation: float

    def __post_init__(self) -> None:
        """Checks what sampling relies on."""
        if not self.proposals:
            raise ValueError("A model needs at least one proposal round. Add one.")
        if not 0.0 <= self.near < self.far:
            raise ValueError(
                f"The distances must satisfy 0 <= near < far; got near = {self.near} and far = "
                f"{self.far}. Correct them."
            )
        if not 0.0 < self.radius < math.inf:
            raise ValueError(
                f"The radius must be positive and finite, not {self.radius}. Correct it."
            )
        if self.learned_tints < 0:
            raise ValueError(
                f"{self.learned_tints} parts can not have learned tints. Give their number, or 0."
            )
        _check_choice("space", self.space, get_args(Space))
        _check_choice("interior", self.interior, get_args(Interior))
        _check_choice("footprint", self.footprint, get_args(Footprint))


def path_detail(config: ModelConfig, budget: Budget) -> Detail:
    """Returns what a model needs to know of its light paths."""
    tally = "parts" if config.learned_tints else "none"
    most = budget.bends + 1
    if config.interior == "field":
        return Detail("all", most, config.footprint, tally)
    legs = _CONVEX_LEGS if budget.reentry == "impossible" else _MOST_LEGS
    return Detail("outside", min(legs, most), config.footprint, tally)


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"The {name} is one of {', '.join(choices)}, not {value!r}. Choose one.")
