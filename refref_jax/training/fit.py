"""Trains a model of a scene, in a folder from which it can be resumed, evaluated and rendered.

    config = TrainConfig().override(scene="experiments/data/cube_smcvx_ball", steps=50)
    model = fit(config, out="runs/fifty")

`fit` consists of three functions that can also be called separately: `prepare` resolves a
configuration, `begin` creates the run folder, and `train` takes the remaining steps. `train_into`
calls them in this order; the command `train` calls it as well.
"""

import contextlib
import functools
import math
import operator
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Bool

from refref_jax import atomic_files, compilation, configuration
from refref_jax.compilation import at_once
from refref_jax.data import image_files, scene_analysis, scene_folder, scene_source
from refref_jax.data.batches import PixelSampler
from refref_jax.data.meshes import MeshPart
from refref_jax.optics.media import Scene
from refref_jax.render import checkpoint_io
from refref_jax.render.checkpoint_io import SavedModel
from refref_jax.render.model import Model, ModelConfig, Params, has_foreground
from refref_jax.training import (
    backdrop_fit,
    devices,
    learned_surface,
    loop,
    run_folder,
)
from refref_jax.training.config import TrainConfig, require
from refref_jax.training.loop import TrainState, init_state
from refref_jax.training.objective import gains
from refref_jax.training.resolve import Resolved, build_scene, read_facts, resolve
from refref_jax.training.run_folder import Checkpoints

# Number of steps between returns to the host, which only then handles interrupts.
_MOST_STEPS = 10

Existing = Literal["refuse", "resume"]

Progress = Callable[[int, int, str], None]
"""Function of the number of steps taken, their total, and a line of text on the last step."""


class Periods(NamedTuple):
    """Periods of logging and checkpoints.

    Attributes:
      log: number of steps between two lines of metrics.
      checkpoint: number of steps between checkpoints.
      keep: number of the newest checkpoints to keep.
    """

    log: int = 50
    checkpoint: int = 500
    keep: int = 2


USUAL = Periods()


def fit(
    config: TrainConfig | None,
    *,
    out: str | Path | None = None,
    existing: Existing = "refuse",
    parts: Sequence[MeshPart] | None = None,
    progress: Progress = lambda step, total, text: None,
    report: Callable[[str], None] = print,
    stop: Callable[[], bool] = lambda: False,
    periods: Periods = USUAL,
    mesh: Mesh | None = None,
) -> Model:
    """Trains a model of a scene, or resumes a run, and returns the model.

    The folder holds the complete configuration (`config.json`), which reproduces the run: on a CPU
    bit for bit.

    Args:
      config: configuration of the run, which must agree with that of a resumed run; `None` to
        resume a run with its own configuration.
      out: folder of the run, which must not contain a run yet; a temporary one if `None`.
      existing: `refuse` or `resume` a run that is in `out` already.
      parts: objects that take the place of the scene's own meshes.
      progress: function called every `periods.log` steps.
      report: function that receives decisions and warnings, as lines of text.
      stop: function called between steps; if it returns `True`, a checkpoint is saved, and the
        model is returned as it is.
      periods: periods of metrics and checkpoints.
      mesh: devices that train together; `None` for a single device.

    Raises:
      ValueError: if the configuration, the scene or the folder is not suitable for training.
      KeyboardInterrupt: if `stop` returned `True` before the first step.
    """
    compilation.add_missing_flags()
    with contextlib.ExitStack() as stack:
        if out is None:
            out = stack.enter_context(tempfile.TemporaryDirectory(prefix="refref_jax_"))
        how: dict[str, Any] = {"existing": existing, "parts": parts, "periods": periods}
        how |= {"progress": progress, "report": report, "stop": stop, "mesh": mesh}
        train_into(Path(out), config, **how)
        return checkpoint_io.load_model(out)


