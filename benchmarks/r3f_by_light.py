"""Claim: light refines shape and index until they are nearly as good as the true ones.

    python -m benchmarks.r3f_by_light --scenes=FOLDER,FOLDER [--limit=N] [--field_steps=N] \
        [--straight_steps=N] [--objects=light]

Each scene is reconstructed from its images and masks as `experiments.reconstruct` does. The first
table has, for the surface from masks, for every shape that light fitted and for the scene's own
mesh, the mean error of pixels that were not fitted, the index of refraction, and the angle between
its normals and the true ones. The second has the results of training with the reconstruction, and
with the scene's own meshes: masked PSNR on the test split, with a backdrop and, with
`--field_steps`, with a field. With `--straight_steps` a field is trained along straight rays, too.
Finished reconstructions and trainings are reused.

Of a vessel with liquid the level, both indices, tints and absorption are printed, too.

Asserted are the bounds of `_MUST` for the scenes named there, for all others that light is no worse
than masks, and with `--straight_steps` that light is 3 dB better than straight rays.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from absl import app, flags

from experiments.r3f import object_source, records
from experiments.r3f.records import Reconstruction
from experiments.runs import measured_runs, subprocesses
from refref_jax.data import meshes
from refref_jax.data.scene_assembly import shaded_mesh
from refref_jax.reconstruct.mesh_distance import Distance, compare_meshes

_SCENES = flags.DEFINE_list("scenes", ["experiments/data/cube_smcvx_ball"], "Folders of scenes.")
_LIMIT = flags.DEFINE_integer("limit", 8, "Number of test images, evenly spaced.", 1)
_RAYS_PER_PIXEL = flags.DEFINE_integer("rays_per_pixel", 4, "Rays per pixel in evaluation.", 1)
_FIELD_STEPS = flags.DEFINE_integer("field_steps", 0, "Steps of a field; 0 trains none.", 0)
_STRAIGHT_STEPS = flags.DEFINE_integer(
    "straight_steps", 0, "Steps of a field along straight rays; 0 trains none.", 0
)
_KINDS = ("masks", "light", "true")
_OBJECTS = flags.DEFINE_multi_enum("objects", _KINDS, _KINDS, "Objects to train with.")
_OUT = flags.DEFINE_string("out", "runs/r3f_by_light", "Output folder.")


class Bounds(NamedTuple):
    """What must hold on a scene: largest errors, and least masked PSNR.

    Attributes:
      normals: mean angle between normals, degrees.
      normals_99: the angle that 99 of 100 are below.
      index: error of the index of refraction.
      psnr: masked PSNR with a backdrop, dB; `None` if no bound is stated.
    """

    normals: float
    normals_99: float
    index: float
    psnr: float | None


_MUST = {
    "torus": Bounds(0.25, 1.2, 0.003, 32.0),
    "ball": Bounds(0.16, 0.6, 0.001, 34.7),
    "cylinder": Bounds(0.5, 4.0, 0.003, 24.0),
    "flask": Bounds(180.0, 180.0, 0.01, 25.0),
}
"""Bounds by object."""

# Least gain over straight rays in masked PSNR, dB.
_GAIN = 3.0

# Largest errors of the level of a liquid, of its index and of its tint.
_LEVEL, _LIQUID, _TINT = 0.015, 0.01, 0.03

# Share of the radius of a part within which its level is measured.
_NEAR_AXIS = 0.05


class Row(NamedTuple):
    """One surface: how well it explains pixels, and how far it is from the truth."""

    shape: str
    error: float | None
    index: float
    deviation: float | None
    distance: Distance | None


def main(arguments: list[str]) -> None:
    del arguments
    wrong = []
    print("| scene | surface | error, sRGB | index | normals, degrees: mean, 99 % | Chamfer, % |")
    print("|---|---|---|---|---|---|", flush=True)
    scenes = [Path(scene) for scene in _SCENES.value]
    for scene in scenes:
        wrong += _measure(scene)
    print("\n| scene | background | masks | light | true meshes | straight rays |")
    print("|---|---|---|---|---|---|", flush=True)
    for scene in scenes:
        wrong += _train_all(scene)
    assert not wrong, "; ".join(wrong)


def _folder(scene: Path) -> Path:
    return Path(_OUT.value) / scene.resolve().name


def _measure(scene: Path) -> list[str]:
    """Reconstructs a scene, prints its surfaces, and returns what is out of bounds."""
    name, out = scene.resolve().name, _folder(scene) / "reconstruction"
    command = [f"--scene={scene}", f"--out={out}"]
    subprocesses.run("reconstruct", *command, log=_folder(scene) / "reconstruct.log")
    found = records.read(out)
    parts = meshes.read_meshes(scene)
    rows = _rows(out, found, parts)
    for row in rows:
        print(_line(name, row), flush=True)
    masks, light = rows[0], rows[-1]
    if light.error is not None and masks.error is not None and light.error > masks.error:
        return [f"{name}: light is worse than masks"]
    if found.light is not None and found.light.parts:
        return _measure_inside(name, out, found, parts)
    must = _MUST.get(name.split("_", 2)[-1])
    if must is None or light.distance is None:
        return []
    within = {
        "normals": light.distance.normal_error <= must.normals,
        "99 % of the normals": light.distance.normal_error_99 <= must.normals_99,
        "index": abs(light.index - parts[0].index) <= must.index,
    }
    return [f"{name}: {what} out of bounds" for what, holds in within.items() if not holds]


def _measure_inside(
    name: str, out: Path, found: Reconstruction, parts: Sequence[meshes.MeshPart]
) -> list[str]:
    """Prints what is inside a vessel beside the truth, and returns what is out of bounds."""
    true, ours = (
        {_kind(p): p for p in each} for each in (parts, object_source.read_parts(out, found))
    )
    print("| part | index | truth | tint | truth | absorption | truth | level | truth |")
    print("|---|---|---|---|---|---|---|---|---|")
    wrong = []
    if set(true) != set(ours):
        wrong.append(f"{name}: {sorted(ours)} were found, {sorted(true)} are there")
    for kind in sorted(set(true) & set(ours)):
        part = ours[kind]
        levels = [_level(each) for each in (part, true[kind])]
        tints = [np.asarray(each.tint) for each in (part, true[kind])]
        print(
            f"| {kind} | {part.index:.4f} | {true[kind].index:g} | {np.round(tints[0], 3)} | "
            f"{tints[1]} | {np.round(part.absorption, 3)} | {true[kind].absorption} | "
            f"{levels[0]:.4f} | {levels[1]:.4f} |",
            flush=True,
        )
        within = {
            "index": abs(part.index - true[kind].index) <= _LIQUID,
            "tint": np.max(np.abs(tints[0] - tints[1])) <= _TINT,
            "level": kind != "liquid" or abs(levels[0] - levels[1]) <= _LEVEL,
        }
        wrong += [f"{name}: {what} of {kind}" for what, holds in within.items() if not holds]
    return wrong


def _level(part: meshes.MeshPart) -> float:
    """Returns the height of the upper surface near the axis: at the wall, a liquid rises."""
    vertices = part.vertices
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    radii = np.linalg.norm((vertices - middle)[:, :2], axis=-1)
    near = radii <= max(_NEAR_AXIS * radii.max(), radii.min())
    return float(vertices[near, 2].max())


def _kind(part: meshes.MeshPart) -> str:
    """Returns what a part is of: glass, air, opaque matter, or some liquid."""
    word = part.name.split("_")[-1]
    return word if word in ("glass", "air", "opaque") else "liquid"


def _rows(out: Path, found: Reconstruction, parts: Sequence[meshes.MeshPart]) -> tuple[Row, ...]:
    """Returns the surface from masks, and the one that is used."""
    truth = shaded_mesh(parts[0]) if len(parts) == 1 else None
    rows = []
    for facts in (dataclasses.replace(found, light=None), found):
        mesh, light = object_source.read_mesh(out, facts), found.light
        index = object_source.index_facts(facts)
        error = None if light is None else (light.before if facts.light is None else light.after)
        shape = "masks" if facts.light is None or light is None else light.shape
        distance = None if truth is None else compare_meshes(mesh, truth)
        rows.append(Row(shape, error, index.index, index.error, distance))
    return tuple(rows)


def _line(name: str, row: Row) -> str:
    error = "" if row.error is None else f"{row.error:.4f}"
    deviation = "" if row.deviation is None else f" ± {row.deviation:.5f}"
    line = f"| {name} | {row.shape} | {error} | {row.index:.4f}{deviation} "
    if row.distance is None:
        return f"{line}| | |"
    angles = f"{row.distance.normal_error:.3f}, {row.distance.normal_error_99:.2f}"
    return f"{line}| {angles} | {100.0 * row.distance.chamfer:.4f} |"


def _train_all(scene: Path) -> list[str]:
    """Trains with each object, prints masked PSNR, and returns what is out of bounds."""
    name, out = scene.resolve().name, _folder(scene) / "reconstruction"
    masks = _folder(scene) / "masks"
    objects = {
        "masks": [f"--reconstruction={masks}"],
        "light": [f"--reconstruction={out}"],
        "true": [],
    }
    objects = {kind: objects[kind] for kind in _OBJECTS.value}
    if "masks" in objects:
        options = [f"--scene={scene}", f"--out={masks}", "--refinement=none"]
        options.append(f"--ior={records.read(out).index.index}")
        subprocesses.run("reconstruct", *options, log=_folder(scene) / "masks.log")
    worlds = {"backdrop": ["--far_field=backdrop"]}
    if _FIELD_STEPS.value:
        worlds["field"] = _field(_FIELD_STEPS.value)
    wrong, straight = [], -np.inf
    if steps := _STRAIGHT_STEPS.value:
        straight = _masked(scene, "straight", [*_field(steps), "--paths=straight"])
    for world, more in worlds.items():
        found = {
            kind: _masked(scene, f"{world}_{kind}", [*given, *more, "--paths=tree"])
            for kind, given in objects.items()
        }
        cells = " | ".join(f"{found[kind]:.2f}" if kind in found else "" for kind in _KINDS)
        last = f"{straight:.2f}" if _STRAIGHT_STEPS.value else ""
        print(f"| {name} | {world} | {cells} | {last} |", flush=True)
        if world != "backdrop" or "light" not in found:
            continue
        if found["light"] < straight + _GAIN:
            wrong.append(f"{name}: {found['light']:.2f} dB masked, straight rays {straight:.2f}")
        must = _MUST.get(name.split("_", 2)[-1])
        if must and must.psnr and found["light"] < must.psnr:
            wrong.append(f"{name}: {found['light']:.2f} dB masked, {must.psnr} wanted")
    return wrong


def _field(steps: int) -> list[str]:
    """Returns the options of a field."""
    return ["--far_field=field", "--preset=tiny", f"--steps={steps}"]


def _masked(scene: Path, name: str, options: Sequence[str]) -> float:
    run = _folder(scene) / name
    measured_runs.train(run, scene=scene, options=options)
    looks = [f"--rays_per_pixel={_RAYS_PER_PIXEL.value}", f"--limit={_LIMIT.value}"]
    return measured_runs.evaluate(run, scene=scene, options=looks).psnr_masked


if __name__ == "__main__":
    app.run(main)
