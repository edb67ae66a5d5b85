"""Model of a scene: static configuration, learned parameters, scene and path settings.

The static configuration holds the fields, their sampling, and the scene bounds. It is hashable, so
compiled functions take it as a static argument. `look_up` queries the field of a model at world
points, for exports; inside objects it is meaningless if the model takes no samples there.
"""

import dataclasses
import math
from typing import NamedTuple, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from refref_jax import numerics
from refref_jax.choices import (
    ORIGIN,
    BallOption,
    Footprint,
    InFront,
    Interior,
    LastSample,
    Position,
    Space,
    SplatFilter,
    ViewDependence,
    check_ball,
)
from refref_jax.fields import base, registry, tnsr
from refref_jax.fields.base import DensityConfig, Radiance, RadianceConfig, Surface
from refref_jax.fields.neus import SurfaceConfig
from refref_jax.fields.tnsr import TnsrConfig
from refref_jax.optics import interface_rules
from refref_jax.optics.media import Scene, with_index
from refref_jax.optics.path_settings import Detail, PathSettings, Tally
from refref_jax.render import backdrop, learned_media
from refref_jax.render.backdrop import Pyramid
from refref_jax.render.learned_media import LearnedTints
from refref_jax.sampling import scene_bounds
from refref_jax.sampling.polylines import Gaussians

# Segments before and after a convex object.
_CONVEX_LEGS = 2

# Light that leaves and re-enters objects has more outer segments, but few: with four, 0.04 % of the
# light of a torus has an omitted segment, which is then treated as empty.
_MOST_LEGS = 4


@dataclasses.dataclass(frozen=True)
class ProposalConfig:
    """One proposal level.

    Attributes:
      field: shape of its density field, of any type.
      samples: number of intervals along a path.
    """

    field: DensityConfig
    samples: int


@dataclasses.dataclass(frozen=True)
class BackdropConfig:
    """Shape of a far field surface; the kind of the surface is the space of the scene.

    Attributes:
      resolution: number of cells per side of a face.
      most_taps: largest number of taps along each axis of a ray's footprint.
      in_front: model of what is in front of the surface: a `field` on opaque parts, and inside
        parts that need one, or `nothing`.
      view_dependence: dependence of radiance on the direction of light: `linear`, or `none`.
      field_ball: centre and radius of a ball, world units, in which the field in front of the
        surface is sampled where all masks show the object; only inside its meshes if `None`.
      hull_cells: number of cells per side of the grid that tells what masks show.
    """

    resolution: int
    most_taps: int = 3
    in_front: InFront = "nothing"
    view_dependence: ViewDependence = "none"
    field_ball: BallOption | None = None
    hull_cells: int = 96

    @property
    def axes(self) -> int:
        """Number of axes of the direction of light that the radiance depends on."""
        return 3 if self.view_dependence == "linear" else 0

    def __post_init__(self) -> None:
        """Checks the numbers."""
        counts = self.resolution, self.most_taps, self.hull_cells
        if min(counts) < 1:
            raise ValueError(f"Resolution, taps and cells are {counts}. Give positive numbers.")
        if self.field_ball is not None:
            check_ball(self.field_ball)


