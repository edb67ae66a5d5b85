"""The commands of the campaign of faults (`benchmarks.faults`), at tiny sizes, and their results.

A result is compared by its digest: of the arrays of a checkpoint, of records without what is
measured (times, memory, paths of folders), and of the bytes of all other files.
"""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import imageio.v3 as iio
import jax
import numpy as np

from refref_jax.render import checkpoint_io

ROOT = Path(__file__).parents[1]

_SOURCE = ROOT / "experiments" / "data" / "cube_smcvx_ball"

# Every fourth pixel of so many views.
_VIEWS, _STEP = {"train": 20, "val": 2, "test": 2}, 4

# Keys of records that are measured, or that name folders or versions.
_MEASURED = ("second", "memory", "mib", "path", "date", "took", "options", "scene", "tables")

# Files without results.
_IGNORED = ("command.json", ".log", ".html", ".jpg", "checksums.json", "config.json", "locks")

# Seconds that processes which a killed command leaves behind may take to end.
_PATIENCE = 180.0


class Command(NamedTuple):
    """A command of `experiments`, at a tiny size.

    Attributes:
      name: what it does, for the table.
      words: function of its output folder to the words that start it.
      again: words that are added when it is repeated after a fault.
      prepare: function that makes the output folder before the first start.
    """

    name: str
    words: Callable[[Path], Sequence[str]]
    again: tuple[str, ...] = ()
    prepare: Callable[[Path], Any] = lambda out: None


class Ended(NamedTuple):
    """How a process ended: its status, all that it printed, and its seconds."""

    status: int
    printed: str
    seconds: float


