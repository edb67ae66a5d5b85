"""Claim: in equal time, the refined tree has a higher PSNR than two other renderers.

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

import contextlib
import csv
import dataclasses
import itertools
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
from refref_jax.data.meshes import MeshPart
from refref_jax.geometry import cameras, triangle_meshes
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

_SAMPLES = (4, 16, 64, 256, 1024)
_UNIFORM = (1, 4, 9, 16)
# First rays, refined rays, and tolerance; where both are equal, the background alone is refined.
_ADAPTIVE = ((4, 4, 0.1), (9, 9, 0.1), (1, 16, 0.1), (4, 16, 0.1), (4, 36, 0.1), (9, 64, 0.1))
# Fields of the results, and their names in figures.
_REGIONS = {"psnr_masked": "masked", "psnr_outside": "outside"}
_FINE = dataclasses.replace(TREE, min_throughput=0.005, max_bends=32)
_FINE_SIDE = 8
_NOISE = "noise of the truth"
_REFINED = "tree, refined"
_HERE = Path(__file__).parent
_DATASET = _HERE.parent / "experiments" / "dataset"


class View(NamedTuple):
    """A view to render: scene folder, name of the view, pose, and field of view in radians."""

    folder: Path
    name: str
    pose: list[list[float]]
    angle_x: float


class Measured(NamedTuple):
    """A row of the results; of silhouettes, those pixels outside that objects cover in part."""

    scene: str
    renderer: str
    samples: str
    mean_samples: float
    seconds: float
    start_up: float
    psnr_masked: float
    psnr_outside: float
    psnr: float
    rms_silhouettes: float
    dropped: float


class Rendered(NamedTuple):
    """A linear image, its seconds, its rays or samples a pixel, and its dropped throughput."""

    linear: np.ndarray
    seconds: float
    count: float
    dropped: float = 0.0


class Other:
    """A renderer in a process of its own."""

    def __init__(self, name: str, command: list[str]):
        """Starts the process."""
        self.name = name
        log = (Path(_OUT.value) / f"{name}.log").open("w")
        self._process = None
        if shutil.which(command[0]):
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True
            )
        self._file = Path(_OUT.value).resolve() / f"{name}.{'exr' if name == 'Cycles' else 'npy'}"

    def __call__(self, view: View, samples: int, seed: int) -> Rendered:
        """Renders a view.

        Raises:
          OSError: if the process has ended, or never started.
        """
        if self._process is None:
            raise OSError(f"{self.name} is not installed.")
        job = {"scene": str(view.folder), "pose": view.pose, "angle_x": view.angle_x}
        job |= {"samples": samples, "seed": seed, "file": str(self._file)}
        answer = ""
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(job) + "\n")
            self._process.stdin.flush()
            answer = self._process.stdout.readline()
        if not answer:
            raise OSError(f"{self.name} ended; see {self.name}.log in {_OUT.value}.")
        return Rendered(_read(self._file), json.loads(answer)["seconds"], samples)


def _read(file: Path) -> np.ndarray:
    if file.suffix == ".npy":
        return np.load(file)
    with OpenEXR.File(str(file)) as opened:
        channels = {k: v.pixels for part in opened.parts for k, v in part.channels.items()}
    return channels["ViewLayer.Combined"][..., :3].astype(np.float32)


def _with_blender_normals(part: MeshPart) -> MeshPart:
    """Returns a part with the vertex normals of Blender and Mitsuba: averages by angle.

    Those that the library computes respect creases and large flat pieces, so that light takes
    other ways near the edges of a base.
    """
    groups = triangle_meshes.smooth_groups(part.vertices, part.faces, crease_angle=np.pi)
    corners = part.vertices[part.faces]
    flat, weights = triangle_meshes.face_normals(corners), triangle_meshes.corner_angles(corners)
    return part._replace(normals=triangle_meshes.average_normals(flat, groups, weights))


class Ours:
    """The path tree; compiled programs are kept."""

    def __init__(self, folder: Path):
        """Reads a scene."""
        parts = [_with_blender_normals(part) for part in meshes.read_meshes(folder)]
        parents = mesh_queries.find_containment(parts).parents
        self.scene = jax.device_put(scene_assembly.assemble_scene(parts, parents, rule="nested"))
        self.radiance = jax.device_put(radiance_of(scene_assembly.read_background(folder)))

    def camera(self, view: View) -> cameras.Cameras:
        """Returns the camera of a view."""
        pose = np.array(view.pose)[None, :3]
        focal = cameras.focal_length(_SIZE.value, view.angle_x)
        return cameras.Cameras(pose, _SIZE.value, _SIZE.value, focal)

    def masks(self, view: View) -> np.ndarray:
        """Returns the pixels whose centre an object covers, and others that it covers in part."""
        camera = self.camera(view)
        inside, fine = (
            np.isfinite(images.find_first_surface(self.scene.surfaces, rays).distances)
            for rays in (
                cameras.image_rays(camera, 0),
                cameras.image_rays(cameras.supersample(camera, _FINE_SIDE), 0),
            )
        )
        covered = cameras.box_filter(fine.astype(np.float32), _FINE_SIDE)
        return np.stack([inside, ~inside & (covered > 0.0)])

    def __call__(self, view: View, choice: tuple) -> Rendered:
        """Renders a view with path settings, first and refined rays, and tolerance."""
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
        seconds = time.process_time() - begin
        return Rendered(
            seen.linear, seconds, float(np.mean(seen.rays)), float(np.mean(seen.dropped))
        )


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
        print(f"Rendering {name} in Cycles, without which there is no truth.", flush=True)
        halves = [cycles(view, _TRUTH.value // 2, seed).linear for seed in (101, 102)]
        np.save(file, np.stack(halves))
    return np.load(file)


def _ways(folder: Path, others: list[Other]) -> dict[tuple[str, str], Callable]:
    """Returns renderers by name and number of samples: functions of a view and a seed."""
    ours = Ours(folder)
    uniform = [(TREE, count, None, 0.0) for count in _UNIFORM]
    ways: dict[tuple[str, str], Callable] = {}
    for choice in (*uniform, *((TREE, *refined) for refined in _ADAPTIVE), (_FINE, *_ADAPTIVE[-1])):
        settings, first, refined, _ = choice
        name = _REFINED if settings == TREE else f"{_REFINED}, 0.5 %"
        key = ("tree", str(first)) if refined is None else (name, f"{first} to {refined}")
        ways[key] = lambda view, _, choice=choice: ours(view, choice)
    for other in others:
        for count in _SAMPLES:
            ways[other.name, str(count)] = lambda view, seed, other=other, count=count: other(
                view, count, seed
            )
    return ways


def _measure(
    folder: Path, views: list[View], truth: dict[str, np.ndarray], others: list[Other]
) -> list[Measured]:
    """Renders all views of a scene by all renderers, in turn; returns the rows of the scene."""
    ways, turns = _ways(folder, others), []
    for turn in range(_ROUNDS.value + 1):
        # The first turn loads and compiles, for which one number of samples suffices elsewhere.
        names = {other.name for other in others} if turn == 0 else set()
        seen = {}
        for key, way in list(ways.items()):
            if key not in ways or (key[0] in names and key[1] != str(_SAMPLES[0])):
                continue
            try:
                seen[key] = [way(view, 1 + 10 * turn) for view in views]
            except OSError as error:
                print(error, "It is omitted.", flush=True)
                ways = {other: way for other, way in ways.items() if other[0] != key[0]}
        turns.append(seen)
    ours = Ours(folder)
    masks = [ours.masks(view) for view in views]
    targets = [truth[view.name] for view in views]
    rows, name = [], folder.name.rsplit("_", 1)[-1]
    for key in ways:
        found = [turn[key] for turn in turns[1:]]
        best = np.min([[result.seconds for result in turn] for turn in found], axis=0)
        begun = turns[0].get(key)
        start = sum(result.seconds for result in begun) - np.sum(best) if begun else np.nan
        pairs = [(x.linear, y.mean(axis=0)) for x, y in zip(found[-1], targets, strict=True)]
        count, dropped = (float(np.mean([x[field] for x in found[-1]])) for field in (2, 3))
        errors = _mean_errors(pairs, masks)
        rows.append(Measured(name, *key, count, float(np.mean(best)), start, *errors, dropped))
    # The mean of the halves has a quarter of the variance of their difference.
    noise = _mean_errors(targets, masks)
    noise[:3] += 10.0 * np.log10(4.0)
    noise[3] *= 0.5
    count = str(_TRUTH.value)
    rows.append(Measured(name, _NOISE, count, _TRUTH.value, np.nan, np.nan, *noise, 0.0))
    _side_by_side(folder, truth, views, turns[-1])
    for row in rows:
        print(*(f"{x:.3f}" if isinstance(x, float) else x for x in row), sep="  ", flush=True)
    return rows


def _mean_errors(pairs: list, masks: list[np.ndarray]) -> np.ndarray:
    """Returns the mean of `_errors` over views."""
    return np.mean([_errors(*pair, mask) for pair, mask in zip(pairs, masks, strict=True)], axis=0)


def _errors(linear: np.ndarray, target: np.ndarray, masks: np.ndarray) -> tuple[float, ...]:
    """Returns PSNR of clipped sRGB in dB, masked, outside, and of the image; RMS of silhouettes."""
    pair = [colours.linear_to_srgb(np.clip(x, 0.0, 1.0)) for x in (linear, target)]
    squares, (mask, silhouettes) = (pair[0] - pair[1]) ** 2, masks
    parts = (squares[mask], squares[~mask], squares)
    psnr = (-10.0 * np.log10(np.mean(part)) for part in parts)
    return (*psnr, float(np.sqrt(np.mean(squares[silhouettes]))))


def _side_by_side(
    folder: Path, truth: dict[str, np.ndarray], views: list[View], images_of: dict[tuple, list]
) -> None:
    """Writes the truth and the last image of each renderer, from left to right."""
    last = {key[0]: results for key, results in images_of.items()}
    strips = []
    for number, view in enumerate(views):
        row = [
            truth[view.name].mean(axis=0),
            *(results[number].linear for results in last.values()),
        ]
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
    """Draws PSNR over seconds for each scene, inside the mask above, and outside below."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    scenes = list(dict.fromkeys(row.scene for row in rows))
    figure, axes = plt.subplots(
        2, len(scenes), figsize=(4.2 * len(scenes), 7.0), squeeze=False, layout="constrained"
    )
    for (line, region), (column, scene) in itertools.product(
        enumerate(_REGIONS), enumerate(scenes)
    ):
        axis, mine = axes[line, column], [row for row in rows if row.scene == scene]
        mine = [row for row in mine if np.isfinite(row.seconds)]
        for name in dict.fromkeys(row.renderer for row in mine):
            curve = sorted((r.seconds, getattr(r, region)) for r in mine if r.renderer == name)
            axis.plot(*zip(*curve, strict=True), "o-", markersize=3, label=name)
        label = f"{_REGIONS[region]} PSNR, dB"
        axis.set(xscale="log", title=scene, xlabel="seconds per image", ylabel=label)
        axis.grid(alpha=0.3)
    axes[0, 0].legend(fontsize=7)
    figure.savefig(file, dpi=110)


