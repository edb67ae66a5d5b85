"""Plans a benchmark: its scenes, its jobs, and the inputs that determine each result.

There is one job for each scene and method, and one for the reconstruction that some wait for. The
job of an external method (`externals`) measures images that are given; it is done again if these
have changed:

{out}/jobs/{scene}/{method}/result.json    exists when the job is finished, see `results`
                           /run/           the trained run, with its evaluation
                           /run.log        the output of its commands
{out}/jobs/{scene}/reconstruction/         the reconstruction shared by the scene's R3F methods

A scene's fingerprint is a hash of the data that determines its results, so that results of another
scene of the same name are not mixed in. It covers the contents of the transforms files, scene.json
and the meshes, and the names and sizes of all images in the transforms files (colours, masks, depth
maps); reading all images of a data set at every start would take minutes. It also covers the
properties that `scene_lists` gives with a scene. It does not depend on the location of the folder
or on other files in it.
"""

import dataclasses
import glob
import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments.benchmarking import externals, scene_lists
from experiments.benchmarking.externals import External
from experiments.benchmarking.methods import (
    RECONSTRUCTION,
    Method,
    Need,
    evaluation_options,
    same_as,
    same_inside,
)
from experiments.benchmarking.settings import Scene, Settings, digest
from experiments.cli import scenes as cli_scenes
from refref_jax import configuration
from refref_jax.data import meshes, scene_folder, scene_names, scene_properties, scene_source
from refref_jax.data.scene_analysis import find_tints
from refref_jax.data.scene_properties import PartDescription

FOLDER = "jobs"
RESULT = "result.json"

PROPERTIES = "scene"
"""Key of the properties given with a scene among the options of a record."""

SPLIT = "test"
"""Split whose views are evaluated."""

# Length of a fingerprint.
_LETTERS = 16

# Possible extensions of the files in a frame: a float depth map may be next to an 8-bit one.
_ENDINGS = {"file_path": (".png",), "mask_file_path": ("",), "depth_file_path": ("", ".exr")}


class Job(NamedTuple):
    """A unit of work for any process on any machine that can access the folders.

    Attributes:
      scene: name of the scene.
      path: folder of the scene.
      fingerprint: hash of the scene's files and properties at planning time.
      method: name of the method, or `RECONSTRUCTION`.
      train: training options; empty for a reconstruction.
      reconstructed: whether it uses the objects of the scene's reconstruction.
      settings: settings of the benchmark.
      lpips_weights: file of LPIPS's weights.
      properties: properties given with the scene, as options of `experiments.train`.
      overlay: file of properties given with the scene, or an empty string.
      external: folder of the renderings of an external method, or an empty string.
      digest: hash of these renderings at planning time; empty if the scene is not unpacked yet.
    """

    scene: str
    path: str
    fingerprint: str
    method: str
    train: tuple[str, ...]
    reconstructed: bool
    settings: Settings
    lpips_weights: str | None
    properties: tuple[str, ...] = ()
    overlay: str = ""
    external: str = ""
    digest: str = ""

    @property
    def name(self) -> str:
        """Name of the job."""
        return f"{self.scene}/{self.method}"

    @property
    def awaited(self) -> str | None:
        """Name of the job that must be finished before this one, if any."""
        return f"{self.scene}/{RECONSTRUCTION}" if self.reconstructed else None


class Skipped(NamedTuple):
    """A method that is skipped on a scene, and the reason."""

    scene: str
    method: str
    reason: str

    @property
    def name(self) -> str:
        """Name that the job would have."""
        return f"{self.scene}/{self.method}"


_WANTING: dict[Need, str] = {
    "meshes": "it has no meshes",
    "masks": "its training images have no masks",
    "colours": "scene.json does not define the colours of all its parts",
    "backdrop": "it needs a field: a part is opaque, or its colours or its interior are unknown",
    "walls": "its background is infinitely far away, but the method needs a cube or a sphere",
}


def plan_jobs(
    scenes: Sequence[Scene],
    methods: Sequence[Method],
    settings: Settings,
    *,
    lpips_weights: str | None = None,
    given: Sequence[External] = (),
) -> tuple[list[Job], list[Skipped]]:
    """Returns all jobs, scene by scene, and the skipped ones.

    A reconstruction precedes the jobs that depend on it. A scene whose test views cannot be read is
    skipped, because it could be trained but not evaluated. A scene that is broken in another way is
    kept: each of its jobs fails with an error message.

    Args:
      scenes: scenes of the benchmark.
      methods: methods to train.
      settings: settings of all results.
      lpips_weights: file of LPIPS's weights.
      given: external methods.

    Raises:
      ValueError: if the renderings of an external method are not complete.
    """
    jobs: list[Job] = []
    skipped: list[Skipped] = []
    for scene in scenes:
        place = (scene.name, scene.path, scene.fingerprint)
        common = (settings, lpips_weights, scene.options, scene.properties)
        reasons = _reasons(scene, methods, given, settings.preset)
        skipped += [Skipped(scene.name, name, reason) for name, reason in reasons.items()]
        possible = [method for method in methods if method.name not in reasons]
        if any(method.reconstructed for method in possible):
            jobs.append(Job(*place, RECONSTRUCTION, (), False, *common))
        jobs += [
            Job(*place, each.name, each.train, each.reconstructed, *common) for each in possible
        ]
        for each in given:
            if each.name not in reasons:
                folder = externals.folder_of(each, scene.name, alone=len(scenes) == 1)
                job = Job(*place, each.name, (), False, *common, external=str(folder))
                jobs.append(job._replace(digest=_digest(job)) if scene.fingerprint else job)
    return jobs, skipped


