"""Measures speed against accuracy: trains around a base point, changing one option at a time.

python -m experiments.trade_off --scene=experiments/data/cube_smcvx_ball --out=runs/trade_off

Every point is trained from the same seed by `experiments.train` and measured by
`experiments.evaluate`, each in a separate process. The outputs are trade_off.csv, one row per
point; trade_off.png, masked PSNR over time; and trade_off.md, tables of the most effective options.
Repeat the command to resume: finished points are skipped, and an interrupted one continues. Times
are those of this machine, which should be idle otherwise.

--base=NAME=VALUE changes the base, --values=NAME=A/B the values to try for an option. Both may be
repeated, and accept any option of `experiments.train`, and rays_per_pixel.

The base has a field or a backdrop, as `experiments.train` would choose for this scene and these
options; --far_field overrides this. Around a backdrop, the options are its resolution, iterations,
light paths and the rays per pixel of the evaluation, and the figure shows curves.
"""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from absl import flags
from etils import epy

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from experiments.sweeps import options
from refref_jax import choices
from refref_jax.training.config import require

if TYPE_CHECKING:
    from experiments.sweeps.points import Point

with epy.lazy_imports():
    from experiments.sweeps import far_fields, points, sweep
    from refref_jax.data import scene_folder

_SCENE = cli_flags.scene("The scene")
_OUT = cli_flags.out("Folder of the sweep.")
_FAR_FIELD = flags.DEFINE_enum(
    "far_field",
    None,
    get_args(choices.FarField),
    "Far field of the base; by default that of the table in --out, else as for training.",
)
_PRESET = cli_flags.preset("Preset of the base point, if it has a field.")
_SEED = cli_flags.seed("Seed of all trainings.")
_STEPS = flags.DEFINE_list(
    "steps",
    [],
    "Steps of the base point, if it has a field, then those of further trainings of it; by default "
    "those of the preset, and a quarter, half and twice as many.",
)
_BASE = flags.DEFINE_multi_string("base", [], "Base option, as in max_bends=6. May be repeated.")
_VALUES = flags.DEFINE_multi_string(
    "values", [], "Values to try for an option, as in max_bends=2/6. May be repeated."
)
_OPTIONS = flags.DEFINE_list("options", None, "Options to try; all by default.")
cli_flags.alias("knobs", "options")
app.check(_BASE, options.parse_base)
app.check(_VALUES, options.parse_values)
_POINTS = flags.DEFINE_list("points", None, "Points to measure with the base, as in max_bends=6.")
_LIMIT = cli_flags.limit()
_DRY_RUN = flags.DEFINE_bool("dry_run", False, "List the points without measuring them.")
cli_flags.allow_outside()


def main() -> None:
    """Measures all points and writes the report."""
    cli_scenes.check(_SCENE.value)
    chosen = points_from_flags(choose_far_field())
    if _DRY_RUN.value:
        for point in chosen:
            print(f"{point.name:24} {' '.join((*point.training, *point.evaluation))}")
        return
    scene, out = cli_scenes.opened(_SCENE.value), Path(_OUT.value)
    # If the sweep is killed, its training is stopped too.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    limit = () if _LIMIT.value is None else (f"--limit={_LIMIT.value}",)
    images = len(scene_folder.read_frames(scene, "test").names)
    images = min(images, _LIMIT.value or images)
    earlier = sweep.earlier_rows(out, chosen[0], scene, images=images)
    out.mkdir(parents=True, exist_ok=True)
    outputs.note(out, __name__)
    failed = sweep.sweep(
        chosen,
        out,
        lambda point: sweep.measure(point, scene, out / "runs", limit),
        earlier,
    )
    print(f"Table:  {out / 'trade_off.csv'}")
    print(f"Figure: {out / 'trade_off.png'}")
    print(f"Report: {out / 'trade_off.md'}")
    given = (f"--scene={_SCENE.value}", "--minutes=5", f"--table={out / 'trade_off.csv'}")
    print(f"Next: {app.shell('recommend', *given)}")
    for name, reason in failed.items():
        print(f"failed: {name}: {reason}", file=sys.stderr)
    if failed:
        sys.exit(1)


def choose_far_field() -> choices.FarField:
    """Returns the far field of the base, and prints it if it depends on the scene.

    Raises:
      ValueError: if an option of a field is given with a backdrop.
    """
    of_field = [flag.name for flag in (_PRESET, _STEPS) if flag.present]
    if _FAR_FIELD.value == "backdrop" and of_field:
        raise ValueError(
            f"--{of_field[0]} is an option of a field, which a backdrop does not read. Leave it "
            "out, or use --far_field=field."
        )
    names = [*of_field, *options.parse_base(_BASE.value), *options.parse_values(_VALUES.value)]
    names += [options.present_name(each).split("=")[0] for each in _OPTIONS.value or ()]
    names += [options.present_name(each).split("=")[0] for each in _POINTS.value or ()]
    if _FAR_FIELD.value is not None:
        return _FAR_FIELD.value
    if (found := far_fields.of_options(names)) or (found := far_fields.of_table(Path(_OUT.value))):
        return found
    base = options.parse_base(_BASE.value)
    resolved, _ = far_fields.prepare(cli_scenes.opened(_SCENE.value), base)
    print(far_fields.describe(resolved), flush=True)
    return require(resolved.config.model.far_field)


def points_from_flags(far_field: choices.FarField) -> list[Point]:
    """Returns the points that the flags select, around a base with a field or a backdrop."""
    common = {
        "seed": _SEED.value,
        "base": options.parse_base(_BASE.value),
        "values": options.parse_values(_VALUES.value),
        "vary": _OPTIONS.value,
    }
    if far_field == "backdrop":
        found = points.sweep_backdrop(**common)
    else:
        found = points.sweep(preset=_PRESET.value, steps=read_steps(_STEPS.value), **common)
    return found if _POINTS.value is None else points.choose(found, _POINTS.value)


def read_steps(words: list[str]) -> list[int]:
    """Parses a list of numbers of steps.

    Raises:
      ValueError: if one is not a positive integer.
    """
    try:
        steps = [int(word) for word in words]
    except ValueError as error:
        raise ValueError(
            f"--steps={','.join(words)} is not a list of numbers. Write as in --steps=2500,1000."
        ) from error
    if any(count < 1 for count in steps):
        raise ValueError(f"--steps={','.join(words)} contains a number below 1. Give 1 or more.")
    return steps


app.check(_STEPS, read_steps)


if __name__ == "__main__":
    app.run(main, again="repeat the command to resume; finished points are skipped.")
