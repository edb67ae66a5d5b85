"""What a benchmark has to do: one job for each scene and method, and what each waits for.

{out}/jobs/{scene}/{method}/result.json    there when the job is done, see `records`
                           /run/           the trained run, with its evaluation
                           /run.log        all that its commands printed
{out}/jobs/{scene}/reconstruction/         what the R3F methods of a scene share
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from experiments.benchmarking.methods import RECONSTRUCTION, Method, Need
from experiments.benchmarking.settings import Scene, Settings
from refref_jax.data import meshes, transforms
from refref_jax.data.part_descriptions import read_part_descriptions

FOLDER = "jobs"
RESULT = "result.json"


class Job(NamedTuple):
    """One thing to do, which a process on any machine that sees the folders can.

    Attributes:
      scene: name of the scene.
      path: its folder.
      method: name of the method, or `RECONSTRUCTION`.
      train: options of training; none of a reconstruction.
      reconstructed: whether it takes the objects that the scene's reconstruction found.
      settings: of the benchmark.
      lpips_weights: file of them.
    """

    scene: str
    path: str
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
    """A method that a scene lacks something for."""

    scene: str
    method: str
    reason: str


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

    A reconstruction comes before the jobs that wait for it. A scene that is broken is left to them:
    each will fail, and say why.
    """
    jobs: list[Job] = []
    skipped: list[Skipped] = []
    for scene in scenes:
        lacks = _lacking_or_broken(scene, methods)
        possible = [method for method in methods if not lacks & set(method.needs)]
        for method in methods:
            if missing := [_LACKING[need] for need in method.needs if need in lacks]:
                skipped.append(Skipped(scene.name, method.name, missing[0]))
        common = {"settings": settings, "lpips_weights": lpips_weights}
        if any(method.reconstructed for method in possible):
            jobs.append(Job(scene.name, scene.path, RECONSTRUCTION, (), False, **common))
        jobs += [
            Job(scene.name, scene.path, method.name, method.train, method.reconstructed, **common)
            for method in possible
        ]
    return jobs, skipped


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


def _lacking_or_broken(scene: Scene, methods: Sequence[Method]) -> set[Need]:
    try:
        return lacking(Path(scene.path), {need for method in methods for need in method.needs})
    except ValueError:
        return set()


def _has_no_masks(scene: Path) -> bool:
    frames = transforms.get(transforms.read_json(scene / "transforms_train.json"), "frames", scene)
    return not any(isinstance(frame, dict) and "mask_file_path" in frame for frame in frames)
