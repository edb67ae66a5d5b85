"""Options that replace parts of a preset's model: where its speed can be traded for accuracy.

What is wrong whatever the preset is refused by functions that need no JAX, as soon as it is read.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from etils import epy

if TYPE_CHECKING:
    from refref_jax.fields.hash_grid import HashGridConfig
    from refref_jax.fields.kinds import RadianceConfig
    from refref_jax.fields.precision import Precision
    from refref_jax.render.config import Footprint, ModelConfig

with epy.lazy_imports():
    from refref_jax.fields import networks

# Points of the cone patterns, see `sampling.cones`.
_PATTERNS = (1, 6)

# More entries than a 32-bit hash tells apart serve nothing.
_MOST_ENTRIES = 31


class ModelOptions(NamedTuple):
    """What is asked of a model; `None` leaves the preset's value.

    Attributes:
      samples: intervals of each proposal round, coarse to fine, then of the final round.
      multisamples: points that stand for an interval's cone.
      entries: base-2 logarithm of the most entries of a level of the radiance field's hash grid.
      finest: cells a side of that grid's last level.
      precision: of the arithmetic of all fields.
      footprint: see `ModelConfig`.
    """

    samples: tuple[int, ...] | None = None
    multisamples: int | None = None
    entries: int | None = None
    finest: int | None = None
    precision: Precision | None = None
    footprint: Footprint | None = None


def parse_samples(words: Sequence[str]) -> tuple[int, ...]:
    """Returns the numbers of samples that an option lists.

    Raises:
      ValueError: if one is not a positive whole number.
    """
    if not words or not all(word.strip().isdecimal() and int(word) > 0 for word in words):
        raise ValueError(
            f"--samples={','.join(words)} is not a list of positive numbers. Write as in "
            "--samples=32,20."
        )
    return tuple(int(word) for word in words)


def check_multisamples(points: int | None) -> None:
    """Refuses a number of points that no pattern has.

    Raises:
      ValueError: if there is no such pattern.
    """
    if points is not None and points not in _PATTERNS:
        raise ValueError(
            f"--multisamples={points} is no pattern of points. Give 1 (on the centre line) or 6 "
            "(Zip-NeRF's hexagon)."
        )


def check_entries(entries: int | None) -> None:
    """Refuses a size that no table of a hash grid has.

    Raises:
      ValueError: if it is none.
    """
    if entries is not None and not 1 <= entries <= _MOST_ENTRIES:
        raise ValueError(
            f"--entries={entries} is the base-2 logarithm of a table's size. Give 1 to "
            f"{_MOST_ENTRIES}, such as 17 for 131,072 entries."
        )


def override(model: ModelConfig, options: ModelOptions, *, preset: str) -> ModelConfig:
    """Returns a preset's model with what is asked of it.

    Args:
      model: the preset's.
      options: what to replace.
      preset: its name, for messages.

    Raises:
      ValueError: if the model can not have that.
    """
    if options.samples is not None:
        model = _with_samples(model, options.samples, preset)
    check_multisamples(options.multisamples)
    if options.multisamples is not None:
        model = dataclasses.replace(model, multisamples=options.multisamples)
    if options.footprint is not None:
        model = dataclasses.replace(model, footprint=options.footprint)
    if options.precision is not None:
        model = _with_precision(model, options.precision)
    return dataclasses.replace(model, field=_with_grid(model.field, options))


def samples_of(model: ModelConfig) -> tuple[int, ...]:
    """Returns the samples of every round, the final one last."""
    return (*(proposal.samples for proposal in model.proposals), model.samples)


def _with_samples(model: ModelConfig, samples: tuple[int, ...], preset: str) -> ModelConfig:
    rounds = len(model.proposals)
    if len(samples) != rounds + 1:
        raise ValueError(
            f"--samples={','.join(map(str, samples))} has {_counted(len(samples) - 1)}, preset "
            f"{preset} has {rounds}. Give {rounds + 1} numbers: one for each proposal round, then "
            "the final round's."
        )
    proposals = tuple(
        dataclasses.replace(proposal, samples=count)
        for proposal, count in zip(model.proposals, samples[:-1], strict=True)
    )
    return dataclasses.replace(model, proposals=proposals, samples=samples[-1])


def _with_precision(model: ModelConfig, precision: Precision) -> ModelConfig:
    proposals = tuple(
        dataclasses.replace(
            proposal, field=dataclasses.replace(proposal.field, precision=precision)
        )
        for proposal in model.proposals
    )
    field = dataclasses.replace(model.field, precision=precision)
    return dataclasses.replace(model, proposals=proposals, field=field)


def grid_of(model: ModelConfig) -> HashGridConfig | None:
    """Returns the hash grid of a model's radiance field, if fields of its kind have one."""
    return model.field.grid if isinstance(model.field, networks.GridRadianceConfig) else None


def _with_grid(field: RadianceConfig, options: ModelOptions) -> RadianceConfig:
    if options.entries is None and options.finest is None:
        return field
    if not isinstance(field, networks.GridRadianceConfig):
        raise ValueError(
            f"--entries and --finest are of a hash grid, which fields of kind {field.kind} have "
            "not. Leave them out."
        )
    grid = field.grid
    check_entries(options.entries)
    if options.entries is not None:
        grid = dataclasses.replace(grid, entries=1 << options.entries)
    if options.finest is not None:
        if options.finest < grid.coarsest:
            raise ValueError(
                f"--finest={options.finest} is coarser than the grid's first level of "
                f"{grid.coarsest} cells a side. Give at least that."
            )
        grid = dataclasses.replace(grid, finest=options.finest)
    return dataclasses.replace(field, grid=grid)


def _counted(rounds: int) -> str:
    return f"{rounds} proposal round" + ("" if rounds == 1 else "s")
