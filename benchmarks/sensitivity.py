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
import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.ndimage
from absl import app, flags
from jaxtyping import Float

from experiments.figures.style import COLOURS, pyplot, style
from experiments.runs import known_scene
from experiments.runs.known_scene import KnownScene
from refref_jax import choices
from refref_jax.data import mesh_queries, meshes, scene_folder, scene_names, scene_properties
from refref_jax.data.mesh_queries import Containment
from refref_jax.data.meshes import MeshPart
from refref_jax.data.scene_assembly import shaded_mesh
from refref_jax.data.scene_properties import SceneProperties
from refref_jax.optics.path_settings import PATH_PRESETS, PathSettings

_SCENES = flags.DEFINE_list("scenes", ["experiments/data/cube_smcvx_ball"], "Folders of scenes.")
_OUT = flags.DEFINE_string("out", None, "Folder to write to.", required=True)
_VIEWS = flags.DEFINE_list("views", ["0", "10"], "Test views.")
_RAYS_PER_PIXEL = flags.DEFINE_integer("rays_per_pixel", 4, "Rays per pixel.", 1)
_SEED = flags.DEFINE_integer("seed", 0, "Seed of the directions of errors.")

_WAVES, _WAVELENGTH = 16, 0.25
_COST, _NOISE = 1.0, 0.05
_PATHS = ("tree", "paper")


class Inputs(NamedTuple):
    """What a rendering needs: everything that may be wrong."""

    parts: tuple[MeshPart, ...]
    frames: scene_folder.Frames
    properties: SceneProperties


class Error(NamedTuple):
    """An input that may be wrong.

    Attributes:
      unit: unit of its error.
      amounts: errors, in ascending order; the first is small.
      spoil: function of the inputs, an error and a random generator to wrong inputs.
    """

    unit: str
    amounts: tuple[float, ...]
    spoil: Callable[[Inputs, float, np.random.Generator], Inputs]


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
            spoilt = error.spoil(inputs, amount, np.random.default_rng(_SEED.value))
            found = _psnr(folder, spoilt, tree, settings, widen=wrong == "mask" and amount)
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


# ---- Errors ----


def _of_index(inputs: Inputs, amount: float, draw: np.random.Generator) -> Inputs:
    """Adds to the index of all parts that are not empty."""
    del draw
    parts = tuple(
        part._replace(index=part.index + amount) if part.index > 1.0 else part
        for part in inputs.parts
    )
    return inputs._replace(parts=parts)


