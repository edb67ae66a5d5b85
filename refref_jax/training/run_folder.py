"""Reads and writes the files of a run: configuration, model, metrics and checkpoints.

    {run}/config.json      the resolved `TrainConfig`
    {run}/model.json       the model, see `render.checkpoint_io`
    {run}/metrics.jsonl    one line for every logged step
    {run}/checkpoints/     the newest few states, saved atomically by Orbax
    {run}/gains.json       gain of each training image, RGB, if exposure=per_image
    {run}/coverage.npz     how many pixels see each vertex of a backdrop
    {run}/images.json      checksums of the training images and cameras

All but checkpoints and coverage are readable text.
"""

import errno
import json
import math
import shutil
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp
from jaxtyping import Float

from refref_jax import atomic_files, configuration
from refref_jax.choices import Colour
from refref_jax.data.scene_folder import Frames
from refref_jax.optics.media import Scene
from refref_jax.render import checkpoint_io
from refref_jax.render.checkpoint_io import (
    PARAMS_ITEM,
    TRAINING_ITEM,
    SavedModel,
    find_step,
    open_checkpoints,
    restore,
)
from refref_jax.training import config_files, devices, presets
from refref_jax.training.config import TrainConfig, options_of
from refref_jax.training.config_files import CONFIG
from refref_jax.training.loop import TrainState

_METRICS = "metrics.jsonl"
_COVERAGE = "coverage.npz"
_GAINS = "gains.json"
# Room for the files of a checkpoint that describe its arrays, in bytes.
_OTHER_FILES = 1 << 20

_IMAGES = "images.json"
_LEFT_BEHIND = (_METRICS, _COVERAGE, _GAINS, _IMAGES, checkpoint_io.CHECKPOINTS)


class Checkpoints:
    """Checkpoints of one run, open for writing. Use it in a `with` statement."""

    def __init__(self, run: Path, *, keep: int) -> None:
        """Opens or creates the checkpoints of a run folder, keeping the newest `keep`."""
        self._run = run
        self._manager = open_checkpoints(run, keep=keep)

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(self, *exception: object) -> None:
        self._manager.close()

    def newest(self) -> int | None:
        """Returns the step of the newest checkpoint, if there is one."""
        return self._manager.latest_step()

    def save(self, state: TrainState) -> None:
        """Writes a state, and waits, because the next step reuses its buffers.

        Raises:
          ValueError: if a parameter is not finite. Existing checkpoints are kept.
          OSError: if the disk has no room for it. Existing checkpoints are kept.
        """
        step = int(state.step)
        if step == self.newest():
            return
        leaves = jax.tree.leaves(state.params)
        if not all(np.all(np.isfinite(leaf)) for leaf in jax.device_get(leaves)):
            raise ValueError(
                f"Parameters are not finite at step {step}, so no checkpoint is written. Evaluate "
                "an earlier one, or train again with another seed, in another folder."
            )
        items = {
            PARAMS_ITEM: ocp.args.StandardSave(state.params),
            TRAINING_ITEM: ocp.args.StandardSave(_training_item(state)),
        }
        devices.in_all(lambda: _check_space(self._run, state))
        self._manager.save(step, args=ocp.args.Composite(**items), force=True)
        self._manager.wait_until_finished()
        if jax.process_index() == 0:
            checkpoint_io.write_checksums(self._run, step)

    def restore(self, like: TrainState) -> TrainState:
        """Reads the newest state.

        Args:
          like: a state of the same run, or its shapes. The result is placed on the same devices,
            or on the first one if `like` has none; it may have been written from other devices.

        Raises:
          ValueError: if there is no checkpoint.
        """
        shapes = jax.tree.map(_abstract, like)
        step = find_step(self._manager, self._run, None)
        items = restore(
            self._manager,
            step,
            {PARAMS_ITEM: shapes.params, TRAINING_ITEM: _training_item(shapes)},
        )
        training = items[TRAINING_ITEM]
        return TrainState(training["step"], items[PARAMS_ITEM], training["optimizer"])


def _check_space(run: Path, state: TrainState) -> None:
    """Refuses to write a state without room for it: Orbax would leave a part, and print pages."""
    needed = sum(leaf.nbytes for leaf in jax.tree.leaves(state)) + _OTHER_FILES
    free = shutil.disk_usage(run).free
    if free < needed:
        raise OSError(
            errno.ENOSPC,
            f"a checkpoint takes up to {needed / 2**20:.0f} MiB, {free / 2**20:.0f} are free",
            str(run),
        )


def _abstract(leaf: jax.Array | jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding)


def _training_item(state: TrainState) -> dict[str, Any]:
    return {"step": state.step, "optimizer": state.optimizer}


def exists(run: Path) -> bool:
    """Returns whether a folder contains a run."""
    return (run / CONFIG).is_file()


