"""Trains a model of a scene.

python -m experiments.train --scene=experiments/data/cube_smcvx_ball --out=runs/ball
python -m experiments.train --config=runs/ball/config.json --out=runs/again

With --method=r3f the object is first reconstructed from images and masks, into {out}/r3f, and the
scene's own meshes are never read.
"""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from absl import flags

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from experiments.cli.progress import ProgressBar
from experiments.r3f import training_body
from experiments.runs import config_flags, processes
from refref_jax.optics.path_settings import make_path_settings
from refref_jax.training.config import TrainConfig

if TYPE_CHECKING:
    from refref_jax.data.meshes import MeshPart

_OUT = cli_flags.out("Folder of the run.")
_CONFIG = config_flags.define_flags()
flags.adopt_module_key_flags(config_flags)
flags.adopt_module_key_flags(training_body)
_DEVICES = cli_flags.devices()
_RESUME = flags.DEFINE_bool("resume", False, "Continue the run in --out, if there is one.")
_LOG_EVERY = flags.DEFINE_integer("log_every", 50, "Steps between two lines of metrics.", 1)
_CHECKPOINT_EVERY = flags.DEFINE_integer("checkpoint_every", 500, "Steps between checkpoints.", 1)
_KEEP = flags.DEFINE_integer("keep", 2, "Number of newest checkpoints to keep.", 1)
cli_flags.allow_outside()


def main() -> None:
    """Resolves a new run, or the one to resume, and trains it."""
    run = Path(_OUT.value)
    asked = check_flags()
    processes.connect(_DEVICES)
    with processes.first_speaks():
        if not _train(run, asked):
            print(f"Continue with {app.shell('train', f'--out={run}', '--resume')}")
            sys.exit(app.INTERRUPTED)
        print(f"Run: {run}  (config.json, metrics.jsonl, checkpoints/)")
        print(f"Next: {app.shell('evaluate', f'--run={run}', '--split=test')}")


def check_flags() -> TrainConfig:
    """Rejects flags that are invalid for any scene, before JAX is imported.

    Returns:
      The configuration: the file of --config, overridden by flags.

    Raises:
      ValueError: if a flag is invalid, or no scene is set.
    """
    run = Path(_OUT.value)
    if not _RESUME.value and (run / cli_flags.RUN).is_file():
        raise ValueError(
            f"{run} already contains a run. Continue it with --resume, or give another --out."
        )
    say = (lambda line: None) if _DEVICES.process.value else print
    scene, config = _CONFIG["scene"].value, training_body.asked(_CONFIG, say=say)
    if processes.together(_DEVICES) and training_body.reconstructs(config):
        raise ValueError(
            "Several processes cannot reconstruct together. Run experiments.reconstruct on one "
            "machine first, and pass its folder as --reconstruction."
        )
    cli_scenes.check((config.scene.path or None) if scene is None else scene)
    if scene is None and flags.FLAGS["config"].value is None and not _RESUME.value:
        raise ValueError(
            "No scene is given. Add --scene=FOLDER, or --resume to continue a run, or "
            "--config=FILE."
        )
    cli_flags.check_properties(config.scene.properties)
    training_body.check_flags(config, _CONFIG)
    if config.paths.name is not None:
        make_path_settings(
            config.paths.name,
            min_throughput=config.paths.min_throughput,
            max_bends=config.paths.max_bends,
        )
    outputs.check_folder(run)
    return config


def _train(run: Path, asked: TrainConfig) -> bool:
    """Starts or resumes a run; returns whether it has reached its last step."""
    from refref_jax.training import devices, fit

    existing = "resume" if _RESUME.value else "refuse"
    resuming, mesh = fit.is_resumed(run, existing), processes.mesh(_DEVICES)
    given, parts, config = asked.scene.reconstruction, None, None
    if resuming and _CONFIG["scene"].value is None:
        _refuse_flags(run)
    else:
        config, parts = _with_object(run, asked)
    interrupt, bar = app.Interrupt(), ProgressBar("train", 0)
    with contextlib.ExitStack() as stack:

        def ready() -> None:
            if not resuming and devices.is_first():
                training_body.note(run, parts, given)
            stack.enter_context(interrupt)
            stack.enter_context(bar)

        return fit.train_into(
            run,
            config,
            existing=existing,
            parts=parts,
            ready=ready,
            progress=bar.move,
            stop=lambda: interrupt.requested,
            periods=fit.Periods(_LOG_EVERY.value, _CHECKPOINT_EVERY.value, _KEEP.value),
            mesh=mesh,
        )


def _with_object(run: Path, asked: TrainConfig) -> tuple[TrainConfig, list[MeshPart] | None]:
    """Returns the configuration with the scene's folder, and a reconstructed object's parts."""
    if not asked.scene.path:
        raise ValueError("The configuration has no scene. Add --scene=FOLDER.")
    config = asked.at(str(cli_scenes.opened(asked.scene.path).resolve()))
    ior = _CONFIG["ior"].value or ()
    parts = training_body.find(run, config, ior=ior, resume=_RESUME.value)
    if parts is not None:
        made = training_body.folder(run, config.scene.reconstruction)
        config = training_body.with_parts(config, parts, made, run=run, ior=ior, say=print)
    return config, parts


def _refuse_flags(run: Path) -> None:
    """Rejects flags that a resumed run would ignore."""
    ignored = [*_CONFIG, "config", *(holder.name for holder in training_body.FLAGS)]
    if given := [f"--{name}" for name in ignored if flags.FLAGS[name].present]:
        raise ValueError(
            f"{run} resumes with its original options: {', '.join(given)} would have no effect. "
            "Remove them, or add --scene to compare all options."
        )


if __name__ == "__main__":
    app.run(
        main,
        again="repeat the command with --resume to continue; a run is never replaced.",
    )
