"""Presets: the size of a model and the length of its training.

| preset  | for                    | samples      | multi | hash levels x features, max res, size |
|---------|------------------------|--------------|-------|---------------------------------------|
| `tiny`  | two CPU cores, minutes | 32 + 20      | 1     | 6 x 4, 512, 2^17                      |
| `small` | a laptop, a small GPU  | 48 + 32      | 1     | 8 x 4, 2048, 2^19                     |
| `paper` | a GPU, as published    | 64 + 64 + 32 | 6     | 10 x 4, 8192, 2^21                    |
| `best`  | a large GPU            | 64 + 64 + 32 | 6     | 10 x 4, 8192, 2^21                    |

| preset  | colour network | rays per step | steps  | footprint    |
|---------|----------------|---------------|--------|--------------|
| `tiny`  | 1 x 32         | 1,024         | 2,500  | differential |
| `small` | 1 x 64         | 2,048         | 8,000  | differential |
| `paper` | 2 x 256        | 4,096         | 25,000 | cone         |
| `best`  | 2 x 256        | 16,384        | 25,000 | differential |

These are the sizes of Zip-NeRF's fields (`fields/zipnerf.py`). The sizes of another field kind are
in its own module; those of `paper` are the published ones.

Samples are per path, for each proposal level and the radiance field; `tiny` takes 16 + 8 where
nothing is in front of the walls (`Preset.background_samples`). `multi` is the number of
multisamples per interval; the hash map size is the number of entries of a level. Values that depend
on the scene are not part of a preset. For the complete published set-up, use the preset `paper`
with the path settings `paper` and the interior `field`; leave these two out for other presets.
`docs/benchmark.md` lists what the paper's released code does otherwise, and the options for it.

On the bundled ball, 1250 steps of 1024 rays reach a masked PSNR of 36.6 dB with `tiny` and 37.9 dB
with `small`, whose steps take 3.1 times as long. `paper` and `best` require a GPU: a CPU core needs
0.8 s for 256 of their rays, 10 times as long as `tiny`
(`benchmarks/results/presets_few_rays.csv`).

`small` is between its neighbours in every number. `best` has the samples of the paper, but ray
differentials, so that footprints follow the bends, and four times as many rays per step, at the
learning rate that Zip-NeRF uses for 65,536. It traces fewer batches at once, so that pre-traced
batches have as many rays, and take as much memory, as those of `paper`.

Of Gaussian splats, a preset has the number (20,000, 50,000, 500,000 and 1,000,000) and the steps,
of one image each.
"""

import dataclasses
from typing import Any

from refref_jax.choices import InFront, Interior, Paths
from refref_jax.fields import hash_grid, msnerf, registry
from refref_jax.fields.base import RadianceConfig
from refref_jax.fields.hash_grid import HashGridConfig
from refref_jax.render.model import BackdropConfig, ModelConfig, ProposalConfig, SplatsConfig
from refref_jax.sampling.scene_bounds import Bounds, check_ball_size
from refref_jax.training import learned_surface
from refref_jax.training.config import (
    BACKDROP_ONLY,
    FIELD_ONLY,
    FieldConfig,
    LossConfig,
    ScheduleConfig,
    TrainConfig,
    require,
)

BACKDROP_RESOLUTION = 384
"""Default number of cells per side of a face of a backdrop."""

BACKDROP_ITERATIONS = 32
"""Default number of iterations of its solver."""

SPLATS = "splats"
"""Name of the field kind of Gaussian splats, which have no field."""

# Options of fields and light paths that Gaussian splats read, and others that they do not.
_READ_BY_SPLATS = ("preset", "field", "steps", "gaussians", "splat_filter")
_NOT_READ = (
    *("rule", "ior", "shading", "pixels", "min_throughput", "max_bends", "reentry"),
    *("interior", "tints", "tint_decay"),
)

# Kinds of field whose colours may exceed white.
_BRIGHT = ("zipnerf", "msnerf", "raydef", "rosenerf")

