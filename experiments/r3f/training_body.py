"""The object of a training: the scene's meshes, or one reconstructed from images and masks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from absl import flags

from experiments.cli import flags as cli_flags
from experiments.runs import refraction_indices
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

FOLDER = "r3f"
"""Below the run's folder: what is reconstructed for it."""


def reconstructs(given: str | None) -> bool:
    """Returns whether an object is reconstructed first.

    Args:
      given: folder of a reconstruction that is there already.
    """
    return METHOD.value == "r3f" and not given


def is_reconstructed(given: str | None) -> bool:
    """Returns whether the object is a reconstructed one."""
    return METHOD.value == "r3f" or bool(given)


def check_flags(given: str | None, *, paths: str | None, ior: Sequence[str]) -> None:
    """Refuses flags that contradict each other, or would have no effect, before any import.

    Args:
      given: the value of --reconstruction.
      paths: the value of --paths.
      ior: the values of --ior.

    Raises:
      ValueError: if there are any, or an index is not one.
    """
    if is_reconstructed(given):
        given_index(ior)
    if METHOD.value == "oracle" and given and METHOD.present:
        raise ValueError(
            "--method=oracle takes the scene's own meshes, not a reconstruction. Leave out either "
            "--method or --reconstruction."
        )
    idle = [f"--{holder.name}" for holder in FLAGS[1:] if holder.present]
    if idle and not reconstructs(given):
        raise ValueError(
            f"{', '.join(idle)} would have no effect, since nothing is reconstructed. Leave it "
            "out, or add --method=r3f."
        )
    if is_reconstructed(given) and paths == "straight":
        raise ValueError(
            "--paths=straight knows of no objects, so that none has to be reconstructed. Leave out "
            "--method and --reconstruction, or use --paths=tree."
        )


def given_index(ior: Sequence[str]) -> float | None:
    """Returns the index of `--ior=NUMBER`, if it is given.

    Raises:
      ValueError: if there are several, or one has a name.
    """
    if not ior:
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
    if not is_reconstructed(given):
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
                f"{scene}. Make sure that it is the same object in the same place."
            )
        index = index or dict(config.scene.indices).get(part.name)
        return part if index is None else part._replace(index=index)
    if out.exists() and not resume:
        raise ValueError(
            f"{out} holds a reconstruction already. Continue with --resume, or give another --out."
        )
    asked = _RECONSTRUCTED.chosen(
        index=index, seed=config.seed, space=config.scene.space, radius=config.scene.radius
    )
    try:
        chain.reconstruct(scene, out, asked, compare=False)
    except KeyboardInterrupt:
        print("Stopped. Continue with the same command and --resume.")
        raise
    return chain.read_part(out)


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
