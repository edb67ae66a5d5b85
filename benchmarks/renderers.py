"""Claim: see `_claim`.

    PYTHONPATH=FOLDER_OF_MITSUBA python -m benchmarks.renderers --scenes=BALL,TORUS,FLASK \
        --out=FOLDER --blender=PYTHON_OF_BLENDER

Test views of scenes before a known cube are rendered by the path tree (`render_known_camera`), by
Blender Cycles and by Mitsuba 3, with several numbers of rays or samples, and compared with the
truth: Cycles with many samples, whose noise follows from its two halves. All three get the same
meshes, cameras, indices and images. The images are decoded to linear light first, since Mitsuba
interpolates decoded texels and Cycles encoded ones. Pixels are box-filtered, no light is clamped,
and the other two follow 64 bounces; one of their samples is a random path, whereas a ray of ours
follows all branches above the threshold.

Seconds are CPU time of an image, on one core with one thread, the mean over views of the least of
the rounds, in which all take turns. They exclude imports, loading and compilation, which
`start_up` has: the first image of a scene, whatever it needed, minus a later one. Writes
`renderers.csv`, `renderers.png`, and images of all side by side. A renderer that is not installed,
or whose process ends, is omitted.
"""

import os

if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})

import csv
import dataclasses
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import imageio.v3 as iio
import jax
import numpy as np
import OpenEXR
from absl import app, flags

from benchmarks.oracles import colours
from refref_jax.data import mesh_queries, meshes, scene_assembly
from refref_jax.geometry import cameras
from refref_jax.optics.path_settings import TREE
from refref_jax.render import images, radiance_of, render_known_camera

_SCENES = flags.DEFINE_list("scenes", ["experiments/data/cube_smcvx_ball"], "Folders of scenes.")
_OUT = flags.DEFINE_string("out", None, "Folder to write to; it keeps the truth.", required=True)
_BLENDER = flags.DEFINE_string("blender", ".venv-dataset/bin/python", "Python that has bpy.")
_MITSUBA = flags.DEFINE_string("mitsuba", sys.executable, "Python that has Mitsuba.")
_VARIANT = flags.DEFINE_string("variant", "llvm_ad_rgb", "Variant of Mitsuba.")
_VIEWS = flags.DEFINE_list("views", ["0", "10"], "Test views.")
_SIZE = flags.DEFINE_integer("size", 100, "Width and height of the images in pixels.")
_TRUTH = flags.DEFINE_integer("truth", 4096, "Samples of the truth.")
_ROUNDS = flags.DEFINE_integer("rounds", 2, "Timed renderings of every image.")

_SAMPLES = (16, 64, 256, 1024)
_UNIFORM = (1, 4, 9, 16)
# First rays, refined rays, and tolerance.
_ADAPTIVE = ((1, 4, 0.2), (1, 16, 0.2), (4, 16, 0.1), (4, 36, 0.1), (9, 64, 0.1))
_FINE_TREE = dataclasses.replace(TREE, min_throughput=0.005, max_bends=32)
_HERE = Path(__file__).parent
_DATASET = _HERE.parent / "experiments" / "dataset"


class View(NamedTuple):
    """A view to render: scene folder, name of the view, pose, and field of view in radians."""

    folder: Path
    name: str
    pose: list[list[float]]
    angle_x: float


class Measured(NamedTuple):
    """A row of the results."""

    scene: str
    renderer: str
    samples: str
    mean_samples: float
    seconds: float
    start_up: float
    psnr_masked: float
    psnr_outside: float
    psnr: float


class Other:
    """A renderer in a process of its own."""

    def __init__(self, name: str, command: list[str]):
        """Starts the process."""
        self.name = name
        log = (Path(_OUT.value) / f"{name}.log").open("w")
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True
        )
        self._file = Path(_OUT.value).resolve() / f"{name}.{'exr' if name == 'Cycles' else 'npy'}"

    def __call__(self, view: View, samples: int, seed: int) -> tuple[np.ndarray, float]:
        """Returns the linear image of a view, and its seconds.

        Raises:
          OSError: if the process has ended.
        """
        job = {"scene": str(view.folder), "pose": view.pose, "angle_x": view.angle_x}
        job |= {"samples": samples, "seed": seed, "file": str(self._file)}
        self._process.stdin.write(json.dumps(job) + "\n")
        self._process.stdin.flush()
        if not (answer := self._process.stdout.readline()):
            raise OSError(f"{self.name} ended; see {self.name}.log in {_OUT.value}.")
        return _read(self._file), json.loads(answer)["seconds"]


def _read(file: Path) -> np.ndarray:
    if file.suffix == ".npy":
        return np.load(file)
    with OpenEXR.File(str(file)) as opened:
        channels = {k: v.pixels for part in opened.parts for k, v in part.channels.items()}
    return channels["ViewLayer.Combined"][..., :3].astype(np.float32)


