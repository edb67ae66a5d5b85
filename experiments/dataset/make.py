"""Makes scenes of the data set: objects before backgrounds, rendered by Blender.

python -m experiments.dataset.make --out=runs/dataset --scenes=all --workers=4

Each scene gets a folder in --out. Blender needs an environment of its own, which
`make dataset-env` makes. A command that was stopped, in whatever way, is given again and goes on
where it stopped: the result is the same, to the bit. What is there already is never replaced.

`--preview` renders one test view of each scene instead, into {out}/preview, and contact sheets.
"""

import contextlib
import fcntl
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from absl import flags

from experiments import commands
from experiments.dataset import (
    cameras,
    catalogue,
    contact_sheet,
    frame_files,
    scene_setup,
    scenes,
    views,
)
from experiments.dataset.render_settings import PerSplit, RenderSettings
from experiments.dataset.scenes import Scene
from experiments.dataset.workers import Pool

_OUT = flags.DEFINE_string("out", None, "Folder that gets a folder for each scene.", required=True)
_SCENES = flags.DEFINE_string(
    "scenes",
    "all",
    "all, or names parted by commas: scenes as cube_smcvx_ball, objects as ball for all their "
    "backgrounds, or either with wildcards as 'sphere_*'.",
)
_SIZE = flags.DEFINE_integer("size", 800, "Width and height of images in pixels.", lower_bound=1)
_SPP = flags.DEFINE_integer("spp", 512, "Samples a pixel of train and val.", lower_bound=1)
_TEST_SPP = flags.DEFINE_integer(
    "test_spp", None, "Samples a pixel of test; those of --spp if not given.", lower_bound=1
)
_VIEWS = flags.DEFINE_integer("views", 100, "Views of each split.", lower_bound=0)
_SPLIT_VIEWS = {
    split: flags.DEFINE_integer(
        f"{split}_views", None, f"Views of {split}; those of --views if not given.", lower_bound=0
    )
    for split in cameras.SPLITS
}
_WORKERS = flags.DEFINE_integer(
    "workers", None, "Processes of Blender; one for each core if not given.", lower_bound=1
)
_RULE = flags.DEFINE_enum(
    "rule",
    "nested",
    ["nested", "facing"],
    "What lies outside a part: the part around it, or always air, as in Blender without care.",
)
_EXR = flags.DEFINE_enum(
    "exr", "test", ["all", "test", "none"], "Splits whose images are kept as linear EXRs too."
)
_PREVIEW = flags.DEFINE_bool("preview", False, "One test view of each scene, and contact sheets.")
_BLENDER = flags.DEFINE_string(
    "blender", ".venv-dataset/bin/python", "Python of the environment that has Blender."
)

_SCRATCH = ".scratch"

# Pixels of a picture on a contact sheet.
_TILE = 200


def main() -> None:
    """Makes what is missing of the chosen scenes."""
    chosen = scenes.choose(_SCENES.value, catalogue.OBJECTS)
    settings = _settings()
    blender = Path(_BLENDER.value).absolute()
    if not blender.is_file():
        raise ValueError(
            f"There is no Blender: {_BLENDER.value} does not exist. Run make dataset-env, or give "
            "the Python of an environment that has bpy 5.0.1 as --blender."
        )
    out = Path(_OUT.value) / "preview" if _PREVIEW.value else Path(_OUT.value)
    for scene in chosen:
        scene_setup.check(out / scene.name, scene, settings)
    out.mkdir(parents=True, exist_ok=True)
    with _alone_in(out) as scratch:
        for scene in chosen:
            frame_files.remove_unfinished(out / scene.name)
        whole = _render(out, chosen, settings, blender, scratch)
    if not whole:
        print("Stopped. The same command goes on from here.")
        sys.exit(commands.INTERRUPTED)
    if _PREVIEW.value:
        _write_contact_sheets(out, chosen, settings)
    print(f"Scenes: {out / chosen[0].name}" + f" and {len(chosen) - 1} more" * (len(chosen) > 1))
    print(f"Next: python -m experiments.dataset.check {out}")


def _settings() -> RenderSettings:
    test_spp = _SPP.value if _TEST_SPP.value is None else _TEST_SPP.value
    views = (
        _VIEWS.value if _SPLIT_VIEWS[split].value is None else _SPLIT_VIEWS[split].value
        for split in cameras.SPLITS
    )
    return RenderSettings(
        size=_SIZE.value,
        spp=PerSplit(_SPP.value, _SPP.value, test_spp),
        views=PerSplit(*views),
        rule=_RULE.value,
        linear=_EXR.value,
        preview=_PREVIEW.value,
    )


@contextlib.contextmanager
def _alone_in(out: Path) -> Iterator[Path]:
    """Gives an empty folder for files that come and go to the only command that works in `out`.

    It stays behind where an error ends the command, for the logs in it.

    Raises:
      ValueError: if another command works there.
    """
    lock = os.open(out, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise ValueError(
            f"Another command makes scenes in {out}. Wait for it, or give another --out."
        ) from error
    scratch = out / _SCRATCH
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(exist_ok=True)
    # A process of a killed command may still be about to write: the name is new every time.
    yield Path(tempfile.mkdtemp(dir=scratch)).absolute()
    shutil.rmtree(scratch, ignore_errors=True)
    os.close(lock)


def _render(
    out: Path, chosen: Sequence[Scene], settings: RenderSettings, blender: Path, scratch: Path
) -> bool:
    """Renders all views that are not done; returns whether none is left."""
    wanted = views.all_views(chosen, settings)
    missing = [view for view in wanted if not views.is_done(out, view, settings)]
    if not missing:
        print(f"Nothing to do: all {len(wanted)} views are there.")
        return True
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    count = min(_WORKERS.value or cores, len(missing))
    tasks = views.tasks(out, missing, settings, objects=catalogue.OBJECTS, scratch=scratch)
    threads = max(1, cores // count)
    pool = Pool(tasks, blender=blender, scratch=scratch, workers=count, threads=threads)
    interrupt = commands.Interrupt()
    started, there, done = time.monotonic(), len(wanted) - len(missing), 0
    with commands.ProgressBar("render", len(wanted), there) as bar, pool:
        for done, task in enumerate(pool.run(), start=1):
            pace = (time.monotonic() - started) / done
            bar.show(there + done, f"{task.name}  {pace:.1f} s a view")
            if interrupt.requested:
                pool.stop()
    return done == len(missing)


def _write_contact_sheets(out: Path, chosen: Sequence[Scene], settings: RenderSettings) -> None:
    """Writes a sheet for each kind of background."""
    (number,) = settings.numbers("test")
    image = frame_files.relative("test", number).image
    for kind in scenes.KINDS:
        pictures = [(s.object, out / s.name / image) for s in chosen if s.kind == kind]
        if pictures:
            path = out / f"contact_sheet_{kind}.png"
            contact_sheet.write(path, pictures, tile=_TILE)
            print(f"Contact sheet: {path}")


if __name__ == "__main__":
    commands.run(main)
