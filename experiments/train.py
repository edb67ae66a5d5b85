"""Trains a model of a scene.

python -m experiments.train --scene=experiments/data/cube_smcvx_ball --out=runs/ball

With --method=r3f the object is reconstructed from images and masks first, into {out}/r3f, and the
scene's own meshes are never read.
"""

import contextlib
import sys
from pathlib import Path

from absl import flags
from etils import epy

from experiments.cli import app
from experiments.cli import flags as cli_flags
from experiments.r3f import training_body
from experiments.runs import plans, processes

with epy.lazy_imports():
    from experiments.runs import trainer
    from refref_jax.training import devices, run_folder, run_lock

_OUT = cli_flags.out("Folder to write the run to.")

flags.adopt_module_key_flags(plans)
flags.adopt_module_key_flags(training_body)
_DEVICES = cli_flags.devices()
_RESUME = flags.DEFINE_bool("resume", False, "Continue the run in --out, if there is one.")
_LOG_EVERY = flags.DEFINE_integer("log_every", 50, "Steps between two lines of metrics.", 1)
_CHECKPOINT_EVERY = flags.DEFINE_integer("checkpoint_every", 500, "Steps between checkpoints.", 1)
_KEEP = flags.DEFINE_integer("keep", 2, "Newest checkpoints to keep.", 1)


def main() -> None:
    """Plans a run, or finds the one to resume, and trains it."""
    run = Path(_OUT.value)
    check_options()
    processes.connect(_DEVICES)
    with processes.first_speaks():
        if not _begin(run):
            print(f"Continue with {app.shell('train', f'--out={run}', '--resume')}")
            sys.exit(app.INTERRUPTED)
        print(f"Run: {run}  (metrics.jsonl, checkpoints/)")
        print(f"Next: {app.shell('evaluate', f'--run={run}', '--split=test')}")


def check_options() -> None:
    """Refuses what can be told of the options alone, before anything is imported.

    Raises:
      ValueError: if there is any.
    """
    if processes.together(_DEVICES) and training_body.reconstructs():
        raise ValueError(
            "Several processes do not reconstruct together. Run experiments.reconstruct on one "
            "machine first, and give its folder as --reconstruction."
        )
    plans.check_options(resume=_RESUME.value)
    training_body.check_options()


def _begin(run: Path) -> bool:
    """Begins a run, or goes on with it; returns whether it has reached its last step."""
    mesh = processes.mesh(_DEVICES)
    resuming = _RESUME.value and run_folder.exists(run)
    if not resuming:
        _open(run)
    elif plans.SCENE.value is not None:
        body = training_body.find(run, resume=True)
        run_folder.check_unchanged(run, *plans.plan_from_flags(body=body))
    else:
        _refuse_options(run)
    with run_lock.hold(run) if devices.is_first() else contextlib.nullcontext():
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
    app.run(
        main,
        again="a run is never replaced; the same command with --resume goes on with it.",
    )