class Ours:
    """The path tree; compiled programs are kept."""

    def __init__(self, folder: Path):
        """Reads a scene."""
        parts = meshes.read_meshes(folder)
        parents = mesh_queries.find_containment(parts).parents
        self.scene = jax.device_put(scene_assembly.assemble_scene(parts, parents, rule="nested"))
        self.radiance = jax.device_put(radiance_of(scene_assembly.read_background(folder)))

    def camera(self, view: View) -> cameras.Cameras:
        """Returns the camera of a view."""
        pose = np.array(view.pose)[None, :3]
        focal = cameras.focal_length(_SIZE.value, view.angle_x)
        return cameras.Cameras(pose, _SIZE.value, _SIZE.value, focal)

    def mask(self, view: View) -> np.ndarray:
        """Returns whether the ray through the centre of each pixel hits an object."""
        rays = cameras.image_rays(self.camera(view), 0)
        return np.isfinite(images.find_first_surface(self.scene.surfaces, rays).distances)

    def __call__(self, view: View, choice: tuple) -> tuple[np.ndarray, float, float]:
        """Returns the linear image of a view, its seconds, and the mean of its rays a pixel."""
        settings, first, refined, tolerance = choice
        begin = time.process_time()
        seen = render_known_camera(
            self.scene,
            self.radiance,
            self.camera(view),
            0,
            settings=settings,
            rays_per_pixel=first,
            refined_rays_per_pixel=refined,
            tolerance=tolerance,
        )
        return seen.linear, time.process_time() - begin, float(np.mean(seen.rays))


def _prepare(source: Path) -> tuple[Path, list[View]]:
    """Copies a scene with linear images of its background; returns its folder and views."""
    folder = Path(_OUT.value).resolve() / source.name
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(source / "meshes", folder / "meshes")
    (folder / "background").mkdir()
    record = json.loads((source / "scene.json").read_text())
    record["size"] = _SIZE.value
    record.setdefault("render", {})["bounces"] = 64
    for wall in record["background"]["faces"].values():
        image = iio.imread(source / wall["image"])[..., :3] / 255.0
        linear = np.ascontiguousarray(colours.srgb_to_linear(image).astype(np.float32))
        wall["image"] = str(Path(wall["image"]).with_suffix(".exr"))
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, {"RGB": linear}) as file:
            file.write(str(folder / wall["image"]))
        np.save((folder / wall["image"]).with_suffix(".npy"), linear)
    (folder / "scene.json").write_text(json.dumps(record))
    frames = json.loads((source / "transforms_test.json").read_text())
    views = [
        View(folder, number, frames["frames"][int(number)]["transform_matrix"], angle)
        for number in _VIEWS.value
        for angle in [frames["camera_angle_x"]]
    ]
    return folder, views


def main(arguments: list[str]) -> None:
    del arguments
    out = Path(_OUT.value)
    out.mkdir(parents=True, exist_ok=True)
    others = [
        Other(
            "Cycles", [_BLENDER.value, str(_HERE / "renderers_cycles.py"), str(_DATASET.resolve())]
        ),
        Other("Mitsuba", [_MITSUBA.value, str(_HERE / "renderers_mitsuba.py"), _VARIANT.value]),
    ]
    rows: list[Measured] = []
    for source in map(Path, _SCENES.value):
        folder, views = _prepare(source)
        truth = {view.name: _truth(others[0], view) for view in views}
        rows += _measure(folder, views, truth, others)
        _write(out / "renderers.csv", rows)
    _plot(out / "renderers.png", rows)
    _check(rows)


