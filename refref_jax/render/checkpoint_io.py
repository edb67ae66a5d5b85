"""Saves and loads a model: the files of a run folder that rendering needs.

    {run}/model.json            static description (`SavedModel`)
    {run}/geometry.npz          surfaces and interfaces
    {run}/checkpoints/{step}/   parameters, and next to them the training state and `checksums.json`

These files alone suffice to render a model, without the scene that it was trained on.

Orbax notices missing and shorter files, but not a changed byte in an array, so a checkpoint is
compared with the checksums of its files before it is read. One without them is of an earlier
version, or its writer was killed when it was complete.
"""

import contextlib
import dataclasses
import json
import os
import zlib
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import orbax.checkpoint as ocp

from refref_jax import atomic_files, configuration
from refref_jax.fields import registry
from refref_jax.fields.neus import NeusParams
from refref_jax.geometry.bvh import BVH
from refref_jax.geometry.surfaces import Surfaces
from refref_jax.optics.media import Interfaces, Scene, meshes_of
from refref_jax.optics.path_settings import PathSettings
from refref_jax.render.model import (
    Model,
    ModelConfig,
    Params,
    bends_light,
    init_params,
    surface_scene,
)

_MODEL = "model.json"
_GEOMETRY = "geometry.npz"

CHECKPOINTS = "checkpoints"

_CHECKSUMS = "checksums.json"

_PIECE = 1 << 24

_LONGEST_REASON = 200

PARAMS_ITEM = "params"
TRAINING_ITEM = "training"


@dataclasses.dataclass(frozen=True)
class SavedModel:
    """The static part of a model.

    Attributes:
      config: configuration of the fields and the sampling.
      settings: path settings.
    """

    config: ModelConfig
    settings: PathSettings = dataclasses.field(metadata={configuration.FORMERLY: "budget"})


def save_scene(run: Path, saved: SavedModel, scene: Scene) -> None:
    """Writes a model without its parameters to an existing folder."""
    write_static(run, saved)
    surfaces, interfaces = meshes_of(scene), scene.interfaces
    np.savez_compressed(
        run / _GEOMETRY,
        **surfaces.bvh._asdict(),
        normals=surfaces.normals,
        parts=surfaces.parts,
        radiance=surfaces.radiance,
        **interfaces._asdict(),
    )


def write_static(run: Path, saved: SavedModel) -> None:
    """Writes the static part of a model to an existing folder."""
    configuration.write(run / _MODEL, saved)


def read_static(run: Path) -> SavedModel:
    """Reads the static part of a model."""
    return configuration.read(run / _MODEL, SavedModel, variants=registry.variants())


def load_model(run: str | os.PathLike[str], *, step: int | None = None) -> Model:
    """Loads a trained model.

    Args:
      run: folder of a training run.
      step: step of the checkpoint; the newest by default.

    Raises:
      ValueError: if the folder is not a run, or has no such checkpoint.
    """
    run = Path(run)
    saved = read_static(run)
    shapes = jax.eval_shape(lambda: init_params(jax.random.key(0), saved.config))
    with open_checkpoints(run) as manager:
        step = find_step(manager, run, step)
        params = restore(manager, step, {PARAMS_ITEM: shapes})[PARAMS_ITEM]
    # Restored arrays are committed to a device, and so are all results computed from them. The
    # initial sums of an image are not, so their chunk would be compiled separately.
    unbound = jax.device_put(jax.device_get(params))
    learned = Params(*unbound)
    if bends_light(saved.config):
        return Model(saved.config, saved.settings, surface_scene(learned, saved.config), learned)
    return Model(saved.config, saved.settings, load_scene(run), learned)


def latest_step(run: Path) -> int:
    """Returns the step of a run's newest checkpoint.

    Raises:
      ValueError: if there is none.
    """
    with open_checkpoints(run) as manager:
        return find_step(manager, run, None)


def open_checkpoints(run: Path, *, keep: int | None = None) -> ocp.CheckpointManager:
    """Opens the checkpoints of a run.

    Args:
      run: the run folder.
      keep: number of the newest checkpoints to keep; `None` to only read.
    """
    # Orbax warns about its option `read_only` each time; a manager that only restores does not
    # write either.
    chosen = {"create": False} if keep is None else {"max_to_keep": keep}
    # Every save is waited for. In the background Orbax gives up by the time of day, which may jump.
    options = ocp.CheckpointManagerOptions(enable_async_checkpointing=False, **chosen)
    return ocp.CheckpointManager(
        (run / CHECKPOINTS).absolute(), item_names=(PARAMS_ITEM, TRAINING_ITEM), options=options
    )


def find_step(manager: ocp.CheckpointManager, run: Path, step: int | None) -> int:
    """Returns the step of a checkpoint, the newest by default.

    Raises:
      ValueError: if it does not exist.
    """
    steps = sorted(manager.all_steps())
    if not steps:
        raise ValueError(
            f"{run} has no checkpoint. Train it first, or give the folder of a finished run."
        )
    if step is not None and step not in steps:
        raise ValueError(f"{run} has no checkpoint of step {step}. It has {steps}: choose one.")
    return steps[-1] if step is None else step


