from pathlib import Path

import pytest

from tests.experiments.command import ROOT, run_command


@pytest.fixture(scope="session")
def trained(tmp_path_factory) -> Path:
    """A run of six steps on the bundled scene."""
    run = tmp_path_factory.mktemp("runs") / "ball"
    scene = ROOT / "experiments" / "data" / "cube_smcvx_ball"
    options = ("--steps=6", "--batch=64", "--log_every=2", "--checkpoint_every=3")
    result = run_command("train", f"--scene={scene}", f"--out={run}", *options)
    assert "experiments.evaluate" in result.stdout
    return run
