import subprocess
import sys

import pytest

from refref_jax.training import run_lock

_HOLD = """
import sys, time
from pathlib import Path
from refref_jax.training import run_lock
with run_lock.hold(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


def test_a_run_is_held_once_and_free_afterwards(tmp_path):
    with (
        run_lock.hold(tmp_path),
        pytest.raises(ValueError, match="Another process"),
        run_lock.hold(tmp_path),
    ):
        raise AssertionError("held twice")
    with run_lock.hold(tmp_path):
        pass


def test_a_killed_process_holds_nothing(tmp_path):
    command = [sys.executable, "-c", _HOLD, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "held\n"
        with pytest.raises(ValueError, match="Another process"), run_lock.hold(tmp_path):
            raise AssertionError("held twice")
        process.kill()
    with run_lock.hold(tmp_path):
        pass
    assert not list(tmp_path.iterdir())
