"""However a command that waits for another is told to stop, the other saves once, and ends."""

import os
import signal
import subprocess
import sys
import time

import pytest

from tests.processes.command import ROOT

pytestmark = pytest.mark.loose

_LONG = 60.0


def _wait_for(condition):
    end = time.monotonic() + _LONG
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def _tell(number):
    """Returns what sends a signal to the group of who waits, as a terminal does."""
    return lambda waiting, saving: os.killpg(waiting, number)


def _timeout(waiting, saving):
    os.kill(waiting, signal.SIGTERM)
    time.sleep(0.1)
    os.killpg(waiting, signal.SIGTERM)


def _service_manager(waiting, saving):
    """Tells each process, whatever its group is."""
    for pid in (waiting, saving):
        os.kill(pid, signal.SIGTERM)


@pytest.mark.parametrize(
    ("stop", "status"),
    [
        (_tell(signal.SIGTERM), 130),
        (_tell(signal.SIGINT), 130),
        (_tell(signal.SIGHUP), -signal.SIGHUP),
        (_tell(signal.SIGKILL), -signal.SIGKILL),
        (_timeout, 130),
        (_service_manager, 130),
    ],
    ids=["kill", "ctrl_c", "hangup", "killed", "timeout", "service_manager"],
)
def test_whoever_is_waited_for_saves_once(tmp_path, stop, status):
    waiting = subprocess.Popen(
        [sys.executable, "-m", "tests.fakes.waiting", str(tmp_path)],
        cwd=ROOT,
        start_new_session=True,
        stdout=subprocess.DEVNULL,
    )
    _wait_for((tmp_path / "ready").exists)
    saving = int((tmp_path / "pid").read_text())
    stop(waiting.pid, saving)
    (tmp_path / "go").touch()
    assert waiting.wait(_LONG) == status
    _wait_for((tmp_path / "ended").exists)
    assert (tmp_path / "saved").read_text() == "saved\n"