def _gain(ours: Measured, theirs: list[Measured], region: str) -> float:
    """Returns our PSNR in a region minus that of another renderer in the same seconds, in dB.

    Its curve is interpolated over the logarithm of the seconds; where ours is faster than its first
    point, that point counts.
    """
    theirs = sorted(theirs, key=lambda row: row.seconds)
    seconds, psnr = ([getattr(row, key) for row in theirs] for key in ("seconds", region))
    return getattr(ours, region) - float(np.interp(np.log(ours.seconds), np.log(seconds), psnr))


def _check(rows: list[Measured]) -> None:
    """Prints the gains of all points of the refined tree, and asserts the claim."""
    missed = []
    for mine in (row for row in rows if row.renderer == _REFINED):
        for name in ("Cycles", "Mitsuba"):
            theirs = [row for row in rows if (row.scene, row.renderer) == (mine.scene, name)]
            if not theirs:
                continue
            key = mine.scene, mine.samples, name
            gains = {label: _gain(mine, theirs, key) for key, label in _REGIONS.items()}
            told = ", ".join(f"{label} {gain:+.1f} dB" for label, gain in gains.items())
            print(f"{mine.scene}, {mine.samples}, {mine.seconds:.3f} s: {told}, {name}")
            missed += [(*key, label) for label in gains if gains[label] < 0.0]
    assert not missed, missed


if __name__ == "__main__":
    app.run(main)
