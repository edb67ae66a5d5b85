"""Runs a command as a user does."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]

# Options of a training that takes seconds.
TINY = ("--steps=6", "--batch=64", "--log_every=2", "--checkpoint_every=3")


def run_command(command, *options, fails=False, env=None):
    """Runs `python -m experiments.{command}` and checks whether it succeeds.

    In the suite's environment, whose code generator is the faster one, if `env` is not given.
    """
    result = subprocess.run(
        [sys.executable, "-m", f"experiments.{command}", *map(str, options)],
        cwd=ROOT,
        env=env,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (result.returncode != 0) == fails, result.stdout + result.stderr
    return result