def _digest(job: Job) -> str:
    """Returns the hash of the renderings of an external method."""
    limit = job.settings.limit
    return externals.digest(Path(job.external), Path(job.path), split=SPLIT, limit=limit)


def options(method: str, train: Sequence[str], settings: Settings) -> dict[str, list[str]]:
    """Returns the options of a job's commands, by command; they determine its result.

    Args:
      method: name of the method, or `RECONSTRUCTION`.
      train: training options of the method.
      settings: settings of the benchmark.
    """
    if method == RECONSTRUCTION:
        return {"reconstruct": [f"--seed={settings.seed}"]}
    return {
        "train": [*settings.training(), *train],
        "evaluate": evaluation_options(method, settings.evaluation()),
    }


def external_options(settings: Settings, digest: str) -> dict[str, list[str]]:
    """Returns the options of the job of an external method, which determine its result.

    Args:
      settings: settings of the benchmark.
      digest: hash of the renderings.
    """
    return {
        "metrics": [f"--split={SPLIT}", *settings.views()],
        externals.OPTIONS: [f"--renderings=sha256:{digest}"],
    }


def given_properties(job: Job) -> list[str]:
    """Returns the properties given with the scene of a job, which determine its result as well."""
    if not job.overlay:
        return list(job.properties)
    return [*job.properties, f"--properties=sha256:{digest(Path(job.overlay))[:_LETTERS]}"]


def _lacking(scene: Scene, requires: set[Need]) -> set[Need]:
    """Returns the requirements that a scene does not meet; none if it is broken."""
    try:
        return _unmet(scene, requires)
    except ValueError:
        return set()


def _unmet(listed: Scene, requires: set[Need]) -> set[Need]:
    found: set[Need] = set()
    scene = Path(listed.path)
    of_meshes: set[Need] = {"meshes", "colours", "backdrop"}
    files = meshes.mesh_files(scene) if requires & of_meshes else []
    if "meshes" in requires and not files:
        found.add("meshes")
    if requires & {"colours", "backdrop"}:
        described = scene_properties.read(scene, overlay=listed.properties).parts
        parts = [described.get(path.name, PartDescription()) for path in files]
        if not parts or not all(part.colour_known for part in parts):
            found.add("colours")
        if find_tints(parts) == "learned" or any(map(_learns_inside, parts)):
            found.add("backdrop")
    if "walls" in requires and _space(listed) == "unbounded":
        found.add("walls")
    if "masks" in requires and _has_no_masks(scene):
        found.add("masks")
    return found


def _space(listed: Scene) -> str:
    """Returns the kind of a scene's background: that given with it, or its own."""
    given = [word.removeprefix("--background=") for word in listed.options]
    chosen = [kind for kind, word in zip(given, listed.options, strict=True) if kind != word]
    own = scene_properties.read(Path(listed.path), overlay=listed.properties).space
    return chosen[-1] if chosen else own


def _learns_inside(part: PartDescription) -> bool:
    return part.material.kind == "opaque" or part.material.interior == "field"


def job_folder(out: Path, job: Job) -> Path:
    """Returns the folder of a job."""
    return out / FOLDER / job.scene / job.method


def is_done(out: Path, job: Job) -> bool:
    """Returns whether the result of a job exists; that of other renderings does not count."""
    path = job_folder(out, job) / RESULT
    return path.is_file() and (not job.external or _measures(path, job))


def _measures(path: Path, job: Job) -> bool:
    """Returns whether a result is that of the present renderings of an external method."""
    try:
        made = configuration.parse_json(path.read_text("utf-8"))["options"]
        wanted = external_options(job.settings, job.digest)
        return made[externals.OPTIONS] == wanted[externals.OPTIONS]
    except (ValueError, KeyError, TypeError):
        return False


