"""Checks a GPU, or another accelerator, against the CPU beside it, and measures its speed.

python -m experiments.accelerator_check --out=runs/check

Writes report.md and report.json: the environment and versions that are known to be slow; bandwidth,
random reads and additions in memory; closest hits, light paths and the gradient of a training step
against the CPU's; two trainings of some steps from the same state; time, compilation and memory of
tracing, training steps and rendering for each preset, and of the backdrop's solver. Each line has a
verdict, and is printed as soon as its part is done. Something that fails, for example because
memory runs out, becomes a line, too.

It takes a few minutes, trains on the bundled scene, and keeps no model. Without an accelerator it
compares the CPU with itself, and says so.
"""

from pathlib import Path

from absl import flags
from etils import epy

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags
from experiments.cli.progress import ProgressBar

with epy.lazy_imports():
    from experiments.accelerator import measuring, report

_OF_A_CPU, _OF_AN_ACCELERATOR = ("tiny",), ("tiny", "paper")

_SCENE = Path("experiments/data/cube_smcvx_ball")

_OUT = cli_flags.out("Folder for report.md and report.json.")
_PRESETS = flags.DEFINE_list(
    "presets",
    None,
    f"Presets whose programs are timed: {', '.join(cli_flags.PRESETS)}; by default "
    f"{','.join(_OF_AN_ACCELERATOR)} on an accelerator, {','.join(_OF_A_CPU)} on a CPU.",
)
_PARTS = flags.DEFINE_list(
    "parts", [], "Parts to run, by the beginnings of their headings in the report; by default all."
)
_STEPS = flags.DEFINE_integer("steps", 200, "Training steps of the repeated runs.", 2)
_OVERWRITE = cli_flags.overwrite("an earlier report")

_WRITES = ("report.md", "report.json")


def _check_presets(names: list[str] | None) -> None:
    for name in names or ():
        if name not in cli_flags.PRESETS:
            near = app.did_you_mean(name, cli_flags.PRESETS)
            raise ValueError(
                f"{name!r} is not a preset.{near} Choose from {', '.join(cli_flags.PRESETS)}."
            )


app.check(_PRESETS, _check_presets)


def main() -> None:
    """Runs all parts, and writes the report."""
    out = Path(_OUT.value)
    place = {"module": __name__, "writes": _WRITES, "overwrite": _OVERWRITE.value}
    outputs.replaceable(out, **place)
    context = measuring.find_context(Path(__file__).parents[1] / _SCENE, _STEPS.value)
    usual = _OF_AN_ACCELERATOR if context.compares else _OF_A_CPU
    print(f"{report.describe(context)}.", flush=True)
    everything = report.parts_of(tuple(dict.fromkeys(_PRESETS.value or usual)))
    parts = report.chosen(everything, _PARTS.value)
    results = []
    with outputs.fresh(out, **place) as draft:
        with ProgressBar("check", len(parts)) as bar:
            for part in parts:
                results.append(report.run_part(part, context))
                bar.show(len(results), part.name)
                print(report.in_words(results[-1]), flush=True)
        report.write(draft, context, results, parts=len(everything))
    for line in report.with_verdict(results, "problem", "failed"):
        print(line)
    print(f"{report.summary(results)}.")
    print(f"Report:   {out / 'report.md'}, {out / 'report.json'}")
    if context.compares and len(results) == len(everything):
        print("Please attach both to an issue of the project.")
    options = (f"--scene={_SCENE}", f"--preset={usual[-1]}", "--out=runs/ball")
    print(f"Next: {app.shell('train', *options)}")


if __name__ == "__main__":
    app.run(main, again="repeat the command to check again; no report was written.")
