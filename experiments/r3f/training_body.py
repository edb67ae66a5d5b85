"""Which body a training bends light with: the scene's meshes, or one that is reconstructed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from absl import flags
from etils import epy

from experiments.cli import flags as cli_flags
from experiments.runs import plans, refraction_indices

if TYPE_CHECKING:
    from refref_jax.data.meshes import MeshPart

with epy.lazy_imports():
    from experiments.r3f import chain, provenance, records

METHOD = flags.DEFINE_enum(
    "method",
    "oracle",
    ["oracle", "r3f"],
    "Where objects come from: the scene's meshes and their indices of refraction, or images and "
    "masks alone, from which one body and its index are reconstructed into {out}/r3f. Then --ior "
    "is that body's index, as 1.5; it is estimated if not given.",
)
RECONSTRUCTION = flags.DEFINE_string(
    "reconstruction",
    None,
    "Folder that experiments.reconstruct wrote: train with its body instead of the scene's meshes.",
)
_RECONSTRUCTED = cli_flags.reconstruction()

SETTLED = (
    METHOD,
    RECONSTRUCTION,
    *_RECONSTRUCTED,
)
"""Options that a run is begun with, and can not change when it is resumed."""

FOLDER = "r3f"
"""Below the run's folder: what is reconstructed for it."""


def reconstructs() -> bool:
    """Returns whether the options ask for a body that is reconstructed first."""
    return METHOD.value == "r3f" and RECONSTRUCTION.value is None


def find(run: Path, *, resume: bool) -> MeshPart | None:
    """Returns the body that the options ask for, or `None` for the scene's own meshes.

    It is reconstructed first, or as much of it as is not done yet.

    Args:
      run: the run's folder.
      resume: whether what is there may be gone on with.

    Raises:
      ValueError: if there is no such body.
    """
    if METHOD.value == "oracle" and RECONSTRUCTION.value is None:
        return None
    index = _given_index()
    out = _folder(run)
    if RECONSTRUCTION.value is not None:
        if out.resolve() == run.resolve():
            raise ValueError(
                f"--out={run} is the reconstruction itself. Give a folder of its own for the run."
            )
        body = chain.read_part(out)
        if chain.fingerprint(plans.opened_scene()) != records.read(out).inputs:
            print(
                f"warning: {out} was reconstructed from other images, masks or poses than those of "
                f"{plans.SCENE.value}. Make sure that it is the same object in the same place."
            )
        return body if index is None else body._replace(index=index)
    if out.exists() and not resume:
        raise ValueError(
            f"{out} holds a reconstruction already. Continue with --resume, or give another --out."
        )
    config = _RECONSTRUCTED.chosen(index=index, seed=plans.SEED.value, space=plans.SPACE)
    try:
        chain.reconstruct(plans.opened_scene(), out, config, compare=False)
    except KeyboardInterrupt:
        print("Stopped. Continue with the same command and --resume.")
        raise
    return chain.read_part(out)


def note(run: Path, body: MeshPart | None) -> None:
    """Notes in the run's folder where its body comes from."""
    found = None if body is None else provenance.Provenance(str(_folder(run).resolve()), body.index)
    provenance.write(run, found)


def _folder(run: Path) -> Path:
    return run / FOLDER if RECONSTRUCTION.value is None else Path(RECONSTRUCTION.value)


def _given_index() -> float | None:
    """Returns the index of `--ior=NUMBER`, if it is given."""
    words = plans.IOR.value
    if not words:
        return None
    if len(words) > 1 or "=" in words[0]:
        raise ValueError(
            f"--ior={words[-1]}, but there is one reconstructed body, without a name. Give its "
            "index alone, once, as in --ior=1.5."
        )
    return refraction_indices.parse(words[0])


def check_options() -> None:
    """Refuses options that contradict each other, or would have no effect, before any import.

    Raises:
      ValueError: if there are any, or an index is none.
    """
    if METHOD.value == "oracle" and RECONSTRUCTION.value is None:
        refraction_indices.parse_named(plans.IOR.value)
    else:
        _given_index()
    if METHOD.value == "oracle" and RECONSTRUCTION.value is not None and METHOD.present:
        raise ValueError(
            "--method=oracle takes the scene's own meshes, not a reconstruction. Leave out either "
            "--method or --reconstruction."
        )
    given = [f"--{holder.name}" for holder in SETTLED[2:] if flags.FLAGS[holder.name].present]
    if given and not reconstructs():
        raise ValueError(
            f"{', '.join(given)} would have no effect, since nothing is reconstructed. Leave it "
            "out, or add --method=r3f."
        )
    if (reconstructs() or RECONSTRUCTION.value) and plans.PATHS.value == "straight":
        raise ValueError(
            "--paths=straight knows of no objects, so that none has to be reconstructed. Leave out "
            "--method and --reconstruction, or use --paths=tree."
        )
