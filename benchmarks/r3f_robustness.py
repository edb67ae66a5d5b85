"""Claim: light finds the shape and the index from inputs that are a little wrong.

    python -m benchmarks.r3f_robustness [--scene=FOLDER]

The scene is reconstructed as it is, and with a fault in its inputs: half of its views, masks that
are a pixel too wide, one mask that is shifted, an index that is 0.03 off where the light begins.
The table has the chosen shape, the index, and the angle between its normals and those of the
scene's own mesh. In the last row all walls are grey: a clear object in front of them cannot be
seen, so its index is given, and the surface must stay as the masks give it. Finished
reconstructions are reused.
"""

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from absl import app, flags, logging
from scipy.ndimage import binary_dilation

from experiments.r3f import index_stage, light_stage, object_source, records
from experiments.runs import subprocesses
from refref_jax.data import meshes
from refref_jax.data.scene_assembly import shaded_mesh
from refref_jax.geometry.triangle_meshes import Mesh
from refref_jax.reconstruct.mesh_distance import compare_meshes

_SCENE = flags.DEFINE_string("scene", "experiments/data/cube_smcvx_ball", "Folder of the scene.")
_OUT = flags.DEFINE_string("out", "runs/r3f_robustness", "Output folder.")

_GREY, _NOISE = 188, 1.0
"""Level of grey walls, and standard deviation of the noise of their images, in 8-bit levels."""

_SHIFT = 3
"""Shift of one mask, pixels."""

_OFF = 0.03
"""Error of the index where the light begins."""

_NORMALS, _INDEX = 0.25, 0.003
"""Largest mean angle of the normals in degrees, and error of the index."""


def main(arguments: list[str]) -> None:
    del arguments
    logging.set_verbosity(logging.ERROR)  # Orbax logs every checkpoint
    print(
        "| inputs | surface | index | normals, degrees: mean, 99 % |\n|---|---|---|---|", flush=True
    )
    wrong = []
    for name, change in _FAULTS.items():
        scene = _copy(name, change)
        out = scene.parent / "reconstruction"
        options = [f"--scene={scene}", f"--out={out}"]
        options += ["--ior=1.5"] if change is _grey_walls else []
        subprocesses.run("reconstruct", *options, log=scene.parent / "reconstruct.log")
        found = records.read(out)
        wrong += _measured(name, out, found)
        if name == "as they are":
            wrong += _begun_off(scene, out, found)
    assert not wrong, "; ".join(wrong)


def _copy(name: str, change: Callable[[Path], None]) -> Path:
    """Returns a copy of the scene with a fault; one that was made before is kept."""
    scene = Path(_OUT.value) / name.replace(" ", "_") / "scene"
    if not scene.is_dir():
        draft = scene.with_suffix(".draft")
        shutil.rmtree(draft, ignore_errors=True)
        shutil.copytree(_SCENE.value, draft)
        change(draft)
        draft.rename(scene)
    return scene


def _half_of_the_views(scene: Path) -> None:
    path = scene / "transforms_train.json"
    facts = json.loads(path.read_text())
    facts["frames"] = facts["frames"][::2]
    path.write_text(json.dumps(facts))


def _wide_masks(scene: Path) -> None:
    for path in sorted(scene.glob("mask/*/*.png")):
        iio.imwrite(path, 255 * binary_dilation(iio.imread(path) > 0).astype(np.uint8))


def _shifted_mask(scene: Path) -> None:
    path = sorted(scene.glob("mask/train/*.png"))[0]
    iio.imwrite(path, np.roll(iio.imread(path), _SHIFT, axis=1))


def _grey_walls(scene: Path) -> None:
    """Writes images of uniform walls, in front of which a clear object cannot be seen."""
    generator = np.random.default_rng(0)
    for split in ("train", "val"):
        for path in sorted((scene / split).glob("*.png")):
            noise = generator.normal(0.0, _NOISE, (*iio.imread(path).shape[:2], 3))
            iio.imwrite(path, np.round(_GREY + noise).astype(np.uint8))


_FAULTS: dict[str, Callable[[Path], None]] = {
    "as they are": lambda scene: None,
    "half of the views": _half_of_the_views,
    "masks a pixel too wide": _wide_masks,
    "one mask shifted": _shifted_mask,
    "grey walls": _grey_walls,
}


def _measured(name: str, out: Path, found: records.Reconstruction) -> list[str]:
    """Prints a row, and returns what is out of bounds."""
    assert found.light is not None, "light was not left out"
    facts = object_source.index_facts(found)
    shape = found.light.shape if found.light.kept else f"masks: {found.light.remark}"
    mesh = object_source.read_mesh(out, found)
    wrong = _row(name, shape, facts.index, facts.error, mesh)
    if name == "grey walls":
        return [f"{name}: the surface was changed"] if found.light.kept else []
    return wrong


def _begun_off(scene: Path, out: Path, found: records.Reconstruction) -> list[str]:
    """Begins the light with a wrong index; prints a row, and returns what is out of bounds."""
    surface = index_stage.learn_backdrop(scene, out / "index", seed=0)
    assert surface is not None and found.index is not None, "it was reconstructed before a backdrop"
    masks = object_source.read_mesh(out, dataclasses.replace(found, light=None))
    seen = light_stage.read(scene, seed=0)
    known = dataclasses.replace(found.index, index=found.index.index + _OFF)
    revolved = light_stage.look_at_opaque_parts(scene, masks, surface, seen, seed=0)
    trials = light_stage.fit(scene, masks, known, surface, seen, revolved, seed=0)
    chosen = light_stage.choose(scene, masks, trials)[1]
    name = f"index begun {_OFF:g} off"
    return _row(name, chosen.name, chosen.outer_index, chosen.index_deviation, chosen.mesh)


def _row(name: str, shape: str, index: float, deviation: float | None, mesh: Mesh) -> list[str]:
    part = meshes.read_meshes(Path(_SCENE.value))[0]
    distance = compare_meshes(mesh, shaded_mesh(part))
    bar = "" if deviation is None else f" ± {deviation:.5f}"
    angles = f"{distance.normal_error:.3f}, {distance.normal_error_99:.2f}"
    print(f"| {name} | {shape} | {index:.4f}{bar} | {angles} |", flush=True)
    within = {
        "normals": distance.normal_error <= _NORMALS,
        "index": abs(index - part.index) <= _INDEX,
    }
    return [f"{name}: {what} out of bounds" for what, holds in within.items() if not holds]


if __name__ == "__main__":
    app.run(main)
