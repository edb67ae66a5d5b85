"""The points of a sweep: a base, and variants with one changed option each.

An option is one of `experiments.train`, or `rays_per_pixel` of `experiments.evaluate`. A point is
named after its option and value, as in `min_throughput=0.01`; commas become `+`, so that points can
be listed.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from experiments.cli import app
from experiments.sweeps.options import OF_EVALUATION, present_name
from refref_jax.fields import registry
from refref_jax.optics.path_settings import PATH_PRESETS
from refref_jax.sampling.scene_bounds import Bounds
from refref_jax.training import presets
from refref_jax.training.config import BACKDROP_ONLY, FIELD_ONLY
from refref_jax.training.presets import PRESETS

BASE = "base"

_BASE_OPTIONS = {"paths": "tree"}

_OF_BENT_PATHS = ("min_throughput", "max_bends", "interior", "reentry", "tints")

_NOT_OF_BASE = ("preset", "seed", "steps", "far_field", "scene", "out", "resume", "run", "limit")

_BACKDROP = {"far_field": "backdrop"}

_ANY_BOUNDS = Bounds(near=0.05, far=20.0, radius=7.3, space="bounded")


class Point(NamedTuple):
    """One training and one evaluation.

    Attributes:
      name: `base`, or option and value.
      option: changed option; empty for the base.
      value: value of that option; empty for the base.
      training: options of `experiments.train`, as `--name=value`, without scene and folder.
      evaluation: options of `experiments.evaluate`, likewise.
    """

    name: str
    option: str
    value: str
    training: tuple[str, ...]
    evaluation: tuple[str, ...]


def sweep(
    *,
    preset: str,
    seed: int = 0,
    steps: Sequence[int] = (),
    base: Mapping[str, str] | None = None,
    values: Mapping[str, Sequence[str]] | None = None,
    vary: Sequence[str] | None = None,
) -> list[Point]:
    """Returns the base and all points around it; a point that equals the base is left out.

    Straight rays have no throughput threshold, bends or interior, so these options are not combined
    with them.

    Args:
      preset: preset of the base.
      seed: seed of all trainings.
      steps: number of steps of the base, then those of further trainings; by default the preset's
        own, and a quarter, half and twice of them. A single number keeps the steps constant.
      base: options of the base that override the preset.
      values: values of an option, in place of those of `default_values`; new options are added.
      vary: names of the options to vary; all if `None`.

    Raises:
      ValueError: if a preset or option does not exist, or the base sets an option of the sweep
      itself.
    """
    if preset not in PRESETS:
        raise ValueError(f"There is no preset {preset}. Choose from {', '.join(PRESETS)}.")
    _check_base(base or {})
    usual = PRESETS[preset].schedule.steps
    first, *others = steps or (usual, usual // 4, usual // 2, 2 * usual)
    base = _BASE_OPTIONS | dict(base or {})
    options = {"preset": preset, "seed": str(seed), "steps": str(first)} | base
    field = base.get("field", registry.USUAL)
    if field not in registry.KINDS:
        raise ValueError(
            f"--base=field={field} does not exist. Choose from {', '.join(registry.KINDS)}."
        )
    swept = (
        default_values(preset, field=field)
        | {"steps": tuple(map(str, others))}
        | dict(values or {})
    )
    known = own_values(preset, base["paths"], field=field)
    return _around(options, known, _varied(swept, vary))


def sweep_backdrop(
    *,
    seed: int = 0,
    base: Mapping[str, str] | None = None,
    values: Mapping[str, Sequence[str]] | None = None,
    vary: Sequence[str] | None = None,
) -> list[Point]:
    """Returns the points of a sweep whose base has a backdrop; see `sweep`.

    A backdrop is fitted to one traced ray per pixel, whose footprint covers the pixel, so the
    number of rays per pixel is an option of the evaluation alone.

    Args:
      seed: seed of the points that train a field; a backdrop has no random numbers.
      base: options of the base.
      values: values of an option, in place of the usual ones; new options are added.
      vary: names of the options to vary; all if `None`.

    Raises:
      ValueError: if an option does not exist, the base sets an option of the sweep itself, or an
        option is one of a field.
    """
    _check_base(base or {})
    if of_field := [name for name in (*(base or {}), *(values or {})) if name in FIELD_ONLY]:
        raise ValueError(
            f"{of_field[0]} is an option of a field, which a backdrop does not read. Leave it out, "
            "or use --far_field=field."
        )
    options = _BACKDROP | {"seed": str(seed)} | _BASE_OPTIONS | dict(base or {})
    if options["paths"] == "straight":
        raise ValueError(
            "A backdrop is not solved along straight rays. Use --base=paths=tree or "
            "--far_field=field."
        )
    known = own_backdrop_values(options["paths"])
    swept = default_backdrop_values() | dict(values or {})
    return _around(options, known, _varied(swept, vary))


def _check_base(base: Mapping[str, str]) -> None:
    if misplaced := [name for name in _NOT_OF_BASE if name in base]:
        raise ValueError(
            f"--base={misplaced[0]}=... conflicts with the points. Use --{misplaced[0]}."
        )
    if (paths := base.get("paths", "tree")) not in PATH_PRESETS:
        raise ValueError(
            f"--base=paths={paths} does not exist. Choose from {', '.join(PATH_PRESETS)}."
        )


def _varied(
    swept: Mapping[str, Sequence[str]], vary: Sequence[str] | None
) -> Mapping[str, Sequence[str]]:
    """Returns the values of the options to vary."""
    if vary is None:
        return swept
    vary = [present_name(name) for name in vary]
    if unknown := [name for name in vary if name not in swept]:
        raise ValueError(
            f"There is no option {unknown[0]}.{app.did_you_mean(unknown[0], swept)} "
            f"Choose from {', '.join(swept)}, or give its "
            f"values with --values={unknown[0]}=A/B."
        )
    return {name: swept[name] for name in vary}


def _around(
    options: Mapping[str, str], own: Mapping[str, str], swept: Mapping[str, Sequence[str]]
) -> list[Point]:
    """Returns the base with some options, and its variants; `own` has the values of the others."""
    known = {**own, **options}
    points = [_point(options, "", "")]
    points += [
        _point(options, name, value)
        for name, alternatives in swept.items()
        for value in alternatives
        if not _same(value, known.get(name))
        and not (options["paths"] == "straight" and name in _OF_BENT_PATHS)
    ]
    return points


def own_backdrop_values(paths: str = "tree") -> dict[str, str]:
    """Returns the options' values that apply by default with a backdrop, along some paths."""
    return {
        "backdrop_resolution": str(presets.BACKDROP_RESOLUTION),
        "iterations": str(presets.BACKDROP_ITERATIONS),
        "min_throughput": str(PATH_PRESETS[paths].min_throughput),
        "max_bends": str(PATH_PRESETS[paths].max_bends),
        "rays_per_pixel": "1",
    }


