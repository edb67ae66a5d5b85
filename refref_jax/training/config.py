"""The configuration of a training run: one small tree of frozen dataclasses.

    config = TrainConfig().override(scene="scenes/ball", preset="small", steps=4000)

Every value is reached by the name of its option, which is also the name of its command-line flag.
`None` leaves a decision to the scene or the preset: `training.resolve` takes it, with a reason, and
returns the same tree without `None`. That is what a run writes as `config.json`; a file in this
form, complete or partial, begins a run again. What was asked for is told from what was decided by
`TrainConfig.chosen`: with another scene, say, decisions are taken again, and wishes stay.

Importing this module imports neither JAX nor the library's numerics.
"""

import dataclasses
import functools
import math
import numbers
import typing
from collections.abc import Iterator, Mapping
from pathlib import PurePath
from typing import Any, NamedTuple

from refref_jax import configuration
from refref_jax.choices import (
    DataLoss,
    DistortionOver,
    FieldName,
    Footprint,
    Interior,
    Paths,
    Pixels,
    Precision,
    PresetName,
    RuleName,
    Space,
    Tints,
)
from refref_jax.optics.path_settings import Reentry, check_bends, check_cut

# Options that say which objects there are.
_OBJECTS = ("scene", "reconstruction")

# Of steps, rays and batches, which are counted in 32 bits.
_MOST = 2**31 - 1

_FINEST = 2**20
_SEEDS = 2**32

# Points of the cone patterns, see `sampling.cones`.
_PATTERNS = (1, 6)

# More entries than a 32-bit hash tells apart serve nothing.
_MOST_ENTRIES = 31


def _option(default: Any = None, *, name: str = "", after: tuple[str, ...] = ()) -> Any:
    """Declares a value of the configuration.

    Args:
      default: value if none is given; `None` for a decision of the scene or the preset.
      name: name of the option where it is not that of the field.
      after: options on which the decision depends. Overriding one of them takes it again, unless
        the option was asked for.
    """
    return dataclasses.field(default=default, metadata={"name": name, "after": after})


def _convert_fields(record: Any) -> None:
    """Converts the values of a new record as `TrainConfig.override` does; see `_converted`."""
    hints = _hints(type(record))
    for field in dataclasses.fields(record):
        value, kind = getattr(record, field.name), hints[field.name]
        name = field.metadata.get("name") or field.name
        if not dataclasses.is_dataclass(kind):
            value = configuration.convert(_plain(value), kind, name=name)
            object.__setattr__(record, field.name, value)
        elif not isinstance(value, kind):
            raise ValueError(f"{name} is {value!r}, not of type {kind.__name__}.")


@functools.cache
def _hints(owner: type) -> dict[str, Any]:
    return typing.get_type_hints(owner)


def _plain(value: Any) -> Any:
    """Returns a value as JSON has it, also of numbers that are NumPy's."""
    if isinstance(value, Mapping):
        return [[name, _plain(each)] for name, each in sorted(value.items())]
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, numbers.Integral) and not isinstance(value, bool):
        return int(value)
    if isinstance(value, numbers.Real) and not isinstance(value, bool):
        return float(value)
    return str(value) if isinstance(value, PurePath) else value


@dataclasses.dataclass(frozen=True)
class SceneConfig:
    """The scene that is trained on.

    Attributes:
      path: Scene to train on: a folder, or hf:CONFIG/SCENE of the published data set.
      rule: What lies outside each mesh: the part around it (nested), always air as in Cycles
        (facing), or, of meshes that overlap, the one with the highest priority in scene.json.
      indices: Index of refraction of a material or a mesh, over those of the table and of
        scene.json.
      space: Where the background stands: on a cube (bounded), on a sphere (spherical), or
        infinitely far away (unbounded). By default as scene.json or the scene's name says.
      radius: Half edge of the background's cube, or radius of its sphere (by default that of
        scene.json, else 7.3), or radius of an unbounded scene's uncontracted ball, world units.
      reconstruction: Folder that experiments.reconstruct wrote, whose object takes the place of the
        scene's meshes.
      pixels: Pixels that are learned from: all, or only those of the background, at least a margin
        away from the masks.
    """

    path: str = _option("", name="scene")
    rule: RuleName = _option("nested")
    indices: tuple[tuple[str, float], ...] = _option((), name="ior", after=("reconstruction",))
    space: Space | None = _option(name="background", after=("scene",))
    radius: float | None = _option(after=("scene", "background"))
    reconstruction: str = _option("")
    pixels: Pixels = _option("all")

    def __post_init__(self) -> None:
        """Checks the numbers."""
        _convert_fields(self)
        if self.radius is not None and not 0.0 < self.radius < math.inf:
            raise ValueError(
                f"radius is {self.radius}, but it is a length. Give a positive, finite number of "
                "world units."
            )
        for name, index in self.indices:
            if not name or not 0.0 < index < math.inf:
                raise ValueError(
                    f"The index of refraction of {name!r} is {index}. Give a name, and a positive "
                    "number."
                )


