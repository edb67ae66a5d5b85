"""Selects the object of a training: the scene's meshes, or a reconstruction from masks."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from absl import flags

from experiments.cli import flags as cli_flags
from experiments.r3f import flags as r3f_flags
from experiments.runs import config_flags, refraction_indices
from refref_jax import choices
from refref_jax.training.config import TrainConfig

if TYPE_CHECKING:
    from experiments.r3f import records
    from refref_jax.data.meshes import MeshPart

METHOD = flags.DEFINE_enum(
    "method",
    "oracle",
    ["oracle", "r3f"],
    "Where objects come from: the scene's meshes and their indices of refraction, or images and "
    "masks only, from which one object and its index are reconstructed into {out}/r3f. Then --ior "
    "is the index of that object, as in 1.5; it is estimated by default.",
)
_RECONSTRUCTED = r3f_flags.reconstruction()
FLAGS = (METHOD, *_RECONSTRUCTED)
"""Flags of a new run, which cannot change when it is resumed."""

Options = Mapping[str, flags.FlagHolder]

# File of a run that has begun.
_CONFIG = "config.json"

FOLDER = "r3f"
"""Folder of the reconstruction, relative to the run's folder."""


def asked(options: Options, *, say: config_flags.Say) -> TrainConfig:
    """Returns the command line's configuration, without `--ior` if the object is reconstructed.

    Args:
      options: flags of the configuration, by name.
      say: function called with the decisions of --config that are made again.

    Raises:
      ValueError: if the configuration is invalid.
    """
    instead: dict[str, Any] = {}
    decides = METHOD.present and not options["reconstruction"].value
    if decides and config_flags.base().scene.reconstruction:  # dropped together with its index
        instead = {"reconstruction": "", "ior": ()}
    others = {name: holder for name, holder in options.items() if name != "ior"}
    config = config_flags.chosen(others, say=say, **instead)
    takes_back = options["ior"].value == [config_flags.AUTO]
    if not options["ior"].present or (is_reconstructed(config) and not takes_back):
        return config
    return config.override(**config_flags.given({"ior": options["ior"]}))


def reconstructs(config: TrainConfig) -> bool:
    """Returns whether an object must be reconstructed before training."""
    return METHOD.value == "r3f" and not config.scene.reconstruction


def is_reconstructed(config: TrainConfig) -> bool:
    """Returns whether the object comes from a reconstruction."""
    return METHOD.value == "r3f" or bool(config.scene.reconstruction)


def check_flags(config: TrainConfig, options: Options) -> None:
    """Rejects contradictory or useless flags before JAX is imported.

    Args:
      config: resolved flags, see `asked`.
      options: flags of the configuration, by name.

    Raises:
      ValueError: if there are such flags, or an index is invalid.
    """
    given, made = options["reconstruction"].value, config.scene.reconstruction
    file = flags.FLAGS["config"].value
    if METHOD.value == "oracle" and given and METHOD.present:
        raise ValueError(
            "--method=oracle uses the scene's own meshes, not a reconstruction. Remove either "
            "--method or --reconstruction."
        )
    if is_reconstructed(config):
        given_index(options["ior"].value or ())
    idle = [f"--{holder.name}" for holder in FLAGS[1:] if holder.present]
    if idle and not reconstructs(config):
        why, instead = "nothing is reconstructed", "add --method=r3f"
        if made:
            why = f"the object of {made} is already reconstructed"
            instead = "add --method=r3f" if not given else "use --method=r3f instead of it"
        raise ValueError(
            f"{', '.join(idle)} would have no effect, since {why}. Remove it, or {instead}."
        )
    if is_reconstructed(config) and config.paths.name == "straight":
        instead = "Remove --method and --reconstruction"
        if made and not given:
            instead = f"Add --method=oracle, since {file} names the reconstruction {made}"
        raise ValueError(
            "--paths=straight ignores objects, so there is nothing to reconstruct. "
            f"{instead}, or use --paths=tree."
        )
    if made and not given and not (Path(made) / cli_flags.RECONSTRUCTION).is_file():
        raise ValueError(
            f"{file} uses the reconstruction {made}, which does not exist. Set --reconstruction to "
            "its new location, or add --method=r3f to reconstruct the object again."
        )