def default_backdrop_values() -> dict[str, tuple[str, ...]]:
    """Returns the values of each option that a sweep around a backdrop tries.

    The last is the field of the smallest preset, for comparison.
    """
    return {
        "backdrop_resolution": ("128", "256", "512", "768"),
        "iterations": ("8", "16", "24", "48"),
        "rays_per_pixel": ("1", "4", "9"),
        "paths": ("paper", "tree"),
        "min_throughput": ("0.1", "0.05", "0.02", "0.01", "0.005"),
        "max_bends": ("2", "6", "10", "24"),
        "far_field": ("field",),
    }


def own_values(preset: str, paths: str = "tree", *, field: str = registry.USUAL) -> dict[str, str]:
    """Returns the options' values that apply by default.

    Args:
      preset: name of a preset.
      paths: name of path settings.
      field: kind of the fields.
    """
    model = PRESETS[preset].model(_ANY_BOUNDS, "field", field=field)
    grid = presets.grid_of(model)
    of_grid = {}
    if grid is not None:
        size = grid.hashmap_size.bit_length() - 1
        of_grid = {"log2_hashmap_size": str(size), "max_res": str(grid.max_res)}
    return {
        "field": field,
        "samples_per_ray": ",".join(map(str, presets.samples_of(model))),
        "multisamples": str(model.multisamples),
        **of_grid,
        "footprint": model.footprint,
        "precision": model.field.precision,
        "min_throughput": str(PATH_PRESETS[paths].min_throughput),
        "max_bends": str(PATH_PRESETS[paths].max_bends),
        "rays_per_pixel": "1",
    }


def default_values(preset: str, *, field: str = registry.USUAL) -> dict[str, tuple[str, ...]]:
    """Returns the values of each option that a sweep tries: some below and some above the preset's.

    For interiors this is the paper's field; the base has the interior that the scene requires.
    """
    own = own_values(preset, field=field)
    rounds = [int(count) for count in own["samples_per_ray"].split(",")]
    of_grid = {}
    if "max_res" in own:
        size, finest = int(own["log2_hashmap_size"]), int(own["max_res"])
        of_grid = {
            "log2_hashmap_size": tuple(str(size + more) for more in (-3, -2, -1, 1, 2)),
            "max_res": tuple(str(round(share * finest)) for share in (0.25, 0.5, 2, 4)),
        }
    return {
        "paths": ("straight", "paper", "tree"),
        "min_throughput": ("0.1", "0.05", "0.02", "0.01", "0.005"),
        "max_bends": ("2", "6", "10", "24"),
        "samples_per_ray": tuple(
            ",".join(str(round(share * count)) for count in rounds) for share in (0.5, 0.75, 1.5, 2)
        ),
        "multisamples": ("1", "6"),
        **of_grid,
        "interior": ("field",),
        "footprint": ("cone", "differential"),
        "precision": ("float32", "bfloat16"),
        "rays_per_pixel": ("1", "4", "9"),
    }


def choose(points: Sequence[Point], names: Sequence[str]) -> list[Point]:
    """Returns the points with these names, and the base, for comparison.

    Raises:
      ValueError: if a point does not exist.
    """
    known, names = [point.name for point in points], [present_name(name) for name in names]
    if unknown := [name for name in names if name not in known]:
        near = app.did_you_mean(unknown[0], known)
        raise ValueError(f"There is no point {unknown[0]}.{near} Choose from {', '.join(known)}.")
    return [point for point in points if point.name in {BASE, *names}]


def _point(base: Mapping[str, str], option: str, value: str) -> Point:
    options = {**base, option: value} if option else dict(base)
    if options["paths"] == "straight":
        options = {name: each for name, each in options.items() if name not in _OF_BENT_PATHS}
    if options.get("far_field") == "field":
        options = {name: each for name, each in options.items() if name not in BACKDROP_ONLY}
    evaluation = {name: options.pop(name) for name in OF_EVALUATION if name in options}
    return Point(
        name=f"{option}={value}".replace(",", "+") if option else BASE,
        option=option,
        value=value,
        training=tuple(f"--{name}={each}" for name, each in options.items()),
        evaluation=tuple(f"--{name}={each}" for name, each in evaluation.items()),
    )


def _same(value: str, other: str | None) -> bool:
    """Returns whether two values are equal as text or as numbers."""
    try:
        return other is not None and [*map(float, value.split(","))] == [
            *map(float, other.split(","))
        ]
    except ValueError:
        return value == other