@dataclasses.dataclass(frozen=True)
class PathsConfig:
    """The light paths that are followed.

    Attributes:
      name: Light paths: straight ignores the objects; paper bends up to 10 times and reflects at
        the first surface, with its ablations without that and without total internal reflection;
        tree follows every branch that carries light. By default tree if there are meshes, else
        straight.
      cut: Smallest throughput worth following, in [0, 1); by default that of the paths.
      bends: Most refractions and reflections of a path; by default that of the paths.
      reentry: Whether light that has left the objects may meet them again; by default found from
        the meshes.
    """

    name: Paths | None = _option(name="paths", after=_OBJECTS)
    cut: float | None = _option(after=("paths",))
    bends: int | None = _option(after=("paths",))
    reentry: Reentry | None = _option(after=(*_OBJECTS, "rule", "paths", "bends"))

    def __post_init__(self) -> None:
        """Checks the numbers."""
        _convert_fields(self)
        if self.cut is not None:
            check_cut(self.cut)
        if self.bends is not None:
            check_bends(self.bends)


@dataclasses.dataclass(frozen=True)
class FieldConfig:
    """The fields, and how they are sampled; what is not given is the preset's.

    Attributes:
      preset: Size of the model and its training.
      field: Kind of field: Zip-NeRF's, or without its anti-aliasing Nerfacto's.
      interior: What is modelled inside the objects: a learned field (the paper), nothing (clear),
        or interfaces and media that take light (absorbing). By default clear if scene.json says
        that all is, else absorbing.
      tints: Colours of interfaces and media of an absorbing interior: those of scene.json, or
        learned; by default given if scene.json describes every part.
      footprint: Footprint of a pixel: widened by arc length (cone), or followed through the bends
        (differential).
      samples: Samples along a path in each proposal round, then in the final one, as 32,20.
      multisamples: Points that stand for a sample's cone, 1 or 6.
      entries: Most entries of a level of the radiance field's hash grid, as base-2 logarithm.
      finest: Cells a side of that grid's finest level.
      precision: Arithmetic of the fields.
      dilation: Widening of a proposal before it is sampled, as a share of its mean bin width; 0 for
        none.
    """

    preset: PresetName = _option("tiny")
    field: FieldName = _option("zipnerf")
    interior: Interior | None = _option(after=(*_OBJECTS, "paths", "bends", "tints"))
    tints: Tints | None = _option(after=(*_OBJECTS, "paths", "bends", "interior"))
    footprint: Footprint | None = _option(after=("preset", "field"))
    samples: tuple[int, ...] | None = _option(after=("preset", "field"))
    multisamples: int | None = _option(after=("preset", "field"))
    entries: int | None = _option(after=("preset", "field"))
    finest: int | None = _option(after=("preset", "field"))
    precision: Precision | None = _option(after=("preset", "field"))
    dilation: float | None = _option(after=("preset", "field"))

    def __post_init__(self) -> None:
        """Checks the numbers."""
        _convert_fields(self)
        if self.samples is not None and not (self.samples and min(self.samples) > 0):
            raise ValueError(
                f"samples is {','.join(map(str, self.samples))}, not a list of positive numbers. "
                "Write as in samples=32,20."
            )
        if self.multisamples not in (None, *_PATTERNS):
            raise ValueError(
                f"There is no pattern of multisamples={self.multisamples} points. Give 1 (on the "
                "centre line) or 6 (Zip-NeRF's hexagon)."
            )
        if self.finest is not None and not 1 <= self.finest <= _FINEST:
            raise ValueError(f"finest is {self.finest}. Give 1 to {_FINEST} cells a side.")
        if self.dilation is not None and not 0.0 <= self.dilation < math.inf:
            raise ValueError(f"dilation is {self.dilation}. Give 0 or a positive number.")
        if self.entries is not None and not 1 <= self.entries <= _MOST_ENTRIES:
            raise ValueError(
                f"entries is {self.entries}, but it is the base-2 logarithm of a table's size. "
                f"Give 1 to {_MOST_ENTRIES}, such as 17 for 131,072 entries."
            )


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """The training loss: the data loss plus the weighted others.

    Attributes:
      data: Loss on sRGB colours.
      interlevel: Weight of the anti-aliased interlevel loss.
      blurs: Half-width of its blur for each proposal round, in normalised distance.
      distortion: Weight of the distortion loss.
      hash_decay: Weight of the decay of the hash grids; by default that of the kind of field.
      dye_decay: Weight of the optical density of learned colours.
      distortion_over: Samples that the distortion loss draws together: those outside the objects
        (the paper's correction), or everywhere (Mip-NeRF 360, the paper's ablation).
    """

    data: DataLoss = _option("mse", name="data_loss")
    interlevel: float = _option(0.01, name="interlevel_weight")
    blurs: tuple[float, ...] | None = _option(after=("preset", "field", "samples"))
    distortion: float = _option(0.01, name="distortion_weight")
    hash_decay: float | None = _option(after=("field",))
    dye_decay: float = _option(1e-3)
    distortion_over: DistortionOver = _option("outside", name="distortion")

    def __post_init__(self) -> None:
        """Checks the numbers."""
        _convert_fields(self)
        weights = (self.interlevel, self.distortion, self.hash_decay, self.dye_decay)
        for number in (*weights, *(self.blurs or ())):
            if number is not None and not 0.0 <= number < math.inf:
                raise ValueError(
                    f"A weight or blur of the losses is {number}. Give 0 or a positive number."
                )


