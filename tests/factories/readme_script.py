"""The script of the README that trains and renders."""

import re
from pathlib import Path

import pytest

from tests.processes.command import ROOT


def read() -> str:
    """Returns the script."""
    snippets = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    (script,) = (each for each in snippets if "refref_jax.fit(" in each)
    return script


def small(options: str) -> str:
    """Returns the script with other options than 50 steps, and with an image of 16 x 16."""
    return read().replace("steps=50", options).replace("size=128", "size=16")


def execute(script: str, folder: Path) -> Path:
    """Returns the folder of the run that a script leaves."""
    (folder / "experiments").symlink_to(ROOT / "experiments")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        exec(compile(script, "README.md", "exec"), {})
    return folder / "runs" / "fifty"