def train_into(
    run: Path,
    config: TrainConfig | None,
    *,
    existing: Existing = "refuse",
    parts: Sequence[MeshPart] | None = None,
    ready: Callable[[], None] = lambda: None,
    report: Callable[[str], None] = print,
    **options: Any,
) -> bool:
    """Trains like `fit`, but leaves the model in the run folder.

    Args:
      run: folder of the run.
      config: configuration of the run; `None` resumes the run with its own.
      existing: `refuse` or `resume` a run that is in the folder.
      parts: objects that replace the scene's own meshes.
      ready: function that is called once everything is resolved, before the folder is created.
      report: function that receives the resolved options and warnings, as lines of text.
      **options: options of `train`.

    Returns:
      Whether the run has reached its last step.
    """
    resuming = is_resumed(run, existing)
    if config is None and not resuming:
        raise ValueError(
            f"Without a configuration a run is resumed, but {run} holds none, or existing is "
            "not 'resume'. Give a configuration, or existing='resume' and the folder of a run."
        )
    if config is None:
        ready()
        return train(run, report=report, **options)
    resolved, scene = prepare(config, parts=parts, report=report)
    report(resolved.describe())
    # `ready` may write into the folder, which every process must have found free before.
    devices.wait_for_all("all have resolved the configuration")
    ready()
    open_ = run_folder.check_unchanged if resuming else begin
    open_(run, resolved.config, resolved.model, scene)
    # The scene may have moved since the folder was written.
    return train(run, scene=resolved.config.scene.path, report=report, **options)


def is_resumed(run: Path, existing: Existing) -> bool:
    """Returns whether an existing run is resumed.

    Raises:
      ValueError: if it is not, and no run can be created there.
    """
    if existing == "resume" and run_folder.exists(run):
        return True
    run_folder.check_free(run)
    return False


def prepare(
    config: TrainConfig,
    *,
    parts: Sequence[MeshPart] | None = None,
    report: Callable[[str], None] = print,
) -> tuple[Resolved, Scene]:
    """Reads the scene of a configuration and takes all open decisions.

    Args:
      config: configuration of the run.
      parts: objects that replace the scene's own meshes.
      report: function that receives the results of the checks of the scene, as lines of text.

    Raises:
      ValueError: if the scene is missing or broken, or the configuration contradicts it.
    """
    if not config.scene.path:
        raise ValueError("No scene is given. Set scene to a folder, or to hf:CONFIG/SCENE.")
    if config.scene.reconstruction and parts is None:
        raise ValueError(
            f"The object of this configuration was reconstructed ({config.scene.reconstruction}), "
            "which fit does not read. Give its mesh as parts."
        )
    config = config.at(str(scene_source.open_scene(config.scene.path).resolve()))
    if config.scene.properties:
        config = config.decided(properties=str(Path(config.scene.properties).resolve()))
    if config.model.far_field is None and jax.process_count() > 1:
        config = config.decided(far_field="field")  # one process solves a backdrop
    facts = read_facts(config.scene, parts=parts)
    for note in facts.notes:
        report(note)
    resolved = resolve(config, facts)
    report(scene_analysis.describe(facts.analysis))
    return resolved, build_scene(resolved, facts)


def begin(run: Path, config: TrainConfig, model: SavedModel, scene: Scene) -> None:
    """Creates a run folder; with several processes, the first one creates it when all are ready.

    Args:
      run: folder of the run.
      config: complete configuration.
      model: static part of the model.
      scene: surfaces and interfaces of the objects.

    Raises:
      ValueError: if the folder contains a run already.
    """
    devices.wait_for_all("all have planned, and nothing is written yet")
    if devices.is_first():
        run_folder.create(run, config, model, scene)
    devices.wait_for_all("the folder is there")


def train(
    run: Path,
    *,
    scene: str | Path | None = None,
    progress: Progress = lambda step, total, text: None,
    report: Callable[[str], None] = print,
    stop: Callable[[], bool] = lambda: False,
    periods: Periods = USUAL,
    mesh: Mesh | None = None,
) -> bool:
    """Trains the run of a folder from its newest checkpoint, or from the start.

    Several processes take the same steps and end together; only the first one writes files.

    Args:
      run: folder of the run.
      scene: new path of its scene, if the scene has moved.
      progress: function called every `periods.log` steps.
      report: function that receives warnings and the final status, as lines of text.
      stop: function called between steps; if it returns `True`, a checkpoint is saved and training
        ends.
      periods: periods of metrics and checkpoints.
      mesh: devices that train together; `None` for a single device.

    Returns:
      Whether the run has reached its last step.

    Raises:
      KeyboardInterrupt: if `stop` returned `True` before the first step.
    """
    config, model = run_folder.read_config(run), checkpoint_io.read_static(run)
    lock = atomic_files.hold(run) if devices.is_first() else contextlib.nullcontext()
    with lock, Checkpoints(run, keep=periods.keep) as checkpoints:
        surface = model.config.backdrop is not None
        solved = surface and not has_foreground(model.config)
        total = require(config.model.iterations if solved else config.schedule.steps)
        if checkpoints.newest() == total:
            report(f"{run} is trained already: {total} {'iterations' if solved else 'steps'}.")
            return True
        if surface and jax.process_count() > 1:
            raise ValueError(
                f"{run} has far_field=backdrop, which one process solves, but there are "
                f"{jax.process_count()}. Run it in one."
            )
        folder = scene_source.open_scene(scene or config.scene.path)
        devices.in_all(lambda: _check_images(run, folder))
        objects, log = checkpoint_io.load_scene(run), _Log(periods, progress, stop)
        if model.config.splats is not None:
            step = _train_splats(run, config, model.config, folder, checkpoints, log, mesh)
        elif solved:
            step = backdrop_fit.solve(
                run, config, model, objects, folder, checkpoints, progress, stop
            )
        else:
            step = _train_field(run, config, model, objects, folder, checkpoints, log, report, mesh)
    if step < total:
        report(f"Stopped at {'iteration' if solved else 'step'} {step}.")
    return step == total


