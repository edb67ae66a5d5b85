import sys
from pathlib import Path

import pytest

from experiments.benchmarking import worker
from experiments.cli import subprocesses
from tests.experiments.benchmarking.made import write_scene
from tests.experiments.benchmarking.serving import Server

_STAND_IN = Path(__file__).with_name("stand_in.py")


def stand_in_line(name, options):
    """Returns what runs the stand-in for a command of `experiments`."""
    return [sys.executable, str(_STAND_IN), name, *options]


def run_with_stand_in(out, job):
    """Does a job with stand-ins for its commands, in whatever process."""
    subprocesses.command_line = stand_in_line
    return worker.run_job(out, job)


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """Stands in for the commands; they write what they are called with into this file."""
    calls = tmp_path / "calls.txt"
    monkeypatch.setenv("CALLS", str(calls))
    monkeypatch.setattr(subprocesses, "command_line", stand_in_line)
    return calls


@pytest.fixture(scope="module")
def serve():
    """Runs the command in a process that is started once."""
    server = Server()
    yield server
    server.stop()


@pytest.fixture
def scenes(tmp_path):
    """Writes two scenes, and returns the option that names them."""
    for name in ("cube_smcvx_ball", "env_mmncvx_cup"):
        write_scene(tmp_path / "scenes" / name)
    return f"--scenes={tmp_path / 'scenes' / '*'}"
