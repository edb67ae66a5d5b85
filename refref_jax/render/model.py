"""A model of a scene: learned fields, and the scene that bends light paths."""

from typing import NamedTuple

import jax
from jaxtyping import Array

from refref_jax.fields import kinds, registry
from refref_jax.optics.budgets import Budget
from refref_jax.optics.scene import Scene
from refref_jax.render import dyes
from refref_jax.render.config import ModelConfig
from refref_jax.render.dyes import Dyes


class Params(NamedTuple):
    """The learned part of a model.

    Attributes:
      proposals: parameters of each proposal level's density field.
      field: parameters of the radiance field.
      dyes: learned tints and absorption of the parts, if any.
    """

    proposals: tuple[kinds.Params, ...]
    field: kinds.Params
    dyes: Dyes | None = None


class Model(NamedTuple):
    """A complete model, ready to be rendered.

    Attributes:
      config: static configuration of fields and sampling.
      budget: path settings.
      geometry: the scene.
      params: learned parameters.
    """

    config: ModelConfig
    budget: Budget
    geometry: Scene
    params: Params


def init_params(key: Array, config: ModelConfig) -> Params:
    """Returns initial parameters of all fields of a model."""
    field_key, *keys = jax.random.split(key, 1 + len(config.proposals))
    proposals = tuple(
        registry.init_density(proposal_key, proposal.field)
        for proposal_key, proposal in zip(keys, config.proposals, strict=True)
    )
    colours = dyes.init(config.learned_tints) if config.learned_tints else None
    return Params(proposals, registry.init_radiance(field_key, config.field), colours)
