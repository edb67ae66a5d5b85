import fcntl
import os
from pathlib import Path

import pytest

from tests.processes.command import ROOT, TINY, run_command


@pytest.fixture(scope="session")
def trained(tmp_path_factory) -> Path:
    """A run of six steps on the bundled scene, made once.

    All processes of the suite read the same: nothing may be written into it but evaluations.
    """
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    run = shared / "trained" / "ball"
    run.parent.mkdir(exist_ok=True)
    with (shared / "trained.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (run.parent / "done").exists():
            scene = ROOT / "experiments" / "data" / "cube_smcvx_ball"
            options = (f"--scene={scene}", f"--out={run}", *TINY)
            result = run_command("train", *options)
            assert "experiments.evaluate" in result.stdout
            (run.parent / "done").touch()
    return run