def restore(manager: ocp.CheckpointManager, step: int, items: dict[str, Any]) -> ocp.args.Composite:
    """Reads items of a checkpoint with the given shapes and types.

    Args:
      manager: manager of the checkpoints.
      step: step of the checkpoint.
      items: shapes by the name of the item. Those without a sharding are placed on one device,
        whatever devices they were written from.

    Raises:
      ValueError: if the checkpoint is damaged.
    """
    folder = Path(manager.directory) / str(step)
    if damaged := _find_damage(folder, items):
        raise ValueError(
            f"The checkpoint {folder} is damaged: {damaged} is not as it was written. Remove that "
            "folder to use an older one, or train again."
        )
    here = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    items = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=x.sharding or here), items
    )
    try:
        return _restore(manager, step, items)
    except Exception as error:  # Orbax raises the errors of its storage
        for now, before in _FORMERLY.items():
            with contextlib.suppress(Exception):
                former = _restore(manager, step, _replace_each(items, now, before))
                return ocp.args.Composite(**_replace_each(dict(former), before, now))
        raise ValueError(
            f"The checkpoint {folder} cannot be read ({_brief(error)}). Remove it to use an "
            "older one, or train again."
        ) from error


def write_checksums(run: Path, step: int) -> None:
    """Records the checksum of every file of a complete checkpoint."""
    folder = run / CHECKPOINTS / str(step)
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    with ThreadPoolExecutor() as pool:
        sums = list(pool.map(checksum, files))
    names = (path.relative_to(folder).as_posix() for path in files)
    with atomic_files.written_file(folder / _CHECKSUMS) as draft:
        draft.write_text(json.dumps(dict(zip(names, sums, strict=True)), indent=1) + "\n")


def _find_damage(folder: Path, items: Iterable[str]) -> str | None:
    """Returns a file of some items of a checkpoint that was changed after it was written."""
    try:
        known = configuration.parse_json((folder / _CHECKSUMS).read_text(encoding="utf-8"))
        names = [name for name in known if name.partition("/")[0] in items]
    except FileNotFoundError:
        return None
    except (ValueError, AttributeError, TypeError):
        return _CHECKSUMS
    with ThreadPoolExecutor() as pool:
        sums = pool.map(checksum, [folder / name for name in names])
        changed = (name for name, found in zip(names, sums, strict=True) if found != known[name])
        return next(changed, None)


def checksum(path: Path) -> int | None:
    """Returns the CRC-32 of a file; `None` if it cannot be read."""
    found = 0
    try:
        with path.open("rb") as file:
            while piece := file.read(_PIECE):
                found = zlib.crc32(piece, found)
    except OSError:
        return None
    return found


class _FormerParams(NamedTuple):
    """The fields of `Params` as earlier versions stored them."""

    proposals: Any
    field: Any
    dyes: Any


class _FormerNeusParams(NamedTuple):
    """The fields of `NeusParams` as earlier versions stored them."""

    surface: Any
    around: Any
    log_sharpness: Any


_FORMERLY: dict[Any, Any] = {Params: _FormerParams, NeusParams: _FormerNeusParams}


def _restore(
    manager: ocp.CheckpointManager, step: int, items: dict[str, Any]
) -> ocp.args.Composite:
    arguments = {name: ocp.args.StandardRestore(shapes) for name, shapes in items.items()}
    return manager.restore(step, args=ocp.args.Composite(**arguments))


def _replace_each(tree: Any, old: Any, new: Any) -> Any:
    """Replaces records by records of another type with the same first values."""
    count = len(new._fields)
    return jax.tree.map(
        lambda x: new(*x[:count]) if isinstance(x, old) else x,
        tree,
        is_leaf=lambda x: isinstance(x, old),
    )


def load_scene(run: Path) -> Scene:
    """Reads the scene that a run was trained in.

    Raises:
      ValueError: if the file is missing or damaged.
    """
    path = run / _GEOMETRY
    try:
        arrays: dict[str, Any] = atomic_files.read_arrays(path)
        bvh = BVH(*(arrays[name] for name in BVH._fields))
        known = _empty_arrays(arrays["index_inside"].size) | arrays
        surfaces = Surfaces(bvh, *(known[name] for name in Surfaces._fields[1:]))
        interfaces = Interfaces(*(known[name] for name in Interfaces._fields))
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(
            f"{path} cannot be read ({_brief(error)}). Restore it, or train again into another "
            "folder."
        ) from error
    return jax.device_put(Scene(surfaces, interfaces))


def _empty_arrays(parts: int) -> dict[str, np.ndarray]:
    """Returns the arrays that earlier versions did not store, as a scene without them has them."""
    shapes = {"complex_index": (0, 2, 3), "alpha": (0,), "index_by_channel": (0, 2, parts)}
    return {
        "index_by_face": np.zeros(0, bool),
        "kinds": np.zeros(0, np.int32),
        "opaque": np.zeros(0, bool),
        "radiance": np.zeros((0, 3, 3), np.float32),
        **{name: np.zeros(shape, np.float32) for name, shape in shapes.items()},
    }


def _brief(error: Exception) -> str:
    """Returns the kind of an error and the first line of its message."""
    return f"{type(error).__name__}: {str(error).partition(chr(10))[0][:_LONGEST_REASON]}"
