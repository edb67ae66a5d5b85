"""Static description of a training run."""

import dataclasses
from typing import Literal

from refref_jax.optics.part_choices import RuleName

DistortionOver = Literal["outside", "everywhere"]
"""Samples that the distortion loss counts: those outside the objects, or all."""


@dataclasses.dataclass(frozen=True)
class SceneConfig:
    """What is trained on.

    Attributes:
      path: the scene folder.
      rule: what lies outside each mesh part, see `optics.interface_rules`.
      indices: indices of refraction that replace the table's, by material or part.
    """

    path: str
    rule: RuleName
    indices: tuple[tuple[str, float], ...]


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """What is minimised: the data loss plus the weighted others.

    Attributes:
      data: loss on sRGB colours.
      interlevel: weight of the anti-aliased interlevel loss.
      blurs: half-width of its blur for each proposal round, in normalised distance.
      distortion: weight of the distortion loss.
      hash_decay: weight of the decay of the hash grids.
      dye_decay: weight of the optical density of learned colours.
      distortion_over: which samples the distortion loss is summed over: those `outside` the
        objects (the paper's correction), or `everywhere` (Mip-NeRF 360, the paper's ablation).
    """

    data: Literal["mse", "charbonnier"]
    interlevel: float
    blurs: tuple[float, ...]
    distortion: float
    hash_decay: float
    dye_decay: float
    distortion_over: DistortionOver = "outside"


@dataclasses.dataclass(frozen=True)
class ScheduleConfig:
    """How the parameters move.

    Attributes:
      steps: steps until the learning rate has reached its end.
      warmup: steps of linear warm-up.
      peak: learning rate after the warm-up.
      end: learning rate at the end; the decay between is exponential.
      anneal: steps until the proposals are fully trusted.
    """

    steps: int
    warmup: int
    peak: float
    end: float
    anneal: int

    def over(self, steps: int) -> "ScheduleConfig":
        """Returns the same schedule stretched over another number of steps."""
        scale = steps / self.steps
        warmup, anneal = round(self.warmup * scale), round(self.anneal * scale)
        return dataclasses.replace(self, steps=steps, warmup=warmup, anneal=anneal)


@dataclasses.dataclass(frozen=True)
class TrainingConfig:
    """A training run, together with the model's own configuration.

    Attributes:
      scene: what is trained on.
      paths: name of the budget of light paths, see `optics.budgets`.
      loss: what is minimised.
      schedule: how.
      batch: rays a step.
      pool: batches whose light paths are traced at once.
      seed: of the initial parameters, the order of pixels and the sampling.
      pixels: which of them are learned from: `all`, or those of the `background` alone, a margin
        away from the masks.
    """

    scene: SceneConfig
    paths: str
    loss: LossConfig
    schedule: ScheduleConfig
    batch: int
    pool: int
    seed: int
    pixels: Literal["all", "background"] = "all"