@dataclasses.dataclass(frozen=True)
class SplatsConfig:
    """Shape of a model of Gaussian splats.

    Attributes:
      gaussians: number of Gaussians.
      kernel: opacity of blurred Gaussians, see `splats.gaussians.project`.
    """

    gaussians: int
    kernel: SplatFilter

    def __post_init__(self) -> None:
        """Checks the values."""
        if self.gaussians < 1:
            raise ValueError(f"gaussians is {self.gaussians}. Give a positive number.")
        _check_choice("kernel", self.kernel, get_args(SplatFilter))


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """Configuration of a model of a scene.

    Attributes:
      proposals: proposal levels, coarse to fine; at least one.
      field: shape of the radiance field, of any type.
      samples: number of intervals of the radiance field.
      multisamples: number of multisamples per interval, 1 or 6.
      interior: `field` also samples inside the objects (the paper); `clear` assumes empty objects,
        which holds for clear glass and costs no samples; `absorbing` does not sample inside the
        objects either, but attenuates light by the tints and absorption of interfaces and media.
      footprint: `cone` widens the pixel footprint with arc length, as along a straight ray (the
        paper); `differential` propagates it through every bend by ray differentials.
      learned_tints: number of parts whose tint and absorption are learned, all parts or 0.
      near: distance of the first sample from the camera, world units; 0 starts at the camera.
      far: distance of the last sample from the last bend, or from the camera on a straight path;
        the background is opaque there. In bounded and spherical scenes, paths end at the scene
        bounds, and `far` is only used for paths that miss them.
      radius: half edge of a bounded scene's cube, or radius of a spherical scene or of an
        unbounded scene's uncontracted ball, world units. A background cube should coincide with the
        scene bounds: the field is unconstrained between the two.
      space: `bounded` by the cube, `spherical` (bounded by the ball), or `unbounded` (contracted
        beyond the ball).
      dilation: widening of a proposal before it is sampled, as a fraction of its mean bin width; 0
        for none.
      field_parts: parts whose inside is sampled too, where `interior` leaves out the others.
      centre: centre of the cube or ball, world units; it is the centre of the fields' unit cube.
      backdrop: surface behind the objects that takes the place of the field around them, or `None`.
      last_sample: place at which the field of the last, opaque interval is evaluated: its `middle`,
        as in models of earlier versions, or at the `end` of the path, which is on a surface if the
        scene is bounded or spherical; if it is unbounded, always in the middle.
      splats: Gaussians that take the place of all fields, or `None`.
      learned_gains: number of training images whose exposure is learned, all of them or 0.
    """

    proposals: tuple[ProposalConfig, ...]
    field: RadianceConfig
    samples: int
    multisamples: int
    interior: Interior
    footprint: Footprint
    learned_tints: int
    near: float
    far: float
    radius: float
    space: Space
    dilation: float
    field_parts: tuple[int, ...] = ()
    centre: Position = ORIGIN
    backdrop: BackdropConfig | None = None
    last_sample: LastSample = "middle"
    splats: SplatsConfig | None = None
    learned_gains: int = 0

    @property
    def domain(self) -> scene_bounds.Domain:
        """The scene bounds."""
        return scene_bounds.Domain(self.radius, self.space, self.centre)

    def __post_init__(self) -> None:
        """Validates the values."""
        if not self.proposals:
            raise ValueError("proposals is empty. Give at least one proposal level.")
        if not 0.0 <= self.near < self.far:
            raise ValueError(f"near is {self.near}, far {self.far}. Give 0 <= near < far.")
        if not 0.0 < self.radius < math.inf:
            raise ValueError(f"radius is {self.radius}. Give a positive, finite radius.")
        if not all(map(math.isfinite, self.centre)):
            raise ValueError(f"centre is {self.centre}. Give three finite numbers of world units.")
        if self.learned_tints < 0:
            raise ValueError(f"learned_tints is {self.learned_tints}. Give a number of parts or 0.")
        kinds = {"space": Space, "interior": Interior, "footprint": Footprint}
        for name, kind in (kinds | {"last_sample": LastSample}).items():
            _check_choice(name, getattr(self, name), get_args(kind))


def path_detail(config: ModelConfig, settings: PathSettings) -> Detail:
    """Returns the parts of light paths that a model needs.

    Raises:
      ValueError: if the model has Gaussian splats.
    """
    if config.splats is not None:
        raise ValueError(
            "This model consists of Gaussian splats, which are seen by cameras instead of along "
            "rays. Use render_camera, or train with another field, such as field=zipnerf."
        )
    tally: Tally = "parts" if config.learned_tints else "none"
    most = settings.max_bends + 1
    samples_inside = config.interior == "field" or bool(config.field_parts)
    if config.backdrop is not None and not (has_foreground(config) and samples_inside):
        return Detail("outside", min(_MOST_LEGS, most), "differential", tally)
    if samples_inside:
        return Detail("all", most, "differential" if config.backdrop else config.footprint, tally)
    legs = _CONVEX_LEGS if settings.reentry == "impossible" else _MOST_LEGS
    return Detail("outside", min(legs, most), config.footprint, tally)


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"{name} is {value!r}, which is unknown. Use one of {', '.join(choices)}.")


class Layers(NamedTuple):
    """Parameters of a backdrop and of what is in front of it.

    Attributes:
      field: parameters of the radiance field.
      backdrop: radiance of each level of the surface.
    """

    field: base.Params
    backdrop: Pyramid


class LayersWithHull(NamedTuple):
    """Layers with a field in a ball; a type of its own, as checkpoints of `Layers` have no hull.

    Attributes:
      field: parameters of the radiance field.
      backdrop: radiance of each level of the surface.
      hull: occupancy of the cells of the cube around `field_ball`: 1 in the masks' hull, else 0.
    """

    field: base.Params
    backdrop: Pyramid
    hull: Float[Array, "cells cells cells"]


