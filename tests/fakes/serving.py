"""The command in a process that is started once, for all tests of a module."""

import json
import subprocess
import sys
from typing import NamedTuple

from tests.processes.command import ROOT

COMMAND = [sys.executable, "-m", "tests.fakes.with_stand_in"]


class Answer(NamedTuple):
    """What a command came to."""

    status: int
    stdout: str
    stderr: str


class Server:
    """Runs `experiments.benchmark` with stand-ins for its commands, as often as it is asked."""

    def __init__(self):
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        self._process = subprocess.Popen(COMMAND, cwd=ROOT, text=True, **pipes)

    def __call__(self, folder, *options, status=0, fail="^$"):
        """Runs it on `{folder}/out` for five steps a job, and returns its answer."""
        out = [] if any(str(each).startswith("--out=") for each in options) else [folder / "out"]
        steps = [] if "--tables_only" in options else ["--steps=5"]
        words = [*(f"--out={each}" for each in out), *steps, *map(str, options)]
        environment = {"CALLS": str(folder / "calls.txt"), "PACE": "0", "FAIL": fail}
        print(json.dumps({"words": words, "environment": environment}), file=self._process.stdin)
        self._process.stdin.flush()
        answer = Answer(**json.loads(self._process.stdout.readline()))
        assert answer.status == status, answer
        return answer

    def stop(self):
        """Ends the process."""
        self._process.stdin.close()
        self._process.wait(60.0)
        self._process.stdout.close()


def calls(folder):
    """Returns what commands were begun for, as `[name, job, process]`."""
    path = folder / "calls.txt"
    return [line.split() for line in path.read_text().splitlines()] if path.exists() else []
