"""A benchmark of made results with pictures, as its jobs would leave them."""

import json

import imageio.v3 as iio
import numpy as np

from experiments.benchmarking import plan, results, settings, summary
from experiments.benchmarking.methods import METHODS
from experiments.benchmarking.plan import Skipped
from experiments.benchmarking.results import Costs, Image, Truth, View
from experiments.benchmarking.settings import Benchmark, Scene
from refref_jax.data import files
from tests.experiments.benchmarking.made_records import SETTINGS, made_record

QUALITY = {"straight": 15.0, "oracle": 22.0, "tree": 28.0}
"""PSNR inside the mask of each method's first view; each further one is a decibel better."""


def write(folder, scenes, *, methods=("straight", "tree"), views=3, size=12, truth=None):
    """Writes a benchmark, with its tables and results.

    Args:
      folder: where it and its scenes go.
      scenes: their names.
      methods: their names.
      views: of each scene.
      size: edge of the pictures.
      truth: colours of a view, by the number of the scene and its own; a pattern if not given.
    """
    out = folder / "out"
    known = {name: Scene(name, str(folder / f"scene_{i}"), "") for i, name in enumerate(scenes)}
    for i, name in enumerate(scenes):
        images = [(truth or _pattern(size))(i, j) for j in range(views)]
        _write_scene(folder / f"scene_{i}", images)
        for method in methods:
            _write_job(out, name, folder / f"scene_{i}", method, images)
    benchmark = Benchmark(SETTINGS, known, {name: METHODS[name].train for name in methods})
    settings.write(out, benchmark)
    failed = {f"{scenes[0]}/r3f": "experiments.train: error: <b>no</b> & never"}
    skipped = [Skipped(scenes[0], "r3f_tree", "its training images have no masks")]
    summary.write(out, benchmark, failed=failed, skipped=skipped)
    return out


def _pattern(size):
    def colours(scene, view):
        row, column = np.indices((size, size)) / size
        return np.stack([row, column, np.full_like(row, 0.1 * scene + 0.05 * view)], axis=-1)

    return colours


def _write_scene(folder, images):
    for kind in ("test", "mask", "depth"):
        (folder / kind).mkdir(parents=True)
    for i, rgb in enumerate(images):
        height, width, _ = rgb.shape
        files.write_rgb(folder / f"test/r_{i}.png", rgb)
        mask = np.zeros((height, width), np.uint8)
        mask[height // 3 : 2 * height // 3, width // 3 : 2 * width // 3] = 255
        iio.imwrite(folder / f"mask/r_{i}.png", mask, plugin="pillow", extension=".png")
        depth = np.where(mask > 0, 3.0, np.linspace(4.0, 6.0, width)).astype(np.float32)
        files.write_exr(folder / f"depth/r_{i}.exr", depth)
    frames = [{"file_path": f"./test/r_{i}"} for i in range(len(images))]
    (folder / "transforms_test.json").write_text(
        json.dumps({"camera_angle_x": 1.0, "frames": frames})
    )


def _write_job(out, scene, path, method, images):
    folder = out / plan.FOLDER / scene / method
    run = folder / "run"
    noise = np.random.default_rng(len(method))
    for kind in ("rgb", "distance"):
        (run / "eval/test" / kind).mkdir(parents=True)
    for i, rgb in enumerate(images):
        scale = 10.0 ** (-QUALITY[method] / 20.0)
        blurred = (rgb + np.roll(rgb, 2, 1) + np.roll(rgb, 2, 0)) / 3.0
        rendered = np.clip(blurred + 0.3 * scale * noise.standard_normal(rgb.shape), 0.0, 1.0)
        files.write_rgb(run / f"eval/test/rgb/r_{i}.png", rendered)
        distance = np.full(rgb.shape[:2], 4.0 + 10.0 * scale, np.float32)
        distance[0, 0] = np.inf
        files.write_exr(run / f"eval/test/distance/r_{i}.exr", distance)
    lines = [
        {
            "step": n,
            "seconds": 0.1 * n,
            "loss": 1.0,
            "psnr": QUALITY[method] * (1.0 - 2.0 ** (-n / 20)),
        }
        for n in range(1, 101)
    ]
    (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    per_image = [
        Image(f"r_{i}", 0.1, None, {"psnr": 30.0, "psnr_masked": QUALITY[method] + i})
        for i in range(len(images))
    ]
    record = made_record(scene, method, psnr=30.0, psnr_masked=QUALITY[method])
    results.write(
        folder,
        record._replace(
            per_image=per_image,
            scene_path=str(path),
            views=[_view(i) for i in range(len(images))],
            costs=Costs(steps=6, seconds_per_step=0.125),
            versions={"jax": "0.0", "refref_jax": "0.0"},
        ),
    )


def _view(i):
    return View(
        f"r_{i}",
        Truth(f"test/r_{i}.png", f"mask/r_{i}.png", f"depth/r_{i}.exr"),
        rgb=f"run/eval/test/rgb/r_{i}.png",
        distance=f"run/eval/test/distance/r_{i}.exr",
    )
