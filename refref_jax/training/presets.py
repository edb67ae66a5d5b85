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

These are sizes of Zip-NeRF's fields (`fields/zipnerf.py`). Those of another kind, by `field`, are
in its own module; `paper` are the published ones.

Points are those that stand for an interval's cone, `multisamples`; the size is the entries of a
level. What depends on the scene is no preset's: give `paper` the budget `paper` and the
interior `field` to have the published set-up in full, and leave both out for the others.

On the bundled ball 1250 steps of 1024 rays give `tiny` 36.6 dB in the mask and `small` 37.9, at 3.1
times the time of a step. `paper` and `best` take a GPU: a CPU's core needs 0.8 s for 256 of their
rays, 10 times as long as `tiny` (`benchmarks/results/presets_few_rays.csv`).

`small` lies between its neighbours in every number. `best` samples as the paper does and differs in
what a pixel sees and how often: footprints follow the bends, and a step has four times the rays, at
the learning rate at which Zip-NeRF takes 65,536. It traces fewer batches at once, so that a pool is
of as many rays, and takes as much memory, as one of `paper`.
"""

import dataclasses
import math

import numpy as np

from refref_jax.choices import Interior, Space
from refref_jax.fields import registry
from refref_jax.geometry.cameras import Cameras
from refref_jax.render.model import ModelConfig, ProposalConfig
from refref_jax.training.config import LossConfig, ScheduleConfig

_WALLS = 7.3
"""Half edge of a bounded scene's cube, or radius of a sphere, if nothing tells: the data set's.

Paths end there, on an opaque background. Of all the ways to choose an end this one alone knows
where the background is: a cube 3 % too large costs 2.7 dB, since its faces are taken for walls.
"""

_NEAR = 0.05
_FAR_UNBOUNDED = 1000.0

# Blur of the interlevel loss in each proposal round (Zip-NeRF, supplement).
_BLURS = (0.03, 0.003)


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
      size: of the fields, by its name in `fields.registry`.
      schedule: how parameters move, and on how many rays.
    """

    size: str
    schedule: ScheduleConfig

    def model(
        self, bounds_: Bounds, interior: Interior, *, field: str = registry.USUAL
    ) -> ModelConfig:
        """Returns a model of a scene, with fields of some kind.

        Raises:
          ValueError: if that kind has no such size.
        """
        sizes = registry.KINDS[field].sizes
        if self.size not in sizes:
            raise ValueError(
                f"Fields of kind {field} have no size {self.size}. Use a preset of "
                f"{', '.join(sizes)}."
            )
        size = sizes[self.size]
        *counts, samples = size.samples
        return ModelConfig(
            proposals=tuple(map(ProposalConfig, size.proposals, counts)),
            field=size.field,
            samples=samples,
            multisamples=size.multisamples,
            interior=interior,
            footprint=size.footprint,
            learned_tints=0,
            dilation=size.dilation,
            **dataclasses.asdict(bounds_),
        )


def bounds(cameras: Cameras, *, space: Space, radius: float | None) -> Bounds:
    """Returns the bounds of a scene.

    A bounded scene reaches from any camera to the farthest corner of its cube, a spherical one to
    the far side of its sphere. An unbounded one keeps the cameras, and all between them,
    uncontracted.

    Args:
      cameras: of the training images.
      space: `unbounded` if the background is infinitely far, `spherical` if it is a sphere.
      radius: overrides the default of `ModelConfig.radius`.

    Raises:
      ValueError: if the radius is not positive and finite.
    """
    if radius is not None and not 0.0 < radius < math.inf:
        raise ValueError(
            f"radius is {radius}, but it is a length. Give a positive number of world units."
        )
    farthest = float(np.max(np.linalg.norm(cameras.poses[:, :, 3], axis=-1)))
    if space == "unbounded":
        return Bounds(_NEAR, _FAR_UNBOUNDED, radius or 1.25 * farthest, space)
    radius = radius or _WALLS
    reach = radius if space == "spherical" else math.sqrt(3.0) * radius
    return Bounds(_NEAR, farthest + reach, radius, space)


def loss(model: ModelConfig) -> LossConfig:
    """Returns what is minimised when a model is trained, the same for all presets.

    What does not depend on the model is as `LossConfig` has it by default. The interlevel loss and
    its blurs are Zip-NeRF's for every kind of field.
    """
    finest = len(_BLURS) - 1
    return LossConfig(
        blurs=tuple(_BLURS[min(i, finest)] for i in range(len(model.proposals))),
        hash_decay=registry.KINDS[model.field.kind].hash_decay,
    )


PRESETS = {
    "tiny": Preset(
        size="tiny",
        schedule=ScheduleConfig(
            steps=2500, warmup=100, peak=1e-2, end=1e-3, anneal=250, batch=1024, pool=32
        ),
    ),
    "small": Preset(
        size="small",
        schedule=ScheduleConfig(
            steps=8000, warmup=300, peak=1e-2, end=1e-3, anneal=500, batch=2048, pool=32
        ),
    ),
    "paper": Preset(
        size="paper",
        schedule=ScheduleConfig(
            steps=25_000, warmup=1000, peak=8e-3, end=1e-3, anneal=1000, batch=4096, pool=32
        ),
    ),
    "best": Preset(
        size="best",
        schedule=ScheduleConfig(
            steps=25_000, warmup=1000, peak=1e-2, end=1e-3, anneal=1000, batch=16_384, pool=8
        ),
    ),
}