# Blur of the interlevel loss for each proposal level (Zip-NeRF, supplement); losses of a surface.
_BLURS, _SURFACE = (0.03, 0.003), ("eikonal", "curvature")


@dataclasses.dataclass(frozen=True)
class Preset:
    """One trade-off between speed and accuracy.

    Attributes:
      size: size of the fields, by its name in `fields.registry`.
      schedule: optimisation schedule.
      gaussians: number of Gaussian splats.
    """

    size: str
    schedule: ScheduleConfig
    gaussians: int

    def model(
        self, bounds_: Bounds, interior: Interior, *, field: str = registry.USUAL
    ) -> ModelConfig:
        """Returns the configuration of a model of a scene, with fields of a given type.

        A model of Gaussian splats has the usual fields too, but does not read them.

        Raises:
          ValueError: if that field kind does not have this size.
        """
        sizes = registry.KINDS[registry.USUAL if field == SPLATS else field].sizes
        if self.size not in sizes:
            raise ValueError(
                f"Field kind {field} has no size {self.size}. Use one of the presets "
                f"{', '.join(sizes)}."
            )
        size = sizes[self.size]
        *counts, samples = size.samples
        return ModelConfig(
            proposals=tuple(map(ProposalConfig, size.proposals, counts)),
            field=size.field,
            samples=samples,
            multisamples=size.multisamples,
            interior=interior,
            footprint=size.footprint,
            learned_tints=0,
            dilation=size.dilation,
            last_sample="end",
            splats=SplatsConfig(self.gaussians, "mip") if field == SPLATS else None,
            **dataclasses.asdict(bounds_),
        )

    def background_samples(self, model: ModelConfig) -> tuple[int, ...] | None:
        """Returns the samples of each level if there is nothing in front of the walls.

        Light paths end on the walls of a bounded or spherical scene, where the field is evaluated.
        Returns `None` if this size is not known to need fewer samples then, or a model has other
        paths, or samples inside the objects.
        """
        if model.interior == "field" or model.field_parts or model.space == "unbounded":
            return None
        return registry.KINDS[model.field.kind].sizes[self.size].background_samples


def _backdrop(model: ModelConfig, asked: FieldConfig, in_front: InFront) -> BackdropConfig:
    """Returns the backdrop of a model.

    Raises:
      ValueError: if an option needs another content in front of it, or the ball is too large.
    """
    if asked.exposure == "per_image" and in_front == "field":
        raise ValueError(
            "exposure=per_image cannot be learned with a field in front of a backdrop. Use "
            "exposure=fixed, or far_field=field."
        )
    if asked.field_ball and (in_front, model.interior) != ("field", "field"):
        raise ValueError("field_ball needs interior=field. Add it, or leave field_ball out.")
    if asked.field_ball:
        check_ball_size(model.domain, asked.field_ball)
    return BackdropConfig(
        asked.backdrop_resolution or BACKDROP_RESOLUTION,
        in_front=in_front,
        view_dependence=asked.view_dependence or "none",
        field_ball=asked.field_ball,
    )


