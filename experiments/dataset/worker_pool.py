"""Distributes views over several Blender processes.

Images do not depend on the process that renders a view, nor on the time.
"""

import queue
import sys
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path

from experiments.dataset.render_settings import Device
from experiments.dataset.workers import SCRIPT, BlenderError, Task, Worker, WorkerDiedError


class Pool:
    """The processes. The context manager ends all of them."""

    def __init__(
        self,
        tasks: Iterable[Task],
        *,
        blender: Path,
        scratch: Path,
        workers: int,
        threads: int,
        device: Device,
    ) -> None:
        """Describes a pool; `run` starts it.

        Args:
          tasks: views, taken one by one by idle processes, from several threads in turn.
          blender: Python that has bpy.
          scratch: existing folder for temporary files.
          workers: number of processes.
          threads: number of threads of each process.
          device: device of Cycles.
        """
        self._tasks, self._taking = iter(tasks), threading.Lock()
        self._command = [str(blender), str(SCRIPT), f"--device={device}"]
        self._scratch, self._workers, self._threads = scratch, workers, threads
        self._done: queue.SimpleQueue[Task | Exception | None] = queue.SimpleQueue()
        self._stopping = threading.Event()
        self._alive: dict[str, Worker] = {}
        self._changing = threading.Lock()

    def run(self) -> Iterator[Task]:
        """Renders all views, and yields each when it is finished.

        Raises:
          BlenderError: if a view cannot be rendered; a process that dies is replaced once.
          ValueError: if taking a task raises it.
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
        """Ends `run` after the current views."""
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
        """Renders views one after the other, until none is left."""
        try:
            worker = self._start(name)
            while (task := self._take()) is not None:
                try:
                    worker.render(task)
                except WorkerDiedError as error:
                    if self._stopping.is_set():
                        break
                    print(f"{task.name}: Blender ended, {error}. Retrying.", file=sys.stderr)
                    worker = self._start(name)
                    self._render_again(worker, task)
                self._done.put(task)
        except Exception as error:  # is raised where the results are awaited
            # After `stop` this may only be a process that was not started.
            if not self._stopping.is_set():
                self._done.put(error)
        self._done.put(None)

    def _render_again(self, worker: Worker, task: Task) -> None:
        try:
            worker.render(task)
        except WorkerDiedError as error:
            raise BlenderError(
                f"Blender ended twice while it rendered {task.name}: {error}. See {worker.log}; "
                "the same command resumes where this one stopped."
            ) from error

    def _start(self, name: str) -> Worker:
        with self._changing:
            if self._stopping.is_set():
                raise BlenderError("The command is stopping. Start it again.")
            worker = Worker(self._command, scratch=self._scratch, name=name, threads=self._threads)
            self._alive[name] = worker
        worker.check_version()
        return worker

    def _take(self) -> Task | None:
        if self._stopping.is_set():
            return None
        with self._taking:
            return next(self._tasks, None)
