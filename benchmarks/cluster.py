"""Claim: a benchmark of 300 jobs on a Ray cluster whose workers are killed at random is complete.

    pip install -e '.[cluster]'
    python -m benchmarks.cluster [--jobs=300] [--kills=30] [--out=FOLDER]

All scenes are copies of one small scene, and a job takes two training steps. While
`experiments.benchmark --ray=local` runs, one worker of Ray after another, chosen at random, gets
SIGKILL. If jobs failed, the command is repeated without kills. Asserts that every job has its
results in the end, and that jobs of one method, which differ in nothing but their scene's name,
have the same metrics.
"""

import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

from absl import app, flags

from benchmarks import faults_commands
from experiments.benchmarking import summary

_JOBS = flags.DEFINE_integer("jobs", 300, "Number of jobs, a multiple of the methods.", 1)
_METHODS = flags.DEFINE_list("methods", ["straight"], "Methods of the benchmark.")
_KILLS = flags.DEFINE_integer("kills", 30, "Number of workers to kill.", 0)
_EVERY = flags.DEFINE_float("every", 20.0, "Mean seconds between two kills.", 0.1)
_OUT = flags.DEFINE_string("out", "runs/cluster", "Folder to write to, which must not exist.")

_MOST_CALLS = 3


def main(arguments: list[str]) -> None:
    del arguments
    out = Path(_OUT.value).absolute()
    out.mkdir(parents=True)
    scenes = _write_scenes(out, _JOBS.value // len(_METHODS.value))
    words = faults_commands.line(
        [
            "benchmark",
            f"--scenes={scenes}/*",
            f"--methods={','.join(_METHODS.value)}",
            "--ray=local",
            "--steps=2",
            "--preset=tiny",
            f"--out={out / 'benchmark'}",
        ]
    )
    killed: list[float] = []
    begun = time.monotonic()
    for call in range(_MOST_CALLS):
        status = _run(words, out, killed if call == 0 else None)
        print(f"call {call + 1}: status {status}, {len(killed)} workers killed", flush=True)
        if status == 0:
            break
    assert status == 0, f"jobs failed in every call: see {out / 'printed.txt'}"
    minutes = (time.monotonic() - begun) / 60
    found = json.loads((out / "benchmark" / summary.RESULTS).read_text(encoding="utf-8"))["jobs"]
    _check(found)
    print("| jobs | workers killed | calls of the command | minutes |\n|---|---|---|---|")
    print(f"| {len(found)} | {len(killed)} | {call + 1} | {minutes:.1f} |")


def _write_scenes(out: Path, count: int) -> Path:
    """Writes copies of the small scene, and returns their folder."""
    first, scenes = faults_commands.make_scene(out), out / "scenes"
    for i in range(count):
        shutil.copytree(first, scenes / f"{first.name}_{i:03d}")
    return scenes


def _run(words: list[str], out: Path, killed: list[float] | None) -> int:
    """Runs the benchmark, and kills workers meanwhile if asked to."""
    with (out / "printed.txt").open("a", encoding="utf-8") as file:
        process = subprocess.Popen(
            words,
            cwd=faults_commands.ROOT,
            env=faults_commands.environment(out),
            stdout=file,
            stderr=subprocess.STDOUT,
        )
        if killed is not None:
            threading.Thread(target=_kill, args=(process, killed), daemon=True).start()
        return process.wait()


def _kill(benchmark: "subprocess.Popen[bytes]", killed: list[float]) -> None:
    """Kills workers of Ray at random moments, until there were enough or the benchmark ends."""
    draw = random.Random(0)
    while benchmark.poll() is None and len(killed) < _KILLS.value:
        time.sleep(draw.expovariate(1.0 / _EVERY.value))
        workers = _busy_workers(benchmark.pid)
        if workers and benchmark.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(draw.choice(workers), signal.SIGKILL)
                killed.append(time.monotonic())


def _busy_workers(benchmark: int) -> list[int]:
    """Returns the workers of a benchmark that run a job: Ray names a process after its function."""
    parents, busy = {}, []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            stat = (path / "stat").read_text(encoding="utf-8")
            parents[int(path.name)] = int(stat.rsplit(")", 1)[1].split()[1])
            if (path / "cmdline").read_bytes().startswith(b"ray::run_job"):
                busy.append(int(path.name))
        except OSError:
            continue
    return [each for each in busy if benchmark in _ancestors(each, parents)]


def _ancestors(process: int, parents: dict[int, int]) -> set[int]:
    found: set[int] = set()
    while process in parents:
        process = parents[process]
        found.add(process)
    return found


def _check(jobs: list[dict[str, Any]]) -> None:
    """Asserts that all jobs are there, and that those of one method have the same metrics."""
    pairs = {(job["scene"], job["method"]) for job in jobs}
    assert len(jobs) == len(pairs) == _JOBS.value, f"{len(pairs)} of {_JOBS.value} jobs"
    for method in _METHODS.value:
        images = [job["per_image"] for job in jobs if job["method"] == method]
        metrics = {json.dumps([_lasting(each) for each in job]) for job in images}
        assert len(metrics) == 1, f"{method}: {len(metrics)} different results"


def _lasting(image: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in image.items() if key != "seconds"}


if __name__ == "__main__":
    app.run(main)
