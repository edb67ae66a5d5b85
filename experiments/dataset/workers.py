"""Runs Blender in a separate process that renders one view after the other.

See `blender_worker` for the protocol.
"""

import json
import signal
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments.dataset.render_settings import BLENDER

SCRIPT = Path(__file__).with_name("blender_worker.py")
"""Script that a Blender process runs."""


class Job(NamedTuple):
    """A view to render.

    Attributes:
      scene: absolute path of the scene's folder.
      pose: camera-to-world matrix, 4 x 4.
      angle_x: horizontal field of view in radians.
      samples: samples per pixel.
      seed: seed, below 2^31.
    """

    scene: str
    pose: list[list[float]]
    angle_x: float
    samples: int
    seed: int


class Task(NamedTuple):
    """A job, and the processing of its result.

    Attributes:
      name: name of the view in messages.
      job: description of the view.
      finish: function that takes the multi-layer EXRs of colour, one or one per channel, and of
        geometry, which are deleted afterwards.
    """

    name: str
    job: Job
    finish: Callable[[Sequence[Path], Path], None]


class BlenderError(ValueError):
    """Blender does not start, or cannot render a view."""


class WorkerDiedError(BlenderError):
    """A process exited, or was killed."""


class Worker:
    """One process of Blender.

    Attributes:
      log: path of its log file.
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
        self._colours = [scratch / f"{name}_colour_{channel}.exr" for channel in range(3)]
        self._geometry = scratch / f"{name}_geometry.exr"
        with self.log.open("a", encoding="utf-8") as log:
            # Ctrl-C reaches all processes of a session: only this one decides how to react.
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
          BlenderError: if it does not start, or has another version.
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
        message = {
            **task.job._asdict(),
            "colours": list(map(str, self._colours)),
            "geometry": str(self._geometry),
        }
        try:
            self._process.stdin.write(json.dumps(message) + "\n")
            self._process.stdin.flush()
        except OSError as error:  # a pipe without a reader
            raise WorkerDiedError(self._end()) from error
        answer = self._receive()
        if "error" in answer:
            raise BlenderError(
                f"Blender cannot render {task.name} ({answer['error']}). See {self.log}."
            )
        colours = self._colours[: answer["written"]]
        task.finish(colours, self._geometry)
        for path in (*colours, self._geometry):
            path.unlink()

    def kill(self) -> None:
        """Kills the process."""
        self._process.kill()
        self._process.wait()

    def _receive(self) -> dict[str, Any]:
        line = self._process.stdout.readline()
        # An incomplete line is from a process that was killed meanwhile.
        if not line.endswith("\n"):
            raise WorkerDiedError(self._end())
        return json.loads(line)

    def _end(self) -> str:
        """Returns the cause of the process's end, in words."""
        status = self._process.wait()
        how = f"killed by {signal.Signals(-status).name}" if status < 0 else f"status {status}"
        lines = self.log.read_text(encoding="utf-8", errors="replace").split("\n")
        said = [line.strip() for line in lines if line.strip()]
        return f"{how}, having said: {said[-1]}" if said else how
