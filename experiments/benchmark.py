"""Compares methods over scenes: trains and evaluates each with each, and tables what comes of it.

python -m experiments.benchmark --scenes='scenes/*' --methods=straight,oracle,tree --out=runs/all

One job for each scene and method, each command in a process of its own. Killed at any time, in
whatever way, the same command goes on where it was, and does only what is missing; scenes and
methods can be added later. What fails is listed, and the rest goes on. After every job
{out}/summary.md is written anew: methods by category and background beside the paper's numbers, the
test views farthest from the training views, and ablations; as Markdown, CSV, JSON and LaTeX in
{out}/tables. At the end {out}/report.html shows all of it, with pictures, in one page that needs no
network. --tables_only makes tables and report again from the results that are there.

Jobs are done on this machine, --jobs at once, or on a Ray cluster with --ray=ADDRESS, whose
machines see --out, --scenes and these modules by the same paths. docs/benchmark.md says all.
"""

import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from absl import flags

from experiments import commands
from experiments.benchmarking import (
    engines,
    jobs,
    methods,
    scene_list,
    schedule,
    settings,
    summary,
)
from experiments.benchmarking.jobs import Job, Skipped
from experiments.benchmarking.report import page
from experiments.benchmarking.settings import Benchmark, Settings
from experiments.presets import PRESETS
from experiments.supersampling import side_of
from refref_jax.training import run_lock

_SCENES = flags.DEFINE_list(
    "scenes",
    [],
    "Scenes, parted by commas: folders, with wildcards or without, or hf:CONFIG/SCENE of the "
    "published data set.",
)
_METHODS = flags.DEFINE_list(
    "methods",
    ["straight", "oracle", "tree"],
    f"Methods: {', '.join(methods.METHODS)}; main, ablations and all stand for many.",
)
_OUT = flags.DEFINE_string("out", None, "Folder of the benchmark.", required=True)
_PRESET = flags.DEFINE_enum("preset", "tiny", list(PRESETS), "Preset of all trainings.")
_STEPS = flags.DEFINE_integer(
    "steps", None, "Steps of each training; the preset's if not given.", 1
)
_LIMIT = flags.DEFINE_integer("limit", None, "Only this many test images, evenly spread.", 1)
_RAYS_PER_PIXEL = flags.DEFINE_integer(
    "rays_per_pixel", 4, "Rays in each pixel of an evaluation, a square: 1, 4, 9, 16."
)
_SEED = flags.DEFINE_integer("seed", 0, "Seed of everything random.", 0, 2**32 - 1)
_LPIPS_WEIGHTS = flags.DEFINE_string(
    "lpips_weights", None, "Weights of LPIPS, as experiments.evaluate takes them."
)
_JOBS = flags.DEFINE_integer("jobs", 1, "Jobs at once on this machine.", 1)
_RAY = flags.DEFINE_string(
    "ray", None, "Address of a Ray cluster that does the jobs, or 'local' to start one here."
)
_JOB_CPUS = flags.DEFINE_float("job_cpus", 1.0, "CPUs that a job takes of a cluster.", 0.0)
_JOB_GPUS = flags.DEFINE_float("job_gpus", 0.0, "Accelerators that it takes.", 0.0)
_DRY_RUN = flags.DEFINE_bool("dry_run", False, "List the jobs, and do nothing.")
_TABLES_ONLY = flags.DEFINE_bool(
    "tables_only", False, "Make the tables and the report again, and do no job."
)
_REPORT_VIEWS = flags.DEFINE_integer(
    "report_views",
    5,
    "Test views of a scene in the report: three in five where methods fail most, the others spread "
    "evenly.",
    1,
)
_REPORT_EDGE = flags.DEFINE_integer(
    "report_edge",
    200,
    "Longest edge of the report's pictures in pixels; larger ones are reduced.",
    16,
)


