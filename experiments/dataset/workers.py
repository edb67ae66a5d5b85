"""Runs Blender in a separate process that renders one view after the other.

What is spoken with it is told in `blender_worker`.
"""

import json
import signal
import subprocess
from collections.abc import Callable
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
      name: name of the view in messages.
      job: description of the view.
      finish: function that takes the multi-layer EXRs of colour and of geometry, which are deleted
        afterwards.
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
          command: command that starts the process.
          scratch: existing folder for its files.
          name: name of the process, unique in the folder.
          threads: number of render threads.
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