def _check_images(run: Path, folder: Path) -> None:
    if devices.is_first():
        run_folder.check_images(run, scene_folder.read_frames(folder, "train"))


class _Log(NamedTuple):
    """What `train` does between steps; see its arguments."""

    periods: Periods
    progress: Progress
    stop: Callable[[], bool]


def _train_field(
    run: Path,
    config: TrainConfig,
    model: SavedModel,
    objects: Scene,
    folder: Path,
    checkpoints: Checkpoints,
    log: _Log,
    report: Callable[[str], None],
    mesh: Mesh | None,
) -> int:
    """Trains a field, and returns the number of the last step."""
    surface = model.config.backdrop is not None
    front = backdrop_fit.read_front(model.config, objects, folder) if surface else None
    sampler = read_pixels(config, folder, kept=front and front.pixels)
    set_up = functools.partial(loop.set_up, config, model.config, model.settings, objects, sampler)
    begin = functools.partial(init_state, config.seed, model.config, config.schedule)
    tasks = functools.partial(set_up, mesh=mesh, beside=loop.compile_steps), begin
    setup, state = at_once(operator.call, tasks)
    _report_misses(setup, report)
    begun = time.monotonic()
    state = devices.put_everywhere(state, mesh=mesh)
    if checkpoints.newest() is not None:
        state = checkpoints.restore(state)
    elif config.model.surface_start == "meshes":
        params = learned_surface.fit(state.params, model.config, objects, seed=config.seed)
        state = devices.put_everywhere(state._replace(params=params), mesh=mesh)
    elif front is not None:
        state = backdrop_fit.behind_field(
            run, state, config, model, objects, folder, front, log.progress, log.stop
        )
    if devices.any_process(log.stop()):
        raise KeyboardInterrupt  # there is no new state to save
    # Of a run with fields alone, these are the seconds of its steps.
    begun = begun if surface else time.monotonic()
    schedule = config.schedule
    total, batch = require(schedule.steps), require(schedule.batch)
    names = scene_folder.read_frames(folder, "train").names if model.config.learned_gains else ()
    steps = _Steps(functools.partial(loop.run_steps, setup), total, batch, names)
    return _take_steps(run, steps, state, checkpoints, log, begun)


def _train_splats(
    run: Path,
    config: TrainConfig,
    model: ModelConfig,
    folder: Path,
    checkpoints: Checkpoints,
    log: _Log,
    mesh: Mesh | None,
) -> int:
    """Trains Gaussian splats, and returns the number of the last step.

    Raises:
      ValueError: if there are several devices or processes.
    """
    if mesh is not None or jax.process_count() > 1:
        raise ValueError(
            "Gaussian splats (field=splats) train on one device in one process. Leave out the "
            "others, or use another field."
        )
    state, steps = _splats(config, model, folder)
    if checkpoints.newest() is not None:
        state = checkpoints.restore(state)
    if log.stop():
        raise KeyboardInterrupt  # there is no new state to save
    return _take_steps(run, steps, state, checkpoints, log, time.monotonic())


def _report_misses(setup: loop.Setup, report: Callable[[str], None]) -> None:
    """Reports that no light is bent, although there are objects."""
    if setup.hit_fraction == 0.0 and setup.settings.max_bends > 0:
        report(
            "warning: no camera ray hits the meshes, so no light is bent. Check that their "
            "units, axes and position are those of the cameras."
        )


