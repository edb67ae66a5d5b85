"""Runs Blender in processes of its own, and gives them views to render.

What is spoken with them is told in `blender_worker`. Which process renders a view, and when, does
not show in it.
"""

import json
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from experiments.dataset.render_settings import BLENDER

SCRIPT = Path(__file__).with_name("blender_worker.py")
"""What a process of Blender runs."""


class Job(NamedTuple):
    """A view to render.

    Attributes:
      scene: folder of the scene, absolute.
      pose: camera-to-world, 4 x 4.
      angle_x: horizontal field of view in radians.
      samples: a pixel.
      seed: below 2^31.
    """

    scene: str
    pose: list[list[float]]
    angle_x: float
    samples: int
    seed: int


class Task(NamedTuple):
    """A job, and what is to be done with its result.

    Attributes:
      name: what the view is called, for people.
      job: the view.
      finish: takes the multi-layer EXRs of colour and of geometry, which go away afterwards.
    """

    name: str
    job: Job
    finish: Callable[[Path, Path], None]


class BlenderError(ValueError):
    """Blender does not start, or does not render a view."""


class WorkerDiedError(BlenderError):
    """A process ended by itself, or was killed."""


class Worker:
    """One process of Blender.

    Attributes:
      log: file that it prints to.
    """

    def __init__(self, command: list[str], *, scratch: Path, name: str, threads: int) -> None:
        """Starts the process.

        Args:
          command: that starts it.
          scratch: existing folder for its files.
          name: of the process, unique in the folder.
          threads: that it renders with.
        """
        self.log = scratch / f"{name}.log"
        self._files = tuple(scratch / f"{name}_{kind}.exr" for kind in ("colour", "geometry"))
        with self.log.open("a", encoding="utf-8") as log:
            # Ctrl-C goes to a whole session: there, only this process is to decide what it means.
            self._process = subprocess.Popen(
                [*command, f"--threads={threads}"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                start_new_session=True,
                encoding="utf-8",
            )

    def check_version(self) -> None:
        """Waits until the process is ready.

        Raises:
          BlenderError: if it does not start, or is another version.
        """
        try:
            version = self._receive()["blender"]
        except WorkerDiedError as error:
            raise BlenderError(
                f"Blender does not start: {error}. Run make dataset-env, or give the Python of an "
                "environment with bpy as --blender."
            ) from error
        if version != BLENDER:
            raise BlenderError(
                f"This is Blender {version}, but the data set is made with {BLENDER}. Run "
                "make dataset-env."
            )

    def render(self, task: Task) -> None:
        """Renders a view and finishes it.

        Raises:
          WorkerDiedError: if the process ends.
          BlenderError: if Blender reports an error.
        """
        colour, geometry = self._files
        message = {**task.job._asdict(), "colour": str(colour), "geometry": str(geometry)}
        try:
            self._process.stdin.write(json.dumps(message) + "\n")
            self._process.stdin.flush()
        except OSError as error:  # a pipe without a reader
            raise WorkerDiedError(self._end()) from error
        answer = self._receive()
        if "error" in answer:
            raise BlenderError(
                f"Blender can not render {task.name} ({answer['error']}). See {self.log}."
            )
        task.finish(colour, geometry)
        for path in self._files:
            path.unlink()

    def kill(self) -> None:
        """Ends the process at once."""
        self._process.kill()
        self._process.wait()

    def _receive(self) -> dict[str, str]:
        line = self._process.stdout.readline()
        # What is cut off was said by a process that was killed meanwhile.
        if not line.endswith("\n"):
            raise WorkerDiedError(self._end())
        return json.loads(line)

    def _end(self) -> str:
        """Returns how the process ended, in words."""
        status = self._process.wait()
        how = f"killed by {signal.Signals(-status).name}" if status < 0 else f"status {status}"
        lines = self.log.read_text(encoding="utf-8", errors="replace").split("\n")
        said = [line.strip() for line in lines if line.strip()]
        return f"{how}, having said: {said[-1]}" if said else how


class Pool:
    """Processes that share the views between them.

    Used as a context, it leaves no process behind.
    """

    def __init__(
        self, tasks: Iterable[Task], *, blender: Path, scratch: Path, workers: int, threads: int
    ) -> None:
        """Describes a pool; `run` starts it.

        Args:
          tasks: views, taken one by one as processes get free, from several threads in turn.
          blender: Python that has bpy.
          scratch: existing folder for files that come and go.
          workers: number of processes.
          threads: of each.
        """
        self._tasks, self._taking = iter(tasks), threading.Lock()
        self._command = [str(blender), str(SCRIPT)]
        self._scratch, self._workers, self._threads = scratch, workers, threads
        self._done: queue.SimpleQueue[Task | Exception | None] = queue.SimpleQueue()
        self._stopping = threading.Event()
        self._alive: dict[str, Worker] = {}
        self._changing = threading.Lock()

    def run(self) -> Iterator[Task]:
        """Renders all views, and yields each when it is finished.

        Raises:
          BlenderError: if a view can not be rendered; a process that dies is replaced once.
          ValueError: whatever taking a task raises.
        """
        for number in range(self._workers):
            threading.Thread(target=self._work, args=(f"worker_{number}",), daemon=True).start()
        working = self._workers
        while working:
            done = self._done.get()
            if done is None:
                working -= 1
            elif isinstance(done, Exception):
                raise done
            else:
                yield done

    def stop(self) -> None:
        """Lets `run` end after the views that are being rendered."""
        self._stopping.set()

    def __enter__(self) -> "Pool":
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()
        with self._changing:
            for worker in self._alive.values():
                worker.kill()
            self._alive.clear()

    def _work(self, name: str) -> None:
        """Renders views one after the other, until there are no more."""
        try:
            worker = self._start(name)
            while (task := self._take()) is not None:
                try:
                    worker.render(task)
                except WorkerDiedError as error:
                    if self._stopping.is_set():
                        break
                    print(f"{task.name}: Blender ended, {error}. Once more.", file=sys.stderr)
                    worker = self._start(name)
                    self._render_again(worker, task)
                self._done.put(task)
        except Exception as error:  # is raised where the results are awaited
            self._done.put(error)
        self._done.put(None)

    def _render_again(self, worker: Worker, task: Task) -> None:
        try:
            worker.render(task)
        except WorkerDiedError as error:
            raise BlenderError(
                f"Blender ended twice while it rendered {task.name}: {error}. See {worker.log}; "
                "the same command goes on where this one stopped."
            ) from error

    def _start(self, name: str) -> Worker:
        with self._changing:
            if self._stopping.is_set():
                raise BlenderError("No process is started any more. Start the command again.")
            worker = Worker(self._command, scratch=self._scratch, name=name, threads=self._threads)
            self._alive[name] = worker
        worker.check_version()
        return worker

    def _take(self) -> Task | None:
        if self._stopping.is_set():
            return None
        with self._taking:
            return next(self._tasks, None)
