"""What makes a kind of field: configurations, and functions that take them.

A field is two functions, `init` and `radiance`; a proposal's are `init` and `density`. All of them
are plain functions over Gaussians in the unit cube. A kind is one module with a `FieldKind`, and
one line in `registry`; all else asks the registry.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from jaxtyping import Array, Float

from refref_jax.choices import Footprint, Precision
from refref_jax.fields.precision import check_precision
from refref_jax.sampling.cones import Gaussians

Params = Any
"""A pytree of arrays, as `init` makes it."""


@dataclasses.dataclass(frozen=True)
class FieldConfig:
    """Shape of a field of any kind.

    Each kind derives from the two classes below, and gives `kind` its name as the default and the
    only choice: by that name the registry, and the files of a run, know what a shape is of.

    Attributes:
      precision: of tables and matrix products.
      kind: name of the kind.
    """

    precision: Precision = dataclasses.field(default="float32", kw_only=True)
    kind: str = dataclasses.field(default="", kw_only=True)

    def __post_init__(self) -> None:
        """Checks the choice."""
        check_precision(self.precision)


@dataclasses.dataclass(frozen=True)
class RadianceConfig(FieldConfig):
    """Shape of a radiance field of any kind."""


@dataclasses.dataclass(frozen=True)
class DensityConfig(FieldConfig):
    """Shape of a density field, of a proposal, of any kind."""


class Radiance(NamedTuple):
    """The field at a point.

    Attributes:
      density: per scene radius, not negative.
      rgb: linear radiance towards the camera, in `[-0.001, 1.001]`.
    """

    density: Float[Array, ""]
    rgb: Float[Array, "3"]


class FieldSize(NamedTuple):
    """Fields of one size, and how often a path asks them.

    Attributes:
      field: the radiance field.
      proposals: the density field of each round of proposals, coarse to fine.
      samples: intervals of each of these rounds, then of the final one.
      multisamples: points that stand for an interval's cone.
      footprint: how wide a pixel is along its path.
      dilation: widening of a proposal before it is sampled, see `ModelConfig`.
    """

    field: RadianceConfig
    proposals: tuple[DensityConfig, ...]
    samples: tuple[int, ...]
    multisamples: int
    footprint: Footprint
    dilation: float


class FieldKind(NamedTuple):
    """A kind of field.

    Attributes:
      radiance_config: class of the radiance field's shape.
      init_radiance: makes its parameters, of a key and a shape.
      radiance: density and colour of one interval of a path, of parameters, shape, Gaussians in
        the unit cube (fractions of its edge), and the unit direction of travel, world frame.
      density_config: class of a proposal's shape.
      init_density: makes its parameters.
      density: density of one interval, of parameters, shape and Gaussians.
      sizes: by the names of presets.
      hash_decay: weight of the decay of hash grids in its loss.
    """

    radiance_config: type[RadianceConfig]
    init_radiance: Callable[[Array, Any], Params]
    radiance: Callable[[Params, Any, Gaussians, Float[Array, "3"]], Radiance]
    density_config: type[DensityConfig]
    init_density: Callable[[Array, Any], Params]
    density: Callable[[Params, Any, Gaussians], Float[Array, ""]]
    sizes: Mapping[str, FieldSize]
    hash_decay: float


def in_half_precision(size: FieldSize) -> FieldSize:
    """Returns the same fields with their arithmetic in bfloat16."""
    field, *proposals = (
        dataclasses.replace(each, precision="bfloat16") for each in (size.field, *size.proposals)
    )
    return size._replace(field=field, proposals=tuple(proposals))
