"""A benchmark made by hand: its scenes, its records, and what its jobs would leave."""

import json

import imageio.v3 as iio
import numpy as np

from experiments.benchmarking import plan, results, settings, summary
from experiments.benchmarking.methods import METHODS
from experiments.benchmarking.plan import Skipped
from experiments.benchmarking.results import Costs, Image, Record, Truth, View
from experiments.benchmarking.settings import Benchmark, Scene, Settings
from refref_jax.data import image_files, scene_folder
from tests.factories import small_scenes

SETTINGS = Settings(preset="tiny", steps=6, limit=None, rays_per_pixel=1, seed=0, lpips=None)

QUALITY = {"straight": 15.0, "oracle": 22.0, "tree": 28.0}
"""PSNR inside the mask of each method's first view; each further one is a decibel better."""


def write_scene(folder, *, meshes=True, masks=True, colours=True):
    """Writes a scene to be listed: two training views, and test views ever farther from them."""
    small_scenes.write_scene(folder)
    path = folder / "transforms_train.json"
    content = json.loads(path.read_text())
    if not masks:
        for frame in content["frames"]:
            del frame["mask_file_path"]
        path.write_text(json.dumps(content))
    (folder / "test").mkdir()
    frames = []
    for i in range(7):
        pose = np.eye(4)
        pose[:3, 3] = [0.0, 10.0 + 0.5 * i, 20.0]
        name = f"test/r_{i:03d}"
        (folder / f"{name}.png").write_bytes((folder / "train/r_000.png").read_bytes())
        named = {"file_path": f"./{name}", "transform_matrix": pose.tolist()}
        frames.append({**content["frames"][0], **named})
    (folder / "transforms_test.json").write_text(json.dumps({**content, "frames": frames}))
    if meshes:
        (folder / "meshes").mkdir()
        (folder / "meshes" / "ball_glass.ply").write_text("not looked at")
        colour = {"colour_per_interface": [1.0, 1.0, 1.0]} if colours else {}
        parts = [{"mesh": "meshes/ball_glass.ply", "ior_inside": 1.5, **colour}]
        (folder / "scene.json").write_text(json.dumps({"parts": parts}))
    return folder


def write_renderings(folder, scene, *, level=0.5, distance=None):
    """Writes grey images of a scene's test views, and distances that are all the same."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = scene_folder.read_frames(scene, plan.SPLIT)
    size = (frames.cameras.height, frames.cameras.width)
    for name in frames.names:
        image_files.write_rgb(folder / f"{name}.png", np.full((*size, 3), level))
        if distance is not None:
            image_files.write_exr(folder / f"{name}.exr", np.full(size, distance, np.float32))
    return folder


def made_record(scene, method, **metrics):
    """A result with some metrics, and one image of the same."""
    category, background = results.category_and_background(scene)
    return Record(
        scene=scene,
        category=category,
        background=background,
        method=method,
        fingerprint="",
        options=plan.options(method, METHODS[method].train if method in METHODS else (), SETTINGS),
        settings=SETTINGS,
        metrics=metrics,
        per_image=[Image("r_0", 0.1, None, metrics)],
        costs=Costs(),
        versions={},
        views=[],
        scene_path="/nowhere",
        facts={},
    )


def write_benchmark(folder, scenes, *, methods=("straight", "tree"), views=3, size=12):
    """Writes a benchmark in `{folder}/out`, with its tables, its pictures and its scenes."""
    out = folder / "out"
    known = {name: Scene(name, str(folder / f"scene_{i}"), "") for i, name in enumerate(scenes)}
    row, column = np.indices((size, size)) / size
    for i, name in enumerate(scenes):
        blue = [np.full_like(row, 0.1 * i + 0.05 * j) for j in range(views)]
        images = [np.stack([row, column, each], axis=-1) for each in blue]
        _write_scene(folder / f"scene_{i}", images)
        for method in methods:
            _write_job(out, name, folder / f"scene_{i}", method, images)
    benchmark = Benchmark(SETTINGS, known, {name: METHODS[name].train for name in methods})
    settings.write(out, benchmark)
    failed = {f"{scenes[0]}/r3f": "experiments.train: error: <b>no</b> & never"}
    skipped = [Skipped(scenes[0], "r3f_tree", "its training images have no masks")]
    summary.write(out, benchmark, failed=failed, skipped=skipped)
    return out


def _write_scene(folder, images):
    for kind in ("test", "mask", "depth"):
        (folder / kind).mkdir(parents=True)
    for i, rgb in enumerate(images):
        image_files.write_rgb(folder / f"test/r_{i}.png", rgb)
        mask = np.zeros(rgb.shape[:2], np.uint8)
        mask[4:8, 4:8] = 255
        iio.imwrite(folder / f"mask/r_{i}.png", mask, plugin="pillow", extension=".png")
        image_files.write_exr(
            folder / f"depth/r_{i}.exr", np.where(mask > 0, 3.0, 5.0).astype("f4")
        )
    frames = [{"file_path": f"./test/r_{i}"} for i in range(len(images))]
    content = {"camera_angle_x": 1.0, "frames": frames}
    (folder / "transforms_test.json").write_text(json.dumps(content))


def _write_job(out, scene, path, method, images):
    folder = out / plan.FOLDER / scene / method
    run, quality = folder / "run", QUALITY[method]
    for kind in ("rgb", "distance"):
        (run / "eval/test" / kind).mkdir(parents=True)
    for i, rgb in enumerate(images):
        image_files.write_rgb(run / f"eval/test/rgb/r_{i}.png", rgb * quality / 30.0)
        distance = np.full(rgb.shape[:2], 4.0, np.float32)
        image_files.write_exr(run / f"eval/test/distance/r_{i}.exr", distance)
    curve = [{"step": n, "seconds": 0.1 * n, "loss": 1.0, "psnr": quality} for n in (1, 50, 100)]
    (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in curve))
    per_image = [
        Image(f"r_{i}", 0.1, None, {"psnr": 30.0, "psnr_masked": quality + i})
        for i in range(len(images))
    ]
    record = made_record(scene, method, psnr=30.0, psnr_masked=quality)._replace(
        per_image=per_image,
        scene_path=str(path),
        views=[_view(i) for i in range(len(images))],
        costs=Costs(steps=6, seconds_per_step=0.125),
        versions={"jax": "0.0", "refref_jax": "0.0"},
    )
    results.write(folder, record)


def _view(i):
    return View(
        f"r_{i}",
        Truth(f"test/r_{i}.png", f"mask/r_{i}.png", f"depth/r_{i}.exr"),
        rgb=f"run/eval/test/rgb/r_{i}.png",
        distance=f"run/eval/test/distance/r_{i}.exr",
    )
