"""A model and a run small enough for tests, on images made from a formula."""

import functools

import jax
import numpy as np

from refref_jax.data.batches import PixelSampler
from refref_jax.fields import registry
from refref_jax.fields.hash_grid import HashGridConfig
from refref_jax.fields.zipnerf import DensityFieldConfig, RadianceFieldConfig
from refref_jax.geometry.cameras import orbit
from refref_jax.optics.path_settings import PAPER
from refref_jax.render.checkpoint_io import SavedModel
from refref_jax.render.model import ModelConfig, ProposalConfig, init_params
from refref_jax.training.config import (
    FieldConfig,
    LossConfig,
    PathsConfig,
    SceneConfig,
    ScheduleConfig,
    TrainConfig,
)

_GRID = HashGridConfig(levels=2, base_res=4, max_res=16, hashmap_size=1 << 10, features=2)

MODEL = ModelConfig(
    proposals=(ProposalConfig(DensityFieldConfig(_GRID, width=8), samples=8),),
    field=RadianceFieldConfig(_GRID, density_width=8, bottleneck=3, colour_width=8, colour_depth=1),
    samples=6,
    multisamples=1,
    interior="field",
    footprint="cone",
    learned_tints=0,
    near=0.05,
    far=15.0,
    radius=7.5,
    space="bounded",
    dilation=0.5,
)

SAVED = SavedModel(MODEL, PAPER)

CONFIG = TrainConfig(
    scene=SceneConfig("nowhere", "nested", ()),
    paths=PathsConfig("paper"),
    model=FieldConfig(far_field="field"),
    losses=LossConfig(
        data="mse", interlevel=0.01, blurs=(0.01,), distortion=0.01, hash_decay=0.1, tint_decay=1e-3
    ),
    schedule=ScheduleConfig(
        steps=12, warmup=2, peak=1e-2, end=1e-3, anneal=4, batch=32, pretraced_batches=4
    ),
    seed=0,
)

CAMERAS = orbit(4, distance=4.0, elevation=0.3, size=16, angle_x=1.1656)


@functools.cache
def initial(config):
    """Returns a model's parameters at the start of training, made once."""
    return jax.jit(lambda: init_params(jax.random.key(0), config))()


@functools.cache
def initial_field(config):
    """Returns the parameters of a field at the start of training, made once."""
    return jax.jit(lambda: registry.init_radiance(jax.random.key(0), config))()


def sampler(seed=0):
    """Returns pixels of four images whose colours change smoothly."""
    frame, row, column = np.indices((4, 16, 16))
    images = np.stack([row * 16, column * 16, 60 * frame], axis=-1).astype(np.uint8)
    return PixelSampler(images, CAMERAS, seed=seed, batch=CONFIG.schedule.batch)
