"""Makes a capture with a hand-held camera, and the same views without any fault (NumPy only).

    {out}/perfect/    scene folder: pinhole, true poses, exact masks, depth, linear EXRs, meshes
    {out}/capture/    transforms.json of nerfstudio, images/*.jpg, masks/*.png: with faults
    {out}/truth/      truth.json: true lens, poses, gains; room/: what Blender renders

A view is rendered once, as linear light of a pinhole with a margin and three times as many pixels
a side. Its middle, averaged, is the perfect image; seen through a lens, it is the photograph.
"""

import dataclasses
import json
import subprocess
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np

from experiments.dataset import (
    cameras,
    catalogue,
    frame_files,
    handheld,
    production,
    room,
    scene_record,
    scene_setup,
)
from experiments.dataset.frame_files import Rendering
from experiments.dataset.parts import ObjectPart
from experiments.dataset.render_settings import BLENDER, PerSplit, RenderSettings
from experiments.dataset.seeds import seed_of
from experiments.dataset.worker_pool import Pool
from experiments.dataset.workers import Job, Task
from refref_jax import atomic_files, configuration
from refref_jax.choices import SPLITS, Split
from refref_jax.data import image_files, scene_folder
from refref_jax.data.scene_names import SceneName
from refref_jax.geometry.cameras import focal_length

PERFECT, CAPTURE, TRUTH = "perfect", "capture", "truth"

_BAKE = Path(__file__).with_name("blender_bake.py")
_FILE = "truth.json"

# Pixels of a rendering per pixel of an image, a side; margin, as a share of the image.
_FINE, _MARGIN = 3, 0.125

# Every eighth view is for testing, every sixteenth for validation.
_TEST_EVERY, _VAL_EVERY, _VAL_FIRST = 8, 16, 4

_QUALITY = 90

# Samples of test views per sample of others.
_TEST_SAMPLES = 4

_BAKED_SAMPLES = 256

# Light on the table: a sheet of white paper is a little overexposed, as its pattern is dark.
_WHITE = 1.2

_SEEDS = 1 << 31


@dataclasses.dataclass(frozen=True)
class CaptureSettings:
    """Settings that decide all files of a capture.

    Attributes:
      object: name of the object in `catalogue.OBJECTS`.
      views: number of views, of all splits together.
      size: width and height of images in pixels.
      spp: samples per pixel, rounded up to a multiple of nine; test views have four times as many.
      seed: seed of the walk and of all faults.
      distance: mean distance of the cameras from the object, world units.
      pose_degrees: error of rotations, root mean square, degrees.
      pose_percent: error of positions, root mean square, percent of the distance.
      mask_pixels: largest error of the edges of masks, pixels.
      missing_masks: number of training images without a mask.
      texture_scale: width of the room's textures, see `room.furnish`.
    """

    object: str = "ball"
    views: int = 60
    size: int = 160
    spp: int = 72
    seed: int = 0
    distance: float = 4.2
    pose_degrees: float = 0.3
    pose_percent: float = 0.5
    mask_pixels: float = 2.0
    missing_masks: int = 3
    texture_scale: float = 1.0

    def __post_init__(self) -> None:
        """Rejects numbers of views and masks that do not fit.

        Raises:
          ValueError: if there are too few views.
        """
        if self.object not in catalogue.OBJECTS:
            known = configuration.nearest(self.object, catalogue.OBJECTS) or "ball"
            raise ValueError(f"There is no object {self.object}. The nearest is {known}.")
        if len(self.numbers("train")) <= self.missing_masks:
            raise ValueError(
                f"{self.missing_masks} of {len(self.numbers('train'))} training images would have "
                "no mask. Give more views, or fewer missing masks."
            )

    def split_of(self, view: int) -> Split:
        """Returns the split of a view of the walk."""
        if view % _TEST_EVERY == 0:
            return "test"
        return "val" if view % _VAL_EVERY == _VAL_FIRST else "train"

    def numbers(self, split: Split) -> list[int]:
        """Returns the views of a split, in the order of the walk."""
        return [view for view in range(self.views) if self.split_of(view) == split]

    @property
    def pad(self) -> int:
        """Margin of renderings, in pixels of the image."""
        return int(np.ceil(_MARGIN * self.size))

    @property
    def focal(self) -> float:
        """Focal length in pixels of the image."""
        return focal_length(self.size, cameras.ANGLE_X)

    def lens(self) -> handheld.Lens:
        """Returns the lens of the capture."""
        return handheld.usual_lens(self.size, self.focal)

    def poses(self) -> np.ndarray:
        """Returns the true poses of all views, `[views, 4, 4]`."""
        return handheld.orbit(self.views, distance=self.distance, seed=self.seed_of("orbit"))

    def seed_of(self, *names: str) -> int:
        """Returns a seed for a purpose."""
        return seed_of("capture", str(self.seed), *names)


