"""The object of a training: the scene's meshes, or one reconstructed from images and masks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from absl import flags

from experiments.cli import flags as cli_flags
from experiments.runs import config_flags, refraction_indices
from refref_jax.training.config import TrainConfig

if TYPE_CHECKING:
    from refref_jax.data.meshes import MeshPart

METHOD = flags.DEFINE_enum(
    "method",
    "oracle",
    ["oracle", "r3f"],
    "Where objects come from: the scene's meshes and their indices of refraction, or images and "
    "masks alone, from which one object and its index are reconstructed into {out}/r3f. Then --ior "
    "is that object's index, as 1.5; it is estimated if not given.",
)
_RECONSTRUCTED = cli_flags.reconstruction()
FLAGS = (METHOD, *_RECONSTRUCTED)
"""Flags that a run is begun with, and can not change when it is resumed."""

Options = Mapping[str, flags.FlagHolder]

FOLDER = "r3f"
"""Below the run's folder: what is reconstructed for it."""


def asked(options: Options, *, say: config_flags.Say) -> TrainConfig:
    """Returns the configuration of the command line, of a reconstructed object without `--ior`.

    Args:
      options: flags of the configuration, by name.
      say: is told which decisions of the file of --config are taken again.

    Raises:
      ValueError: if it makes no sense.
    """
    instead: dict[str, Any] = {}
    decides = METHOD.present and not options["reconstruction"].value
    if decides and config_flags.base().scene.reconstruction:  # which goes, and its index with it
        instead = {"reconstruction": "", "ior": ()}
    others = {name: holder for name, holder in options.items() if name != "ior"}
    config = config_flags.chosen(others, say=say, **instead)
    takes_back = options["ior"].value == [config_flags.AUTO]
    if not options["ior"].present or (is_reconstructed(config) and not takes_back):
        return config
    return config.override(**config_flags.given({"ior": options["ior"]}))


def reconstructs(config: TrainConfig) -> bool:
    """Returns whether an object is reconstructed first."""
    return METHOD.value == "r3f" and not config.scene.reconstruction


def is_reconstructed(config: TrainConfig) -> bool:
    """Returns whether the object is a reconstructed one."""
    return METHOD.value == "r3f" or bool(config.scene.reconstruction)


def check_flags(config: TrainConfig, options: Options) -> None:
    """Refuses what contradicts itself, or would have no effect, before any import.

    Args:
      config: the configuration that was asked for, see `asked`.
      options: flags of the configuration, by name.

    Raises:
      ValueError: if there is anything, or an index is not one.
    """
    given, made = options["reconstruction"].value, config.scene.reconstruction
    file = flags.FLAGS["config"].value
    if METHOD.value == "oracle" and given and METHOD.present:
        raise ValueError(
            "--method=oracle takes the scene's own meshes, not a reconstruction. Leave out either "
            "--method or --reconstruction."
        )
    if is_reconstructed(config):
        given_index(options["ior"].value or ())
    idle = [f"--{holder.name}" for holder in FLAGS[1:] if holder.present]
    if idle and not reconstructs(config):
        why, instead = "nothing is reconstructed", "add --method=r3f"
        if made:
            why = f"the object of {made} is reconstructed already"
            instead = "add --method=r3f" if not given else "give --method=r3f instead of it"
        raise ValueError(
            f"{', '.join(idle)} would have no effect, since {why}. Leave it out, or {instead}."
        )
    if is_reconstructed(config) and config.paths.name == "straight":
        instead = "Leave out --method and --reconstruction"
        if made and not given:
            instead = f"Add --method=oracle, since {file} names the reconstruction {made}"
        raise ValueError(
            "--paths=straight knows of no objects, so that none has to be reconstructed. "
            f"{instead}, or use --paths=tree."
        )
    if made and not given and not (Path(made) / cli_flags.RECONSTRUCTION).is_file():
        raise ValueError(
            f"{file} names the reconstruction {made}, which is not there. Give where it is now as "
            "--reconstruction, or add --method=r3f to reconstruct the object of the scene anew."
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
            f"--ior={ior[-1]}, but there is one reconstructed object, without a name. Give its "
            "index alone, once, as in --ior=1.5."
        )
    return refraction_indices.parse(ior[0])


def find(run: Path, config: TrainConfig, *, ior: Sequence[str], resume: bool) -> MeshPart | None:
    """Returns the reconstructed object that is asked for, or `None` for the scene's meshes.

    It is reconstructed first, or as much of it as is not done yet.

    Args:
      run: the run's folder.
      config: the configuration, with the folder of the scene.
      ior: the values of --ior.
      resume: whether what is there may be continued.

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
                f"--out={run} is the reconstruction itself. Give a folder of its own for the run."
            )
        part = chain.read_part(out)
        if chain.fingerprint(scene) != records.read(out).inputs:
            print(
                f"warning: {out} was reconstructed from other images, masks or poses than those of "
                f"{scene}. Make sure that it is the same object in the same place, or reconstruct "
                "that of the scene with --method=r3f and without --reconstruction."
            )
        index = index or dict(config.scene.indices).get(part.name)
        return part if index is None else part._replace(index=index)
    if out.exists() and not resume:
        raise ValueError(
            f"{out} holds a reconstruction already. Continue with --resume, or give another --out."
        )
    wishes = config.wishes()  # what training has decided, a reconstruction does for itself
    asked = _RECONSTRUCTED.chosen(
        index=index,
        seed=config.seed,
        space=config.scene.space if "background" in wishes else None,
        radius=config.scene.radius if "radius" in wishes else None,
    )
    try:
        chain.reconstruct(scene, out, asked, compare=False)
    except KeyboardInterrupt:
        print("Stopped. Continue with the same command and --resume.")
        raise
    return chain.read_part(out)


def with_part(
    config: TrainConfig, part: MeshPart, made: Path, *, ior: Sequence[str], say: config_flags.Say
) -> TrainConfig:
    """Returns a configuration with its reconstructed object.

    Args:
      config: the configuration, with the folder of the scene.
      part: the object.
      made: folder that it was reconstructed into.
      ior: the values of --ior.
      say: is told which decisions are taken again.
    """
    folder, index = str(made.resolve()), ((part.name, part.index),)
    given = config.scene.reconstruction
    if given and Path(given).resolve() == made.resolve():
        config = config.decided(reconstruction=folder)
    else:
        config = config_flags.on_top(config, {"reconstruction": folder}, say=say)
    is_given = given_index(ior) is not None
    return config.override(ior=index) if is_given else config.decided(ior=index)


def note(run: Path, part: MeshPart | None, given: str) -> None:
    """Notes in the run's folder where its object comes from."""
    from experiments.r3f import object_source

    made = None
    if part is not None:
        made = object_source.Provenance(str(folder(run, given).resolve()), part.index)
    object_source.write(run, made)


def folder(run: Path, given: str | None) -> Path:
    """Returns the folder of a run's reconstruction."""
    return Path(given) if given else run / FOLDER