def _reasons(
    scene: Scene, methods: Sequence[Method], given: Sequence[External], preset: str
) -> dict[str, str]:
    """Returns the reasons for skipping methods, by name."""
    if not scene.fingerprint:  # what the scene lacks is found when it is unpacked
        pairs = {method.name: same_as(method, preset) for method in methods}
        return {
            name: f"in the preset {preset} it equals {full}" for name, full in pairs.items() if full
        }
    try:
        scene_folder.read_frames(Path(scene.path), SPLIT)
    except ValueError as error:
        names = [each.name for each in (*methods, *given)]
        return dict.fromkeys(names, f"its {SPLIT} views cannot be read: {error}")
    requires = {need for method in methods for need in method.requires}
    lacks, inside = _lacking(scene, requires), _inside(scene)
    reasons = {}
    for method in methods:
        if missing := [_WANTING[need] for need in method.requires if need in lacks]:
            reasons[method.name] = missing[0]
        elif full := same_as(method, preset):
            reasons[method.name] = f"in the preset {preset} it equals {full}"
        elif full := same_inside(method, inside):
            text = ", ".join(f"{name} {value}" for name, value in inside.items())
            reasons[method.name] = f"in this scene it equals {full} ({text})"
    return reasons


def _inside(scene: Scene) -> dict[str, str]:
    """Returns the interior options that a scene leads to; none if it is broken."""
    try:
        described = scene_properties.read(Path(scene.path), overlay=scene.properties).parts
        files = meshes.mesh_files(Path(scene.path))
        parts = [described.get(path.name, PartDescription()) for path in files]
    except ValueError:
        return {}
    tints = find_tints(parts)
    return {"interior": "clear"} if tints == "none" else {"interior": "absorbing", "tints": tints}


def _has_no_masks(scene: Path) -> bool:
    frames = scene_folder.get(
        scene_folder.read_json(scene / "transforms_train.json"), "frames", scene
    )
    return not any(isinstance(frame, dict) and "mask_file_path" in frame for frame in frames)


def find_scenes(words: Sequence[str], *, unpack: bool = True) -> list[Scene]:
    """Returns scenes in the order of their names.

    Without unpacking, published scenes that are not unpacked yet have their source as path, and no
    fingerprint: they can be listed, but not used.

    Args:
      words: folders, with or without wildcards, `hf:CONFIG/SCENE`, patterns of the latter, or lists
        of these, see `scene_lists`. Matches of a wildcard that are not scenes are ignored.
      unpack: whether to unpack published scenes, which takes minutes for all of them.

    Raises:
      ValueError: if there are no scenes, if a folder is not a scene, if two have the same name, or
        if different properties are given with the same one.
    """
    listed = [
        each._replace(source=source)
        for each in scene_lists.expand(words)
        for source in cli_scenes.expanded([each.source])
    ]
    later = [each for each in listed if not unpack and not scene_source.is_unpacked(each.source)]
    now = [
        (folder.resolve(), each)
        for each in listed
        if each not in later
        for folder in _folders(each.source)
    ]
    if not now and not later:
        raise ValueError(
            f"--scenes={','.join(words)} matches no scene. Give folders that contain "
            "transforms_train.json, as in --scenes='scenes/*'."
        )
    waiting = {str(scene_names.parse_source(each.source)): each for each in later}
    found = {
        n: Scene(n, each.source, "", each.options, each.properties) for n, each in waiting.items()
    }
    for folder, (_, options, overlay) in now:
        name = scene_names.of_folder(folder)
        made = Scene(name, str(folder), "", options, overlay)
        known = found.get(name, made)
        if known.path != made.path:
            raise ValueError(
                f"Both {known.path} and {folder} are named {name}. Rename one of them."
            )
        if (known.options, known.properties) != (options, overlay):
            raise ValueError(f"{folder} is listed with different properties. Remove one entry.")
        found[name] = made
    for name, scene in found.items():
        if name in waiting:
            continue
        told = fingerprint(Path(scene.path), scene.options, scene.properties)
        found[name] = dataclasses.replace(scene, fingerprint=told)
    return [found[name] for name in sorted(found)]


def _folders(word: str) -> list[Path]:
    if cli_scenes.has_wildcards(word):
        return [Path(path) for path in sorted(glob.glob(word)) if _is_scene(Path(path))]
    folder = cli_scenes.opened(word)
    if not _is_scene(folder):
        raise ValueError(
            f"{folder} is not a scene: it has no transforms_train.json. Give the folder of a scene."
        )
    return [folder]


def _is_scene(folder: Path) -> bool:
    return (folder / "transforms_train.json").is_file()


def fingerprint(scene: Path, options: Sequence[str] = (), overlay: str = "") -> str:
    """Returns the hash of a scene, which may be broken or incomplete.

    Args:
      scene: folder of the scene.
      options: properties given with it.
      overlay: file of properties given with it, or an empty string.
    """
    found = hashlib.sha256()
    for option in options:
        _add(found, "option", option.encode())
    if overlay:
        _add(found, "properties", Path(overlay).read_bytes())
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
    """Adds a name and its content to a hash, unambiguously."""
    for part in (name.encode(), content):
        found.update(len(part).to_bytes(8, "big"))
        found.update(part)


def _images(path: Path) -> Iterator[str]:
    """Yields the files in a transforms file, as far as it is valid."""
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
    """Returns the file of an image name, which lacks its extension; depth maps may have another."""
    if ending == ".exr":
        return str(Path(name).with_suffix(ending)) if Path(name).name else name
    return f"{name}{ending}"