def main() -> None:
    """Does all jobs that are missing, and writes the tables and the report."""
    out = Path(_OUT.value).absolute()
    if _TABLES_ONLY.value:
        benchmark = settings.read(out)
        earlier_failed, earlier_skipped = summary.not_done(out)
        summary.write(out, benchmark, failed=earlier_failed, skipped=earlier_skipped)
        _finish(out)
        return
    scenes, chosen = scene_list.find(_SCENES.value), methods.parse(_METHODS.value)
    common = _settings()
    benchmark = settings.extended(out, settings.asked(common, scenes, chosen))
    weights = _LPIPS_WEIGHTS.value and str(Path(_LPIPS_WEIGHTS.value).absolute())
    planned, skipped = jobs.plan(scenes, chosen, common, lpips_weights=weights)
    missing = [job for job in planned if not jobs.is_done(out, job)]
    if _DRY_RUN.value:
        _list(planned, missing, skipped)
        return
    # A benchmark that is killed takes the commands that it waits for with it.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    out.mkdir(parents=True, exist_ok=True)
    with run_lock.hold(out):
        # Another process may have added to it meanwhile.
        benchmark = settings.extended(out, benchmark)
        settings.write(out, benchmark)
        failed = _work(out, benchmark, missing, skipped)
    _finish(out)
    for each in skipped:
        print(f"left out: {each.scene}/{each.method}: {each.reason}")
    for name, reason in failed.items():
        print(f"failed: {name}: {reason}", file=sys.stderr)
    if failed:
        print("The same command tries them again.", file=sys.stderr)
        sys.exit(1)


def _settings() -> Settings:
    """Returns what the options fix for all results.

    Raises:
      ValueError: if one makes no sense.
    """
    side_of(_RAYS_PER_PIXEL.value)
    weights = _LPIPS_WEIGHTS.value
    if weights is not None and not Path(weights).is_file():
        raise ValueError(f"There is no file {weights}. Give the weights of LPIPS, or leave it out.")
    return Settings(
        preset=_PRESET.value,
        steps=_STEPS.value or PRESETS[_PRESET.value].schedule.steps,
        limit=_LIMIT.value,
        rays_per_pixel=_RAYS_PER_PIXEL.value,
        seed=_SEED.value,
        lpips=None if weights is None else settings.digest(Path(weights)),
    )


def _work(
    out: Path, benchmark: Benchmark, missing: Sequence[Job], skipped: Sequence[Skipped]
) -> dict[str, str]:
    """Does jobs, and writes the summary after each; returns why some failed."""
    failed: dict[str, str] = {}
    summary.write(out, benchmark, failed=failed, skipped=skipped)
    if not missing:
        print("All jobs are done already.")
        return failed
    engine = _engine(out)
    start, count = time.monotonic(), 0
    with commands.ProgressBar("benchmark", len(missing)) as bar:

        def done(job: Job, reason: str | None) -> None:
            nonlocal count
            count += 1
            if reason is not None:
                failed[job.name] = reason
            summary.write(out, benchmark, failed=failed, skipped=skipped)
            left = (time.monotonic() - start) / count * (len(missing) - count)
            end = "failed" if reason is not None else "done"
            bar.show(count, f"{job.name} {end}, about {_duration(left)} left")

        schedule.work(missing, engine, done)
    return failed


def _engine(out: Path) -> engines.Engine:
    if _RAY.value is None:
        return engines.LocalEngine(out, _JOBS.value)
    return engines.RayEngine(out, _RAY.value, cpus=_JOB_CPUS.value, gpus=_JOB_GPUS.value)


def _list(planned: Sequence[Job], missing: Sequence[Job], skipped: Sequence[Skipped]) -> None:
    for job in planned:
        state = "to do" if job in missing else "done"
        print(f"{state:6} {job.name:48} {' '.join(job.train)}".rstrip())
    for each in skipped:
        print(f"{'out':6} {each.scene}/{each.method}: {each.reason}")
    print(f"{len(planned)} jobs, {len(missing)} to do.")


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60.0)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min"


def _finish(out: Path) -> None:
    """Writes the report, and says where everything is."""
    report = page.write(out, views=_REPORT_VIEWS.value, edge=_REPORT_EDGE.value)
    print(f"Summary: {out / summary.FILE}")
    print(f"Tables:  {out / summary.TABLES}")
    print(f"Results: {out / summary.RESULTS}")
    print(f"Report:  {report} ({report.stat().st_size / 1e6:.1f} MB)")
    options = (f"--scenes={','.join(_SCENES.value)}", "--methods=ablations", f"--out={out}")
    if _SCENES.value:
        print(f"Next: {commands.shell('benchmark', *options)}")


if __name__ == "__main__":
    commands.run(main)
