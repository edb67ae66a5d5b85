"""Trains a run that a folder holds, with a bar of progress, metrics, and checkpoints."""

import math
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jax.sharding import Mesh

from experiments.cli import app
from experiments.cli import scenes as cli_scenes
from experiments.cli.progress import ProgressBar
from refref_jax.data import local_layout, mask_margins
from refref_jax.data.batches import PixelSampler
from refref_jax.render import saved
from refref_jax.training import devices, loop, run_folder
from refref_jax.training.checkpoints import Checkpoints
from refref_jax.training.config import TrainingConfig
from refref_jax.training.objective import StepReport
from refref_jax.training.state import TrainState, init_state

# Steps that the device takes without the host, which sees an interrupt only between them.
_MOST_STEPS = 10


class Periods(NamedTuple):
    """How often things are done.

    Attributes:
      log: steps between two lines of metrics.
      checkpoint: steps between checkpoints.
      keep: newest checkpoints to keep.
    """

    log: int = 50
    checkpoint: int = 500
    keep: int = 2


USUAL = Periods()


def train(
    run: Path, *, scene: str | None = None, periods: Periods = USUAL, mesh: Mesh | None = None
) -> bool:
    """Trains the run of a folder from its newest checkpoint, or from the start.

    Ctrl-C saves a checkpoint, and ends it; before the first step it ends all. Of several processes
    all take the same steps and end together, and the first alone writes.

    Args:
      run: the folder.
      scene: where its scene is now, if it has moved.
      periods: of what is done every so many steps.
      mesh: the devices that train together; `None` for one alone.

    Returns:
      Whether it has reached its last step.

    Raises:
      KeyboardInterrupt: if it was interrupted before it took a step.
    """
    config, model = run_folder.read_config(run), saved.read_static(run)
    # From here on, for Python loses a Ctrl-C that meets JAX while it collects garbage.
    with Checkpoints(run, keep=periods.keep) as checkpoints, app.Interrupt() as interrupt:
        if checkpoints.newest() == config.schedule.steps:
            print(f"{run} is trained already: {config.schedule.steps} steps.")
            return True
        sampler = _sampler(config, cli_scenes.opened(scene or config.scene.path))
        geometry = saved.load_geometry(run)
        setup = loop.set_up(config, model.config, model.budget, geometry, sampler, mesh=mesh)
        if setup.hit_fraction == 0.0 and model.budget.bends > 0:
            print(
                "warning: no pixel sees the meshes, so no light is bent. Check that their units, "
                "axes and position are those of the cameras."
            )
        state = init_state(config.seed, model.config, config.schedule)
        state = devices.put_everywhere(state, mesh=mesh)
        if checkpoints.newest() is not None:
            state = checkpoints.restore(state)
        if devices.any_process(interrupt.requested):
            raise KeyboardInterrupt  # there is nothing to save yet
        return _train(run, setup, state, checkpoints, periods, interrupt)


def _sampler(config: TrainingConfig, scene: Path) -> PixelSampler:
    """Reads the pixels that a run learns from."""
    frames = local_layout.read_frames(scene, "train")
    kept = None
    if config.pixels == "background":
        kept = mask_margins.well_outside(local_layout.read_masks(frames))
    images = local_layout.read_images(frames)
    return PixelSampler(images, frames.cameras, seed=config.seed, batch=config.batch, kept=kept)


def _train(
    run: Path,
    setup: loop.Setup,
    state: TrainState,
    checkpoints: Checkpoints,
    periods: Periods,
    interrupt: app.Interrupt,
) -> bool:
    total, step = setup.config.schedule.steps, int(state.step)
    writes = devices.is_first()
    earlier = run_folder.rewind_metrics(run, step) if writes else 0.0
    start = last = time.monotonic()
    logged = step
    with ProgressBar("train", total, step) as bar:
        every = (_MOST_STEPS, periods.log, periods.checkpoint)
        for stepped, report in loop.run_steps(setup, state, total, every=every):
            step = int(stepped.step)
            if step % periods.log == 0 or step == total:
                report = jax.device_get(report)
                now = time.monotonic()
                rate = setup.config.batch * (step - logged) / (now - last)
                line = _line(step, report, rate, earlier + now - start)
                if writes:
                    run_folder.append_metrics(run, line)
                bar.show(step, f"loss {report.loss:.5f}  PSNR {report.psnr:.2f}  {rate:.0f} rays/s")
                last, logged = now, step
            stopping = devices.any_process(interrupt.requested)
            if step % periods.checkpoint == 0 or step == total or stopping:
                checkpoints.save(stepped)
            if stopping:
                break
    if step < total:
        print(f"Stopped at step {step}.")
    return step == total


def _line(step: int, report: StepReport, rate: float, seconds: float) -> dict[str, Any]:
    """Returns a line of metrics.

    Raises:
      ValueError: if the loss is not finite.
    """
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
    return app.string_safe(line)
