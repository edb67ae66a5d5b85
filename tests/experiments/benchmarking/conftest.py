import subprocess
import sys
from pathlib import Path

import pytest

from experiments import child_process

_STAND_IN = Path(__file__).with_name("stand_in.py")
_START = subprocess.Popen


def start_stand_in(command, **options):
    """Starts the stand-in for a command of `experiments`."""
    name = command[2].removeprefix("experiments.")
    return _START([sys.executable, str(_STAND_IN), name, *command[3:]], **options)


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """Stands in for the commands; they write what they are called with into this file."""
    calls = tmp_path / "calls.txt"
    monkeypatch.setenv("CALLS", str(calls))
    monkeypatch.setattr(child_process.subprocess, "Popen", start_stand_in)
    return calls
