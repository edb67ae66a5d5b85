"""Trains a model of a scene.

python -m experiments.train --scene=experiments/data/cube_smcvx_ball --out=runs/ball

With --method=r3f the object is reconstructed from images and masks first, into {out}/r3f, and the
scene's own meshes are never read.
"""

import contextlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from absl import flags

from experiments.cli import (
    command_line,
    commands,
    device_options,
    options,
    reconstruction_options,
    run_option,
    scenes,
)
from experiments.cli.late_imports import late
from experiments.r3f import training_body
from experiments.runs import plans

if TYPE_CHECKING:
    from experiments.runs import trainer
    from refref_jax import atomic_files
    from refref_jax.training import devices, run_folder
else:
    trainer = late("experiments.runs.trainer")
    atomic_files = late("refref_jax.atomic_files")
    devices = late("refref_jax.training.devices")
    run_folder = late("refref_jax.training.run_folder")

_OUT = options.out("Folder to write the run to.")

flags.adopt_module_key_flags(scenes)
flags.adopt_module_key_flags(plans)
flags.adopt_module_key_flags(training_body)
flags.adopt_module_key_flags(device_options)
flags.adopt_module_key_flags(reconstruction_options)
_RESUME = flags.DEFINE_bool("resume", False, "Continue the run in --out, if there is one.")
_LOG_EVERY = flags.DEFINE_integer("log_every", 50, "Steps between two lines of metrics.", 1)
_CHECKPOINT_EVERY = flags.DEFINE_integer("checkpoint_every", 500, "Steps between checkpoints.", 1)
_KEEP = flags.DEFINE_integer("keep", 2, "Newest checkpoints to keep.", 1)


def main() -> None:
    """Plans a run, or finds the one to resume, and trains it."""
    run = Path(_OUT.value)
    check_options()
    device_options.connect()
    with device_options.first_speaks():
        if not _begin(run):
            print(f"Continue with {commands.shell('train', f'--out={run}', '--resume')}")
            sys.exit(commands.INTERRUPTED)
        print(f"Run: {run}  (metrics.jsonl, checkpoints/)")
        print(f"Next: {commands.shell('evaluate', f'--run={run}', '--split=test')}")


def check_options() -> None:
    """Refuses what can be told of the options alone, before anything is imported.

    Raises:
      ValueError: if there is any.
    """
    if device_options.together() and training_body.reconstructs():
        raise ValueError(
            "Several processes do not reconstruct together. Run experiments.reconstruct on one "
            "machine first, and give its folder as --reconstruction."
        )
    plans.check_options(resume=_RESUME.value)
    training_body.check_options()


def _begin(run: Path) -> bool:
    """Begins a run, or goes on with it; returns whether it has reached its last step."""
    mesh = device_options.mesh()
    resuming = _RESUME.value and run_folder.exists(run)
    if not resuming:
        _open(run)
    elif plans.SCENE.value is not None:
        body = training_body.find(run, resume=True)
        run_folder.check_unchanged(run, *plans.plan_from_flags(body=body))
    else:
        _refuse_options(run)
    with atomic_files.hold(run) if devices.is_first() else contextlib.nullcontext():
        return trainer.train(
            run,
            scene=plans.SCENE.value,
            periods=trainer.Periods(_LOG_EVERY.value, _CHECKPOINT_EVERY.value, _KEEP.value),
            mesh=mesh,
        )


def _open(run: Path) -> None:
    """Plans a run and opens its folder; of several processes all plan, and the first opens."""
    run_folder.check_free(run)
    body = training_body.find(run, resume=_RESUME.value)
    plan = plans.plan_from_flags(body=body)
    devices.wait_for_all("all have planned, and nothing is written yet")
    if devices.is_first():
        training_body.note(run, body)
        run_folder.create(run, *plan)
    devices.wait_for_all("the folder is there")


def _settled() -> command_line.Settled | None:
    """Returns the options of the run that is resumed, unless all are given and compared."""
    run = Path(_OUT.value)
    if not _RESUME.value or plans.SCENE.value is not None or not (run / run_option.RUN).is_file():
        return None
    return command_line.Settled(_settled_names(), f"{run_option.RUN} and model.json in {run}")


def _settled_names() -> list[str]:
    return [holder.name for holder in (*plans.SETTLED, *training_body.SETTLED)]


def _refuse_options(run: Path) -> None:
    """Refuses options that a resumed run would not heed."""
    if given := [f"--{name}" for name in _settled_names() if flags.FLAGS[name].present]:
        raise ValueError(
            f"{run} goes on with the options that it was begun with: {', '.join(given)} would have "
            "no effect. Leave it out, or add --scene to have all options compared."
        )


if __name__ == "__main__":
    commands.run(
        main,
        first=(
            *("scene", "preset", "steps", "paths", "cut", "bends", "interior", "ior", "rule"),
            *("background", "radius", "samples", "entries", "batch", "method", "reconstruction"),
            *("resume", "seed", "devices"),
        ),
        again="a run is never replaced; the same command with --resume goes on with it.",
        settled=_settled,
    )