def given_index(ior: Sequence[str]) -> float | None:
    """Returns the index of `--ior=NUMBER`, if it is given and not `auto`.

    Raises:
      ValueError: if there are several, or one has a name.
    """
    if not ior or list(ior) == [config_flags.AUTO]:
        return None
    if len(ior) > 1 or "=" in ior[0]:
        raise ValueError(
            f"--ior={ior[-1]} is invalid for the single reconstructed object. Pass its index once, "
            "without a name, as in --ior=1.5."
        )
    return refraction_indices.parse(ior[0])


def find(
    run: Path, config: TrainConfig, *, ior: Sequence[str], resume: bool
) -> list[MeshPart] | None:
    """Returns the parts of the reconstructed object, or `None` if the scene's meshes are used.

    Unfinished stages of the reconstruction are run first.

    Args:
      run: folder of the run.
      config: configuration, with the folder of the scene.
      ior: values of --ior.
      resume: whether an existing reconstruction may be continued.

    Raises:
      ValueError: if there is no such object.
    """
    given, scene = config.scene.reconstruction, Path(config.scene.path)
    if not is_reconstructed(config):
        return None
    from experiments.r3f import chain, records

    index, out = given_index(ior), folder(run, given)
    if given:
        if out.resolve() == run.resolve():
            raise ValueError(
                f"--out={run} is the reconstruction itself. Use another folder for the run."
            )
        parts = chain.read_parts(out)
        if chain.fingerprint(scene) != records.read(out).inputs:
            print(
                f"warning: {out} was reconstructed from other images, masks or poses than those of "
                f"{scene}. Make sure that it is the same object in the same place, or reconstruct "
                "the scene's object with --method=r3f and without --reconstruction."
            )
        known = dict(config.scene.indices)
        outer, *inner = [part._replace(index=known.get(part.name, part.index)) for part in parts]
        return [outer if index is None else outer._replace(index=index), *inner]
    if out.exists() and not resume:
        raise ValueError(
            f"{out} already contains a reconstruction. Continue with --resume, or change --out."
        )
    asked = _asked(run, config, index)
    try:
        chain.reconstruct(scene, out, asked, compare=False)
    except KeyboardInterrupt:
        print("Stopped. Continue with the same command and --resume.")
        raise
    return chain.read_parts(out)


def _asked(run: Path, config: TrainConfig, index: float | None) -> records.ReconstructionConfig:
    """Returns the options of a run's reconstruction, which makes its own decisions."""
    from experiments.r3f import chain, records

    overrides, out = config.overrides(), run / FOLDER
    names = {"space": "background", "radius": "radius", "centre": "centre"}
    said: dict[str, Any] = {
        key: config.get(name) if name in overrides else None for key, name in names.items()
    }
    scene = Path(config.scene.path)
    space, radius, centre = chain.bounds_of(scene, config.scene.properties, **said)
    asked = _RECONSTRUCTED.chosen(
        index=index,
        seed=config.seed,
        space=space,
        radius=radius,
        centre=centre,
        exposure=config.model.exposure or "fixed",
    )
    if records.exists(out) and (run / _CONFIG).is_file():
        # The run has begun with its object, maybe with the defaults of an earlier version.
        before = records.read(out).config
        asked = dataclasses.replace(asked, exposure=before.exposure)
        if not _RECONSTRUCTED.refinement.present:
            asked = dataclasses.replace(asked, refinement=before.refinement)
    return asked