def read_pixels(
    config: TrainConfig, scene: Path, *, kept: Bool[np.ndarray, "views h w"] | None = None
) -> PixelSampler:
    """Reads the training pixels of a resolved configuration.

    Args:
      config: configuration of the run.
      scene: folder of the scene.
      kept: mask of the pixels to draw from; by default those that the configuration names.
    """
    frames = scene_folder.read_frames(scene, "train")
    if config.scene.pixels == "background" and kept is None:
        kept = image_files.well_outside(scene_folder.read_masks(frames))
    images, batch = scene_folder.read_images(frames), require(config.schedule.batch)
    return PixelSampler(images, frames.cameras, seed=config.seed, batch=batch, kept=kept)


class _Steps(NamedTuple):
    """The steps of a run.

    Attributes:
      take: function of a state, the number of the last step, and periods (`every`), that yields
        states and their reports, as `loop.run_steps` does.
      total: number of steps of the run.
      rays: number of rays per step.
      names: names of the training images, if their gains are learned.
    """

    take: Callable[..., Iterator[tuple[TrainState, Any]]]
    total: int
    rays: int
    names: tuple[str, ...] = ()


def _splats(config: TrainConfig, model: ModelConfig, folder: Path) -> tuple[TrainState, _Steps]:
    """Returns the initial state and the steps of Gaussian splats, of one training image each."""
    from refref_jax.splats import gaussians, training  # costs nothing without splats

    assert model.splats is not None
    frames, total = scene_folder.read_frames(folder, "train"), require(config.schedule.steps)
    targets, views = scene_folder.read_images(frames), frames.cameras
    setup = training.set_up(
        views,
        targets,
        seed=config.seed,
        steps=total,
        kernel=model.splats.kernel,
        centre=model.centre,
    )
    begun = gaussians.start(config.seed, model.splats.gaussians, views, model.domain)

    def as_state(state: training.State) -> TrainState:
        return TrainState(state.step, Params((), state.gaussians), state.moments)

    def take(
        state: TrainState, until: int, *, every: Sequence[int]
    ) -> Iterator[tuple[TrainState, training.Report]]:
        first = training.State(state.step, state.params.field, state.optimizer)
        for found, report in training.run_steps(setup, first, until, every=every):
            yield as_state(found), report

    return as_state(training.init_state(begun)), _Steps(take, total, views.height * views.width)


def _take_steps(
    run: Path,
    steps: _Steps,
    state: TrainState,
    checkpoints: Checkpoints,
    log: _Log,
    begun: float,
) -> int:
    """Takes the remaining steps, and returns the number of the last; seconds count from `begun`."""
    periods, progress, stop = log
    total, step = steps.total, int(state.step)
    writes = devices.is_first()
    earlier = run_folder.rewind_metrics(run, step) if writes else 0.0
    last, logged = time.monotonic(), step
    progress(step, total, "")
    every = (_MOST_STEPS, periods.log, periods.checkpoint)
    for stepped, measured in steps.take(state, total, every=every):
        step = int(stepped.step)
        if step % periods.log == 0 or step == total:
            measured = jax.device_get(measured)
            now = time.monotonic()
            rate = steps.rays * (step - logged) / (now - last)
            line = _line(step, measured, rate, earlier + now - begun)
            if writes:
                run_folder.append_metrics(run, line)
            text = f"loss {measured.loss:.5f}  PSNR {measured.psnr:.2f}  {rate:.0f} rays/s"
            progress(step, total, text)
            last, logged = now, step
        stopping = devices.any_process(stop())
        if step % periods.checkpoint == 0 or step == total or stopping:
            checkpoints.save(stepped)
            if steps.names and writes:
                run_folder.write_gains(run, steps.names, jax.device_get(gains(stepped.params)))
        if stopping:
            break
    return step


def _line(step: int, measured: Any, rate: float, seconds: float) -> dict[str, Any]:
    """Returns a line of metrics.

    Raises:
      ValueError: if the loss is not finite.
    """
    if not math.isfinite(measured.loss):
        raise ValueError(
            f"The loss is {measured.loss} at step {step}. Evaluate the last checkpoint, which is "
            "finite, or train again with another seed in another folder; and please report the "
            "scene."
        )
    known = measured._asdict().items()
    values = {name: float(value) for name, value in known if value is not None}
    line = {"step": step, **values, "rays_per_second": rate, "seconds": seconds}
    # CPUs do not report memory.
    if (memory := jax.local_devices()[0].memory_stats()) is not None:
        line["peak_device_bytes"] = memory["peak_bytes_in_use"]
    # The PSNR of a batch without error is infinite.
    return configuration.string_safe(line)
