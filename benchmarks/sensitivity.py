"""Claim: masked PSNR falls with every error of the inputs, and which error costs a decibel.

    python -m benchmarks.sensitivity --scenes=BALL,TORUS,FLASK --out=FOLDER

Renders test views of scenes before their known background, as `experiments.render_known` does, with
one input that is wrong by a known amount: the index of refraction, the vertices, the shading
normals, the size, direction or place of the object, the direction or place of the cameras, the size
of the background. A mask only decides where an image is compared, so that its row shows what a
wrong mask does to the measure. Light follows the path tree and the paper's paths. Errors of shape
are smooth: sixteen waves in random directions, a quarter of the object's diagonal long.

Writes `sensitivity.csv`, one row per scene, paths, input and error, `sensitivity.png`, its curves,
and `one_decibel.csv`, the error of each input that costs 1 dB, which is printed, too. Asserted are,
of every input but the mask: its largest error is nowhere better than the right input (by 0.05 dB; a
ball may be turned), and costs 1 dB on one of the scenes.
"""

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.ndimage
from absl import app, flags

from benchmarks.wrong_inputs import ERRORS, Inputs
from experiments.figures.style import COLOURS, pyplot, style
from experiments.runs import known_scene
from experiments.runs.known_scene import KnownScene
from refref_jax import choices
from refref_jax.data import mesh_queries, meshes, scene_folder, scene_names, scene_properties
from refref_jax.data.mesh_queries import Containment
from refref_jax.optics.path_settings import PATH_PRESETS, PathSettings

_SCENES = flags.DEFINE_list("scenes", ["experiments/data/cube_smcvx_ball"], "Folders of scenes.")
_OUT = flags.DEFINE_string("out", None, "Folder to write to.", required=True)
_VIEWS = flags.DEFINE_list("views", ["0", "10"], "Test views.")
_RAYS_PER_PIXEL = flags.DEFINE_integer("rays_per_pixel", 4, "Rays per pixel.", 1)
_SEED = flags.DEFINE_integer("seed", 0, "Seed of the directions of errors.")

_COST, _NOISE = 1.0, 0.05
_PATHS = ("tree", "paper")


class Trial(NamedTuple):
    """A row of the results: masked PSNR, mean over the views, dB; the right input has error 0."""

    scene: str
    paths: str
    wrong: str
    unit: str
    error: float
    psnr_masked: float


def main(arguments: list[str]) -> None:
    del arguments
    out = Path(_OUT.value)
    out.mkdir(parents=True, exist_ok=True)
    trials: list[Trial] = []
    for folder in map(Path, _SCENES.value):
        for paths in _PATHS:
            trials += measure(folder, paths)
    measured = ([*each[:-1], f"{each.psnr_masked:.2f}"] for each in trials)
    _write(out / "sensitivity.csv", [Trial._fields, *measured])
    _write(out / "one_decibel.csv", costs(trials))
    draw(out / "sensitivity.png", trials)
    print(table(trials))
    print(f"\nMeasures: {out / 'sensitivity.csv'}\nCurves:   {out / 'sensitivity.png'}")
    check(trials)


