"""Claim: a long training keeps its memory, its open files and its threads.

    python -m benchmarks.load [--steps=20000] [--scene=FOLDER] [--out=FOLDER]

Trains with small batches, and samples the process every few seconds from its first checkpoint on.
Asserts that the mean resident memory of the last fifth of the samples is at most 3 % above that of
the second fifth, and that open files and threads, of which there are more while a checkpoint is
written, come back to the same numbers.
"""

import statistics
import subprocess
import time
from pathlib import Path
from typing import NamedTuple

from absl import app, flags

from benchmarks import faults_commands

_SCENE = flags.DEFINE_string("scene", "experiments/data/cube_smcvx_ball", "Folder of the scene.")
_STEPS = flags.DEFINE_integer("steps", 20_000, "Steps of the training.", 100)
_OUT = flags.DEFINE_string("out", "runs/load", "Folder of the run, which must not exist.")

_PERIOD = 5.0
"""Seconds between two samples."""

_GROWTH = 0.03
"""Largest growth of the resident memory."""


class Sample(NamedTuple):
    """A process at one moment.

    Attributes:
      step: newest step that its metrics state.
      mebibytes: resident memory.
      files: number of open files.
      threads: number of threads.
    """

    step: int
    mebibytes: float
    files: int
    threads: int


def main(arguments: list[str]) -> None:
    del arguments
    out, every = Path(_OUT.value), max(1, _STEPS.value // 40)
    options = (f"--steps={_STEPS.value}", f"--log_every={every}", f"--checkpoint_every={every}")
    words = ("train", f"--scene={_SCENE.value}", f"--out={out}", "--batch=64", *options)
    line = faults_commands.line([*words, "--far_field=field"])
    process = subprocess.Popen(line, cwd=faults_commands.ROOT, stdout=subprocess.DEVNULL)
    samples = []
    while process.poll() is None:
        time.sleep(_PERIOD)
        if (step := faults_commands.newest_step(out)) > 0:
            samples.append(_sample(process.pid, step))
    assert process.returncode == 0 and faults_commands.newest_step(out) == _STEPS.value
    samples = [each for each in samples if each is not None]
    _report(samples)


def _sample(pid: int, step: int) -> Sample | None:
    """Returns a sample; `None` if the process has just ended."""
    try:
        rows = [row.split() for row in Path(f"/proc/{pid}/status").read_text().splitlines()]
        sizes = {row[0]: int(row[1]) for row in rows if row[1:2] and row[1].isdecimal()}
        files = len(list(Path(f"/proc/{pid}/fd").iterdir()))
        return Sample(step, sizes["VmRSS:"] / 1024, files, sizes["Threads:"])
    except (OSError, KeyError):
        return None


def _report(samples: list[Sample]) -> None:
    fifth = len(samples) // 5
    assert fifth, "the training was too short to be sampled"
    parts = [samples[i * fifth : (i + 1) * fifth] for i in range(5)]
    print("| up to step | memory, MiB | open files | threads |\n|---|---|---|---|")
    for part in parts:
        memory = statistics.mean(each.mebibytes for each in part)
        files, threads = (_span([each[i] for each in part]) for i in (2, 3))
        print(f"| {part[-1].step} | {memory:.0f} | {files} | {threads} |")
    early, late = parts[1], parts[4]
    first, last = (statistics.mean(x.mebibytes for x in part) for part in (early, late))
    assert last <= (1.0 + _GROWTH) * first, f"memory grew from {first:.0f} to {last:.0f} MiB"
    for i in (2, 3):
        assert min(x[i] for x in late) <= min(x[i] for x in early), Sample._fields[i]


def _span(numbers: list[int]) -> str:
    return f"{min(numbers)} to {max(numbers)}"


if __name__ == "__main__":
    app.run(main)
