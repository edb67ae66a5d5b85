"""What decides the results of a benchmark, fixed in its folder when it begins.

{out}/benchmark.json    a `Benchmark`: its settings, and all scenes and methods asked for so far

Scenes and methods may be added later; what they are may not change.
"""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.benchmarking.methods import Method
from refref_jax import atomic_files
from refref_jax.data import scene_folder

FILE = "benchmark.json"

# Settings that no training depends on.
_OF_EVALUATION = ("limit", "rays_per_pixel", "lpips")


@dataclasses.dataclass(frozen=True)
class Settings:
    """What all results of a benchmark have in common.

    Attributes:
      preset: of the trainings.
      steps: of each.
      limit: test images of an evaluation, evenly spread; `None` for all.
      rays_per_pixel: of an evaluation.
      seed: of everything random.
      lpips: SHA-256 of the weights that LPIPS is measured with; `None` if it is not.
    """

    preset: str
    steps: int
    limit: int | None
    rays_per_pixel: int
    seed: int
    lpips: str | None

    def training(self) -> tuple[str, ...]:
        """Returns what all trainings are told."""
        return (f"--preset={self.preset}", f"--steps={self.steps}", f"--seed={self.seed}")

    def evaluation(self) -> tuple[str, ...]:
        """Returns what all evaluations are told, but for where the weights of LPIPS are."""
        limit = () if self.limit is None else (f"--limit={self.limit}",)
        return (f"--rays_per_pixel={self.rays_per_pixel}", *limit)


@dataclasses.dataclass(frozen=True)
class Scene:
    """A scene of a benchmark.

    Attributes:
      name: unique in the benchmark.
      path: absolute path of its folder, where it was last.
      fingerprint: hash of its files, see `plan.fingerprint`.
    """

    name: str
    path: str
    fingerprint: str


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """What a benchmark was begun with, and what was added.

    Attributes:
      settings: common to all results.
      scenes: by name.
      methods: options of training of each, by its name.
    """

    settings: Settings
    scenes: dict[str, Scene]
    methods: dict[str, tuple[str, ...]]


def asked(settings: Settings, scenes: Sequence[Scene], methods: Sequence[Method]) -> Benchmark:
    """Returns the benchmark that a command asks for."""
    return Benchmark(
        settings,
        {scene.name: scene for scene in scenes},
        {method.name: method.train for method in methods},
    )


def read(out: Path) -> Benchmark:
    """Reads what a benchmark was begun with.

    Raises:
      ValueError: if the folder holds none, or a broken one.
    """
    path = out / FILE
    if not path.is_file():
        raise ValueError(f"{out} holds no benchmark. Give --scenes and --methods to begin one.")
    record = scene_folder.read_json(path)
    try:
        return Benchmark(
            Settings(**record["settings"]),
            {name: Scene(**scene) for name, scene in record["scenes"].items()},
            {name: tuple(options) for name, options in record["methods"].items()},
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path} is not that of a benchmark ({error!r}). Restore it, or give another --out."
        ) from error


def extended(out: Path, more: Benchmark) -> Benchmark:
    """Returns the benchmark of a folder, if it holds one, with scenes and methods added.

    Raises:
      ValueError: if it was begun with other settings, or knows a scene or method of that name that
        is not the same.
    """
    if not (out / FILE).exists():
        return more
    begun = read(out)
    _check_settings(out, begun.settings, more.settings)
    for name, scene in more.scenes.items():
        known = begun.scenes.get(name, scene)
        if known.fingerprint != scene.fingerprint:
            raise ValueError(
                f"{out} was begun with another scene named {name}: that of {known.path} had other "
                f"cameras, meshes, images or scene.json than {scene.path} has now. Restore or "
                "rename the folder, or give another --out."
            )
    for name, options in more.methods.items():
        known = begun.methods.get(name, options)
        if known != options:
            raise ValueError(
                f"In {out} the method {name} is {' '.join(known)}, in this version it is "
                f"{' '.join(options)}. Use the version that it was begun with, or another --out."
            )
    return Benchmark(begun.settings, begun.scenes | more.scenes, dict(begun.methods) | more.methods)


def write(out: Path, benchmark: Benchmark) -> None:
    """Writes what a benchmark is begun with; its folder is made."""
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / FILE, dataclasses.asdict(benchmark))


def digest(path: Path) -> str:
    """Returns the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_json(path: Path, content: Any) -> None:
    """Writes a JSON file, all or nothing."""
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
                    " To evaluate what is trained once more, without training it again, see "
                    "'Evaluating again' in docs/benchmark.md."
                )
            raise ValueError(
                f"{out} was begun {_told(field.name, before)}, and is now asked for "
                f"{_told(field.name, after)}: results would not compare. Leave --{option} as it "
                f"was, or give another --out.{again}"
            )


def _told(name: str, value: int | str | None) -> str:
    if value is None:
        return "without LPIPS" if name == "lpips" else f"without --{name}"
    if name == "lpips":
        return f"with the weights of LPIPS whose SHA-256 begins with {str(value)[:8]}"
    return f"with {name} {value}"