class Rendering(NamedTuple):
    """Rendered rays. The leading axes are those of the rays.

    Attributes:
      rgb: sRGB colours in `[0, 1]`.
      distance: median distance along the ray's heaviest path, as arc length from the camera in
        world units.
      mean_distance: mean distance along the ray's heaviest path.
      accumulation: sum of the weights, 1 with an opaque background.
      linear: linear RGB colours, not clipped, for averaging the rays of a pixel.
      dropped: dropped throughput of each ray, because a path buffer was full.
    """

    rgb: Float[Array, "*rays 3"]
    distance: Float[Array, "*rays"]
    mean_distance: Float[Array, "*rays"]
    accumulation: Float[Array, "*rays"]
    linear: Float[Array, "*rays 3"]
    dropped: Float[Array, "*rays 3"]


class Params(NamedTuple):
    """The learned part of a model.

    Attributes:
      proposals: parameters of each proposal level's density field.
      field: parameters of the radiance field, the pyramid of a backdrop, Gaussian splats, or
        `Layers` or `LayersWithHull` of a field in front of a backdrop.
      tints: learned tints and absorption of the parts, if any.
      gains: logarithm of the gain of each training image, up to a constant per channel, if learned;
        rendering has a gain of 1.
    """

    proposals: tuple[base.Params, ...]
    field: base.Params
    tints: LearnedTints | None = None
    gains: Float[Array, "views 3"] | None = None


class Model(NamedTuple):
    """A complete model, ready to be rendered.

    Attributes:
      config: static configuration of fields and sampling.
      settings: path settings.
      scene: the scene.
      params: learned parameters.
    """

    config: ModelConfig
    settings: PathSettings
    scene: Scene
    params: Params


def init_params(key: Array, config: ModelConfig) -> Params:
    """Returns initial parameters of all fields of a model; of Gaussian splats, their shapes."""
    if config.splats is not None:
        from refref_jax.splats import gaussians  # costs nothing without splats

        return Params((), gaussians.blank(config.splats.gaussians), None)
    colours = learned_media.init(config.learned_tints) if config.learned_tints else None
    shape = config.backdrop
    surface = backdrop.init(shape.resolution, axes=shape.axes) if shape else None
    if is_backdrop(config):
        return Params((), surface, colours)
    field_key, *keys = jax.random.split(key, 1 + len(config.proposals))
    proposals = tuple(
        registry.init_density(proposal_key, proposal.field)
        for proposal_key, proposal in zip(keys, config.proposals, strict=True)
    )
    field = registry.init_radiance(field_key, config.field)
    if shape is not None and surface is not None:
        field = Layers(field, surface)
        if shape.field_ball is not None:
            field = LayersWithHull(*field, jnp.zeros(3 * (shape.hull_cells,)))
    gains = jnp.zeros((config.learned_gains, 3)) if config.learned_gains else None
    return Params(proposals, field, colours, gains)


def has_foreground(config: ModelConfig) -> bool:
    """Returns whether a field is in front of a backdrop."""
    return config.backdrop is not None and config.backdrop.in_front == "field"


def is_backdrop(config: ModelConfig) -> bool:
    """Returns whether a model is a backdrop and nothing in front of it."""
    return config.backdrop is not None and not has_foreground(config)


def surface_of(params: Params) -> Pyramid:
    """Returns the radiance of a backdrop."""
    field = params.field
    return field.backdrop if isinstance(field, Layers | LayersWithHull) else field


def field_of(params: Params) -> base.Params:
    """Returns the parameters of the radiance field."""
    return params.field.field if isinstance(params.field, Layers | LayersWithHull) else params.field


class FieldPoint(NamedTuple):
    """Values of the field at a point.

    Attributes:
      density: density per world unit, non-negative: the transmittance of a short distance `dt` is
        `exp(-density dt)`.
      linear: linear RGB radiance, opposite to the direction of travel.
    """

    density: Float[Array, ""]
    linear: Float[Array, "3"]


