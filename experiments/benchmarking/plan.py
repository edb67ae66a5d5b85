"""What a benchmark has to do: which scenes, which jobs, and what decides the result of each.

One job for each scene and method, and what each waits for:

{out}/jobs/{scene}/{method}/result.json    there when the job is done, see `results`
                           /run/           the trained run, with its evaluation
                           /run.log        all that its commands printed
{out}/jobs/{scene}/reconstruction/         what the R3F methods of a scene share

A scene's fingerprint is a hash of what decides results on it, so that results of another scene of
that name are not mixed in. It covers the transforms files, scene.json and the meshes by their
content, and all images that the transforms files name (colours, masks, depth maps) by their names
and sizes in bytes: to read a data set's images whole whenever a benchmark begins would take
minutes. Where the folder lies does not matter, nor does what else is in it.
"""

import glob
import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments.benchmarking.methods import RECONSTRUCTION, Method, Need, same_as, same_inside
from experiments.benchmarking.settings import Scene, Settings
from experiments.cli import scenes as cli_scenes
from refref_jax import configuration
from refref_jax.data import meshes, scene_folder, scene_names
from refref_jax.data.meshes import PartDescription, read_part_descriptions
from refref_jax.data.scene_analysis import find_tints

FOLDER = "jobs"
RESULT = "result.json"

SPLIT = "test"
"""The views that are evaluated."""

# Of a fingerprint.
_LETTERS = 16

# Endings of what a key of a frame names: a float depth map may lie beside an 8-bit one.
_ENDINGS = {"file_path": (".png",), "mask_file_path": ("",), "depth_file_path": ("", ".exr")}


class Job(NamedTuple):
    """One thing to do, which a process on any machine that sees the folders can.

    Attributes:
      scene: name of the scene.
      path: its folder.
      fingerprint: of its files when this was planned.
      method: name of the method, or `RECONSTRUCTION`.
      train: options of training; none of a reconstruction.
      reconstructed: whether it takes the objects that the scene's reconstruction found.
      settings: of the benchmark.
      lpips_weights: file of them.
    """

    scene: str
    path: str
    fingerprint: str
    method: str
    train: tuple[str, ...]
    reconstructed: bool
    settings: Settings
    lpips_weights: str | None

    @property
    def name(self) -> str:
        """What it is called."""
        return f"{self.scene}/{self.method}"

    @property
    def awaited(self) -> str | None:
        """The name of the job that must be done before, if there is one."""
        return f"{self.scene}/{RECONSTRUCTION}" if self.reconstructed else None


class Skipped(NamedTuple):
    """A method that is left out on a scene, and why."""

    scene: str
    method: str
    reason: str

    @property
    def name(self) -> str:
        """What its job would be called."""
        return f"{self.scene}/{self.method}"


_WANTING: dict[Need, str] = {
    "meshes": "it has no meshes",
    "masks": "its training images have no masks",
    "colours": "scene.json does not tell the colours of all its parts",
}


def plan_jobs(
    scenes: Sequence[Scene],
    methods: Sequence[Method],
    settings: Settings,
    *,
    lpips_weights: str | None = None,
) -> tuple[list[Job], list[Skipped]]:
    """Returns all jobs, scene by scene, and what is left out for want of something.

    A reconstruction comes before the jobs that wait for it. A scene whose test views can not be
    read is left out, for it could be trained on and not be evaluated. One that is broken otherwise
    is left to its jobs: each will fail, and say why.
    """
    jobs: list[Job] = []
    skipped: list[Skipped] = []
    for scene in scenes:
        place = (scene.name, scene.path, scene.fingerprint)
        reasons = _reasons(scene, methods, settings.preset)
        skipped += [Skipped(scene.name, name, reason) for name, reason in reasons.items()]
        possible = [method for method in methods if method.name not in reasons]
        if any(method.reconstructed for method in possible):
            jobs.append(Job(*place, RECONSTRUCTION, (), False, settings, lpips_weights))
        jobs += [
            Job(*place, each.name, each.train, each.reconstructed, settings, lpips_weights)
            for each in possible
        ]
    return jobs, skipped


def options(method: str, train: Sequence[str], settings: Settings) -> dict[str, list[str]]:
    """Returns what decides a job's result: the options of its commands, by command.

    Args:
      method: name, or `RECONSTRUCTION`.
      train: options of the method.
      settings: of the benchmark.
    """
    if method == RECONSTRUCTION:
        return {"reconstruct": [f"--seed={settings.seed}"]}
    return {
        "train": [*settings.training(), *train],
        "evaluate": list(settings.evaluation()),
    }


def _lacking(scene: Path, needs: set[Need]) -> set[Need]:
    """Returns which of some needs a scene does not meet; none if it is broken."""
    try:
        return _unmet(scene, needs)
    except ValueError:
        return set()


def _unmet(scene: Path, needs: set[Need]) -> set[Need]:
    found: set[Need] = set()
    files = meshes.mesh_files(scene) if needs & {"meshes", "colours"} else []
    if "meshes" in needs and not files:
        found.add("meshes")
    if "colours" in needs:
        described = read_part_descriptions(scene / "scene.json")
        told = [path.name in described and described[path.name].colour_known for path in files]
        if not told or not all(told):
            found.add("colours")
    if "masks" in needs and _has_no_masks(scene):
        found.add("masks")
    return found