def produce(
    out: Path,
    settings: CaptureSettings,
    *,
    blender: Path,
    workers: int | None,
    stopped: Callable[[], bool],
) -> bool:
    """Makes missing folders and views, and returns whether all of them exist.

    Args:
      out: folder of the three folders; created if missing.
      settings: settings of the capture.
      blender: Python that has bpy.
      workers: number of Blender processes, or one for each core.
      stopped: callback that returns whether the user wants to end; queried after every view.

    Raises:
      ValueError: if the folder has other contents, if another command works in it, or if Blender
        fails.
    """
    check(out, settings)
    out.mkdir(parents=True, exist_ok=True)
    with production.alone_in(out) as scratch:
        if not (out / TRUTH).exists():
            _set_up(out, settings, blender=blender, scratch=scratch)
        frame_files.remove_unfinished(out)
        missing = [view for view in range(settings.views) if not _is_done(out, settings, view)]
        there = settings.views - len(missing)
        count = min(workers or production.cores(), max(1, len(missing)))
        pool = Pool(
            _tasks(out, settings, missing),
            blender=blender,
            scratch=scratch,
            workers=count,
            threads=max(1, production.cores() // count),
            device="CPU",
        )
        done = production.render(pool, there, settings.views, stopped) if missing else 0
        whole = done == len(missing)
        if whole:
            _write_json(out / CAPTURE / "transforms.json", _transforms(settings))
    return whole


def check(out: Path, settings: CaptureSettings) -> None:
    """Checks that an existing folder was made with these settings.

    Raises:
      ValueError: if it was not.
    """
    path = out / TRUTH / _FILE
    if not path.is_file():
        if out.is_dir() and any((out / name).exists() for name in (PERFECT, CAPTURE, TRUTH)):
            raise ValueError(f"{out} is not a folder of this command. Give another --out.")
        return
    found = configuration.parse_json(path.read_text(encoding="utf-8")).get("settings")
    if not isinstance(found, dict):
        raise ValueError(f"{path} states no settings. Give another --out.")
    # Settings that a folder does not state are newer than it.
    before = dataclasses.asdict(CaptureSettings()) | found
    for name, value in dataclasses.asdict(settings).items():
        if before[name] != value:
            raise ValueError(
                f"{path} has other settings: {name} is {before[name]}, not {value}. Give the same "
                "ones to resume, or another --out."
            )


def _set_up(out: Path, settings: CaptureSettings, *, blender: Path, scratch: Path) -> None:
    """Creates the folders without images; `truth` comes last, so that it means all of them."""
    if (out / PERFECT).exists():
        raise ValueError(f"{out / PERFECT} is incomplete. Remove it, and repeat the command.")
    parts = catalogue.OBJECTS[settings.object].make(1.0)
    perfect, stage = scratch / PERFECT, scratch / TRUTH / "room"
    scene = SceneName("env", catalogue.OBJECTS[settings.object].category, settings.object)
    for folder in (perfect, stage):
        (folder / "meshes").mkdir(parents=True)
        scene_setup.write_meshes(folder, scene, parts)
    record = _describe(scene, parts, settings)
    _write_json(perfect / "scene.json", record)
    for split in SPLITS:
        if settings.numbers(split):
            _write_json(perfect / f"transforms_{split}.json", _perfect_transforms(settings, split))
    bottom = min(part.vertices[:, 2].min() for part in parts)
    surfaces = room.furnish(bottom, texture_scale=settings.texture_scale)
    _light_room(stage, record, surfaces, settings, blender=blender)
    _write_json(scratch / TRUTH / _FILE, describe_truth(settings))
    for name in (PERFECT, TRUTH):
        atomic_files.move(scratch / name, out / name)


def _describe(
    scene: SceneName, parts: Sequence[ObjectPart], settings: CaptureSettings
) -> dict[str, Any]:
    """Returns the `scene.json` of the perfect scene, which does not state what the room is."""
    views = PerSplit(*(len(settings.numbers(split)) for split in SPLITS))
    spp = settings.spp
    like = RenderSettings(size=settings.size, spp=PerSplit(spp, spp, spp), views=views)
    record = scene_record.describe(scene, parts, {"type": "env"}, like)
    record["scene"] = f"{settings.object} in a room"
    record["camera_radius"] = settings.distance
    del record["texture_size"]
    return record


def _light_room(
    stage: Path,
    record: dict[str, Any],
    surfaces: Sequence[room.Surface],
    settings: CaptureSettings,
    *,
    blender: Path,
) -> None:
    """Bakes the light of the room, and writes what Blender renders the views of."""
    stated = [_describe_surface(surface) for surface in surfaces]
    job = {
        **record,
        "folder": str(stage),
        "samples": _BAKED_SAMPLES,
        "seed": settings.seed_of("light") % _SEEDS,
        "threads": production.cores(),
        "background": {"type": "surfaces", "surfaces": stated},
    }
    baked = _bake(job, stage, blender)
    top = next(surface.name for surface in surfaces if surface.near)
    exposure = _WHITE / float(np.median(baked[top]))
    (stage / "light").mkdir()
    for surface, stating in zip(surfaces, stated, strict=True):
        stating["image"] = f"light/{surface.name}.exr"
        leaving = exposure * room.paint(surface, baked.get(surface.name))
        image_files.write_exr(stage / stating["image"], leaving.astype(np.float16))
    fine = _FINE * (settings.size + 2 * settings.pad)
    room_record = {**record, "size": fine, "background": {"type": "surfaces", "surfaces": stated}}
    _write_json(stage / "scene.json", room_record)


def _describe_surface(surface: room.Surface) -> dict[str, Any]:
    stated: dict[str, Any] = {
        "name": surface.name,
        "corner": surface.corner.tolist(),
        "along": surface.along.tolist(),
        "up": surface.up.tolist(),
    }
    if surface.radiance is not None:
        return stated | {"radiance": list(surface.radiance)}
    colour = room.paint(surface, np.ones((2, 2, 3))).mean(axis=(0, 1))
    return stated | {"colour": colour.tolist(), "light_size": list(surface.light_size())}


def _bake(job: dict[str, Any], stage: Path, blender: Path) -> dict[str, np.ndarray]:
    """Returns the light of each surface that reflects any."""
    source, made = stage / "bake.json", stage / "bake.npz"
    _write_json(source, job)
    command = [str(blender), str(_BAKE), str(source), str(made)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode != 0 or not made.is_file():
        said = (result.stderr.strip().splitlines() or ["nothing"])[-1]
        raise ValueError(
            f"Blender {BLENDER} cannot bake the room's light ({said}). Run make dataset-env, or "
            "give the Python of an environment with bpy as --blender."
        )
    arrays = atomic_files.read_arrays(made)
    baked = {name: room.without_noise(light) for name, light in arrays.items()}
    source.unlink()
    made.unlink()
    return baked


def _tasks(out: Path, settings: CaptureSettings, views: Sequence[int]) -> Iterator[Task]:
    poses = settings.poses()
    # The fine image has the margin, and a wider angle.
    angle = 2.0 * np.arctan(0.5 * (settings.size + 2 * settings.pad) / settings.focal)
    fine_spp = -(-settings.spp // _FINE**2)
    for view in views:
        job = Job(
            scene=str((out / TRUTH / "room").absolute()),
            pose=poses[view].tolist(),
            angle_x=float(angle),
            samples=_TEST_SAMPLES * fine_spp if settings.split_of(view) == "test" else fine_spp,
            seed=settings.seed_of("render", str(view)) % _SEEDS,
        )
        yield Task(f"view {view}", job, partial(_finish, out, settings, view))


def _finish(
    out: Path, settings: CaptureSettings, view: int, colours: Sequence[Path], geometry: Path
) -> None:
    rendering = frame_files.read_rendering(colours, geometry)
    split = settings.split_of(view)
    number = settings.numbers(split).index(view)
    middle = perfect_rendering(rendering, settings)
    frame_files.write(out / PERFECT, split, number, middle, linear=True)
    lens, fine_focal = settings.lens(), _FINE * settings.focal
    pixels = handheld.photograph(
        rendering.linear,
        lens,
        fine_focal=fine_focal,
        size=settings.size,
        gain=gains(settings)[view],
        seed=settings.seed_of("noise", str(view)),
    )
    mask = handheld.photograph_mask(rendering.mask, lens, fine_focal=fine_focal, size=settings.size)
    wrong = handheld.wobble(
        mask, pixels=settings.mask_pixels, seed=settings.seed_of("mask", str(view))
    )
    image, mask_file = (out / CAPTURE / name for name in _names(view))
    options = {"plugin": "pillow", "extension": ".jpg", "quality": _QUALITY}
    frame_files.write_file(image, lambda path: iio.imwrite(path, pixels, **options))
    if view not in without_mask(settings):
        frame_files.write_file(mask_file, lambda path: image_files.write_mask(path, wrong))
    exact = out / TRUTH / mask_file.relative_to(out / CAPTURE)
    frame_files.write_file(exact, lambda path: image_files.write_mask(path, mask))


def perfect_rendering(fine: Rendering, settings: CaptureSettings) -> Rendering:
    """Returns the middle of a fine rendering at the resolution of the images."""
    edge = _FINE * settings.pad
    inner = slice(edge, edge + _FINE * settings.size)
    shape = (settings.size, _FINE, settings.size, _FINE, 3)
    linear = fine.linear[inner, inner].reshape(shape).mean(axis=(1, 3))
    # The middle of a pixel is that of the middle one of its fine pixels.
    centres = slice(edge + _FINE // 2, edge + _FINE * settings.size, _FINE)
    depth, normal, mask = (each[centres, centres] for each in fine[1:])
    return Rendering(linear.astype(np.float32), depth, normal, mask)


def gains(settings: CaptureSettings) -> np.ndarray:
    """Returns the factors of linear RGB of all views, `[views, 3]`."""
    return handheld.gains(settings.views, seed=settings.seed_of("gains"))


def given_poses(settings: CaptureSettings) -> np.ndarray:
    """Returns the poses of all views with their errors, `[views, 4, 4]`."""
    return handheld.disturb(
        settings.poses(),
        degrees=settings.pose_degrees,
        share=settings.pose_percent / 100.0,
        seed=settings.seed_of("poses"),
    )


def without_mask(settings: CaptureSettings) -> set[int]:
    """Returns the training views without a mask."""
    rng = np.random.default_rng(settings.seed_of("missing"))
    chosen = rng.choice(settings.numbers("train"), settings.missing_masks, replace=False)
    return set(chosen.tolist())


def describe_truth(settings: CaptureSettings) -> dict[str, Any]:
    """Returns the content of `truth.json`."""
    poses, factors = settings.poses(), gains(settings)
    return {
        "settings": dataclasses.asdict(settings),
        "lens": settings.lens()._asdict(),
        "without_mask": sorted(_names(view)[0] for view in without_mask(settings)),
        "frames": [
            {
                "file_path": _names(view)[0],
                "split": settings.split_of(view),
                "perfect": _perfect_name(settings, view),
                "gain": factors[view].tolist(),
                "transform_matrix": poses[view].tolist(),
            }
            for view in range(settings.views)
        ],
    }


def _perfect_name(settings: CaptureSettings, view: int) -> str:
    split = settings.split_of(view)
    return f"./{scene_folder.plain(split, settings.numbers(split).index(view)).image}"


def _perfect_transforms(settings: CaptureSettings, split: Split) -> dict[str, Any]:
    poses = settings.poses()
    frames = [
        scene_folder.frame_record(
            scene_folder.plain(split, number), poses[view].tolist(), masked=True, deep=True
        )
        for number, view in enumerate(settings.numbers(split))
    ]
    return {"camera_angle_x": cameras.ANGLE_X, "frames": frames}


def _transforms(settings: CaptureSettings) -> dict[str, Any]:
    """Returns the capture's `transforms.json`."""
    lens, poses, lacking = settings.lens(), given_poses(settings), without_mask(settings)
    frames = []
    for view in range(settings.views):
        image, mask = _names(view)
        named = {"file_path": image} | ({} if view in lacking else {"mask_path": mask})
        frames.append(named | {"transform_matrix": poses[view].tolist()})
    return {
        "camera_model": "OPENCV",
        "fl_x": lens.focal,
        "fl_y": lens.focal,
        "cx": lens.centre_x,
        "cy": lens.centre_y,
        "w": settings.size,
        "h": settings.size,
        **{key: getattr(lens, key) for key in ("k1", "k2", "p1", "p2")},
        **{
            f"{split}_filenames": [_names(view)[0] for view in settings.numbers(split)]
            for split in SPLITS
        },
        "frames": frames,
    }


def _names(view: int) -> tuple[str, str]:
    """Returns the names of an image and of its mask, relative to the capture."""
    return f"images/frame_{view + 1:05d}.jpg", f"masks/frame_{view + 1:05d}.png"


def _is_done(out: Path, settings: CaptureSettings, view: int) -> bool:
    split = settings.split_of(view)
    number = settings.numbers(split).index(view)
    # The exact mask is written last.
    exact = (out / TRUTH / _names(view)[1]).is_file()
    return exact and frame_files.is_done(out / PERFECT, split, number, linear=True)


def _write_json(path: Path, content: dict[str, Any]) -> None:
    with atomic_files.written_file(path) as draft:
        draft.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