def override_model(
    model: ModelConfig, asked: FieldConfig, *, in_front: InFront = "nothing"
) -> ModelConfig:
    """Returns a preset's model with overrides; `None` keeps the value of the preset.

    Args:
      model: model of a preset.
      asked: overrides.
      in_front: content in front of a backdrop, if there is one.

    Raises:
      ValueError: if the model does not support an override.
    """
    if asked.samples_per_ray is not None:
        model = _with_samples(model, asked.samples_per_ray, asked.preset)
    given = {name: getattr(asked, name) for name in ("multisamples", "footprint", "dilation")}
    if model.splats is not None:
        count, kernel = asked.gaussians, asked.splat_filter
        given["splats"] = SplatsConfig(
            count or model.splats.gaussians, kernel or model.splats.kernel
        )
    if asked.far_field == "backdrop":
        given["backdrop"] = _backdrop(model, asked, in_front)
    model = dataclasses.replace(model, **{n: x for n, x in given.items() if x is not None})
    if asked.precision is not None:
        proposals = tuple(
            dataclasses.replace(
                each, field=dataclasses.replace(each.field, precision=asked.precision)
            )
            for each in model.proposals
        )
        field = dataclasses.replace(model.field, precision=asked.precision)
        model = dataclasses.replace(model, proposals=proposals, field=field)
    field = _with_sub_spaces(_with_grid(model.field, asked), asked.sub_spaces)
    field = learned_surface.with_options(field, asked)
    if asked.colour_network != "plain":
        if not isinstance(field, hash_grid.GridRadianceConfig):
            raise ValueError(
                f"colour_network={asked.colour_network} is an option of field kinds with a hash "
                f"grid, unlike {field.kind}. Leave it out."
            )
        field = dataclasses.replace(field, colour_network=asked.colour_network)
    return dataclasses.replace(model, field=_with_brightest(field, asked.brightest))


def _with_brightest(field: RadianceConfig, brightest: float) -> RadianceConfig:
    if brightest == 1.0:
        return field
    if not isinstance(field, hash_grid.GridRadianceConfig) or field.kind not in _BRIGHT:
        raise ValueError(
            f"brightest={brightest:g} has no effect on field kind {field.kind}. Leave it out, or "
            "use field=zipnerf."
        )
    return dataclasses.replace(field, brightest=brightest)


def _with_samples(model: ModelConfig, samples: tuple[int, ...], preset: str) -> ModelConfig:
    rounds = len(model.proposals)
    if len(samples) != rounds + 1:
        raise ValueError(
            f"samples_per_ray={','.join(map(str, samples))} is for {len(samples) - 1} proposal "
            f"levels, but preset {preset} has {rounds}. Give {rounds + 1} numbers: one for each "
            "proposal level, then one for the radiance field."
        )
    proposals = tuple(
        dataclasses.replace(proposal, samples=count)
        for proposal, count in zip(model.proposals, samples[:-1], strict=True)
    )
    return dataclasses.replace(model, proposals=proposals, samples=samples[-1])


def _with_grid(field: RadianceConfig, asked: FieldConfig) -> RadianceConfig:
    if asked.log2_hashmap_size is None and asked.max_res is None:
        return field
    if not isinstance(field, hash_grid.GridRadianceConfig):
        raise ValueError(
            "log2_hashmap_size and max_res are options of a hash grid, which field kind "
            f"{field.kind} does not have. Leave them out."
        )
    grid = field.grid
    if asked.log2_hashmap_size is not None:
        grid = dataclasses.replace(grid, hashmap_size=1 << asked.log2_hashmap_size)
    if asked.max_res is not None:
        if asked.max_res < grid.base_res:
            raise ValueError(
                f"max_res={asked.max_res} is coarser than the grid's first level of "
                f"{grid.base_res} cells per side. Give at least that."
            )
        grid = dataclasses.replace(grid, max_res=asked.max_res)
    return dataclasses.replace(field, grid=grid)


def _with_sub_spaces(field: RadianceConfig, count: int | None) -> RadianceConfig:
    if count is None:
        return field
    if not isinstance(field, msnerf.MsnerfConfig):
        raise ValueError(
            f"sub_spaces={count} has no effect on field kind {field.kind}. Leave it out, or use "
            "field=msnerf."
        )
    return dataclasses.replace(field, sub_spaces=count)


def check_straight(config: TrainConfig) -> None:
    """Refuses overrides about objects for straight rays, which ignore objects.

    Raises:
      ValueError: if one would have no effect.
    """
    asked = {"interior": config.model.interior, "reentry": config.paths.reentry}
    for name, value in asked.items():
        if value not in (None, "field", "possible"):
            raise ValueError(
                f"{name}={value} has no effect: straight rays (paths={config.paths.name}) ignore "
                "objects. Leave it out, or use paths=tree with meshes."
            )