def look_up(
    params: Params,
    config: ModelConfig,
    point: Float[Array, "3"],
    direction: Float[Array, "3"],
    *,
    width: float,
) -> FieldPoint:
    """Returns density and colour at one point; map it over many.

    Args:
      params: parameters of the model.
      config: configuration of the model.
      point: position in world units; beyond the scene bounds, their nearest point is used.
      direction: unit direction of travel of the viewing path.
      width: edge of the cell around the point, world units: finer detail is blurred.

    Raises:
      ValueError: if the model has a backdrop or Gaussian splats instead of fields, or its field has
        sub-spaces, a surface or a deformation.
    """
    for other, use in ((config.splats, "field=zipnerf"), (config.backdrop, "far_field=field")):
        if other is not None:
            raise ValueError(
                f"Models with splats or a backdrop have no density at a point. Train with {use}."
            )
    if registry.has_sub_spaces(config.field):
        raise ValueError(
            f"A point has no colour in fields of kind {config.field.kind}, which blends sub-spaces "
            "along whole paths. Train with field=zipnerf."
        )
    if registry.has_surface(config.field):
        raise ValueError(
            f"A point has no density in fields of kind {config.field.kind}, whose opacity depends "
            "on the way through it. Use look_up_surface, or train with field=zipnerf."
        )
    if registry.has_deformation(config.field):
        raise ValueError(
            f"A point has no colour in fields of kind {config.field.kind}, where it depends on the "
            "ray to what place it is moved. Train with field=zipnerf."
        )
    # Standard deviation of a cube along each axis.
    scale = jnp.full((1,), width, point.dtype) / jnp.sqrt(jnp.asarray(12.0, point.dtype))
    bounds = config.domain
    held = scene_bounds.nearest_within(bounds, point)
    cell = scene_bounds.to_unit_cube(bounds, Gaussians(held[None], scale))
    seen = registry.radiance(params.field, config.field, cell, direction)
    assert isinstance(seen, Radiance)
    return FieldPoint(seen.density / config.radius, seen.rgb)


class SurfaceValue(NamedTuple):
    """Values of a field with a surface at a point.

    Attributes:
      distance: signed value, world units: 0 on the surface, negative inside it, and near it about
        the distance to it.
      normal: unit normal of its level set, outward.
      linear: linear RGB radiance, opposite to the direction of travel.
    """

    distance: Float[Array, ""]
    normal: Float[Array, "3"]
    linear: Float[Array, "3"]


def look_up_surface(
    params: Params, config: ModelConfig, point: Float[Array, "3"], direction: Float[Array, "3"]
) -> SurfaceValue:
    """Returns signed value, normal and colour at one point; map it over many.

    Args:
      params: parameters of the model.
      config: configuration of the model, whose field has a surface (`registry.has_surface`).
      point: position in world units; beyond the ball of the surface, its value is at least the
        distance to the ball.
      direction: unit direction of travel of the viewing path.

    Raises:
      ValueError: if the field has no surface.
    """
    if config.backdrop is not None or not isinstance(config.field, SurfaceConfig):
        raise ValueError(
            f"Fields of kind {config.field.kind} have no surface. Use look_up, or train with "
            "field=neus."
        )
    ball = ball_of(config)
    offset = point - jnp.asarray(ball.centre, point.dtype)
    cell = scene_bounds.to_unit_cube(config.domain, Gaussians(point[None], jnp.zeros(1)))
    seen = registry.radiance(params.field, tnsr.opaque(config.field), cell, direction)
    assert isinstance(seen, Surface)
    distance = jnp.maximum(ball.radius * seen.signed, numerics.length(offset) - ball.radius)
    return SurfaceValue(distance, numerics.normalize(seen.slope), seen.rgb)


class Ball(NamedTuple):
    """A ball in world units.

    Attributes:
      centre: its centre.
      radius: its radius.
    """

    centre: Position
    radius: float


def ball_of(config: ModelConfig) -> Ball:
    """Returns the ball in which a field has its surface."""
    assert isinstance(config.field, SurfaceConfig)
    edge, middle = 2.0 * config.radius, zip(config.centre, config.field.ball_centre, strict=True)
    x, y, z = (centre + edge * (share - 0.5) for centre, share in middle)
    return Ball((x, y, z), edge * config.field.ball_radius)


def bends_light(config: ModelConfig) -> bool:
    """Returns whether a model has its own surface, which bends light."""
    return isinstance(config.field, TnsrConfig)


def opaque_model(config: ModelConfig) -> ModelConfig:
    """Returns the model of the first part of the training, whose surface stops straight rays."""
    assert isinstance(config.field, SurfaceConfig)
    return dataclasses.replace(config, field=tnsr.opaque(config.field), interior="field")


def surface_scene(params: Params, config: ModelConfig) -> Scene:
    """Returns the scene whose surface a model has learned, and bends light; differentiable.

    Args:
      params: parameters of the model.
      config: configuration of the model, for which `bends_light` holds.
    """
    assert isinstance(config.field, TnsrConfig)
    ball = ball_of(config)
    surface = tnsr.level_set(params.field, config.field, centre=ball.centre, radius=ball.radius)
    glass = interface_rules.nested([config.field.index], [interface_rules.NO_PARENT])
    return with_index(Scene(surface, glass), tnsr.index_of(params.field, config.field))