def _of_vertices(inputs: Inputs, amount: float, draw: np.random.Generator) -> Inputs:
    """Moves vertices along their normals, by percents of the diagonal (root mean square)."""
    centre, diagonal = _extent(inputs.parts)
    wave = _waves(centre, diagonal, draw)
    parts = []
    for part in inputs.parts:
        normals = np.zeros_like(part.vertices)
        np.add.at(normals, part.faces, shaded_mesh(part).normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        height = 0.01 * amount * diagonal * wave(part.vertices)[:, :1]
        parts.append(part._replace(vertices=part.vertices + height * normals))
    return inputs._replace(parts=tuple(parts))


def _of_normals(inputs: Inputs, amount: float, draw: np.random.Generator) -> Inputs:
    """Tilts shading normals, by degrees (root mean square); vertices stay."""
    wave = _waves(*_extent(inputs.parts), draw)
    parts = []
    for part in inputs.parts:
        normals = shaded_mesh(part).normals
        tilt = wave(part.vertices)[part.faces]
        tilt -= np.sum(tilt * normals, axis=-1, keepdims=True) * normals
        # Two of three components of unit variance are left.
        tilted = normals + math.tan(math.radians(amount)) / math.sqrt(2.0) * tilt
        tilted /= np.maximum(np.linalg.norm(tilted, axis=-1, keepdims=True), 1e-12)
        parts.append(part._replace(normals=tilted))
    return inputs._replace(parts=tuple(parts))


def _of_scale(inputs: Inputs, amount: float, draw: np.random.Generator) -> Inputs:
    """Enlarges the object about its centre, by percents."""
    del draw
    return _moved(inputs, (1.0 + 0.01 * amount) * np.eye(3), np.zeros(3))


def _of_rotation(inputs: Inputs, amount: float, draw: np.random.Generator) -> Inputs:
    """Turns the object about its centre, by degrees."""
    return _moved(inputs, _turn(amount, draw), np.zeros(3))


def _of_place(inputs: Inputs, amount: float, draw: np.random.Generator) -> Inputs:
    """Moves the object, by percents of its diagonal."""
    diagonal = _extent(inputs.parts)[1]
    return _moved(inputs, np.eye(3), 0.01 * amount * diagonal * _direction(draw))


def _of_aim(inputs: Inputs, amount: float, draw: np.random.Generator) -> Inputs:
    """Turns each camera about its centre, by degrees."""
    poses = inputs.frames.cameras.poses.copy()
    for pose in poses:
        pose[:, :3] = pose[:, :3] @ _turn(amount, draw)
    return _with_poses(inputs, poses)


def _of_position(inputs: Inputs, amount: float, draw: np.random.Generator) -> Inputs:
    """Moves each camera, by percents of its distance from the object."""
    poses, centre = inputs.frames.cameras.poses.copy(), _extent(inputs.parts)[0]
    for pose in poses:
        pose[:, 3] += 0.01 * amount * np.linalg.norm(pose[:, 3] - centre) * _direction(draw)
    return _with_poses(inputs, poses)


def _of_background(inputs: Inputs, amount: float, draw: np.random.Generator) -> Inputs:
    """Enlarges the background, by percents; an environment has no size."""
    del draw
    background, known = inputs.properties.background, inputs.properties.background.extent
    if known is None:
        return inputs
    background = dataclasses.replace(background, extent=(1.0 + 0.01 * amount) * known)
    return inputs._replace(properties=dataclasses.replace(inputs.properties, background=background))


def _of_mask(inputs: Inputs, amount: float, draw: np.random.Generator) -> Inputs:
    """Leaves everything as it is: `_psnr` widens the mask."""
    del amount, draw
    return inputs


ERRORS = {
    "index": Error("", (0.001, 0.003, 0.01, 0.03, 0.1), _of_index),
    "vertices": Error("% of the diagonal", (0.01, 0.03, 0.1, 0.3, 1.0), _of_vertices),
    "normals": Error("degrees", (0.1, 0.3, 1.0, 3.0, 10.0), _of_normals),
    "size of the object": Error("%", (0.1, 0.3, 1.0, 3.0, 10.0), _of_scale),
    "rotation of the object": Error("degrees", (0.1, 0.3, 1.0, 3.0, 10.0), _of_rotation),
    "place of the object": Error("% of the diagonal", (0.1, 0.3, 1.0, 3.0, 10.0), _of_place),
    "rotation of the cameras": Error("degrees", (0.03, 0.1, 0.3, 1.0, 3.0), _of_aim),
    "place of the cameras": Error("% of the distance", (0.03, 0.1, 0.3, 1.0, 3.0), _of_position),
    "size of the background": Error("%", (0.1, 0.3, 1.0, 3.0, 10.0), _of_background),
    "mask": Error("pixels", (1.0, 2.0, 4.0), _of_mask),
}
"""Inputs that may be wrong, by name."""


def _extent(parts: Sequence[MeshPart]) -> tuple[Float[np.ndarray, "3"], float]:
    """Returns the centre and the diagonal of the box around all parts."""
    vertices = np.concatenate([part.vertices for part in parts])
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return 0.5 * (low + high), float(np.linalg.norm(high - low))


def _waves(
    centre: Float[np.ndarray, "3"], diagonal: float, draw: np.random.Generator
) -> Callable[[np.ndarray], np.ndarray]:
    """Returns a function from points to three smooth random values of unit variance."""
    towards = draw.normal(size=(_WAVES, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    phases, heights = draw.uniform(0.0, 2.0 * np.pi, _WAVES), draw.normal(size=(_WAVES, 3))
    heights *= np.sqrt(2.0 / np.sum(np.square(heights), axis=0))
    number = 2.0 * np.pi / (_WAVELENGTH * diagonal) * towards

    def wave(points: np.ndarray) -> np.ndarray:
        return np.sin((points - centre) @ number.T + phases) @ heights

    return wave


def _moved(
    inputs: Inputs, linear: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]
) -> Inputs:
    """Maps the object about its centre; given shading normals are computed again."""
    centre = _extent(inputs.parts)[0]
    parts = tuple(
        part._replace(vertices=(part.vertices - centre) @ linear.T + centre + shift, normals=None)
        for part in inputs.parts
    )
    return inputs._replace(parts=parts)


def _with_poses(inputs: Inputs, poses: Float[np.ndarray, "views 3 4"]) -> Inputs:
    cameras = inputs.frames.cameras._replace(poses=poses)
    return inputs._replace(frames=inputs.frames._replace(cameras=cameras))


def _direction(draw: np.random.Generator) -> Float[np.ndarray, "3"]:
    towards = draw.normal(size=3)
    return towards / np.linalg.norm(towards)


def _turn(degrees: float, draw: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    """Returns a rotation about a random axis (Rodrigues)."""
    x, y, z = _direction(draw)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = math.radians(degrees)
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross


# ---- Results ----


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
    figure, axes = pyplot.subplots(2, 5, figsize=(16.0, 6.4), sharey=True)
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
        axis.set_xlabel(error.unit)
        style(axis)
    for row in axes:
        row[0].set_ylabel("masked PSNR, dB")
    axes[0, 0].legend(fontsize=7)
    figure.savefig(path, bbox_inches="tight")
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
