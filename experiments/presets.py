"""Presets: how large a model is and how long it is trained.

`tiny` learns a small scene on two CPU cores in minutes. `paper` is the published set-up, for a
GPU: 64, 64 and 32 samples, six multisamples, 25,000 steps of 4,096 rays.
"""

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from refref_jax.data.cameras import Cameras
from refref_jax.fields.density_field import DensityFieldConfig
from refref_jax.fields.hash_grid import HashGridConfig
from refref_jax.fields.radiance_field import RadianceFieldConfig
from refref_jax.render.config import Interior, ModelConfig, ProposalConfig
from refref_jax.sampling.domains import Space
from refref_jax.training.config import LossConfig, ScheduleConfig

_WALLS = 7.3
"""Half edge of a bounded scene's cube, world units, if nothing tells: the data set's walls.

Paths end there, on an opaque background. Of all the ways to choose an end this one alone knows
where the background is: a cube 3 % too large costs 2.7 dB, since its faces are taken for walls.
"""

_NEAR = 0.05
_FAR_UNBOUNDED = 1000.0


@dataclasses.dataclass(frozen=True)
class Bounds:
    """The space that a scene takes up; see `ModelConfig`."""

    near: float
    far: float
    radius: float
    space: Space


@dataclasses.dataclass(frozen=True)
class Preset:
    """One point of the trade between speed and accuracy.

    Attributes:
      model: makes the model's configuration.
      loss: what is minimised.
      schedule: how.
      batch: rays a step.
      pool: batches traced at once.
    """

    model: Callable[[Bounds, Interior], ModelConfig]
    loss: LossConfig
    schedule: ScheduleConfig
    batch: int
    pool: int


def bounds(cameras: Cameras, *, space: Space, radius: float | None) -> Bounds:
    """Returns the bounds of a scene.

    A bounded scene reaches from any camera to the farthest corner of its cube. An unbounded one
    keeps the cameras, and all between them, uncontracted.

    Args:
      cameras: of the training images.
      space: `unbounded` if the background is infinitely far.
      radius: overrides the default of `ModelConfig.radius`.
    """
    farthest = float(np.max(np.linalg.norm(cameras.poses[:, :, 3], axis=-1)))
    if space == "unbounded":
        return Bounds(_NEAR, _FAR_UNBOUNDED, radius or 1.25 * farthest, space)
    radius = radius or _WALLS
    return Bounds(_NEAR, farthest + math.sqrt(3.0) * radius, radius, space)


def _tiny_model(bounds_: Bounds, interior: Interior) -> ModelConfig:
    proposal = DensityFieldConfig(
        HashGridConfig(levels=4, coarsest=16, finest=64, entries=1 << 15, features=2), width=16
    )
    field = RadianceFieldConfig(
        HashGridConfig(levels=6, coarsest=16, finest=512, entries=1 << 17, features=4),
        density_width=32,
        bottleneck=15,
        colour_width=32,
        colour_depth=1,
    )
    return ModelConfig(
        proposals=(ProposalConfig(proposal, samples=32),),
        field=field,
        samples=20,
        multisamples=1,
        interior=interior,
        footprint="cone",
        learned_tints=0,
        dilation=0.0,
        **dataclasses.asdict(bounds_),
    )


def _paper_model(bounds_: Bounds, interior: Interior) -> ModelConfig:
    def proposal(levels: int, finest: int) -> ProposalConfig:
        grid = HashGridConfig(levels, coarsest=16, finest=finest, entries=1 << 21, features=1)
        return ProposalConfig(DensityFieldConfig(grid, width=64), samples=64)

    field = RadianceFieldConfig(
        HashGridConfig(levels=10, coarsest=16, finest=8192, entries=1 << 21, features=4),
        density_width=64,
        bottleneck=255,
        colour_width=256,
        colour_depth=2,
    )
    return ModelConfig(
        proposals=(proposal(6, 512), proposal(8, 2048)),
        field=field,
        samples=32,
        multisamples=6,
        interior=interior,
        footprint="cone",
        learned_tints=0,
        dilation=0.5,
        **dataclasses.asdict(bounds_),
    )


PRESETS = {
    "tiny": Preset(
        model=_tiny_model,
        loss=LossConfig(
            data="mse", interlevel=0.01, blurs=(0.03,), distortion=0.01, hash_decay=0.1
        ),
        schedule=ScheduleConfig(steps=2500, warmup=100, peak=1e-2, end=1e-3, anneal=250),
        batch=1024,
        pool=32,
    ),
    "paper": Preset(
        model=_paper_model,
        loss=LossConfig(
            data="mse", interlevel=0.01, blurs=(0.03, 0.003), distortion=0.01, hash_decay=0.1
        ),
        schedule=ScheduleConfig(steps=25_000, warmup=1000, peak=8e-3, end=1e-3, anneal=1000),
        batch=4096,
        pool=32,
    ),
}
