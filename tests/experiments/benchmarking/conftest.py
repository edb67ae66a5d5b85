import pytest

from experiments.runs import subprocesses
from tests.factories.made_benchmark import write_scene
from tests.fakes.job_commands import stand_in_line
from tests.fakes.serving import Server


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
