"""Compares methods over scenes: trains and evaluates each pair, and tabulates the results.

python -m experiments.benchmark --scenes='scenes/*' --methods=straight,oracle,tree --out=runs/all

There is one job for each scene and method, whose commands run in separate processes. An interrupted
benchmark resumes where it stopped if the same command is repeated; scenes and methods can be added
later. Failed jobs are listed, and the others continue. After every job {out}/summary.md is updated:
methods by category and background next to the paper's numbers, the test views farthest from the
training views, and ablations. {out}/tables has the same as Markdown, CSV, JSON and LaTeX. At the
end {out}/report.html shows all results with images in one self-contained page, and
{out}/pictures.jpg a typical view of each scene, {out}/distances.jpg the same with distances.
--tables_only writes these files again.

--external=NAME=FOLDER adds the renderings of another method, which are measured and not trained:
an image for each test view in FOLDER/SCENE, under the view's name.

Jobs run on this machine, --jobs at a time, or on a Ray cluster with --ray=ADDRESS, whose machines
must see --out, --scenes and these modules under the same paths. See docs/benchmark.md.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from absl import flags
from etils import epy

from experiments.benchmarking import externals, methods, scene_lists
from experiments.benchmarking.methods import Method
from experiments.cli import app
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from refref_jax import atomic_files

if TYPE_CHECKING:
    from experiments.benchmarking.plan import Job, Skipped
    from experiments.benchmarking.settings import Settings

with epy.lazy_imports():
    from experiments.benchmarking import plan, settings, summary, worker
    from experiments.benchmarking.report import page, sheets
    from experiments.runs import perceptual
    from refref_jax.training import presets

_SCENES = flags.DEFINE_list(
    "scenes",
    [],
    "Scenes, separated by commas: folders, or hf:CONFIG/SCENE of the published data set, both with "
    "or without wildcards; hf:all and hf:CONFIG stand for all its scenes; or JSON and CSV files "
    "that list scenes with properties for each, see docs/benchmark.md.",
)
app.check(_SCENES, scene_lists.expand)
_METHODS = flags.DEFINE_list(
    "methods",
    ["straight", "oracle", "tree"],
    f"Methods: {', '.join(methods.METHODS)}; main, baselines, paper (those "
    "that stand for a row of the paper's main table), ablations and all are groups of them.",
)
app.check(_METHODS, lambda words: methods.parse(words) if words else None)
_EXTERNAL = flags.DEFINE_multi_string(
    "external",
    [],
    "Renderings of another method, as NAME=FOLDER, to measure like ours: FOLDER has a folder for "
    "each scene, under its name, with the image of each test view as VIEW.png and, if known, its "
    "distances as VIEW.exr, see docs/benchmark.md. May be repeated; --methods= trains nothing.",
)
app.check(_EXTERNAL, externals.parse)
_OUT = cli_flags.out("Folder of the benchmark.")
_PRESET = cli_flags.preset("Preset of all trainings.")
_STEPS = flags.DEFINE_integer(
    "steps", None, "Steps of each training; those of the preset by default.", 1
)
_LIMIT = cli_flags.limit()
_RAYS_PER_PIXEL = cli_flags.rays_per_pixel(4)
_SEED = cli_flags.seed()
_JOBS = flags.DEFINE_integer("jobs", 1, "Number of concurrent jobs on this machine.", 1)
_RAY = flags.DEFINE_string(
    "ray", None, "Address of a Ray cluster that runs the jobs, or 'local' to start one here."
)
_JOB_CPUS = flags.DEFINE_float("job_cpus", 1.0, "CPUs of the cluster per job.", 0.0)
_JOB_GPUS = flags.DEFINE_float("job_gpus", 0.0, "Accelerators per job.", 0.0)
_DRY_RUN = flags.DEFINE_bool("dry_run", False, "List the jobs without running them.")
_TABLES_ONLY = flags.DEFINE_bool(
    "tables_only", False, "Write the tables and the report again without running jobs."
)
_REPORT_VIEWS = flags.DEFINE_integer(
    "report_views",
    5,
    "Test views per scene in the report: three in five where methods fail most, the others spread "
    "evenly.",
    1,
)
_REPORT_EDGE = flags.DEFINE_integer(
    "report_edge",
    200,
    "Longest edge of the report's images in pixels; larger ones are downsampled.",
    16,
)
_LPIPS_WEIGHTS = cli_flags.lpips_weights()

# Flags that affect results, and flags that select the engine.
_OF_JOBS = (
    *(_PRESET, _STEPS, _LIMIT, _RAYS_PER_PIXEL, _SEED, _LPIPS_WEIGHTS),
    *(_JOBS, _RAY, _JOB_CPUS, _JOB_GPUS),
)
cli_flags.allow_outside()


def main() -> None:
    """Runs all missing jobs, and writes the tables and the report."""
    out = Path(_OUT.value).absolute()
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out} is a file, not a folder. Give another --out.")
    if _TABLES_ONLY.value:
        _make_tables(out)
        return
    _check_engine()
    cli_scenes.check_all(scene_lists.sources(_SCENES.value))
    scenes = plan.find_scenes(_SCENES.value, unpack=not _DRY_RUN.value)
    given = externals.parse(_EXTERNAL.value)
    chosen = [] if given and not _METHODS.value else methods.parse(_METHODS.value)
    weights = perceptual.checked(_LPIPS_WEIGHTS.value)
    common = _settings(weights)
    opened = [scene for scene in scenes if scene.fingerprint]
    benchmark = settings.extended(out, settings.asked(common, opened, chosen, given))
    file = None if weights is None else str(weights.absolute())
    planned, skipped = plan.plan_jobs(scenes, chosen, common, lpips_weights=file, given=given)
    if _DRY_RUN.value:
        _list(out, planned, skipped)
        if packed := len(scenes) - len(opened):
            print(f"{packed} scenes are not unpacked yet: methods may be skipped when they are.")
        return
    # If the benchmark is killed, its child processes are stopped too.
    app.stop_at_kill()
    out.mkdir(parents=True, exist_ok=True)
    with atomic_files.hold(out):
        # Another process may have added to the plan meanwhile.
        benchmark = settings.extended(out, benchmark)
        settings.write(out, benchmark)
        failed = worker.run_missing(
            out, benchmark, planned, skipped, engine=functools.partial(_engine, out)
        )
        _finish(out)
    print(f"Next: {_next(out, chosen)}")
    for each in skipped:
        print(f"skipped: {each.name}: {each.reason}")
    for name, reason in failed.items():
        print(f"failed: {name}: {reason}", file=sys.stderr)
    if failed:
        print("Repeat the command to retry them.", file=sys.stderr)
        sys.exit(1)


def _make_tables(out: Path) -> None:
    """Writes tables and report of the existing results.

    Raises:
      ValueError: if unused flags are set, if there is no benchmark, or if another process works in
        it.
    """
    of_runs = (_SCENES, _METHODS, _EXTERNAL, *_OF_JOBS, _DRY_RUN)
    unused = [f"--{each.name}" for each in of_runs if each.present]
    if unused:
        raise ValueError(
            f"--tables_only does not use {', '.join(unused)}, because it only reads existing "
            "results. Remove --tables_only, or these flags."
        )
    benchmark = settings.read(out)
    with atomic_files.hold(out):
        failed, skipped = summary.not_done(out)
        summary.write(out, benchmark, failed=failed, skipped=skipped)
        _finish(out)
    print(f"Next: open {out / page.FILE} in a browser, or add scenes or methods with --scenes.")


def _settings(weights: Path | None) -> Settings:
    """Returns the settings that all results share, from the flags and the weights of LPIPS."""
    return settings.Settings(
        preset=_PRESET.value,
        steps=_STEPS.value or presets.PRESETS[_PRESET.value].schedule.steps,
        limit=_LIMIT.value,
        rays_per_pixel=_RAYS_PER_PIXEL.value,
        seed=_SEED.value,
        lpips=None if weights is None else settings.digest(weights),
    )


def _check_engine() -> None:
    """Rejects flags that the selected engine ignores."""
    unheeded = (_JOB_CPUS, _JOB_GPUS) if _RAY.value is None else (_JOBS,)
    if given := [f"--{each.name}" for each in unheeded if each.present]:
        who = "without --ray" if _RAY.value is None else "on a Ray cluster"
        raise ValueError(
            f"{', '.join(given)} would have no effect {who}. Remove it, or "
            + ("add --ray=ADDRESS." if _RAY.value is None else "remove --ray.")
        )


def _engine(out: Path) -> worker.Engine:
    if _RAY.value is None:
        return worker.LocalEngine(out, _JOBS.value)
    return worker.RayEngine(out, _RAY.value, cpus=_JOB_CPUS.value, gpus=_JOB_GPUS.value)


def _list(out: Path, planned: Sequence[Job], skipped: Sequence[Skipped]) -> None:
    done = [plan.is_done(out, job) for job in planned]
    for job, is_done in zip(planned, done, strict=True):
        options = [f"--external={job.method}={job.external}"] if job.external else job.train
        words = " ".join([*options, *plan.given_properties(job)])
        print(f"{'done' if is_done else 'to do':6} {job.name:48} {words}".rstrip())
    for each in skipped:
        print(f"{'skip':6} {each.name}: {each.reason}")
    print(f"{len(planned)} jobs, {done.count(False)} to do.")


def _finish(out: Path) -> None:
    """Writes report and images, and prints the paths of all results."""
    report = page.write(out, views=_REPORT_VIEWS.value, edge=_REPORT_EDGE.value)
    print(f"Summary: {out / summary.FILE}")
    print(f"Tables:  {out / summary.TABLES}")
    print(f"Results: {out / summary.RESULTS}")
    print(f"Report:  {report} ({report.stat().st_size / 1e6:.1f} MB)")
    drawn = ", ".join(map(str, sheets.write(out)))
    print(f"Images:  {drawn or 'none, because the scenes are missing'}")


def _next(out: Path, done: Sequence[Method]) -> str:
    """Returns the command that adds the ablations, or another suggestion if they are finished."""
    if {each.name for each in methods.parse(["ablations"])} <= {each.name for each in done}:
        return f"open {out / page.FILE} in a browser, or add scenes or methods"
    deciding = (*_OF_JOBS, _REPORT_VIEWS, _REPORT_EDGE)
    given = [each.serialize() for each in deciding if each.value != each.default]
    scenes = f"--scenes={','.join(_SCENES.value)}"
    return app.shell("benchmark", scenes, "--methods=ablations", f"--out={out}", *given)


if __name__ == "__main__":
    app.run(main, again="repeat the command to resume; finished jobs are skipped.")
