"""Registry of field kinds.

Callers query fields through these functions, which dispatch on `config.kind`. To add a field kind,
write a module with a `FieldKind` and add it to `KINDS`.
"""

from collections.abc import Mapping

from jaxtyping import Array, Float

from refref_jax.fields import msnerf, nerfacto, neus, nunerf, raydef, rosenerf, tnsr, zipnerf
from refref_jax.fields.base import (
    Blend,
    DensityConfig,
    FieldConfig,
    FieldKind,
    Offset,
    Params,
    RadianceConfig,
    Seen,
    Surface,
)
from refref_jax.sampling.polylines import Gaussians

KINDS: dict[str, FieldKind] = {
    "zipnerf": zipnerf.KIND,
    "nerfacto": nerfacto.KIND,
    "msnerf": msnerf.KIND,
    "neus": neus.KIND,
    "unisurf": neus.UNISURF,
    "nunerf": nunerf.KIND,
    "tnsr": tnsr.KIND,
    "raydef": raydef.KIND,
    "raydef_polyline": raydef.POLYLINE,
    "rosenerf": rosenerf.KIND,
}

USUAL = "zipnerf"
"""Field kind if none is named, as in the files of older runs."""


def init_radiance(key: Array, config: RadianceConfig) -> Params:
    """Returns initial parameters of a radiance field."""
    return KINDS[config.kind].init_radiance(key, config)


def radiance(
    params: Params, config: RadianceConfig, gaussians: Gaussians, direction: Float[Array, "3"]
) -> Seen:
    """Returns what a field has in one interval of a path; see `FieldKind`."""
    return KINDS[config.kind].radiance(params, config, gaussians, direction)


def blend(
    params: Params, config: RadianceConfig, features: Float[Array, "sub_spaces channels"]
) -> Blend:
    """Returns colours and shares of the sub-spaces along a path; see `FieldKind`."""
    blended = KINDS[config.kind].blend
    assert blended is not None, config.kind
    return blended(params, config, features)


def depth(
    params: Params,
    config: RadianceConfig,
    seen: Surface,
    direction: Float[Array, "3"],
    length: Float[Array, ""],
    progress: Float[Array, ""],
) -> Float[Array, ""]:
    """Returns the optical depth of one interval of a path; see `FieldKind`."""
    law = KINDS[config.kind].depth
    assert law is not None, config.kind
    return law(params, config, seen, direction, length, progress)


def deform(
    params: Params,
    config: RadianceConfig,
    position: Float[Array, "3"],
    direction: Float[Array, "3"],
    progress: Float[Array, ""],
) -> Offset:
    """Returns the offset of a point of a straight ray, and of its direction; see `FieldKind`."""
    law = KINDS[config.kind].deform
    assert law is not None, config.kind
    return law(params, config, position, direction, progress)


def has_sub_spaces(config: RadianceConfig) -> bool:
    """Returns whether a field has sub-spaces, so that only whole paths have a colour."""
    return KINDS[config.kind].blend is not None


def has_surface(config: RadianceConfig) -> bool:
    """Returns whether a field has a surface, which stops light or bends it."""
    return KINDS[config.kind].eikonal is not None


def has_deformation(config: RadianceConfig) -> bool:
    """Returns whether a field bends straight rays, so that a point alone has no colour."""
    return KINDS[config.kind].deform is not None


def knots(config: RadianceConfig) -> int:
    """Returns the number of knots at which a field bends each ray to a polyline; 0 if it does not.

    A field with a deformation and without knots moves every sample.
    """
    return config.knots if isinstance(config, raydef.RaydefPolylineConfig) else 0


def has_second_ray(config: RadianceConfig) -> bool:
    """Returns whether a deformation makes a second ray, which is sampled beside the first."""
    return isinstance(config, rosenerf.RosenerfConfig)


def init_density(key: Array, config: DensityConfig) -> Params:
    """Returns initial parameters of a density field."""
    return KINDS[config.kind].init_density(key, config)


def density(params: Params, config: DensityConfig, gaussians: Gaussians) -> Float[Array, ""]:
    """Returns the density of one interval of a path; see `FieldKind`."""
    return KINDS[config.kind].density(params, config, gaussians)


def variants() -> Mapping[type[FieldConfig], Mapping[str, type[FieldConfig]]]:
    """Returns the configuration classes of fields by base class and kind, the default first."""
    order = [USUAL, *(name for name in KINDS if name != USUAL)]
    return {
        RadianceConfig: {name: KINDS[name].radiance_config for name in order},
        DensityConfig: {name: KINDS[name].density_config for name in order},
    }
