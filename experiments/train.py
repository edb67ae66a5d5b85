"""Trains a model of a scene.

python -m experiments.train --scene=experiments/data/cube_smcvx_ball --out=runs/ball
"""

import math
import sys
import time
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from absl import flags

from experiments import commands, scenes
from experiments.presets import PRESETS, bounds
from refref_jax.data import background, containment, local_layout, meshes
from refref_jax.data.batches import PixelSampler, check_batch
from refref_jax.data.cameras import Cameras
from refref_jax.data.geometry import build_geometry
from refref_jax.optics.budgets import BUDGETS
from refref_jax.optics.media import EMPTY_SLOT
from refref_jax.optics.wavefront import Geometry
from refref_jax.render import saved
from refref_jax.render.saved import SavedModel
from refref_jax.training import loop, run_folder
from refref_jax.training.checkpoints import Checkpoints
from refref_jax.training.config import SceneConfig, TrainingConfig
from refref_jax.training.state import TrainState, init_state
from refref_jax.training.steps import StepReport

_SCENE = flags.DEFINE_string("scene", None, "Folder of the scene to train on.")
_OUT = flags.DEFINE_string("out", None, "Folder to write the run to.", required=True)
_PRESET = flags.DEFINE_enum("preset", "tiny", list(PRESETS), "Size of the model and its training.")
_PATHS = flags.DEFINE_enum(
    "paths",
    "paper",
    list(BUDGETS),
    "Light paths: 'straight' ignores the objects; 'paper' bends up to 10 times and reflects at "
    "the first surface.",
)
_INTERIOR = flags.DEFINE_enum(
    "interior",
    "field",
    ["field", "clear"],
    "'field' also learns what is inside the objects; 'clear' takes them to be clear.",
)
flags.adopt_module_key_flags(scenes)
_BACKGROUND = flags.DEFINE_enum(
    "background",
    "auto",
    ["auto", "bounded", "unbounded"],
    "Whether there are walls, or an environment infinitely far away.",
)
_RADIUS = flags.DEFINE_float(
    "radius",
    None,
    "Half edge of the cube on whose faces a bounded scene's background stands (by default that of "
    "scene.json, else 7.3), or radius of an unbounded scene's uncontracted ball, in world units.",
    lower_bound=1e-6,
)
_STEPS = flags.DEFINE_integer("steps", None, "Training steps; the preset's if not given.", 1)
_BATCH = flags.DEFINE_integer("batch", None, "Rays a step; the preset's if not given.", 1)
_SEED = flags.DEFINE_integer("seed", 0, "Seed of everything random.", 0, 2**32 - 1)
_RESUME = flags.DEFINE_bool("resume", False, "Continue the run in --out, if there is one.")
_LOG_EVERY = flags.DEFINE_integer("log_every", 50, "Steps between two lines of metrics.", 1)
_CHECKPOINT_EVERY = flags.DEFINE_integer("checkpoint_every", 500, "Steps between checkpoints.", 1)
_KEEP = flags.DEFINE_integer("keep", 2, "Newest checkpoints to keep.", 1)


class Plan(NamedTuple):
    """A run before it begins."""

    config: TrainingConfig
    model: SavedModel
    geometry: Geometry


# What a run is begun with, and can not change when it is resumed.
_SETTLED = (
    _PRESET,
    _PATHS,
    _INTERIOR,
    scenes.RULE,
    scenes.IOR,
    _BACKGROUND,
    _RADIUS,
    _STEPS,
    _BATCH,
    _SEED,
)


def main() -> None:
    """Plans a run, or finds the one to resume, and trains it."""
    run = Path(_OUT.value)
    resuming = _RESUME.value and run_folder.exists(run)
    if not resuming:
        run_folder.create(run, *plan_from_flags())
    elif _SCENE.value is not None:
        run_folder.check_unchanged(run, *plan_from_flags())
    else:
        _refuse_options(run)
    if not train(run):
        sys.exit(commands.INTERRUPTED)
    print(f"Run: {run}  (metrics.jsonl, checkpoints/)")
    print(f"Next: python -m experiments.evaluate --run={run} --split=test")


def _refuse_options(run: Path) -> None:
    """Refuses options that a resumed run would not heed."""
    names = [holder.name for holder in _SETTLED]
    if given := [f"--{name}" for name in names if flags.FLAGS[name].present]:
        raise ValueError(
            f"{run} goes on with the options that it was begun with: {', '.join(given)} would have "
            "no effect. Leave it out, or add --scene to have all options compared."
        )


def _refuse_cameras_inside(parts: list[meshes.MeshPart], cameras: Cameras) -> None:
    """Refuses cameras whose rays would have to know at once what they are in."""
    if np.any(containment.parts_around(parts, cameras.poses[:, :, 3]) != EMPTY_SLOT):
        raise ValueError(
            "A camera stands inside a mesh, which training can not follow under --rule=priority. "
            "Use --rule=nested, or move the camera."
        )


def plan_from_flags() -> Plan:
    """Reads and checks the scene, and resolves all options."""
    if _SCENE.value is None:
        raise ValueError("No scene is given. Add --scene=FOLDER.")
    scene = Path(_SCENE.value).resolve()
    local_layout.check_scene(scene)
    frames = local_layout.read_frames(scene, "train")
    indices = scenes.given_indices()
    parts = meshes.read_meshes(scene, indices=indices)
    if not parts and _PATHS.value != "straight":
        raise ValueError(
            f"{scene / 'meshes'} holds no .ply file, so there is nothing to bend light. Add the "
            "meshes of the objects, or use --paths=straight."
        )
    tree = containment.find_containment(parts)
    scenes.report_meshes(parts, tree, rule=scenes.RULE.value)
    if scenes.RULE.value == "priority":
        _refuse_cameras_inside(parts, frames.cameras)
    space = background.space(scene) if _BACKGROUND.value == "auto" else _BACKGROUND.value
    preset = PRESETS[_PRESET.value]
    radius = _RADIUS.value or (background.half_extent(scene) if space == "bounded" else None)
    extent = bounds(frames.cameras, space=space, radius=radius)
    check_batch(frames.cameras, _BATCH.value or preset.batch)
    schedule = preset.schedule.over(_STEPS.value or preset.schedule.steps)
    config = TrainingConfig(
        scene=SceneConfig(str(scene), scenes.RULE.value, tuple(sorted(indices.items()))),
        paths=_PATHS.value,
        loss=preset.loss,
        schedule=schedule,
        batch=_BATCH.value or preset.batch,
        pool=preset.pool,
        seed=_SEED.value,
    )
    model = SavedModel(preset.model(extent, _INTERIOR.value), BUDGETS[_PATHS.value])
    clear = meshes.without_colour(parts)  # the field learns the colour of the objects
    return Plan(config, model, build_geometry(clear, tree.parents, rule=scenes.RULE.value))


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
        scene = Path(_SCENE.value or config.scene.path)
        frames = local_layout.read_frames(scene, "train")
        sampler = PixelSampler(
            local_layout.read_images(frames), frames.cameras, seed=config.seed, batch=config.batch
        )
        geometry = saved.load_geometry(run)
        setup = loop.set_up(config, model.config, model.budget, geometry, sampler)
        if setup.hit_fraction == 0.0 and config.paths != "straight":
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
        for stepped, report in loop.run_steps(setup, state, total):
            step += 1
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
    run_folder.append_metrics(run, line)


if __name__ == "__main__":
    commands.run(main)