def create(run: Path, config: TrainConfig, model: SavedModel, scene: Scene) -> None:
    """Creates a run; its configuration is written last, so that an incomplete folder is not a run.

    Raises:
      ValueError: if the folder contains a run already, or is a file.
    """
    check_free(run)
    run.mkdir(parents=True, exist_ok=True)
    checkpoint_io.save_scene(run, model, scene)
    config_files.write(run / CONFIG, config)


def check_free(run: Path) -> None:
    """Checks that a run can be created in a folder, which need not exist.

    Raises:
      ValueError: if the folder contains a run already, or is a file.
    """
    if exists(run):
        raise ValueError(f"{run} contains a run already. Resume it, or give another folder.")
    if found := [str(run / name) for name in _LEFT_BEHIND if (run / name).exists()]:
        raise ValueError(
            f"{run} contains the rest of a run that cannot be continued, because its {CONFIG} is "
            f"missing. Remove {' and '.join(found)}, or give another folder."
        )
    if run.exists() and not run.is_dir():
        raise ValueError(f"{run} is a file, but a run needs a folder. Give another one.")


def read_config(run: Path) -> TrainConfig:
    """Reads the configuration of a run, including runs of earlier versions.

    Raises:
      ValueError: if the file is missing or damaged.
    """
    path = run / CONFIG
    content = config_files.of_an_earlier_version(path)
    if content is None:
        return config_files.read(path)
    try:
        config = configuration.build(_with_todays_keys(content), TrainConfig)
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(
            f"{path} does not hold a TrainConfig of an earlier version ({error}). Restore the file."
        ) from error
    # Values that this file lacks follow from the model next to it.
    return as_trained(config, checkpoint_io.read_static(run))


def _with_todays_keys(content: dict[str, Any]) -> dict[str, Any]:
    """Converts a configuration of an earlier version to the keys of this one."""
    sizes = {name: content[name] for name in ("batch", "pool")}
    return {
        "scene": content["scene"] | {"pixels": content.get("pixels", "all")},
        "paths": {"name": content["paths"]},
        "losses": content["loss"],
        "schedule": content["schedule"] | sizes,
        "seed": content["seed"],
    }


def as_trained(config: TrainConfig, saved: SavedModel) -> TrainConfig:
    """Returns a configuration with the decisions that follow from a saved model.

    This is for runs of earlier versions, whose configurations lack these decisions. The preset of
    such a run is unknown, but the model determines all values that follow from it.
    """
    model, settings = saved.config, saved.settings
    tints = "learned" if model.learned_tints else "given"
    config = config.decided(field=model.field.kind)
    follows: dict[str, Any] = {
        "rule": "nested",
        "background": model.space,
        "radius": model.radius,
        "near": model.near,
        "far": model.far,
        "centre": model.centre,
        "min_throughput": settings.min_throughput,
        "max_bends": settings.max_bends,
        "reentry": settings.reentry if settings.max_bends else None,
        "interior": model.interior,
        "far_field": "backdrop" if model.backdrop else "field",
        "tints": tints if model.interior == "absorbing" and settings.max_bends else "none",
    }
    follows |= presets.sampling_of(model)
    return config.decided(**{n: x for n, x in follows.items() if config.get(n) is None})


def check_unchanged(run: Path, config: TrainConfig, model: SavedModel, scene: Scene) -> None:
    """Checks that a run has exactly this configuration and these meshes.

    Its scene, its properties and its reconstruction may have moved to other folders.

    Raises:
      ValueError: if it differs.
    """
    moved = read_config(run).at(config.scene.path)
    if moved.scene.reconstruction and config.scene.reconstruction:
        moved = moved.decided(reconstruction=config.scene.reconstruction)
    if moved.scene.properties and config.scene.properties:
        moved = moved.decided(properties=config.scene.properties)
    if moved != config or checkpoint_io.read_static(run) != model:
        differing = [
            option.name
            for option in options_of()
            if moved.get(option.name) != config.get(option.name)
        ]
        raise ValueError(
            f"{run} was created with other options "
            f"({', '.join(differing) or 'in the model'}). Resume it without a configuration to "
            "continue it unchanged, or choose another folder."
        )
    pairs = zip(jax.tree.leaves(checkpoint_io.load_scene(run)), jax.tree.leaves(scene), strict=True)
    if not all(np.array_equal(theirs, ours) for theirs, ours in pairs):
        raise ValueError(
            f"{run} was created with other meshes than those of "
            f"{config.scene.reconstruction or config.scene.path}. Use the original meshes, or "
            "choose another folder."
        )


