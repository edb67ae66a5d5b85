"""Claim: residuals show which input is wrong, where its error costs a decibel or two.

    python -m benchmarks.residuals --scenes=BALL,TORUS,FLASK --out=FOLDER

Renders test views before their known background, with one input wrong by a known amount (those of
`benchmarks.sensitivity`), and writes what `experiments.runs.residuals` measures, and its warnings:
`residuals.csv`, one row per scene, input and error.

Asserted are: no warning for right inputs; warnings of cameras for wrong cameras, of the background
for a wrong background, of a growth inside the outline for index and size, of a shift there for
the object's place.
"""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from absl import app, flags

from benchmarks.wrong_inputs import ERRORS, Inputs
from experiments.runs import known_scene, residuals
from experiments.runs.residuals import Residuals
from refref_jax.data import mesh_queries, meshes, scene_folder, scene_names, scene_properties
from refref_jax.data.mesh_queries import Containment
from refref_jax.optics.path_settings import PATH_PRESETS

_SCENES = flags.DEFINE_list("scenes", ["experiments/data/cube_smcvx_ball"], "Folders of scenes.")
_OUT = flags.DEFINE_string("out", None, "Folder to write to.", required=True)
_VIEWS = flags.DEFINE_list("views", ["0", "5", "10"], "Test views.")

_NOTHING = "nothing"

# Word of the sentence that each wrong input must lead to, and its error; none for those that may
# look like several others.
_TRIALS = {
    _NOTHING: (0.0, ""),
    "index": (0.01, "index of refraction"),
    "size of the object": (0.3, "index of refraction"),
    "place of the object": (0.3, "place"),
    "rotation of the object": (1.0, None),
    "vertices": (0.1, None),
    "normals": (0.3, None),
    "rotation of the cameras": (0.3, "cameras"),
    "place of the cameras": (0.3, "cameras"),
    "size of the background": (3.0, "background"),
}


class Row(NamedTuple):
    """What one wrong input looks like: medians over the views, pixels."""

    scene: str
    wrong: str
    error: str
    shift_beside: str
    growth_beside: str
    shift_inside: str
    growth_inside: str
    psnr_masked: str
    warnings: str


def main(arguments: list[str]) -> None:
    del arguments
    out = Path(_OUT.value)
    out.mkdir(parents=True, exist_ok=True)
    rows, wrong = [], []
    for folder in map(Path, _SCENES.value):
        frames, properties = scene_folder.read_frames(folder, "test"), scene_properties.read(folder)
        parts = tuple(meshes.read_meshes(folder, properties=properties))
        inputs, tree = Inputs(parts, frames, properties), mesh_queries.find_containment(parts)
        for name, (error, word) in _TRIALS.items():
            row = _row(folder, inputs, tree, name, error)
            rows.append(row)
            print(" | ".join(row), flush=True)
            if word is not None and (word not in row.warnings or (row.warnings and not word)):
                wrong.append(f"{row.scene}: {name} leads to '{row.warnings}'")
    with (out / "residuals.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([Row._fields, *rows])
    print(f"Measures: {out / 'residuals.csv'}")
    assert not wrong, "; ".join(wrong)


def _row(folder: Path, inputs: Inputs, tree: Containment, name: str, error: float) -> Row:
    """Renders a scene with one wrong input."""
    if name != _NOTHING:
        inputs = ERRORS[name].perturb(inputs, error, np.random.default_rng(0))
    chosen = [int(view) for view in _VIEWS.value]
    scene = known_scene.build_scene(
        folder,
        inputs.parts,
        tree,
        frames=inputs.frames,
        chosen=chosen,
        rule=known_scene.rule_of(inputs.properties),
        properties=inputs.properties,
    )
    views: list[Residuals] = []
    psnr = []
    for view in range(len(chosen)):
        rgb = known_scene.render_view(scene, view, settings=PATH_PRESETS["tree"], side=2).rgb
        target = scene.images[view] / 255.0
        views.append(residuals.of_view(np.asarray(rgb), target, np.asarray(scene.masks[view])))
        psnr.append(known_scene.measure(scene, view, rgb)["psnr_masked"])
    unit = "" if name == _NOTHING else f"{error:g} {ERRORS[name].unit}".strip()
    return Row(
        scene_names.of_folder(folder),
        name,
        unit,
        *_medians(views, "beside"),
        *_medians(views, "inside"),
        f"{np.mean(psnr):.2f}",
        " ".join(residuals.warnings(views)),
    )


def _medians(views: Sequence[Residuals], where: str) -> tuple[str, str]:
    """Returns the median shift and growth of the pixels beside or inside the outline."""
    motions = [getattr(view, where) for view in views]
    known = [motion for motion in motions if motion is not None]
    if not known:
        return "", ""
    shift = np.median([motion.length for motion in known])
    return f"{shift:.3f}", f"{np.median([m.growth * m.reach for m in known]):.3f}"


if __name__ == "__main__":
    app.run(main)
