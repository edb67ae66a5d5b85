"""What a benchmark has to do: one job for each scene and method, and what each waits for.

{out}/jobs/{scene}/{method}/result.json    there when the job is done, see `records`
                           /run/           the trained run, with its evaluation
                           /run.log        all that its commands printed
{out}/jobs/{scene}/reconstruction/         what the R3F methods of a scene share
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from experiments.benchmarking.methods import RECONSTRUCTION, Method, Need, same_as, same_inside
from experiments.benchmarking.settings import Scene, Settings
from refref_jax.data import local_layout, meshes, transforms
from refref_jax.data.needs import find_tints
from refref_jax.data.part_descriptions import PartDescription, read_part_descriptions

FOLDER = "jobs"
RESULT = "result.json"

SPLIT = "test"
"""The views that are evaluated."""


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


_LACKING: dict[Need, str] = {
    "meshes": "it has no meshes",
    "masks": "its training images have no masks",
    "colours": "scene.json does not tell the colours of all its parts",
}


def plan(
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


def lacking(scene: Path, needs: set[Need]) -> set[Need]:
    """Returns which of some needs a scene does not meet.

    Raises:
      ValueError: if the scene is broken.
    """
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


def folder(out: Path, job: Job) -> Path:
    """Returns the folder of a job."""
    return out / FOLDER / job.scene / job.method


def is_done(out: Path, job: Job) -> bool:
    """Returns whether a job has left its result."""
    return (folder(out, job) / RESULT).is_file()


def _reasons(scene: Scene, methods: Sequence[Method], preset: str) -> dict[str, str]:
    """Returns why methods are left out, by name."""
    try:
        local_layout.read_frames(Path(scene.path), SPLIT)
    except ValueError as error:
        return {method.name: f"its {SPLIT} views can not be read: {error}" for method in methods}
    lacks, inside = _lacking_or_broken(scene, methods), _inside(Path(scene.path))
    reasons = {}
    for method in methods:
        if missing := [_LACKING[need] for need in method.needs if need in lacks]:
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


def _lacking_or_broken(scene: Scene, methods: Sequence[Method]) -> set[Need]:
    try:
        return lacking(Path(scene.path), {need for method in methods for need in method.needs})
    except ValueError:
        return set()


def _has_no_masks(scene: Path) -> bool:
    frames = transforms.get(transforms.read_json(scene / "transforms_train.json"), "frames", scene)
    return not any(isinstance(frame, dict) and "mask_file_path" in frame for frame in frames)