def usual_paths(config: TrainConfig, parts: int) -> tuple[Paths, str]:
    """Returns the light paths of a scene with some number of parts, and the reason for them.

    Raises:
      ValueError: if the configuration has others, but its field bends straight rays.
    """
    field, given = config.model.field, config.paths
    if field == SPLATS:
        return "straight", "Gaussian splats have no light paths"
    if field == learned_surface.KIND:
        return "paper", "field=tnsr, whose surface bends light"
    if registry.KINDS[field].deform is not None:
        if given.name not in (None, "straight") or given.max_bends:
            raise ValueError(
                f"field={field} bends straight rays, not those of paths={given.name or 'tree'}. "
                "Use paths=straight, or field=zipnerf."
            )
        return "straight", f"field={field} bends straight rays"
    return ("tree", "there are meshes") if parts else ("straight", "there are no meshes")


def check_splats(config: TrainConfig) -> None:
    """Refuses overrides that have no effect on Gaussian splats, or only on them.

    Raises:
      ValueError: if there is one.
    """
    given = config.overrides()
    if config.model.field != SPLATS:
        if ignored := sorted(given & {"gaussians", "splat_filter"}):
            raise ValueError(
                f"{' and '.join(ignored)} have no effect on fields of kind {config.model.field}. "
                "Leave them out, or use field=splats."
            )
        return
    ignored = [name for name in unread_by_splats(config) if name in given]
    wrong = {
        "paths": (config.paths.name, "straight"),
        "far_field": (config.model.far_field, "field"),
    }
    ignored += [f"{n}={x}" for n, (x, usual) in wrong.items() if n in given and x != usual]
    if ignored:
        raise ValueError(
            f"No effect on Gaussian splats, which have neither light paths nor a field: "
            f"{', '.join(ignored)}. Leave them out, or use another field, such as field=zipnerf."
        )


def unread_by_splats(config: TrainConfig) -> list[str]:
    """Returns the options that have no effect on Gaussian splats; none for other fields."""
    if config.model.field != SPLATS:
        return []
    names = (*FIELD_ONLY, *BACKDROP_ONLY, "exposure", *_NOT_READ)
    return [name for name in names if name not in _READ_BY_SPLATS]


def samples_of(model: ModelConfig) -> tuple[int, ...]:
    """Returns the number of samples of each proposal level, then of the radiance field."""
    return (*(proposal.samples for proposal in model.proposals), model.samples)


def grid_of(model: ModelConfig) -> HashGridConfig | None:
    """Returns the hash grid of a model's radiance field, if its field kind has one."""
    return model.field.grid if isinstance(model.field, hash_grid.GridRadianceConfig) else None


def sampling_of(model: ModelConfig) -> dict[str, Any]:
    """Returns the options of a model's samples, grid and precision, by name."""
    grid, field = grid_of(model), model.field
    return {
        "footprint": model.footprint,
        "samples_per_ray": samples_of(model),
        "multisamples": model.multisamples,
        "log2_hashmap_size": grid and grid.hashmap_size.bit_length() - 1,
        "max_res": grid and grid.max_res,
        "precision": model.field.precision,
        "dilation": model.dilation,
        "sub_spaces": field.sub_spaces if isinstance(field, msnerf.MsnerfConfig) else None,
        "gaussians": model.splats and model.splats.gaussians,
        "splat_filter": model.splats and model.splats.kernel,
    }


def schedule_of(schedule: ScheduleConfig) -> dict[str, Any]:
    """Returns the options of a schedule, by name."""
    return {
        "steps": schedule.steps,
        "warmup": schedule.warmup,
        "learning_rate": schedule.peak,
        "final_learning_rate": schedule.end,
        "anneal": schedule.anneal,
        "batch": schedule.batch,
        "pretraced_batches": schedule.pretraced_batches,
    }