def make_scene(folder: Path) -> Path:
    """Writes a small copy of the bundled ball."""
    scene = folder / _SOURCE.name
    shutil.rmtree(scene, ignore_errors=True)
    scene.mkdir(parents=True)
    shutil.copytree(_SOURCE / "meshes", scene / "meshes")
    shutil.copytree(_SOURCE / "background", scene / "background")
    shutil.copy(_SOURCE / "scene.json", scene)
    for split, views in _VIEWS.items():
        name = f"transforms_{split}.json"
        content = json.loads((_SOURCE / name).read_text(encoding="utf-8"))
        content["frames"] = content["frames"][:: len(content["frames"]) // views][:views]
        (scene / name).write_text(json.dumps(content), encoding="utf-8")
        for frame in content["frames"]:
            masks = frame["mask_file_path"], frame["depth_file_path"]
            for image in (f"{frame['file_path']}.png", *masks):
                (scene / image).parent.mkdir(parents=True, exist_ok=True)
                iio.imwrite(scene / image, iio.imread(_SOURCE / image)[::_STEP, ::_STEP])
    return scene


def commands(scene: Path, trained: Path) -> dict[str, Command]:
    """Returns all commands by their short names.

    Args:
      scene: the small scene.
      trained: folder of a finished run of `train`, which is evaluated.
    """
    steps = ("--batch=64", "--far_field=field", f"--scene={scene}")

    def train(out: Path, *options: str) -> tuple[str, ...]:
        return "train", f"--out={out}", *options, *steps

    return {
        "train": Command(
            "training", lambda out: train(out, *_steps(12, every=3)), again=("--resume",)
        ),
        "checkpoint": Command(
            "writing of checkpoints",
            lambda out: train(out, *_steps(12, every=1)),
            again=("--resume",),
        ),
        "evaluate": Command(
            "evaluation",
            lambda out: ("evaluate", f"--run={out}", "--split=test", "--limit=2"),
            again=("--overwrite",),
            prepare=lambda out: shutil.copytree(trained, out),
        ),
        "reconstruct": Command(
            "reconstruction",
            lambda out: (
                *("reconstruct", f"--scene={scene}", f"--out={out}", "--geometry=hull"),
                *("--resolution=24", "--refinement=none", "--ior=1.5"),
            ),
        ),
        "benchmark": Command(
            "benchmark",
            lambda out: (
                *("benchmark", f"--scenes={scene}", f"--out={out}", "--methods=straight,tree"),
                *("--steps=2", "--limit=1", "--rays_per_pixel=1", "--report_views=1"),
            ),
        ),
        "convert": Command(
            "making of a data set",
            lambda out: ("dataset.convert", f"--scene={scene}", "--to=raw", f"--out={out}"),
            prepare=lambda out: shutil.rmtree(out, ignore_errors=True),
        ),
    }


def _steps(steps: int, *, every: int) -> tuple[str, ...]:
    return f"--steps={steps}", f"--log_every={every}", f"--checkpoint_every={every}"


def line(words: Sequence[str]) -> list[str]:
    """Returns the command line of a command."""
    return [sys.executable, "-m", f"experiments.{words[0]}", *words[1:]]


def environment(work: Path) -> dict[str, str]:
    """Returns an environment whose compiled programs are kept in a folder."""
    return os.environ | {
        "PYTHONPATH": str(ROOT),
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": str(work / "programs"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }


def run(
    words: Sequence[str], *, work: Path, kill: float | Callable[[], bool] | None = None
) -> Ended:
    """Runs a command line; `kill -9` ends it after so many seconds, or once a condition holds."""
    begun = time.monotonic()
    with (work / f"printed_{time.monotonic_ns()}.txt").open("w+", encoding="utf-8") as file:
        process = subprocess.Popen(
            words,
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            cwd=ROOT,
            env=environment(work),
            start_new_session=True,
        )
        while kill is not None and process.poll() is None:
            if kill() if callable(kill) else time.monotonic() - begun > kill:
                process.send_signal(signal.SIGKILL)
                break
            time.sleep(0.002)
        status = process.wait()
        file.seek(0)
        printed = file.read()
    Path(file.name).unlink()
    return Ended(status, printed, time.monotonic() - begun)


def wait_for_orphans(out: Path) -> None:
    """Waits until no process names a folder: those of a killed command stop by themselves."""
    until = time.monotonic() + _PATIENCE
    while time.monotonic() < until and _any_process_names(str(out)):
        time.sleep(0.2)


def _any_process_names(text: str) -> bool:
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if int(path.parent.name) != os.getpid() and text.encode() in path.read_bytes():
                return True
        except OSError:
            continue
    return False


def newest_step(out: Path) -> int:
    """Returns the step of the newest complete checkpoint, or -1."""
    folder = out / checkpoint_io.CHECKPOINTS
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    return max((int(name) for name in names if name.isdecimal()), default=-1)


def digest(out: Path) -> str:
    """Returns a hash of all results in a folder."""
    found = hashlib.sha256()
    for path in sorted(path for path in out.rglob("*") if path.is_file()):
        name = path.relative_to(out)
        if checkpoint_io.CHECKPOINTS in name.parts or name.name.endswith(_IGNORED):
            continue
        found.update(name.as_posix().encode() + _content(path))
    for folder in sorted(out.rglob(checkpoint_io.CHECKPOINTS)):
        for leaf in jax.tree.leaves(checkpoint_io.load_model(folder.parent).params):
            found.update(np.asarray(leaf).tobytes())
    return found.hexdigest()


def _content(path: Path) -> bytes:
    if path.suffix in (".md", ".csv", ".txt") or path.parent.name == "tables":
        return b""  # tables of times
    if path.suffix in (".json", ".jsonl"):
        texts = path.read_text(encoding="utf-8").splitlines()
        records = map(json.loads, texts if path.suffix == ".jsonl" else ["\n".join(texts)])
        return json.dumps([_without_measures(each) for each in records], sort_keys=True).encode()
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as arrays:
            return b"".join(name.encode() + arrays[name].tobytes() for name in sorted(arrays))
    return path.read_bytes()


def _without_measures(value: Any) -> Any:
    if isinstance(value, dict):
        kept = {
            key: each for key, each in value.items() if not any(word in key for word in _MEASURED)
        }
        return {key: _without_measures(each) for key, each in kept.items()}
    return [_without_measures(each) for each in value] if isinstance(value, list) else value