def with_parts(
    config: TrainConfig,
    parts: Sequence[MeshPart],
    made: Path,
    *,
    run: Path,
    ior: Sequence[str],
    say: config_flags.Say,
) -> TrainConfig:
    """Returns a configuration that uses a reconstructed object.

    If its reconstruction leaves an error, a field in and around it learns what its shape does not
    explain, unless an interior is given, or an option that excludes a field there.

    Args:
      config: configuration, with the folder of the scene.
      parts: parts of the reconstructed object.
      made: folder of its reconstruction.
      run: folder of the run.
      ior: values of --ior.
      say: function called with the decisions that are made again.
    """
    folder = str(made.resolve())
    index = tuple((part.name, part.index) for part in parts)
    given = config.scene.reconstruction
    if given and Path(given).resolve() == made.resolve():
        config = config.decided(reconstruction=folder)
    else:
        config = config_flags.on_top(config, {"reconstruction": folder}, say=say)
    if config.model.interior is None and (left := _unexplained(made)):
        config = _with_field(config, left, made, run, say)
    is_given = given_index(ior) is not None
    return config.override(ior=index) if is_given else config.decided(ior=index)


def _with_field(
    config: TrainConfig, left: str, made: Path, run: Path, say: config_flags.Say
) -> TrainConfig:
    """Returns a configuration with a field inside the object, unless an option excludes it.

    A run that has begun keeps what was decided then.
    """
    from refref_jax.training import run_folder

    if (run / _CONFIG).is_file():
        begun = run_folder.read_config(run).model
        if begun.interior != "field":
            return config
        ball = begun.field_ball
    elif option := _excludes_field(config):
        say(f"{left}; a field inside would learn part of it, but {option} excludes one")
        return config
    else:
        ball = config.model.field_ball or _ball(config, made, say)
        say(
            f"interior=field: {left}; a field learns part of it. Use --interior=absorbing to train "
            "faster, without it."
        )
        if ball:
            around = f"field_ball={','.join(map(str, ball))}"
            say(f"{around}: in front of a backdrop, the field is sampled there, within the masks.")
    config = config.decided(interior="field")
    return config if "field_ball" in config.overrides() else config.decided(field_ball=ball)


def _unexplained(made: Path) -> str:
    """Returns what the shape of an object leaves unexplained; empty if it explains the images."""
    from experiments.r3f import records

    light = records.read(made).light
    if light is None or light.after is None or not light.leaves_error:
        return ""
    return f"the shape leaves an error of {light.after:.4f}"


def _excludes_field(config: TrainConfig) -> str:
    """Returns the option of a configuration that excludes a field inside; empty if none does."""
    model, given = config.model, config.overrides()
    exclude = {
        "--exposure=per_image": model.exposure == "per_image" and model.far_field != "field",
        "--field=tnsr": model.field == "tnsr",
        "--pixels=background": config.scene.pixels == "background",
        f"--tints={model.tints}": "tints" in given and model.tints != "none",
        "--tint_decay": "tint_decay" in given,
    }
    return next((option for option, holds in exclude.items() if holds), "")


def _ball(config: TrainConfig, made: Path, say: config_flags.Say) -> choices.BallOption | None:
    """Returns a ball around all that the training masks show, if the far field may be a backdrop.

    The reconstructed object may lack thin and opaque parts, which a field around it learns. Without
    masks, or with masks that are known to be wrong, there is none.
    """
    from experiments.r3f import geometry_stage, records
    from refref_jax.data import SceneError
    from refref_jax.reconstruct import ReconstructionError

    if config.model.far_field == "field":
        return None
    inside = "warning: the field is sampled inside the object only"
    if records.read(made).config.outliers:
        say(f"{inside}, as --outliers says that masks may be wrong")
        return None
    try:
        box = geometry_stage.box_of_masks(Path(config.scene.path))
    except (ReconstructionError, SceneError) as error:
        say(f"{inside}, as no ball around it is known: {error}")
        return None
    x, y, z = (round(float(number), 4) for number in 0.5 * (box.low + box.high))
    return x, y, z, round(0.5 * float(sum((box.high - box.low) ** 2)) ** 0.5, 4)


def note(run: Path, parts: Sequence[MeshPart] | None, given: str) -> None:
    """Records the origin of the object in the run's folder."""
    from experiments.r3f import object_source

    made = None
    if parts is not None:
        made = object_source.Provenance(str(folder(run, given).resolve()), parts[0].index)
    object_source.write(run, made)


def folder(run: Path, given: str | None) -> Path:
    """Returns the folder of a run's reconstruction."""
    return Path(given) if given else run / FOLDER