def check_images(run: Path, frames: Frames) -> None:
    """Compares the training images with those at the start of the run, when they are recorded.

    Args:
      run: folder of the run.
      frames: training images, with their masks, if any; they may have moved.

    Raises:
      ValueError: if an image, a mask or a camera has changed.
    """
    files = dict(zip(frames.names, frames.images, strict=True))
    masks = zip(frames.names, frames.masks or (), strict=frames.masks is not None)
    files |= {f"mask of {name}": path for name, path in masks}
    found = {name: checkpoint_io.checksum(path) for name, path in files.items()}
    cameras = [*frames.cameras.poses.ravel(), frames.cameras.focal]
    # Nine digits: the last ones of a focal length depend on the machine.
    found["cameras"] = zlib.crc32(" ".join(f"{float(x):.9g}" for x in cameras).encode())
    path = run / _IMAGES
    if not path.is_file():
        with atomic_files.written_file(path) as draft:
            draft.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        return
    try:
        known = configuration.parse_json(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} is damaged ({error}). Remove it to trust the images.") from error
    if known != found:
        names = [name for name in known | found if known.get(name) != found.get(name)]
        raise ValueError(
            f"{', '.join(names[:3])} of the training images in "
            f"{frames.images[0].parent} changed since {run} began. Restore the scene, train in "
            f"another folder, or remove {path} to continue with the new ones."
        )


def write_coverage(run: Path, coverage: Float[np.ndarray, "6 side side"]) -> None:
    """Writes how many pixels see each vertex of a backdrop (`backdrop_solver.coverage`)."""
    with atomic_files.written_file(run / _COVERAGE) as draft, draft.open("wb") as file:
        np.savez_compressed(file, coverage=coverage)


def read_coverage(run: Path) -> Float[np.ndarray, "6 side side"]:
    """Reads how many pixels see each vertex of a backdrop.

    Raises:
      ValueError: if the run has no such file.
    """
    path = run / _COVERAGE
    if not path.is_file():
        raise ValueError(
            f"{path} does not exist: the run is of an earlier version, or has no backdrop. Train "
            "it again in another folder."
        )
    try:
        return atomic_files.read_arrays(path)["coverage"]
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(
            f"{path} cannot be read ({error}). Restore it, or train again in another folder."
        ) from error


def write_gains(run: Path, names: Sequence[str], gains: Float[np.ndarray, "views 3"]) -> None:
    """Writes the gain of each training image, by its name; their geometric mean is 1."""
    rows = zip(names, np.round(gains.astype(np.float64), 6).tolist(), strict=True)
    with atomic_files.written_file(run / _GAINS) as draft:
        draft.write_text(json.dumps(dict(rows), indent=2) + "\n", encoding="utf-8")


def read_gains(run: Path) -> dict[str, Colour] | None:
    """Reads the gain of each training image, by its name; `None` if the run has learned none.

    Args:
      run: folder of the run.

    Raises:
      ValueError: if the file is damaged.
    """
    path = run / _GAINS
    if not path.is_file():
        return None
    try:
        read = json.loads(path.read_text("utf-8"))
        gains = {name: (float(r), float(g), float(b)) for name, (r, g, b) in read.items()}
    except (AttributeError, TypeError, ValueError) as error:
        raise _damaged_gains(path, str(error)) from error
    for name, gain in gains.items():
        if not all(math.isfinite(each) and each > 0.0 for each in gain):
            raise _damaged_gains(path, f"the gain of {name} is {gain}")
    return gains


def _damaged_gains(path: Path, why: str) -> ValueError:
    return ValueError(
        f"{path} cannot be read ({why}). Restore it, or train again in another folder."
    )


def append_metrics(run: Path, line: dict[str, Any]) -> None:
    """Appends one line to the metrics."""
    with (run / _METRICS).open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")


def rewind_metrics(run: Path, step: int) -> float:
    """Removes the lines after a step, which a resumed run will write again.

    Returns:
      The training time up to the last remaining line, seconds.
    """
    path = run / _METRICS
    if not path.is_file():
        return 0.0
    kept = [line for line in read_metrics(run) if line["step"] <= step]
    with atomic_files.written_file(path) as draft:
        draft.write_text("".join(json.dumps(line) + "\n" for line in kept), encoding="utf-8")
    return kept[-1]["seconds"] if kept else 0.0


def read_metrics(run: Path) -> list[dict[str, Any]]:
    """Reads all lines, except for an incomplete last line of a run that was killed.

    Raises:
      ValueError: if another line is broken.
    """
    path = run / _METRICS
    if not path.is_file():
        return []
    texts = path.read_text(encoding="utf-8", errors="replace").splitlines()
    lines = []
    for number, text in enumerate(texts, 1):
        try:
            lines.append(_line_of(text))
        except ValueError as error:
            if number == len(texts):
                break
            raise ValueError(
                f"Line {number} of {path} is not one of metrics ({error}). Remove that line."
            ) from error
    return lines


def _line_of(text: str) -> dict[str, Any]:
    line = configuration.parse_json(text)
    if not isinstance(line, dict) or not {"step", "seconds"} <= set(line):
        raise ValueError("it has no step or no seconds")
    for name in ("step", "seconds"):
        if math.isnan(configuration.as_number(line[name])):
            raise ValueError(f"{name} is {configuration.abridged(line[name])}")
    return line
