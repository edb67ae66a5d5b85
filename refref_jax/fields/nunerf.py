"""NU-NeRF field kind (first stage): a surface whose colour has reflected and refracted light.

Signed value, opacity, the field around and the losses are those of NeuS (`fields.neus`). Only the
colour of a point `x` with normal `n` differs, seen along the direction of travel `d`:

    c = (1 - T) ((1 - S) D + S L(x, r)) + T (F L(x, r) + (1 - F) R(x, d))

with the mirrored direction `r = d - 2 (d.n) n` and Schlick's reflectance

    F = F0 + (1 - F0) (1 - max(0, -d.n))^5

of glass, `F0 = 0.04`. `S` is the same with an `F0` from 0.04 to 1, by a learned metallicity. The
transmission `T`, the diffuse colour `D` and the metallicity are those of the material at the point.
`L` is the light that is mirrored. `R` is what is seen through the surface, memorised by a network
of point and direction: no path is followed behind the surface, so that what is there does not
decide where the surface is. All terms are averages, so that colours stay in `[0, 1]`.

What is published otherwise: a rough surface, whose reflected light is blurred and looked up in a
table, with a diffuse light of its own; light without an upper bound, from an environment at
infinity that is in part hidden by the object and equal to the field around it (two losses); a
material by three hidden layers; a sharpness that is constant for the first 15,000 of 200,000 steps,
a surface that is held near a ball for 1000, and Charbonnier's distance of colours.
`docs/decisions/050-r3f-without-masks.md` has the reasons. Of the sizes, `paper` has the published
networks of light.

Source: Sun et al., NU-NeRF (2024), first stage, and its code in `jjjkkyz/NU-NeRF` at commit
1083625 (colour); Schlick, An Inexpensive BRDF Model (1994), Eq 15.
"""

import dataclasses
import functools
from typing import Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax import numerics
from refref_jax.fields import neus
from refref_jax.fields.base import FieldSize, dense, shape_of
from refref_jax.fields.hash_grid import GridDensityConfig, spherical_harmonics
from refref_jax.fields.neus import SurfaceConfig, Visible
from refref_jax.optics.fresnel import reflect

GLASS = 0.04
"""Reflectance of glass at normal incidence."""


@dataclasses.dataclass(frozen=True)
class NunerfConfig(SurfaceConfig):
    """Shape of a field with a surface, by NU-NeRF; see also `SurfaceConfig`.

    Attributes:
      octaves: number of octaves of encoded points and directions.
      light_width: width of the hidden layers of the networks of light.
      light_depth: number of these layers.
    """

    octaves: int = dataclasses.field(kw_only=True)
    light_width: int = dataclasses.field(kw_only=True)
    light_depth: int = dataclasses.field(kw_only=True)
    kind: Literal["nunerf"] = dataclasses.field(default="nunerf", kw_only=True)

    def __post_init__(self) -> None:
        """Validates the numbers."""
        super().__post_init__()
        if min(self.octaves, self.light_width, self.light_depth) < 1:
            raise ValueError(
                f"Networks of light with octaves={self.octaves}, light_width={self.light_width} "
                f"and light_depth={self.light_depth} are invalid. Give at least 1 of each."
            )


@dataclasses.dataclass(frozen=True)
class NunerfProposalConfig(GridDensityConfig):
    """Shape of a density field, which is that of Zip-NeRF; see `GridDensityConfig`."""

    kind: Literal["nunerf"] = dataclasses.field(default="nunerf", kw_only=True)


class Material(NamedTuple):
    """What a point of the surface is made of.

    Attributes:
      diffuse: diffuse colour, linear, 0 to 1.
      metallic: metallicity, 0 to 1: how far the reflectance at normal incidence of what is not
        transmitted is between 0.04 and 1.
      transmission: share of the light that is that of clear glass, 0 to 1.
    """

    diffuse: Float[Array, "3"]
    metallic: Float[Array, ""]
    transmission: Float[Array, ""]