@dataclasses.dataclass(frozen=True)
class ScheduleConfig:
    """How the parameters move, and on how many rays; what is not given is the preset's.

    Attributes:
      steps: Training steps, after which the learning rate has reached its end.
      warmup: Steps of linear warm-up; by default the preset's share of the steps.
      peak: Learning rate after the warm-up.
      end: Learning rate at the end; the decay between is exponential.
      anneal: Steps until the proposals are fully trusted; by default the preset's share.
      batch: Rays a step.
      pool: Batches whose light paths are traced at once.
    """

    steps: int | None = _option(after=("preset",))
    warmup: int | None = _option(after=("preset", "steps"))
    peak: float | None = _option(name="learning_rate", after=("preset",))
    end: float | None = _option(name="final_learning_rate", after=("preset",))
    anneal: int | None = _option(after=("preset", "steps"))
    batch: int | None = _option(after=("preset",))
    pool: int | None = _option(after=("preset",))

    def __post_init__(self) -> None:
        """Checks the numbers."""
        _convert_fields(self)
        for name, least in [("steps", 1), ("batch", 1), ("pool", 1), ("warmup", 0), ("anneal", 0)]:
            number = getattr(self, name)
            if number is not None and not least <= number <= _MOST:
                raise ValueError(f"{name} is {number}. Give {least} to {_MOST}.")
        for name in ("peak", "end"):
            if (rate := getattr(self, name)) is not None and not 0.0 < rate < math.inf:
                raise ValueError(f"The learning rate {name} is {rate}. Give a positive number.")

    def over(self, steps: int) -> "ScheduleConfig":
        """Returns the same schedule stretched over another number of steps."""
        scale = steps / self.steps
        warmup, anneal = round(self.warmup * scale), round(self.anneal * scale)
        return dataclasses.replace(self, steps=steps, warmup=warmup, anneal=anneal)


class Followers(NamedTuple):
    """Options that depend on others which change, by name.

    Attributes:
      decided: those that were decided, which is done again.
      kept: those that were asked for, and stay.
    """

    decided: frozenset[str]
    kept: frozenset[str]


