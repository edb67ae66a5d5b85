"""The commands that lead from a capture to a trained model, each in a process of its own.

{out}/imported/   import_capture
{out}/refined/    refine_cameras
{out}/object/     reconstruct, unless there are meshes
{out}/model/      train, evaluate
{out}/logs/       what each command printed; its last line that begins with $ is its call
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from experiments.cli import app
from experiments.runs import subprocesses


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the commands; see `experiments.capture_to_model`."""

    images: str | None = None
    mask_folder: str | None = None
    meshes: str | None = None
    refine: bool = True
    preset: str = "tiny"
    steps: int | None = None
    far_field: str = "field"
    exposure: str = "per_image"
    brightest: float = 1.0
    rays_per_pixel: int = 4


@dataclasses.dataclass(frozen=True)
class Step:
    """One command.

    Attributes:
      name: name of the command in `experiments`.
      options: its flags.
      made: function that returns whether its results are there.
      added: those of its flags that earlier versions did not give.
    """

    name: str
    options: tuple[str, ...]
    made: Callable[[], bool]
    added: tuple[str, ...] = ()


def steps(source: Path, out: Path, options: Options) -> Iterator[Step]:
    """Yields the commands, in order.

    Args:
      source: the capture.
      out: folder of all results.
      options: options of the commands.
    """
    scene, found, model = out / "imported", out / "object", out / "model"
    given = {name: getattr(options, name) for name in ("images", "mask_folder", "meshes")}
    words = [f"--{name}={value}" for name, value in given.items() if value]
    words = [f"--source={source}", f"--out={scene}", *words]
    yield Step("import_capture", tuple(words), scene.is_dir)
    if options.refine:
        refined = out / "refined"
        yield Step("refine_cameras", (f"--scene={scene}", f"--out={refined}"), refined.is_dir)
        scene = refined
    training = [f"--scene={scene}", f"--out={model}", "--resume", f"--preset={options.preset}"]
    training += [f"--far_field={options.far_field}", f"--exposure={options.exposure}"]
    training += [] if options.brightest == 1.0 else [f"--brightest={options.brightest:g}"]
    training += [] if options.steps is None else [f"--steps={options.steps}"]
    if options.meshes is None:
        report = found / "report.md"
        words, added = (f"--scene={scene}", f"--out={found}"), (f"--exposure={options.exposure}",)
        yield Step("reconstruct", (*words, *added), report.is_file, added)
        training.append(f"--reconstruction={found}")
    measures = model / "eval" / "test" / "metrics.json"
    yield Step("train", tuple(training), measures.is_file)
    looks = f"--rays_per_pixel={options.rays_per_pixel}"
    yield Step("evaluate", (f"--run={model}", "--split=test", looks), measures.is_file)


def run(every: Sequence[Step], out: Path) -> None:
    """Runs all steps that are not finished.

    Raises:
      ValueError: if a step fails, or was begun with other options.
    """
    logs = [out / "logs" / f"{step.name}.txt" for step in every]
    for step, log in zip(every, logs, strict=True):
        _check_same(step, log)
    for number, (step, log) in enumerate(zip(every, logs, strict=True), 1):
        if step.made():
            print(f"{number}/{len(every)} {step.name}: done before")
            continue
        print(f"{number}/{len(every)} {step.name}: {log}", flush=True)
        try:
            subprocesses.run(step.name, *step.options, log=log)
        except subprocesses.RunFailedError as error:
            raise ValueError(str(error)) from error


def _check_same(step: Step, log: Path) -> None:
    """Rejects options that differ from those with which a step was begun before."""
    lines = log.read_text(encoding="utf-8").splitlines() if log.is_file() else []
    before = [line[2:] for line in lines if line.startswith("$ ")]
    allowed = [app.shell(step.name, *step.options)]
    if step.made():  # maybe by an earlier version
        formerly = [each for each in step.options if each not in step.added]
        allowed.append(app.shell(step.name, *formerly))
    if before and before[-1] not in allowed:
        raise ValueError(
            f"{log.parents[1]} was begun with other options: {before[-1]}. Repeat them, or give "
            "another --out."
        )
