"""Makes the missing files of scenes, one process per folder (NumPy only)."""

import contextlib
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from experiments.cli.progress import ProgressBar
from experiments.dataset import frame_files, scene_setup, views
from experiments.dataset.parts import Object
from experiments.dataset.render_settings import RenderSettings
from experiments.dataset.worker_pool import Pool
from refref_jax import atomic_files
from refref_jax.data.scene_names import SceneName

_SCRATCH = ".refref_making"


def produce(
    out: Path,
    chosen: Sequence[SceneName],
    settings: RenderSettings,
    *,
    objects: Mapping[str, Object],
    blender: Path,
    workers: int | None,
    stopped: Callable[[], bool],
) -> bool:
    """Makes missing folders and views, and returns whether all of them exist.

    Args:
      out: folder of the scenes; created if missing.
      chosen: scenes to make; those of one object follow each other.
      settings: settings of the rendering.
      objects: objects by name.
      blender: Python that has bpy.
      workers: number of Blender processes, or one for each core.
      stopped: callback that returns whether the user wants to end; queried after every view.

    Raises:
      ValueError: if a scene's folder has other contents, if another command works in the folder, or
      if Blender fails.
    """
    for scene in chosen:
        scene_setup.check(out / str(scene), scene, settings)
    out.mkdir(parents=True, exist_ok=True)
    with alone_in(out) as scratch:
        for scene in chosen:
            frame_files.remove_unfinished(out / str(scene))
        wanted = views.all_views(chosen, settings)
        missing = [view for view in wanted if not views.is_done(out, view, settings)]
        if not missing:
            print(f"Nothing to do: all {len(wanted)} views exist.")
            return True
        available = cores()
        # A GPU renders one view at a time.
        usual = available if settings.device == "CPU" else 1
        count = min(workers or usual, len(missing))
        pool = Pool(
            views.tasks(out, missing, settings, objects=objects, scratch=scratch),
            blender=blender,
            scratch=scratch,
            workers=count,
            threads=max(1, available // count),
            device=settings.device,
        )
        done = render(pool, len(wanted) - len(missing), len(wanted), stopped)
        return done == len(missing)


def render(pool: Pool, there: int, total: int, stopped: Callable[[], bool]) -> int:
    """Renders the views of a pool, and returns their number.

    Args:
      pool: the pool.
      there: number of views that exist already.
      total: number of all views.
      stopped: callback that returns whether the user wants to end; queried after every view.
    """
    started, done = time.monotonic(), 0
    with ProgressBar("render", total, there) as bar, pool:
        for done, task in enumerate(pool.run(), start=1):
            pace = (time.monotonic() - started) / done
            bar.show(there + done, f"{task.name}  {pace:.1f} s per view")
            if stopped():
                pool.stop()
    return done


@contextlib.contextmanager
def alone_in(out: Path) -> Iterator[Path]:
    """Locks `out` for this command, and yields an empty folder for temporary files.

    After an error the folder remains, for the logs in it.
    """
    with atomic_files.hold(out):
        scratch = out / _SCRATCH
        shutil.rmtree(scratch, ignore_errors=True)
        scratch.mkdir(exist_ok=True)
        # A process of a killed command may still write later: the name is always new.
        yield Path(tempfile.mkdtemp(dir=scratch)).absolute()
        shutil.rmtree(scratch, ignore_errors=True)


def cores() -> int:
    """Returns the number of cores available to this process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
