"""Stores the settings of a benchmark, which are fixed in its folder when it starts.

{out}/benchmark.json    a `Benchmark`: its settings, and all scenes and methods requested so far

Scenes and methods may be added later, but not changed.
"""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.benchmarking.externals import External
from experiments.benchmarking.methods import Method
from refref_jax import atomic_files
from refref_jax.data import scene_folder

FILE = "benchmark.json"

# Settings that do not affect any training.
_OF_EVALUATION = ("limit", "rays_per_pixel", "lpips")


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings that all results of a benchmark share.

    Attributes:
      preset: preset of the trainings.
      steps: number of steps of each training.
      limit: number of test images per evaluation, evenly spread; `None` for all.
      rays_per_pixel: number of rays per pixel in an evaluation.
      seed: random seed.
      lpips: SHA-256 of LPIPS's weights; `None` if LPIPS is not measured.
    """

    preset: str
    steps: int
    limit: int | None
    rays_per_pixel: int
    seed: int
    lpips: str | None

    def training(self) -> tuple[str, ...]:
        """Returns the flags that all trainings share."""
        return (f"--preset={self.preset}", f"--steps={self.steps}", f"--seed={self.seed}")

    def evaluation(self) -> tuple[str, ...]:
        """Returns the flags that all evaluations share, except for the file of LPIPS's weights."""
        return (f"--rays_per_pixel={self.rays_per_pixel}", *self.views())

    def views(self) -> tuple[str, ...]:
        """Returns the flags that select the views of an evaluation."""
        return () if self.limit is None else (f"--limit={self.limit}",)


@dataclasses.dataclass(frozen=True)
class Scene:
    """A scene of a benchmark.

    Attributes:
      name: name, unique in the benchmark.
      path: latest absolute path of its folder.
      fingerprint: hash of its files and of the properties given with it, see `plan.fingerprint`.
      options: properties given with it, as options of `experiments.train`.
      properties: latest absolute path of a file of properties given with it, or an empty string.
    """

    name: str
    path: str
    fingerprint: str
    options: tuple[str, ...] = ()
    properties: str = ""


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """Settings, scenes and methods of a benchmark.

    Attributes:
      settings: settings of all results.
      scenes: scenes by name.
      methods: training options of each method, by its name.
      externals: latest absolute folder of the renderings of each external method, by its name.
    """

    settings: Settings
    scenes: dict[str, Scene]
    methods: dict[str, tuple[str, ...]]
    externals: dict[str, str] = dataclasses.field(default_factory=dict)


def asked(
    settings: Settings,
    scenes: Sequence[Scene],
    methods: Sequence[Method],
    externals: Sequence[External] = (),
) -> Benchmark:
    """Returns the benchmark that a command requests."""
    return Benchmark(
        settings,
        {scene.name: scene for scene in scenes},
        {method.name: method.train for method in methods},
        {external.name: external.folder for external in externals},
    )


def read(out: Path) -> Benchmark:
    """Reads the benchmark of a folder.

    Raises:
      ValueError: if the folder contains no benchmark, or a broken one.
    """
    path = out / FILE
    if not path.is_file():
        raise ValueError(f"{out} has no benchmark. Use --scenes and --methods to start one.")
    record = scene_folder.read_json(path)
    try:
        return Benchmark(
            Settings(**record["settings"]),
            {
                name: Scene(**scene | {"options": tuple(scene.get("options", ()))})
                for name, scene in record["scenes"].items()
            },
            {name: tuple(options) for name, options in record["methods"].items()},
            dict(record.get("externals", {})),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"{path} is not a valid benchmark ({error!r}). Restore it, or give another --out."
        ) from error


def extended(out: Path, more: Benchmark) -> Benchmark:
    """Adds scenes and methods to the benchmark of a folder, if it exists.

    Raises:
      ValueError: if it was started with other settings, or contains another scene or method of the
        same name.
    """
    if not (out / FILE).exists():
        return more
    begun = read(out)
    _check_settings(out, begun.settings, more.settings)
    for name, scene in more.scenes.items():
        known = begun.scenes.get(name, scene)
        if known.fingerprint != scene.fingerprint:
            raise ValueError(
                f"{out} was started with another scene named {name}: that of {known.path} had "
                f"other cameras, meshes, images, scene.json or properties than {scene.path} has "
                "now. Restore or rename the folder, or give another --out."
            )
    for name, options in more.methods.items():
        known = begun.methods.get(name, options)
        if known != options:
            raise ValueError(
                f"In {out} the method {name} is {' '.join(known)}, but in this version it is "
                f"{' '.join(options)}. Use the version that started it, or another --out."
            )
    return Benchmark(
        begun.settings,
        begun.scenes | more.scenes,
        begun.methods | more.methods,
        begun.externals | more.externals,
    )


def write(out: Path, benchmark: Benchmark) -> None:
    """Writes the settings of a benchmark; its folder is created."""
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / FILE, dataclasses.asdict(benchmark))


def digest(path: Path) -> str:
    """Returns the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_json(path: Path, content: Any) -> None:
    """Writes a JSON file atomically."""
    with atomic_files.written_file(path) as draft:
        draft.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _check_settings(out: Path, begun: Settings, now: Settings) -> None:
    for field in dataclasses.fields(Settings):
        before, after = getattr(begun, field.name), getattr(now, field.name)
        if before != after:
            option = "lpips_weights" if field.name == "lpips" else field.name
            again = ""
            if field.name in _OF_EVALUATION:
                again = (
                    " To evaluate existing trainings again without repeating them, see "
                    "'Evaluating again' in docs/benchmark.md."
                )
            raise ValueError(
                f"{out} was started {_told(field.name, before)}, but is now requested "
                f"{_told(field.name, after)}: results would not be comparable. Keep --{option} "
                f"unchanged, or give another --out.{again}"
            )


def _told(name: str, value: int | str | None) -> str:
    if value is None:
        return "without LPIPS" if name == "lpips" else f"without --{name}"
    if name == "lpips":
        return f"with the weights of LPIPS whose SHA-256 starts with {str(value)[:8]}"
    return f"with {name} {value}"
