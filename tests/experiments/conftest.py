from pathlib import Path

import pytest

from tests.experiments.command import ROOT, TINY, run_command


@pytest.fixture(scope="session")
def trained(tmp_path_factory) -> Path:
    """A run of six steps on the bundled scene."""
    run = tmp_path_factory.mktemp("runs") / "ball"
    scene = ROOT / "experiments" / "data" / "cube_smcvx_ball"
    result = run_command("train", f"--scene={scene}", f"--out={run}", *TINY)
    assert "experiments.evaluate" in result.stdout
    return run
