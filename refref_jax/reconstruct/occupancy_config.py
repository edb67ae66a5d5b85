"""Static description of an occupancy field's training."""

import dataclasses

from refref_jax.reconstruct.occupancy_field import OccupancyFieldConfig


@dataclasses.dataclass(frozen=True)
class OccupancyTrainingConfig:
    """An occupancy field and how it is trained.

    Attributes:
      field: the field's shape.
      steps: number of them.
      batch: rays a step.
      scan: samples along a ray that find the place which decides, without gradient.
      samples: samples there, which are rendered.
      softness: `b` at the first and the last step, in pixels; geometric between.
      rate: Adam's learning rate at the first and the last step; geometric between.
      distance: weight `lambda_e` of the field's slope.
      smoothness: weight `lambda_s` of the normals' differences.
      solidity: weight `lambda_v` of the push outwards; without it flat faces keep dents, and with
        three times as much outlines give way.
      reach: standard deviation of the steps between compared normals, in cells of the finest grid.
      surface: rays of a batch which the terms other than the first look at.
      band: pixels from an outline up to which a ray counts as near it.
    """

    field: OccupancyFieldConfig = dataclasses.field(default_factory=OccupancyFieldConfig)
    steps: int = 1200
    batch: int = 2048
    scan: int = 32
    samples: int = 4
    softness: tuple[float, float] = (2.0, 0.02)
    rate: tuple[float, float] = (1e-2, 5e-4)
    distance: float = 0.1
    smoothness: float = 0.02
    solidity: float = 0.001
    reach: float = 1.0
    surface: int = 256
    band: float = 3.0

    def __post_init__(self) -> None:
        """Checks what the steps rely on."""
        if min(self.steps, self.samples) < 1 or self.scan < 2:
            raise ValueError(
                f"A training takes at least 1 step and 1 sample, and scans with 2; got {self}. "
                "Correct the configuration."
            )
        if not 1 <= self.surface <= self.batch or min(*self.softness, *self.rate) <= 0.0:
            raise ValueError(
                "A training needs softness and rate above 0, and looks at 1 to all rays of its "
                f"batch for the surface; got {self}. Correct the configuration."
            )
