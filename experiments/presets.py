"""Presets: how large a model is and how long it is trained.

| preset  | for                    | samples      | points | hash levels x features, finest, size |
|---------|------------------------|--------------|--------|--------------------------------------|
| `tiny`  | two CPU cores, minutes | 32 + 20      | 1      | 6 x 4, 512, 2^17                     |
| `small` | a laptop, a small GPU  | 48 + 32      | 1      | 8 x 4, 2048, 2^19                    |
| `paper` | a GPU, as published    | 64 + 64 + 32 | 6      | 10 x 4, 8192, 2^21                   |
| `best`  | a large GPU            | 64 + 64 + 32 | 6      | 10 x 4, 8192, 2^21                   |

| preset  | network of colour | rays a step | steps  | footprint    |
|---------|-------------------|-------------|--------|--------------|
| `tiny`  | 1 x 32            | 1,024       | 2,500  | differential |
| `small` | 1 x 64            | 2,048       | 8,000  | differential |
| `paper` | 2 x 256           | 4,096       | 25,000 | cone         |
| `best`  | 2 x 256           | 16,384      | 25,000 | differential |

Points are those that stand for an interval's cone, `--multisamples`; the size is the entries of a
level. What depends on the scene is no preset's: give `paper` the options `--paths=paper
--interior=field` to have the published set-up in full, and leave both out for the others.

On the bundled ball 1250 steps of 1024 rays give `tiny` 36.6 dB in the mask and `small` 37.9, at 3.1
times the time of a step. `paper` and `best` take a GPU: a CPU's core needs 0.8 s for 256 of their
rays, 10 times as long as `tiny` (`BUILD_NOTES.md` has their first steps).

`small` lies between its neighbours in every number. `best` samples as the paper does and differs in
what a pixel sees and how often: footprints follow the bends, and a step has four times the rays, at
the learning rate at which Zip-NeRF takes 65,536. It traces fewer batches at once, so that a pool is
of as many rays, and takes as much memory, as one of `paper`.
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

    Raises:
      ValueError: if the radius is not positive and finite.
    """
    if radius is not None and not 0.0 < radius < math.inf:
        raise ValueError(f"--radius={radius} is no radius. Give a positive number, in world units.")
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
        footprint="differential",
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


def _small_model(bounds_: Bounds, interior: Interior) -> ModelConfig:
    proposal = DensityFieldConfig(
        HashGridConfig(levels=6, coarsest=16, finest=256, entries=1 << 17, features=2), width=32
    )
    field = RadianceFieldConfig(
        HashGridConfig(levels=8, coarsest=16, finest=2048, entries=1 << 19, features=4),
        density_width=64,
        bottleneck=31,
        colour_width=64,
        colour_depth=1,
    )
    return ModelConfig(
        proposals=(ProposalConfig(proposal, samples=48),),
        field=field,
        samples=32,
        multisamples=1,
        interior=interior,
        footprint="differential",
        learned_tints=0,
        dilation=0.0,
        **dataclasses.asdict(bounds_),
    )


def _best_model(bounds_: Bounds, interior: Interior) -> ModelConfig:
    paper = _paper_model(bounds_, interior)
    half = [
        dataclasses.replace(each, field=dataclasses.replace(each.field, precision="bfloat16"))
        for each in paper.proposals
    ]
    return dataclasses.replace(
        paper,
        proposals=tuple(half),
        field=dataclasses.replace(paper.field, precision="bfloat16"),
        footprint="differential",
    )


def _loss(*blurs: float) -> LossConfig:
    """Returns the loss that all presets share, with the blur of each proposal round."""
    return LossConfig(
        data="mse", interlevel=0.01, blurs=blurs, distortion=0.01, hash_decay=0.1, dye_decay=1e-3
    )


PRESETS = {
    "tiny": Preset(
        model=_tiny_model,
        loss=_loss(0.03),
        schedule=ScheduleConfig(steps=2500, warmup=100, peak=1e-2, end=1e-3, anneal=250),
        batch=1024,
        pool=32,
    ),
    "small": Preset(
        model=_small_model,
        loss=_loss(0.03),
        schedule=ScheduleConfig(steps=8000, warmup=300, peak=1e-2, end=1e-3, anneal=500),
        batch=2048,
        pool=32,
    ),
    "paper": Preset(
        model=_paper_model,
        loss=_loss(0.03, 0.003),
        schedule=ScheduleConfig(steps=25_000, warmup=1000, peak=8e-3, end=1e-3, anneal=1000),
        batch=4096,
        pool=32,
    ),
    "best": Preset(
        model=_best_model,
        loss=_loss(0.03, 0.003),
        schedule=ScheduleConfig(steps=25_000, warmup=1000, peak=1e-2, end=1e-3, anneal=1000),
        batch=16_384,
        pool=8,
    ),
}