class Option(NamedTuple):
    """One value of the configuration.

    Attributes:
      name: name of the option, and of its flag.
      section: field of `TrainConfig` that holds it; empty for the seed.
      field: its field there.
    """

    name: str
    section: str
    field: dataclasses.Field


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """A training run.

    Attributes:
      scene: The scene that is trained on.
      paths: The light paths that are followed.
      model: The fields, and how they are sampled.
      losses: The training loss.
      schedule: How the parameters move, and on how many rays.
      seed: Seed of the initial parameters, the order of pixels and the sampling.
      chosen: Names of the options that were asked for, no option itself; see `wishes` for `None`.
        Configurations that differ in nothing else are equal.
    """

    scene: SceneConfig = SceneConfig()
    paths: PathsConfig = PathsConfig()
    model: FieldConfig = FieldConfig()
    losses: LossConfig = LossConfig()
    schedule: ScheduleConfig = ScheduleConfig()
    seed: int = 0
    chosen: tuple[str, ...] | None = dataclasses.field(default=None, compare=False)

    def __post_init__(self) -> None:
        """Checks the seed, and the names of what was asked for."""
        _convert_fields(self)
        if not 0 <= self.seed < _SEEDS:
            raise ValueError(f"seed is {self.seed}. Give 0 to {_SEEDS - 1}.")
        if unknown := sorted(set(self.chosen or ()) - set(_by_name())):
            raise ValueError(
                f"chosen names {unknown[0]!r}, but there is no such option. Remove it there."
            )

    def override(self, **given: Any) -> "TrainConfig":
        """Returns this configuration with other values, by the names of their options.

        Decisions that depended on a value that changes are taken again: with another `paths` the
        cut is that of those paths, with other `steps` the warm-up is stretched. What was asked for
        stays, until it is given as `None`.

        Args:
          **given: new values.

        Raises:
          ValueError: if there is no such option, or a value is out of range.
        """
        given, options, taken_back = _converted(given), _by_name(), _nothing(given)
        usual = {name: options[name].field.default for name in self.followers(**given).decided}
        wishes = (self.wishes() | set(given)) - taken_back
        chosen = tuple(name for name in options if name in wishes)
        return dataclasses.replace(self.decided(**usual, **given), chosen=chosen)

    def decided(self, **values: Any) -> "TrainConfig":
        """Returns this configuration with values that were decided, not asked for.

        Nothing else changes. The arguments and errors are those of `override`.
        """
        options, wishes = _by_name(), self.wishes()
        chosen = tuple(name for name in options if name in wishes)
        config = dataclasses.replace(self, chosen=chosen)
        for name, value in _converted(values).items():
            config = config._with(options[name], value)
        return config

    def wishes(self) -> frozenset[str]:
        """Returns the names of the options that were asked for.

        `override` and files note them in `chosen`; `dataclasses.replace` of a section does not, so
        that a value that it puts into a configuration which has `chosen` counts as a decision.

        Where `chosen` does not tell, they are all that are not as usual; but none if the schedule
        is complete, as in the file of an earlier version's run, where decisions look the same.
        """
        if self.chosen is not None:
            return frozenset(self.chosen)
        if None not in vars(self.schedule).values():
            return frozenset()
        usual = TrainConfig()
        return frozenset(name for name in _by_name() if self.get(name) != usual.get(name))

    def followers(self, **given: Any) -> Followers:
        """Returns what depends on values that would change; see `override`."""
        changed = {name for name, value in _converted(given).items() if self.get(name) != value}
        wishes = self.wishes()
        after = {o.name: set(o.field.metadata.get("after", ())) - {o.name} for o in options_of()}
        decided: set[str] = set()
        while True:
            reached = {n for n, causes in after.items() if causes & (changed | decided)}
            reached -= set(given)
            if reached - wishes <= decided:
                return Followers(frozenset(decided), frozenset(reached & wishes))
            decided |= reached - wishes

    def at(self, scene: str) -> "TrainConfig":
        """Returns this configuration for the same scene by another path; all decisions stay."""
        return dataclasses.replace(self, scene=dataclasses.replace(self.scene, path=scene))

    def get(self, name: str) -> Any:
        """Returns a value by the name of its option."""
        (option,) = (each for each in options_of() if each.name == name)
        section = getattr(self, option.section) if option.section else self
        return getattr(section, option.field.name)

    def _with(self, option: Option, value: Any) -> "TrainConfig":
        if not option.section:
            return dataclasses.replace(self, **{option.field.name: value})
        section = getattr(self, option.section)
        section = dataclasses.replace(section, **{option.field.name: value})
        return dataclasses.replace(self, **{option.section: section})


def type_of(option: Option) -> Any:
    """Returns the annotation of an option's field."""
    owner = type(getattr(TrainConfig(), option.section)) if option.section else TrainConfig
    return _hints(owner)[option.field.name]


def _converted(given: Mapping[str, Any]) -> dict[str, Any]:
    """Returns values as their fields take them: lists become tuples, numbers floats.

    Raises:
      ValueError: if one is of another type, or none of the choices, or there is no such option.
    """
    options = _by_name()
    if unknown := sorted(set(given) - set(options)):
        raise ValueError(
            f"There is no option {unknown[0]!r}. Choose from {', '.join(sorted(options))}."
        )
    usual = {name: options[name].field.default for name in given}
    return {
        name: usual[name]
        if value is None
        else configuration.convert(_plain(value), type_of(options[name]), name=name)
        for name, value in given.items()
    }


def _nothing(given: Mapping[str, Any]) -> set[str]:
    """Returns the names of values that ask for nothing: `None`, and what is empty."""
    empty = {name for name, value in _converted(given).items() if value in ("", ())}
    return empty | {name for name, value in given.items() if value is None}


def _by_name() -> dict[str, Option]:
    return {option.name: option for option in options_of()}


def options_of() -> Iterator[Option]:
    """Yields all options of a training, in the order of the configuration."""
    for field in dataclasses.fields(TrainConfig):
        if dataclasses.is_dataclass(field.default):
            for leaf in dataclasses.fields(field.default):
                yield Option(leaf.metadata["name"] or leaf.name, field.name, leaf)
        elif field.compare:
            yield Option(field.name, "", field)