def combine(
    material: Material,
    mirrored: Float[Array, "3"],
    refracted: Float[Array, "3"],
    cosine: Float[Array, ""],
) -> Float[Array, "3"]:
    """Returns the colour of a point of the surface, linear, in the range of the given colours.

    Args:
      material: material of the surface.
      mirrored: light from the mirrored direction, linear.
      refracted: light from behind the surface, linear.
      cosine: cosine of the angle between the outward normal and the direction to the camera.

    Source: NU-NeRF, code (`AppShadingNetwork`).
    """
    clear = schlick(cosine, GLASS)
    shine = schlick(cosine, GLASS + (1.0 - GLASS) * material.metallic)
    opaque = (1.0 - shine) * material.diffuse + shine * mirrored
    through = clear * mirrored + (1.0 - clear) * refracted
    return (1.0 - material.transmission) * opaque + material.transmission * through


def schlick(cosine: Float[Array, ""], head_on: Float[Array, ""] | float) -> Float[Array, ""]:
    """Returns Schlick's reflectance; 1 at and beyond grazing incidence.

    The gradient is finite everywhere, and 0 beyond grazing incidence.

    Args:
      cosine: cosine of the angle of incidence.
      head_on: reflectance at normal incidence.
    """
    fall = 1.0 - jnp.clip(cosine, 0.0, 1.0)
    return head_on + (1.0 - head_on) * fall**5


def encode(vector: Float[Array, "3"], octaves: int) -> Float[Array, " features"]:
    """Returns a vector, and sine and cosine of its multiples by powers of 2.

    Source: Mildenhall et al., NeRF (2020), Eq 4, without the factor pi, as in NU-NeRF's code.
    """
    angles = jnp.exp2(jnp.arange(octaves, dtype=vector.dtype))[:, None] * vector[None]
    return jnp.concatenate([vector, jnp.sin(angles).ravel(), jnp.cos(angles).ravel()])


def split(point: Visible, config: NunerfConfig) -> Float[Array, "3"]:
    """Returns the colour of a point, in a module; see `neus.Colour`."""
    material = _material(point, config)
    place = encode(point.position, config.octaves)
    mirrored = reflect(point.direction, point.normal)
    light = _light(jnp.concatenate([place, spherical_harmonics(mirrored)]), config)
    behind = _light(jnp.concatenate([place, encode(point.direction, config.octaves)]), config)
    return combine(material, light, behind, -numerics.dot(point.normal, point.direction))


def _material(point: Visible, config: NunerfConfig) -> Material:
    layer = dense(config.precision)
    inputs = jnp.concatenate([point.features, point.position, point.normal])
    hidden = nn.relu(layer(config.colour_width)(inputs))
    values = jax.nn.sigmoid(layer(5)(hidden))
    return Material(values[:3], values[3], values[4])


def _light(inputs: Float[Array, " inputs"], config: NunerfConfig) -> Float[Array, "3"]:
    layer, hidden = dense(config.precision), inputs
    for _ in range(config.light_depth):
        hidden = nn.relu(layer(config.light_width)(hidden))
    return jax.nn.sigmoid(layer(3)(hidden))


def _size(size: FieldSize, *, width: int, depth: int) -> FieldSize:
    """Returns the same fields with a colour that is split."""
    field = NunerfConfig(**shape_of(size.field), octaves=6, light_width=width, light_depth=depth)
    proposals = tuple(NunerfProposalConfig(**shape_of(each)) for each in size.proposals)
    return size._replace(field=field, proposals=proposals)


_LIGHT = {"tiny": (64, 2), "small": (64, 3), "paper": (256, 3), "best": (256, 3)}

KIND = neus.KIND._replace(
    radiance_config=NunerfConfig,
    init_radiance=functools.partial(neus.init_radiance, colour=split),
    radiance=functools.partial(neus.radiance, colour=split),
    density_config=NunerfProposalConfig,
    sizes={
        name: _size(neus.KIND.sizes[name], width=width, depth=depth)
        for name, (width, depth) in _LIGHT.items()
    },
)
