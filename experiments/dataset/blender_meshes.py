"""Exports Blender's built-in mesh of the monkey."""

import subprocess
from pathlib import Path

from refref_jax import atomic_files

_SCRIPT = Path(__file__).with_name("export_monkey.py")


def export_monkey(path: Path, *, blender: Path) -> None:
    """Writes the monkey's mesh, unless it exists.

    Args:
      path: output file, usually `catalogue.SUZANNE`.
      blender: Python that has bpy.

    Raises:
      ValueError: if Blender fails.
    """
    if path.exists():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_files.written_file(path) as draft:
        command = [str(blender), str(_SCRIPT), str(draft)]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode != 0:
            said = (result.stderr.strip().splitlines() or ["nothing"])[-1]
            raise ValueError(
                f"Blender cannot write its monkey's mesh to {path} ({said}). Run make "
                "dataset-env, or leave the monkey out."
            )