def _write(path: Path, rows: Sequence[Sequence[object]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


def measure(folder: Path, paths: str) -> list[Trial]:
    """Renders a scene with all wrong inputs."""
    inputs, tree, settings = *_read(folder), PATH_PRESETS[paths]
    name = scene_names.of_folder(folder)
    right = _psnr(folder, inputs, tree, settings)
    print(f"{name}, {paths}: {right:.2f} dB with the right inputs", flush=True)
    trials = []
    for wrong, error in ERRORS.items():
        trials.append(Trial(name, paths, wrong, error.unit, 0.0, right))
        for amount in error.amounts:
            perturbed = error.perturb(inputs, amount, np.random.default_rng(_SEED.value))
            found = _psnr(folder, perturbed, tree, settings, widen=wrong == "mask" and amount)
            trials.append(Trial(name, paths, wrong, error.unit, amount, found))
            print(f"  {wrong} off by {amount:g} {error.unit}: {found:.2f} dB", flush=True)
    return trials


def _read(folder: Path) -> tuple[Inputs, Containment]:
    frames = scene_folder.read_frames(folder, "test")
    properties = scene_properties.read(folder)
    parts = tuple(meshes.read_meshes(folder, properties=properties))
    if frames.masks is None:
        raise ValueError(f"The test views of {folder} have no masks, which masked PSNR needs.")
    return Inputs(parts, frames, properties), mesh_queries.find_containment(parts)


def _psnr(
    folder: Path,
    inputs: Inputs,
    tree: Containment,
    settings: PathSettings,
    *,
    widen: float | bool = False,
) -> float:
    """Returns the mean masked PSNR of the views, dB, inside masks that may be too wide."""
    scene = known_scene.build_scene(
        folder,
        inputs.parts,
        tree,
        frames=inputs.frames,
        chosen=[int(view) for view in _VIEWS.value],
        rule=known_scene.rule_of(inputs.properties),
        properties=inputs.properties,
    )
    scene = _with_masks(scene, int(widen))
    side, found = choices.side_of(_RAYS_PER_PIXEL.value), []
    for view in range(len(scene.indices)):
        rgb = known_scene.render_view(scene, view, settings=settings, side=side).rgb
        found.append(known_scene.measure(scene, view, rgb)["psnr_masked"])
    return float(np.mean(found))


def _with_masks(scene: KnownScene, pixels: int) -> KnownScene:
    if not pixels:
        return scene
    square = np.ones((1, 2 * pixels + 1, 2 * pixels + 1), bool)
    return scene._replace(masks=scipy.ndimage.binary_dilation(scene.masks, square))


def cost_of_a_decibel(curve: Sequence[Trial]) -> float:
    """Returns the error at which masked PSNR has fallen by 1 dB; `inf` if it never does.

    Between two errors, it is interpolated over the logarithm of the error; below the first, in
    proportion to it.
    """
    right = curve[0].psnr_masked
    before, lost = 0.0, 0.0
    for trial in curve[1:]:
        now = right - trial.psnr_masked
        if now >= _COST:
            share = (_COST - lost) / (now - lost)
            return trial.error * (share if not before else (before / trial.error) ** (1.0 - share))
        before, lost = trial.error, now
    return math.inf


def curves(trials: Sequence[Trial]) -> dict[tuple[str, str, str], list[Trial]]:
    """Returns the trials of each scene, paths and input, in ascending order of their error."""
    found: dict[tuple[str, str, str], list[Trial]] = {}
    for trial in trials:
        found.setdefault((trial.scene, trial.paths, trial.wrong), []).append(trial)
    return found


def costs(trials: Sequence[Trial]) -> list[list[str]]:
    """Returns the error of each input that costs 1 dB, with headings; the first row has the dB."""
    found = curves(trials)
    pairs = list(dict.fromkeys((scene, paths) for scene, paths, _ in found))
    best = [found[scene, paths, "index"][0].psnr_masked for scene, paths in pairs]
    rows = [
        ["wrong", "unit", *(f"{scene} {paths}" for scene, paths in pairs)],
        ["nothing", "dB", *(f"{value:.2f}" for value in best)],
    ]
    for wrong, error in ERRORS.items():
        each = [cost_of_a_decibel(found[scene, paths, wrong]) for scene, paths in pairs]
        rows.append([wrong, error.unit, *("" if x == math.inf else f"{x:.2g}" for x in each)])
    return rows


def table(trials: Sequence[Trial]) -> str:
    """Returns the error of each input that costs 1 dB, as a table."""
    heading, *rows = (f"| {' | '.join(cells)} |" for cells in costs(trials))
    return "\n".join([heading, "|---" * (heading.count("|") - 1) + "|", *rows])


def draw(path: Path, trials: Sequence[Trial]) -> None:
    """Draws masked PSNR over the error of each input, with the right input at the left."""
    found = curves(trials)
    scenes = list(dict.fromkeys(trial.scene for trial in trials))
    figure, axes = pyplot.subplots(2, 5, figsize=(15.0, 6.4), sharey=True, layout="constrained")
    for axis, (wrong, error) in zip(axes.flat, ERRORS.items(), strict=True):
        for (scene, paths, name), curve in found.items():
            if name != wrong:
                continue
            x = [curve[1].error / 3.0, *(trial.error for trial in curve[1:])]
            y = [trial.psnr_masked for trial in curve]
            line, colour = "-" if paths == "tree" else ":", COLOURS[scenes.index(scene)]
            axis.plot(x, y, line, color=colour, label=f"{scene}, {paths}")
        axis.set_xscale("log")
        axis.set_title(wrong, fontsize=10)
        axis.set_xlabel(error.unit or "index of refraction")
        axis.set_xticks(error.amounts, [f"{amount:g}" for amount in error.amounts])
        axis.minorticks_off()
        style(axis)
    for row in axes:
        row[0].set_ylabel("masked PSNR, dB")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=6)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def check(trials: Sequence[Trial]) -> None:
    """Asserts the claim."""
    found = curves(trials)
    for wrong in ERRORS.keys() - {"mask"}:
        for (scene, paths, name), curve in found.items():
            better = curve[-1].psnr_masked > curve[0].psnr_masked + _NOISE
            assert name != wrong or not better, f"{scene}, {paths}: {wrong} is better when wrong"
        costs = [cost_of_a_decibel(x) for (_, paths, n), x in found.items() if n == wrong]
        assert min(costs) < math.inf, f"{wrong}: no error costs 1 dB on any of the scenes"


if __name__ == "__main__":
    app.run(main)
