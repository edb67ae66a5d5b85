"""Zip-NeRF field type, with its preset sizes.

Source: paper (arXiv 2505.05848), supplement (implementation details), and Zip-NeRF (2023) for the
size `paper`; the other sizes are ours.
"""

from refref_jax.fields import density_field, radiance_field
from refref_jax.fields.density_field import DensityFieldConfig
from refref_jax.fields.hash_grid import HashGridConfig
from refref_jax.fields.kinds import FieldKind, FieldSize, in_half_precision
from refref_jax.fields.radiance_field import RadianceFieldConfig


def _proposal(
    *, levels: int, finest: int, entries: int, features: int, width: int
) -> DensityFieldConfig:
    grid = HashGridConfig(levels, coarsest=16, finest=finest, entries=entries, features=features)
    return DensityFieldConfig(grid, width=width)


_TINY = FieldSize(
    field=RadianceFieldConfig(
        HashGridConfig(levels=6, coarsest=16, finest=512, entries=1 << 17, features=4),
        density_width=32,
        bottleneck=15,
        colour_width=32,
        colour_depth=1,
    ),
    proposals=(_proposal(levels=4, finest=64, entries=1 << 15, features=2, width=16),),
    samples=(32, 20),
    multisamples=1,
    footprint="differential",
    dilation=0.0,
)

_SMALL = FieldSize(
    field=RadianceFieldConfig(
        HashGridConfig(levels=8, coarsest=16, finest=2048, entries=1 << 19, features=4),
        density_width=64,
        bottleneck=31,
        colour_width=64,
        colour_depth=1,
    ),
    proposals=(_proposal(levels=6, finest=256, entries=1 << 17, features=2, width=32),),
    samples=(48, 32),
    multisamples=1,
    footprint="differential",
    dilation=0.0,
)

_PAPER = FieldSize(
    field=RadianceFieldConfig(
        HashGridConfig(levels=10, coarsest=16, finest=8192, entries=1 << 21, features=4),
        density_width=64,
        bottleneck=255,
        colour_width=256,
        colour_depth=2,
    ),
    proposals=(
        _proposal(levels=6, finest=512, entries=1 << 21, features=1, width=64),
        _proposal(levels=8, finest=2048, entries=1 << 21, features=1, width=64),
    ),
    samples=(64, 64, 32),
    multisamples=6,
    footprint="cone",
    dilation=0.5,
)

_BEST = in_half_precision(_PAPER)._replace(footprint="differential")

KIND = FieldKind(
    radiance_config=RadianceFieldConfig,
    init_radiance=radiance_field.init,
    radiance=radiance_field.radiance,
    density_config=DensityFieldConfig,
    init_density=density_field.init,
    density=density_field.density,
    sizes={"tiny": _TINY, "small": _SMALL, "paper": _PAPER, "best": _BEST},
    hash_decay=0.1,
)
