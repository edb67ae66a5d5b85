"""Values of the options of scenes and configurations (standard library only)."""

import math
from typing import Literal, NamedTuple, TypeVar, get_args

_Value = TypeVar("_Value")

Colour = tuple[float, float, float]
"""Linear RGB."""

CLEAR: Colour = (1.0, 1.0, 1.0)
"""Tint of an interface without loss."""

NO_ABSORPTION: Colour = (0.0, 0.0, 0.0)
"""Absorption of a clear medium."""

SATURATED = 254.5 / 255.0
"""Colour, sRGB, from which on an 8-bit pixel is saturated: the light may be brighter."""

Position = tuple[float, float, float]
"""A point in world units."""

BallOption = tuple[float, float, float, float]
"""Centre and radius of a ball, world units."""

ORIGIN: Position = (0.0, 0.0, 0.0)
"""Centre of a scene that does not state another one."""

PartKind = Literal["dielectric", "opaque", "conductor", "thin_sheet"]
"""Kinds of parts: bodies that light passes through, surfaces that it ends on, metals that reflect
it, and open surfaces that stand for a thin wall."""


class Material(NamedTuple):
    """The material of a part, in addition to its index of refraction, tint and absorption.

    Attributes:
      kind: kind of the part.
      roughness: roughness of the surface, 0 to 1, as in Cycles: the `alpha` of GGX is its square.
      complex_index: `eta` and `k` of a conductor, relative to vacuum, linear RGB.
      dispersion: index of refraction inside for red, green and blue, or `None` if one index holds
        for all colours.
      interior: `field` if a radiance field models the inside; `None` if the scene's model does.
      radiance: linear RGB radiance of an opaque part, `vertex_colours` of its mesh, or `None` if
        its colour is to be learned.
    """

    kind: PartKind = "dielectric"
    roughness: float = 0.0
    complex_index: tuple[Colour, Colour] | None = None
    dispersion: Colour | None = None
    interior: Literal["field"] | None = None
    radiance: Colour | Literal["vertex_colours"] | None = None


TwoSidedRule = Literal["nested", "facing"]
"""Rules under which the media on both sides of a part are known in advance."""

RuleName = Literal[TwoSidedRule, "priority"]
"""Rules for the medium outside a part; see `optics.interface_rules`."""

KnownTints = Literal["given", "learned"]
"""Source of tints and absorption in scenes with coloured parts."""

Tints = Literal["none", KnownTints]
"""Source of tints and absorption; `none` if no part is coloured."""

ShadingOverride = Literal["scene", "smooth", "flat"]
"""Shading of all parts, in place of their own; `scene` keeps it."""

Space = Literal["bounded", "spherical", "unbounded"]
"""Scene bounds: a background cube, a background sphere, or none."""

SURFACES: dict[Space, str] = {"bounded": "cube", "spherical": "sphere", "unbounded": "environment"}
"""The background's surface in words."""

Split = Literal["train", "val", "test"]
"""Splits of a scene's views."""

SPLITS: tuple[Split, ...] = get_args(Split)
"""All splits, in the order of the published data set."""

Pixels = Literal["all", "background"]
"""Pixels that are used for training."""

Paths = Literal["straight", "paper", "tree", "paper_no_reflection", "paper_no_tir"]
"""Names of preset path settings; see `optics.path_settings`."""

PresetName = Literal["tiny", "small", "paper", "best"]
"""Sizes of a model and its training; see `training.presets`."""

FieldName = Literal[
    "zipnerf",
    "nerfacto",
    "msnerf",
    "neus",
    "unisurf",
    "nunerf",
    "tnsr",
    "raydef",
    "raydef_polyline",
    "rosenerf",
    "splats",
]
"""Field kinds, the default first (`fields.registry`), and Gaussian splats, which have no field."""

IndexFrom = Literal["given", "learned"]
"""Source of the index of refraction of a learned surface; see `fields.tnsr.TnsrConfig`."""

SurfaceStart = Literal["ball", "meshes"]
"""Where a learned surface begins; see `training.config.FieldConfig`."""

FarField = Literal["field", "backdrop"]
"""Model of the world behind the objects: the radiance field, or a surface (`render.backdrop`)."""

Exposure = Literal["fixed", "per_image"]
"""Exposure of the training images: the same for all, or a gain for each of them."""

ViewDependence = Literal["none", "linear"]
"""How the radiance of a backdrop depends on the direction of light; see `render.backdrop`."""

InFront = Literal["nothing", "field"]
"""What is in front of a backdrop; see `render.model.BackdropConfig`."""

Interior = Literal["field", "clear", "absorbing"]
"""Model of the inside of the objects; see `render.model.ModelConfig`."""

ColourNetwork = Literal["plain", "skip"]
"""Layers of the colour network: plain, or with a skip connection; see `fields.hash_grid`."""

Contraction = Literal["unbounded", "always"]
"""Scenes whose space is contracted: unbounded ones, or all; see `scene_bounds.contracted`."""

LastSample = Literal["middle", "end"]
"""Where the field is evaluated for a path's last interval; see `render.model.ModelConfig`."""

SplatFilter = Literal["mip", "classic"]
"""Opacity of blurred splats: reduced as they widen (Mip-Splatting), or kept; see `splats`."""

Footprint = Literal["cone", "differential"]
"""Model of the pixel footprint along a path; see `render.model.ModelConfig`."""

Precision = Literal["float32", "bfloat16"]
"""Arithmetic precision of the fields."""

DataLoss = Literal["mse", "charbonnier"]
"""Loss on sRGB colours."""

PathLosses = Literal["all", "transmitted"]
"""Light paths that the interlevel and distortion losses include; see `training.objective`."""

DistortionOver = Literal["outside", "everywhere"]
"""Samples that the distortion loss includes: those outside the objects, or all."""


def check_ball(ball: BallOption) -> None:
    """Checks the numbers of a ball in which a field is sampled.

    Raises:
      ValueError: if these are not four finite numbers, or the radius is not positive.
    """
    if not (len(ball) == 4 and all(map(math.isfinite, ball)) and ball[3] > 0.0):
        raise ValueError(
            f"field_ball={','.join(map(str, ball))} is not a ball. Give its centre and a positive "
            "radius, x,y,z,radius."
        )


def side_of(rays_per_pixel: int) -> int:
    """Returns the number of rays along each edge of a pixel.

    Args:
      rays_per_pixel: number of rays in the pixel.

    Raises:
      ValueError: if they do not make a square grid.
    """
    side = math.isqrt(max(rays_per_pixel, 0))
    if side >= 1 and side**2 == rays_per_pixel:
        return side
    nearest = " or ".join(str(s**2) for s in (side, side + 1) if s)
    raise ValueError(f"{rays_per_pixel} rays a pixel do not make a square grid. Give {nearest}.")


def require(value: _Value | None) -> _Value:
    """Returns the value of an option that `training.resolve` has decided.

    Raises:
      ValueError: if it is `None`, which leaves the decision open.
    """
    if value is None:
        raise ValueError(
            "An option that training needs is None, which leaves it open. Use the configuration "
            "that training.resolve returns."
        )
    return value