def loss(model: ModelConfig) -> LossConfig:
    """Returns the training loss of a model, which is the same for all presets.

    Values that do not depend on the model are the defaults of `LossConfig`. The interlevel loss and
    its blurs are those of Zip-NeRF for every field kind.
    """
    finest, kind = len(_BLURS) - 1, registry.KINDS[model.field.kind]
    return LossConfig(
        blurs=tuple(_BLURS[min(i, finest)] for i in range(len(model.proposals))),
        hash_decay=kind.hash_decay,
        eikonal=kind.eikonal,
        curvature=kind.curvature,
        deformation_weights=kind.deformation,
    )


def losses_of(model: ModelConfig, asked: LossConfig) -> dict[str, Any]:
    """Returns the options of a loss that depend on the model, by name.

    Args:
      model: the model.
      asked: overrides.

    Raises:
      ValueError: if they have weights for a surface or a deformation that the field does not have.
    """
    bent = asked.deformation_weights
    if bent and not registry.has_deformation(model.field):
        raise ValueError(
            f"deformation_weights has no effect on field kind {model.field.kind}. Leave it out, or "
            "use field=raydef, raydef_polyline or rosenerf."
        )
    if bent and len(bent) != 3:
        raise ValueError(
            f"deformation_weights has {len(bent)} numbers. Give three, of bends, turns and size, "
            "such as 3e-3,1e-3,1e-4."
        )
    for name in _SURFACE:
        weight = getattr(asked, name)
        if weight is not None and not registry.has_surface(model.field):
            raise ValueError(
                f"{name}_weight={weight:g} has no effect on field kind {model.field.kind}, which "
                "has no surface. Leave it out, or use field=neus."
            )
    names = ("blurs", "hash_decay", "eikonal", "curvature", "deformation_weights")
    usual = {name: getattr(loss(model), name) for name in names}
    return {f"{name}_weight" if name in _SURFACE else name: x for name, x in usual.items()}


PRESETS = {
    "tiny": Preset(
        size="tiny",
        schedule=ScheduleConfig(
            steps=2500,
            warmup=100,
            peak=1e-2,
            end=1e-3,
            anneal=250,
            batch=1024,
            pretraced_batches=32,
        ),
        gaussians=20_000,
    ),
    "small": Preset(
        size="small",
        schedule=ScheduleConfig(
            steps=8000,
            warmup=300,
            peak=1e-2,
            end=1e-3,
            anneal=500,
            batch=2048,
            pretraced_batches=32,
        ),
        gaussians=50_000,
    ),
    "paper": Preset(
        size="paper",
        schedule=ScheduleConfig(
            steps=25_000,
            warmup=1000,
            peak=8e-3,
            end=1e-3,
            anneal=1000,
            batch=4096,
            pretraced_batches=32,
        ),
        gaussians=500_000,
    ),
    "best": Preset(
        size="best",
        schedule=ScheduleConfig(
            steps=25_000,
            warmup=1000,
            peak=1e-2,
            end=1e-3,
            anneal=1000,
            batch=16_384,
            pretraced_batches=8,
        ),
        gaussians=1_000_000,
    ),
}


def stretched(schedule: ScheduleConfig, steps: int) -> ScheduleConfig:
    """Returns the same schedule over another number of steps."""
    scale = steps / require(schedule.steps)
    warmup, anneal = (round(require(x) * scale) for x in (schedule.warmup, schedule.anneal))
    return dataclasses.replace(schedule, steps=steps, warmup=warmup, anneal=anneal)


def check_lengths(schedule: ScheduleConfig) -> None:
    """Refuses a warm-up or annealing that is longer than the run; earlier runs may have one.

    Raises:
      ValueError: if it is.
    """
    steps = require(schedule.steps)
    for name in ("warmup", "anneal"):
        if (number := require(getattr(schedule, name))) > steps:
            raise ValueError(f"{name} is {number}, but there are {steps} steps. Give fewer.")
