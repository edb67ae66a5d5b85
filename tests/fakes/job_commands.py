"""Has the benchmark run the stand-in for the commands of its jobs."""

import sys
from pathlib import Path

from experiments.benchmarking import worker
from experiments.runs import subprocesses

_REAL = subprocesses.command_line
_STAND_IN = Path(__file__).with_name("stand_in.py")


def stand_in_line(name, options):
    """Returns what runs the stand-in for a command of `experiments`; what only measures is real."""
    if name == "metrics":
        return _REAL(name, options)
    return [sys.executable, str(_STAND_IN), name, *options]


def run_with_stand_in(out, job):
    """Does a job with stand-ins for its commands, in whatever process."""
    subprocesses.command_line = stand_in_line
    return worker.run_job(out, job)
