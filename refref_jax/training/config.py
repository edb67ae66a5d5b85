"""Configuration of a training run: a small tree of frozen dataclasses.

    config = TrainConfig().override(scene="scenes/ball", preset="small", steps=4000)

Every value is accessed by the name of its option. `None` leaves a decision to the scene or the
preset: `training.resolve` takes it, with a reason, and returns the same tree without `None`. A run
stores this resolved tree as `config.json`; a file in this form, complete or partial, can start
another run. `TrainConfig.chosen` distinguishes overrides, which the user set, from decisions: with
another scene, for example, decisions are taken again, and overrides are kept. This module imports
neither JAX nor the library's numerics.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from refref_jax import choices, configuration
from refref_jax.choices import require as require
from refref_jax.configuration import Option, option
from refref_jax.optics.path_settings import Reentry, check_max_bends, check_min_throughput

# Options that determine the objects, and the shape of the fields.
_OBJECTS, _KIND = ("scene", "properties", "reconstruction"), ("preset", "field")

SURFACE_ONLY = ("surface_start", "straight_share", "surface_index", "surface_index_from")
"""Options that only a surface that bends light reads."""

FIELD_ONLY = (
    *("preset", "field", "footprint", "samples_per_ray", "multisamples", "dilation"),
    *("log2_hashmap_size", "max_res", "precision", "colour_network", "contraction", "near", "far"),
    *("data_loss", "interlevel_weight", "blurs", "distortion_weight", "hash_decay", "distortion"),
    *("path_losses", "steps", "warmup", "learning_rate", "final_learning_rate", "anneal", "batch"),
    *("pretraced_batches", "adam_b2", "sub_spaces", "eikonal_weight", "curvature_weight"),
    *("gaussians", "splat_filter", "deformation_weights", "brightest", *SURFACE_ONLY),
)
"""Options that only a radiance field reads."""

BACKDROP_ONLY = (
    *("backdrop_resolution", "iterations", "most_pixels", "view_dependence", "field_ball"),
)
"""Options that only a backdrop reads."""

BACKDROP_PIXELS = 64_000_000
"""Default number of pixels whose equations are in memory at once; they take 18.6 GiB."""

# Options that determine the model of the far field.
_FAR_FIELD = (
    *(*_OBJECTS, "background", "radius", "centre", "pixels", "rule", "paths", "max_bends"),
    *("interior", "tints", *FIELD_ONLY, *BACKDROP_ONLY),
)

# Options that determine near and far planes, and numbers of samples.
_BOUNDS = ("scene", "properties", "background", "radius", "contraction")
_SAMPLES = (*_BOUNDS, *_OBJECTS, "centre", "paths", "max_bends", "interior", "far_field", *_KIND)

# Most steps, rays and batches, which are 32-bit integers, and others; numbers of multisamples.
_MOST, _FINEST, _CELLS, _SEEDS, _MOST_SUB_SPACES = 2**31 - 1, 2**20, 2**13, 2**32, 64
_PATTERNS, _MOST_ENTRIES = (1, 6), 31


@dataclasses.dataclass(frozen=True)
class SceneConfig:
    """The training scene.

    Attributes:
      path: Scene to train on: a folder, or hf:CONFIG/SCENE of the published data set.
      rule: Medium outside each mesh: that of the part around it (nested), always air as in Cycles
        (facing), or that of the overlapping mesh with the highest priority in scene.json
        (priority). By default that of scene.json, else nested.
      indices: Index of refraction of a material or a mesh, instead of that in scene.json or in the
        table of materials.
      space: Geometry of the background: a cube (bounded), a sphere (spherical), or infinitely far
        away (unbounded). By default that of scene.json or the scene's name.
      radius: Half edge of the background cube, or radius of the background sphere (by default that
        of scene.json, else measured from depth maps, else 7.3), or radius of an unbounded scene's
        uncontracted ball, world units; with contraction=always only the latter has an effect.
      centre: Centre of the background, x,y,z in world units; by default that of scene.json, else
        measured from depth maps if the radius is, else the origin.
      reconstruction: Folder of experiments.reconstruct, whose object replaces the scene's meshes.
      pixels: Training pixels: all, or only those of the background, at a margin from the masks.
      properties: JSON file of properties of the scene, like scene.json, whose values override it.
      shading: Shading of all objects: their own (scene), smooth, or flat, with face normals, as in
        the paper's released code.
    """

    path: str = option("", name="scene")
    rule: choices.RuleName | None = option(None, after=_OBJECTS)
    indices: tuple[tuple[str, float], ...] = option((), name="ior", after=("reconstruction",))
    space: choices.Space | None = option(None, name="background", after=("scene", "properties"))
    radius: float | None = option(None, after=("scene", "properties", "background", "contraction"))
    reconstruction: str = option("")
    pixels: choices.Pixels = option("all")
    properties: str = option("")
    shading: choices.ShadingOverride = option("scene")
    centre: tuple[float, float, float] | None = option(
        None, after=("scene", "properties", "background"), comparison="none"
    )

    def __post_init__(self) -> None:
        """Checks the numbers."""
        configuration.convert_fields(self)
        if self.radius is not None and not 0.0 < self.radius < math.inf:
            raise ValueError(
                f"radius is {self.radius}, but it is a length. Give a positive, finite number of "
                "world units."
            )
        if not all(map(math.isfinite, self.centre or ())):
            raise ValueError(f"centre is {self.centre}. Give three finite numbers of world units.")
        for name, index in self.indices:
            if not name or not 0.0 < index < math.inf:
                raise ValueError(
                    f"The index of refraction of {name!r} is {index}. Give a name and a positive "
                    "number."
                )


@dataclasses.dataclass(frozen=True)
class PathsConfig:
    """The light paths that are traced.

    Attributes:
      name: Light paths: straight ignores the objects; paper has at most 10 bends and a reflection
        at the first surface; paper_no_reflection and paper_no_tir are its ablations without this
        reflection and without total internal reflections; tree follows every branch that carries
        light. By default tree if there are meshes, else straight.
      min_throughput: Throughput below which a branch is not followed and its sibling takes its
        share, in [0, 1); by default that of the paths.
      max_bends: Maximum number of refractions and reflections of a path; by default that of the
        paths.
      reentry: Whether light that has left the objects may meet them again; by default determined
        from the meshes.
    """

    name: choices.Paths | None = option(None, name="paths", after=(*_OBJECTS, "field"))
    min_throughput: float | None = option(None, formerly="cut", after=("paths",))
    max_bends: int | None = option(None, formerly="bends", after=("paths",))
    reentry: Reentry | None = option(None, after=(*_OBJECTS, "rule", "paths", "max_bends"))

    def __post_init__(self) -> None:
        """Checks the numbers."""
        configuration.convert_fields(self)
        if self.min_throughput is not None:
            check_min_throughput(self.min_throughput)
        if self.max_bends is not None:
            check_max_bends(self.max_bends)


@dataclasses.dataclass(frozen=True)
class FieldConfig:
    """The fields and their sampling; values that are not given are those of the preset.

    Attributes:
      preset: Size of the model and length of its training.
      field: Field kind: zipnerf; nerfacto, without anti-aliasing; msnerf, with sub-spaces; neus or
        unisurf, with the surface of an opaque object; nunerf, with that surface and colours of
        glass; tnsr, whose learned surface bends light; raydef or raydef_polyline, with a
        deformation of straight rays; rosenerf, with a second ray; or Gaussian splats.
      sub_spaces: Number of sub-spaces, only of field=msnerf.
      gaussians: Number of Gaussians, only of field=splats.
      splat_filter: Opacity of blurred Gaussians: reduced (mip) or kept (classic), of field=splats.
      surface_start: Initial surface of field=tnsr: a ball, or that of the scene's meshes.
      straight_share: Share of the steps in which rays are straight and the surface of field=tnsr
        opaque, in [0, 1); by default 0.5 from a ball, 0 from meshes.
      surface_index: Index of refraction of field=tnsr, relative to the medium around it; by default
        that of the scene's largest mesh, else 1.5.
      surface_index_from: Source of this index: given, or learned from there.
      interior: Model of the inside of the objects: a learned field (the paper), empty (clear), or
        interfaces and media that absorb light (absorbing). By default clear if all objects are
        clear in scene.json, else absorbing.
      tints: Colours of interfaces and media of an absorbing interior: those of scene.json, or
        learned; by default given if scene.json describes every part.
      footprint: Footprint of a pixel: widened by arc length (cone), or propagated through the bends
        by ray differentials (differential).
      samples_per_ray: Samples per ray of each proposal level, then of the radiance field: 32,20.
      multisamples: Number of multisamples per interval, 1 or 6.
      log2_hashmap_size: Hash map size of the radiance field, base-2 logarithm of a level's entries.
      max_res: Finest resolution of the radiance field's hash grid, cells per side.
      precision: Arithmetic precision of the fields.
      dilation: Dilation of a proposal before it is sampled, in units of its mean bin width, or 0.
      colour_network: Layers of the colour network: plain, or with a skip connection (skip), which
        appends its inputs to the outputs of its first layer, as in the paper's released code.
      brightest: Largest linear radiance of the field; above 1 (white) where lamps or windows shine.
      contraction: Scenes whose space is contracted: unbounded ones, or all (always; the paper's
        released code), as if the size of their background were unknown.
      near: Near plane: distance of the first sample from the camera, world units; by default 0.05,
        with contraction=always 0.5.
      far: Far plane: distance of the last sample from the last bend in contracted space, world
        units; by default 1000, with contraction=always 150, and 10,000 in unbounded scenes.
      far_field: Model of the world behind the objects: the radiance field, or only its surface
        (backdrop), a cube, sphere or environment whose radiance is solved for. By default the
        backdrop where the scene states which one it is and the images agree, unless a part or an
        option needs a field.
      backdrop_resolution: Number of cells per side of a face of the backdrop.
      iterations: Largest number of iterations of the backdrop's solver.
      most_pixels: Largest number of pixels whose equations are in memory at once; of more, each
        round of 8 iterations takes others, drawn at random.
      exposure: Exposure and white balance of the training images: fixed, or a learned gain for each
        image and channel (per_image), for captures. Test images are rendered with a gain of 1.
      view_dependence: Dependence of a backdrop's radiance on the direction of light: none, or
        linear, for walls that shine.
      field_ball: Ball x,y,z,radius, world units, in which the field of interior=field is sampled
        where all masks show the object; by default it is only sampled inside the meshes.
    """

    preset: choices.PresetName = option("tiny")
    field: choices.FieldName = option("zipnerf")
    sub_spaces: int | None = option(None, after=_KIND)
    gaussians: int | None = option(None, after=_KIND)
    splat_filter: choices.SplatFilter | None = option(None, after=_KIND)
    surface_start: choices.SurfaceStart | None = option(None, after=_KIND)
    straight_share: float | None = option(None, after=(*_KIND, "surface_start"))
    surface_index: float | None = option(None, after=(*_OBJECTS, *_KIND))
    surface_index_from: choices.IndexFrom | None = option(None, after=_KIND)
    interior: choices.Interior | None = option(
        None, after=(*_OBJECTS, "paths", "max_bends", "tints")
    )
    tints: choices.Tints | None = option(None, after=(*_OBJECTS, "paths", "max_bends", "interior"))
    footprint: choices.Footprint | None = option(None, after=_KIND)
    samples_per_ray: tuple[int, ...] | None = option(None, formerly="samples", after=_SAMPLES)
    multisamples: int | None = option(None, after=_KIND)
    log2_hashmap_size: int | None = option(None, formerly="entries", after=_KIND)
    max_res: int | None = option(None, formerly="finest", after=_KIND)
    precision: choices.Precision | None = option(None, after=_KIND)
    dilation: float | None = option(None, after=_KIND)
    colour_network: choices.ColourNetwork = option("plain")
    brightest: float = option(1.0)
    contraction: choices.Contraction = option("unbounded")
    near: float | None = option(None, after=_BOUNDS, comparison="none")
    far: float | None = option(None, after=_BOUNDS, comparison="none")
    far_field: choices.FarField | None = option(None, after=_FAR_FIELD)
    backdrop_resolution: int | None = option(None, after=("far_field",))
    iterations: int | None = option(None, after=("far_field",))
    most_pixels: int | None = option(None, after=("far_field",))
    exposure: choices.Exposure | None = option(None, after=("far_field",))
    view_dependence: choices.ViewDependence | None = option(None, after=("far_field",))
    field_ball: choices.BallOption | None = option(None, after=(*_OBJECTS, "interior"))

    def __post_init__(self) -> None:
        """Checks the numbers."""
        configuration.convert_fields(self)
        counts = self.samples_per_ray
        if counts is not None and not (counts and min(counts) > 0):
            raise ValueError(
                f"samples_per_ray is {','.join(map(str, counts)) or 'empty'}, not a list of "
                "positive numbers. Use a list such as samples_per_ray=32,20."
            )
        if self.multisamples not in (None, *_PATTERNS):
            raise ValueError(f"multisamples is {self.multisamples}. Give 1 (the centre line) or 6.")
        if self.field_ball is not None:
            choices.check_ball(self.field_ball)
        ranges = dict.fromkeys(("most_pixels", "gaussians"), (1, _MOST)) | {"brightest": (1, 8)}
        ranges |= {"backdrop_resolution": (4, _CELLS), "iterations": (1, _FINEST)}
        ranges |= {"sub_spaces": (1, _MOST_SUB_SPACES), "max_res": (1, _FINEST)}
        ranges |= {"log2_hashmap_size": (1, _MOST_ENTRIES)}
        for name, (least, most) in ranges.items():
            number = getattr(self, name)
            if number is not None and not least <= number <= most:
                raise ValueError(f"{name} is {number}. Give {least} to {most}.")
        for name in ("dilation", "near", "far"):
            if (number := getattr(self, name)) is not None and not 0.0 <= number < math.inf:
                raise ValueError(f"{name} is {number}. Give 0 or a positive number.")


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """The training loss: the data loss plus the weighted others.

    Attributes:
      data: Loss on sRGB colours.
      interlevel: Weight of the anti-aliased interlevel loss.
      blurs: Half-width of the interlevel loss's blur at each proposal level, normalised distance.
      distortion: Weight of the distortion loss.
      hash_decay: Weight of the hash decay; by default the one of the field kind.
      tint_decay: Weight of the optical density of learned tints and absorption.
      distortion_over: Samples in the distortion loss: those outside the objects (the paper's
        correction), or all (everywhere; Mip-NeRF 360, the paper's ablation).
      path_losses: Light paths in the interlevel and distortion losses: all, or all but those that
        are reflected at the first surface (transmitted; the paper's released code).
      eikonal: Weight of the eikonal loss of a surface; by default the one of the field kind.
      curvature: Weight of the curvature loss of a surface; by default the one of the field kind.
      deformation_weights: Weights of the losses of a deformation: its bends, its turns that its
        bends do not explain, and its size, such as 3e-3,1e-3,1e-4; by default the field kind's.
    """

    data: choices.DataLoss = option("mse", name="data_loss")
    interlevel: float = option(0.01, name="interlevel_weight")
    blurs: tuple[float, ...] | None = option(None, after=("preset", "field", "samples_per_ray"))
    distortion: float = option(0.01, name="distortion_weight")
    hash_decay: float | None = option(None, after=("field",))
    tint_decay: float = option(1e-3, formerly="dye_decay")
    distortion_over: choices.DistortionOver = option("outside", name="distortion")
    path_losses: choices.PathLosses = option("all")
    eikonal: float | None = option(None, name="eikonal_weight", after=("field",))
    curvature: float | None = option(None, name="curvature_weight", after=("field",))
    deformation_weights: tuple[float, ...] | None = option(None, after=("field",))

    def __post_init__(self) -> None:
        """Checks the numbers."""
        configuration.convert_fields(self)
        weights = (self.interlevel, self.distortion, self.hash_decay, self.tint_decay)
        others = (*(self.blurs or ()), *(self.deformation_weights or ()))
        for number in (*weights, self.eikonal, self.curvature, *others):
            if number is not None and not 0.0 <= number < math.inf:
                raise ValueError(
                    f"A weight or blur of the losses is {number}. Give 0 or a positive number."
                )


@dataclasses.dataclass(frozen=True)
class ScheduleConfig:
    """Optimisation schedule; values that are not given are those of the preset.

    Attributes:
      steps: Number of training steps, over which the learning rate decays.
      warmup: Number of steps of linear warm-up; by default the preset's share of the steps.
      peak: Learning rate after the warm-up.
      end: Learning rate at the end, after an exponential decay.
      anneal: Number of steps over which proposal weights are annealed; by default the preset's
        share of the steps.
      batch: Number of rays per step.
      pretraced_batches: Number of batches whose light paths are traced at once.
      adam_b2: Decay of Adam's second moment, in [0, 1): 0.99 as in Zip-NeRF, whose hash entries are
        touched too rarely for a longer memory, or 0.999 as in the paper's released code.
    """

    steps: int | None = option(None, after=("preset",))
    warmup: int | None = option(None, after=("preset", "steps"))
    peak: float | None = option(None, name="learning_rate", after=("preset",))
    end: float | None = option(None, name="final_learning_rate", after=("preset",))
    anneal: int | None = option(None, after=("preset", "steps"))
    batch: int | None = option(None, after=("preset",))
    pretraced_batches: int | None = option(None, formerly="pool", after=("preset",))
    adam_b2: float = option(0.99)

    def __post_init__(self) -> None:
        """Checks the numbers."""
        configuration.convert_fields(self)
        for name in ("steps", "warmup", "anneal", "batch", "pretraced_batches"):
            number, least = getattr(self, name), 0 if name in ("warmup", "anneal") else 1
            if number is not None and not least <= number <= _MOST:
                raise ValueError(f"{name} is {number}. Give {least} to {_MOST}.")
        for name, rate in (("learning_rate", self.peak), ("final_learning_rate", self.end)):
            if rate is not None and not 0.0 < rate < math.inf:
                raise ValueError(f"{name} is {rate}. Give a positive number.")
        if not 0.0 <= self.adam_b2 < 1.0:
            raise ValueError(f"adam_b2 is {self.adam_b2}. Give a number in [0, 1).")


class Followers(NamedTuple):
    """Names of options that depend on options that change.

    Attributes:
      decided: options that were decided, and will be decided again.
      kept: options that are overrides, and keep their values.
    """

    decided: frozenset[str]
    kept: frozenset[str]


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """A training run.

    Attributes:
      scene: The training scene.
      paths: The light paths that are traced.
      model: The fields and their sampling.
      losses: The training loss.
      schedule: Optimisation schedule.
      seed: Seed of the initial parameters, the order of pixels and the sampling.
      chosen: Names of the options that are overrides; `overrides` explains `None`. It is not an
        option, and is ignored when configurations are compared.
    """

    scene: SceneConfig = SceneConfig()
    paths: PathsConfig = PathsConfig()
    model: FieldConfig = FieldConfig()
    losses: LossConfig = LossConfig()
    schedule: ScheduleConfig = ScheduleConfig()
    seed: int = 0
    chosen: tuple[str, ...] | None = dataclasses.field(default=None, compare=False)

    def __post_init__(self) -> None:
        """Checks the seed, and the names of the overrides."""
        configuration.convert_fields(self)
        if not 0 <= self.seed < _SEEDS:
            raise ValueError(f"seed is {self.seed}. Give 0 to {_SEEDS - 1}.")
        if self.chosen is not None:
            object.__setattr__(self, "chosen", tuple(map(present_name, self.chosen)))
        if unknown := sorted(set(self.chosen or ()) - set(_OPTIONS)):
            raise ValueError(
                f"chosen names {unknown[0]!r}, but there is no such option. Remove it there."
            )

    def override(self, **given: Any) -> "TrainConfig":
        """Returns this configuration with overrides, by the names of their options.

        Decisions that depend on a changed value are taken again: another value of `paths` brings
        its own throughput threshold, another number of `steps` scales the warm-up. Overrides are
        kept until they are set to `None`.

        Args:
          **given: new values.

        Raises:
          ValueError: if there is no such option, or a value is out of range.
        """
        given, options, removed = _converted(given), _OPTIONS, _nothing(given)
        usual = {name: options[name].field.default for name in self.followers(**given).decided}
        overrides = (self.overrides() | set(given)) - removed
        chosen = tuple(name for name in options if name in overrides)
        return dataclasses.replace(self.decided(**usual, **given), chosen=chosen)

    def decided(self, **values: Any) -> "TrainConfig":
        """Returns this configuration with values that are decisions, not overrides.

        Nothing else changes. The arguments and errors are those of `override`.
        """
        overrides, sections = self.overrides(), dict[str, dict[str, Any]]()
        for name, value in _converted(values).items():
            option = _OPTIONS[name]
            sections.setdefault(option.section, {})[option.field.name] = value
        own = sections.pop("", {})
        changed = {
            section: dataclasses.replace(getattr(self, section), **new)
            for section, new in sections.items()
        }
        chosen = tuple(name for name in _OPTIONS if name in overrides)
        return dataclasses.replace(self, chosen=chosen, **own, **changed)

    def overrides(self) -> frozenset[str]:
        """Returns the names of the options that are overrides.

        If `chosen` is `None`, these are all options whose value is not the default. There are none
        if the schedule is complete, as in a configuration of an earlier version, which does not
        distinguish overrides from decisions.
        """
        if self.chosen is not None:
            return frozenset(self.chosen)
        if None not in vars(self.schedule).values():
            return frozenset()
        usual = TrainConfig()
        return frozenset(name for name in _OPTIONS if self.get(name) != usual.get(name))

    def followers(self, **given: Any) -> Followers:
        """Returns the options that depend on values that would change; see `override`."""
        changed = {name for name, value in _converted(given).items() if self.get(name) != value}
        overrides = self.overrides()
        after = {o.name: set(o.field.metadata.get("after", ())) - {o.name} for o in options_of()}
        decided: set[str] = set()
        while True:
            reached = {n for n, causes in after.items() if causes & (changed | decided)}
            reached -= set(given)
            if reached - overrides <= decided:
                return Followers(frozenset(decided), frozenset(reached & overrides))
            decided |= reached - overrides

    def at(self, scene: str) -> "TrainConfig":
        """Returns this configuration with another path of the same scene; decisions are kept."""
        return dataclasses.replace(self, scene=dataclasses.replace(self.scene, path=scene))

    def get(self, name: str) -> Any:
        """Returns a value by the name of its option."""
        option = _OPTIONS[name]
        section = getattr(self, option.section) if option.section else self
        return getattr(section, option.field.name)


def type_of(option: Option) -> Any:
    """Returns the annotation of an option's field."""
    return configuration.type_of(TrainConfig, option)


def _converted(given: Mapping[str, Any]) -> dict[str, Any]:
    """Returns values converted to the types of their fields, by the present names of options."""
    return configuration.convert_options(TrainConfig, given)


def _nothing(given: Mapping[str, Any]) -> set[str]:
    """Returns the names of values that remove an override: `None`, and empty ones."""
    empty = {name for name, value in _converted(given).items() if value in ("", ())}
    return empty | {name for name, value in given.items() if value is None}


def present_name(name: str) -> str:
    """Returns the name of an option for its name in this or an earlier version."""
    return configuration.present_name(TrainConfig, name)


def options_of() -> Iterator[Option]:
    """Yields all options of a training run, in the order of the configuration."""
    return configuration.options_of(TrainConfig)


# By name; looked up some thousand times for each run.
_OPTIONS = {option.name: option for option in options_of()}
