"""Trains a model of a scene.

python -m experiments.train --scene=experiments/data/cube_smcvx_ball --out=runs/ball

With --method=r3f the object is reconstructed from images and masks first, into {out}/r3f, and the
scene's own meshes are never read.
"""

import math
import sys
import time
from pathlib import Path

import jax
from absl import flags

from experiments import commands, plans, reconstruction_options, scene_option, scenes, training_body
from refref_jax.data import local_layout
from refref_jax.data.batches import PixelSampler
from refref_jax.render import saved
from refref_jax.training import loop, run_folder, run_lock
from refref_jax.training.checkpoints import Checkpoints
from refref_jax.training.state import TrainState, init_state
from refref_jax.training.steps import StepReport

flags.adopt_module_key_flags(scenes)
flags.adopt_module_key_flags(plans)
flags.adopt_module_key_flags(training_body)
flags.adopt_module_key_flags(reconstruction_options)
_OUT = flags.DEFINE_string("out", None, "Folder to write the run to.", required=True)
_RESUME = flags.DEFINE_bool("resume", False, "Continue the run in --out, if there is one.")
_LOG_EVERY = flags.DEFINE_integer("log_every", 50, "Steps between two lines of metrics.", 1)
_CHECKPOINT_EVERY = flags.DEFINE_integer("checkpoint_every", 500, "Steps between checkpoints.", 1)
_KEEP = flags.DEFINE_integer("keep", 2, "Newest checkpoints to keep.", 1)

# Steps that the device takes without the host, which sees an interrupt only between them.
_MOST_STEPS = 10


def main() -> None:
    """Plans a run, or finds the one to resume, and trains it."""
    run = Path(_OUT.value)
    if not _begin(run):
        sys.exit(commands.INTERRUPTED)
    print(f"Run: {run}  (metrics.jsonl, checkpoints/)")
    print(f"Next: {commands.shell('evaluate', f'--run={run}', '--split=test')}")


def _begin(run: Path) -> bool:
    """Begins a run, or goes on with it; returns whether it has reached its last step."""
    resuming = _RESUME.value and run_folder.exists(run)
    if not resuming:
        run_folder.check_free(run)
        body = training_body.find(run, resume=_RESUME.value)
        plan = plans.plan_from_flags(body=body)
        training_body.note(run, body)
        run_folder.create(run, *plan)
    elif plans.SCENE.value is not None:
        body = training_body.find(run, resume=True)
        run_folder.check_unchanged(run, *plans.plan_from_flags(body=body))
    else:
        _refuse_options(run)
    with run_lock.hold(run):
        return train(run)


def _refuse_options(run: Path) -> None:
    """Refuses options that a resumed run would not heed."""
    names = [holder.name for holder in (*plans.SETTLED, *training_body.SETTLED)]
    if given := [f"--{name}" for name in names if flags.FLAGS[name].present]:
        raise ValueError(
            f"{run} goes on with the options that it was begun with: {', '.join(given)} would have "
            "no effect. Leave it out, or add --scene to have all options compared."
        )


def train(run: Path) -> bool:
    """Trains the run of a folder from its newest checkpoint, or from the start.

    Returns:
      Whether it has reached its last step.
    """
    config, model = run_folder.read_config(run), saved.read_static(run)
    with Checkpoints(run, keep=_KEEP.value) as checkpoints:
        if checkpoints.newest() == config.schedule.steps:
            print(f"{run} is trained already: {config.schedule.steps} steps.")
            return True
        scene = scene_option.opened(plans.SCENE.value or config.scene.path)
        frames = local_layout.read_frames(scene, "train")
        sampler = PixelSampler(
            local_layout.read_images(frames), frames.cameras, seed=config.seed, batch=config.batch
        )
        geometry = saved.load_geometry(run)
        setup = loop.set_up(config, model.config, model.budget, geometry, sampler)
        if setup.hit_fraction == 0.0 and model.budget.bends > 0:
            print(
                "warning: no pixel sees the meshes, so no light is bent. Check that their units, "
                "axes and position are those of the cameras."
            )
        state = init_state(config.seed, model.config, config.schedule)
        if checkpoints.newest() is not None:
            state = checkpoints.restore(state)
        return _train(run, setup, state, checkpoints)


def _train(run: Path, setup: loop.Setup, state: TrainState, checkpoints: Checkpoints) -> bool:
    total, step = setup.config.schedule.steps, int(state.step)
    earlier = run_folder.rewind_metrics(run, step)
    interrupt = commands.Interrupt()
    start = last = time.monotonic()
    logged = step
    with commands.ProgressBar("train", total, step) as bar:
        every = (_MOST_STEPS, _LOG_EVERY.value, _CHECKPOINT_EVERY.value)
        for stepped, report in loop.run_steps(setup, state, total, every=every):
            step = int(stepped.step)
            if step % _LOG_EVERY.value == 0 or step == total:
                report = jax.device_get(report)
                now = time.monotonic()
                rate = setup.config.batch * (step - logged) / (now - last)
                _log(run, step, report, rate, earlier + now - start)
                bar.show(step, f"loss {report.loss:.5f}  PSNR {report.psnr:.2f}  {rate:.0f} rays/s")
                last, logged = now, step
            if step % _CHECKPOINT_EVERY.value == 0 or step == total or interrupt.requested:
                checkpoints.save(stepped)
            if interrupt.requested:
                break
    if step < total:
        print(f"Stopped at step {step}. Continue with --resume --out={run}.")
    return step == total


def _log(run: Path, step: int, report: StepReport, rate: float, seconds: float) -> None:
    if not math.isfinite(report.loss):
        raise ValueError(
            f"The loss is {report.loss} at step {step}. Evaluate the last checkpoint, which is "
            "finite, or train again with another --seed and --out; and please report the scene."
        )
    values = {name: float(value) for name, value in report._asdict().items()}
    line = {"step": step, **values, "rays_per_second": rate, "seconds": seconds}
    # A CPU keeps no such record.
    if (memory := jax.local_devices()[0].memory_stats()) is not None:
        line["peak_device_bytes"] = memory["peak_bytes_in_use"]
    # The PSNR of a batch that is met exactly is infinite.
    run_folder.append_metrics(run, commands.string_safe(line))


if __name__ == "__main__":
    commands.run(main)