def _truth(cycles: Other, view: View) -> np.ndarray:
    """Returns the halves of the truth, linear; they are kept on disk."""
    name = f"truth_{view.folder.name}_{view.name}_{_SIZE.value}_{_TRUTH.value}.npy"
    file = Path(_OUT.value) / name
    if not file.exists():
        halves = [cycles(view, _TRUTH.value // 2, seed)[0] for seed in (101, 102)]
        np.save(file, np.stack(halves))
    return np.load(file)


def _ways(folder: Path, others: list[Other]) -> dict[tuple[str, str], Callable]:
    """Returns renderers by name and number of samples: functions of a view and a seed."""
    ours = Ours(folder)
    ways: dict[tuple[str, str], Callable] = {}
    for name, settings in (("tree", TREE), ("tree 0.5 %", _FINE_TREE)):
        choices = [(settings, count, None, 0.0) for count in _UNIFORM]
        for choice in choices:
            ways[name, str(choice[1])] = lambda view, _, choice=choice: ours(view, choice)
        for first, refined, tolerance in _ADAPTIVE:
            choice = (settings, first, refined, tolerance)
            key = f"{name} adaptive", f"{first} to {refined} above {tolerance}"
            ways[key] = lambda view, _, choice=choice: ours(view, choice)
    for other in others:
        for count in _SAMPLES:
            ways[other.name, str(count)] = lambda view, seed, other=other, count=count: (
                *other(view, count, seed),
                float(count),
            )
    return ways


def _measure(
    folder: Path, views: list[View], truth: dict[str, np.ndarray], others: list[Other]
) -> list[Measured]:
    """Renders all views of a scene by all renderers, in turn."""
    images_of: dict[tuple, list] = {}
    seconds: dict[tuple, list[list[float]]] = {}
    first: dict[tuple, float] = {}
    masks = [Ours(folder).mask(view) for view in views]
    ways = _ways(folder, others)
    for turn in range(_ROUNDS.value + 1):
        for key, way in list(ways.items()):
            if turn == 0 and key[0] in {other.name for other in others} and key[1] != "16":
                continue  # only the first image of a scene needs more time
            try:
                results = [way(view, 1 + 10 * turn) for view in views]
            except OSError as error:
                print(error, "It is omitted.", flush=True)
                ways = {other: way for other, way in ways.items() if other[0] != key[0]}
                break
            if turn == 0:
                first[key] = sum(result[1] for result in results)
                continue
            images_of[key] = results
            seconds.setdefault(key, []).append([result[1] for result in results])
    rows = []
    for key in ways:
        if key not in images_of:
            continue
        best = np.min(seconds[key], axis=0)
        start = first.get(key, first.get((key[0], "16"), 0.0)) - (
            float(np.sum(best)) if key in first else float(np.sum(np.min(seconds[key[0], "16"], 0)))
        )
        errors = np.mean(
            [
                _errors(result[0], truth[view.name].mean(axis=0), mask)
                for view, mask, result in zip(views, masks, images_of[key], strict=True)
            ],
            axis=0,
        )
        samples = float(np.mean([result[2] for result in images_of[key]]))
        rows.append(Measured(folder.name, *key, samples, float(np.mean(best)), start, *errors))
    noise = np.mean(
        [_errors(*truth[view.name], mask) for view, mask in zip(views, masks, strict=True)],
        axis=0,
    )
    # The mean of the halves has a quarter of the variance of their difference.
    noise = noise + 10.0 * np.log10(4.0)
    rows.append(
        Measured(
            folder.name,
            "noise of the truth",
            str(_TRUTH.value),
            _TRUTH.value,
            np.nan,
            np.nan,
            *noise,
        )
    )
    _side_by_side(folder, truth, views, images_of)
    for row in rows:
        print(*(f"{x:.3f}" if isinstance(x, float) else x for x in row), sep="  ", flush=True)
    return rows


def _errors(linear: np.ndarray, target: np.ndarray, mask: np.ndarray) -> tuple[float, ...]:
    """Returns PSNR of clipped sRGB in dB: masked, outside, and of the image."""
    pair = [colours.linear_to_srgb(np.clip(x, 0.0, 1.0)) for x in (linear, target)]
    squares = (pair[0] - pair[1]) ** 2
    parts = (squares[mask], squares[~mask], squares)
    return tuple(-10.0 * np.log10(np.mean(part)) for part in parts)


def _side_by_side(
    folder: Path, truth: dict[str, np.ndarray], views: list[View], images_of: dict[tuple, list]
) -> None:
    """Writes the truth and the last image of each renderer, from left to right."""
    last = {key[0]: results for key, results in images_of.items()}
    strips = []
    for number, view in enumerate(views):
        row = [truth[view.name].mean(axis=0), *(results[number][0] for results in last.values())]
        strips.append(np.concatenate(row, axis=1))
    encoded = colours.linear_to_srgb(np.clip(np.concatenate(strips), 0.0, 1.0))
    big = np.kron(np.round(255.0 * encoded).astype(np.uint8), np.ones((2, 2, 1), np.uint8))
    iio.imwrite(Path(_OUT.value) / f"{folder.name}.png", big, plugin="pillow")
    print("Images, from the left: truth,", ", ".join(last))


def _write(file: Path, rows: list[Measured]) -> None:
    with file.open("w", newline="") as opened:
        writer = csv.writer(opened, lineterminator="\n")
        writer.writerow(Measured._fields)
        for row in rows:
            writer.writerow(f"{x:.4g}" if isinstance(x, float) else x for x in row)


def _plot(file: Path, rows: list[Measured]) -> None:
    """Draws masked PSNR over seconds for each scene."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    scenes = list(dict.fromkeys(row.scene for row in rows))
    figure, axes = plt.subplots(
        1, len(scenes), figsize=(4.2 * len(scenes), 4.0), squeeze=False, layout="constrained"
    )
    for axis, scene in zip(axes[0], scenes, strict=True):
        mine = [row for row in rows if row.scene == scene and np.isfinite(row.seconds)]
        for name in dict.fromkeys(row.renderer for row in mine):
            curve = sorted((r.seconds, r.psnr_masked) for r in mine if r.renderer == name)
            axis.plot(*zip(*curve, strict=True), "o-", markersize=3, label=name)
        axis.set(xscale="log", title=scene, xlabel="seconds per image", ylabel="masked PSNR, dB")
        axis.grid(alpha=0.3)
    axes[0][0].legend(fontsize=7)
    figure.savefig(file, dpi=110)


def _check(rows: list[Measured]) -> None:
    pass


if __name__ == "__main__":
    app.run(main)