def job_folder(out: Path, job: Job) -> Path:
    """Returns the folder of a job."""
    return out / FOLDER / job.scene / job.method


def is_done(out: Path, job: Job) -> bool:
    """Returns whether a job has left its result."""
    return (job_folder(out, job) / RESULT).is_file()


def _reasons(scene: Scene, methods: Sequence[Method], preset: str) -> dict[str, str]:
    """Returns why methods are left out, by name."""
    try:
        scene_folder.read_frames(Path(scene.path), SPLIT)
    except ValueError as error:
        return {method.name: f"its {SPLIT} views can not be read: {error}" for method in methods}
    needs = {need for method in methods for need in method.needs}
    lacks, inside = _lacking(Path(scene.path), needs), _inside(Path(scene.path))
    reasons = {}
    for method in methods:
        if missing := [_WANTING[need] for need in method.needs if need in lacks]:
            reasons[method.name] = missing[0]
        elif full := same_as(method, preset):
            reasons[method.name] = f"in the preset {preset} it is {full} again"
        elif full := same_inside(method, inside):
            told = ", ".join(f"{name} {value}" for name, value in inside.items())
            reasons[method.name] = f"in this scene it is {full} again ({told})"
    return reasons


def _inside(scene: Path) -> dict[str, str]:
    """Returns what a scene needs inside its objects, as options; nothing if it is broken."""
    try:
        described = read_part_descriptions(scene / "scene.json")
        parts = [described.get(p.name, PartDescription()) for p in meshes.mesh_files(scene)]
    except ValueError:
        return {}
    tints = find_tints(parts)
    return {"interior": "clear"} if tints == "none" else {"interior": "absorbing", "tints": tints}


def _has_no_masks(scene: Path) -> bool:
    frames = scene_folder.get(
        scene_folder.read_json(scene / "transforms_train.json"), "frames", scene
    )
    return not any(isinstance(frame, dict) and "mask_file_path" in frame for frame in frames)


def find_scenes(words: Sequence[str]) -> list[Scene]:
    """Returns scenes in the order of their names.

    Args:
      words: folders, with wildcards or without, or `hf:CONFIG/SCENE`. What a wildcard matches and
        is no scene is passed over.

    Raises:
      ValueError: if there is none, if a folder holds none, or two have one name.
    """
    folders = [folder for word in words if word for folder in _folders(word.strip())]
    if not folders:
        raise ValueError(
            f"--scenes={','.join(words)} names no scene. Give folders that hold "
            "transforms_train.json, as in --scenes='scenes/*'."
        )
    found: dict[str, Scene] = {}
    for folder in dict.fromkeys(folder.resolve() for folder in folders):
        name = scene_names.of_folder(folder)
        if name in found:
            raise ValueError(
                f"Both {found[name].path} and {folder} are named {name}. Rename one of them."
            )
        found[name] = Scene(name, str(folder), fingerprint(folder))
    return [found[name] for name in sorted(found)]


def _folders(word: str) -> list[Path]:
    if cli_scenes.has_wildcards(word):
        return [Path(path) for path in sorted(glob.glob(word)) if _is_scene(Path(path))]
    folder = cli_scenes.opened(word)
    if not _is_scene(folder):
        raise ValueError(
            f"{folder} is no scene: it holds no transforms_train.json. Give the folder of one."
        )
    return [folder]


def _is_scene(folder: Path) -> bool:
    return (folder / "transforms_train.json").is_file()


def fingerprint(scene: Path) -> str:
    """Returns the hash of a scene, which may be broken or lack files."""
    found = hashlib.sha256()
    described = scene / "scene.json"
    files = sorted(scene.glob("transforms_*.json"))
    for path in (*files, *([described] if described.is_file() else [])):
        _add(found, path.name, path.read_bytes())
    for path in meshes.mesh_files(scene):
        _add(found, f"meshes/{path.name}", path.read_bytes())
    for name in sorted({name for path in files for name in _images(path)}):
        path = scene / name
        size = path.stat().st_size if path.is_file() else "missing"
        _add(found, Path(name).as_posix(), str(size).encode())
    return found.hexdigest()[:_LETTERS]


def _add(found: Any, name: str, content: bytes) -> None:
    """Adds to a hash what a name stands for; no two lists of such come to the same bytes."""
    for part in (name.encode(), content):
        found.update(len(part).to_bytes(8, "big"))
        found.update(part)


def _images(path: Path) -> Iterator[str]:
    """Yields the files that a transforms file names, as far as it is one."""
    try:
        frames = configuration.parse_json(path.read_text(encoding="utf-8"))["frames"]
    except (ValueError, KeyError, TypeError):
        return
    for frame in frames if isinstance(frames, list) else ():
        for key, endings in _ENDINGS.items():
            name = frame.get(key) if isinstance(frame, dict) else None
            if isinstance(name, str):
                yield from (_ending(name, ending) for ending in endings)


def _ending(name: str, ending: str) -> str:
    """Returns the file of a name: image names lack their ending, depth maps may have another."""
    if ending == ".exr":
        return str(Path(name).with_suffix(ending)) if Path(name).name else name
    return f"{name}{ending}"
