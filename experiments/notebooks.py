"""Executes the notebooks of `experiments/colab`, each from top to bottom in a kernel of its own.

python -m experiments.notebooks             # executes them and reports
python -m experiments.notebooks --write     # also stores them with their outputs

They run in a temporary copy of the package and the experiments, so that no results remain and no
earlier run is used. The first error ends the command, with the cell and its message; the notebooks
before it are already written. The command needs the extra `notebooks`, and the notebooks need the
extras `experiments` and `r3f`.
"""

from __future__ import annotations

import atexit
import importlib.util
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from absl import flags
from etils import epy

from experiments.cli import app
from experiments.cli.progress import ProgressBar
from refref_jax import atomic_files

with epy.lazy_imports():
    import nbclient
    import nbformat
    from nbclient import exceptions

_WRITE = flags.DEFINE_bool("write", False, "Store the notebooks with their outputs.")
_ONLY = flags.DEFINE_list("only", [], "Names of the notebooks to execute; all by default.")
_CELL_SECONDS = flags.DEFINE_integer("cell_seconds", 1200, "Time limit of a cell, seconds.", 1)

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "experiments" / "colab"

METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}
"""Metadata of every notebook; more would differ between machines."""

LARGEST = 1_500_000
"""Largest size of a notebook in bytes, above which code hosting sites do not display it."""

_COPIED = ("refref_jax", "experiments")

_LINES_OF_AN_ERROR = 15


def main() -> None:
    """Executes the selected notebooks."""
    for name in ("nbclient", "nbformat", "ipykernel"):
        if importlib.util.find_spec(name) is None:
            raise ValueError(f"{name} is missing. Run pip install -e '.[notebooks]'.")
    paths = find(_ONLY.value)
    for path in paths:
        start = time.monotonic()
        notebook = execute(path, cell_seconds=_CELL_SECONDS.value)
        seconds = time.monotonic() - start
        size = len(as_text(notebook).encode())
        if _WRITE.value:
            write(path, notebook)
        print(f"{path.stem}: {seconds:.0f} s, {size / 1e6:.2f} MB", flush=True)
    if _WRITE.value:
        print(f"Notebooks: {FOLDER}")
        print("Next: check the images, then run git diff --stat")
    else:
        print("All notebooks ran; nothing was written.")
        print(f"Next: {app.shell('notebooks', '--write')}")


def find(names: Sequence[str], *, folder: Path = FOLDER) -> list[Path]:
    """Returns the files of notebooks, all if no name is given.

    Raises:
      ValueError: if there is no such notebook.
    """
    there = {path.stem: path for path in sorted(folder.glob("*.ipynb"))}
    for name in names:
        if name not in there:
            raise ValueError(f"There is no notebook {name!r}. Choose from {', '.join(there)}.")
    return [there[name] for name in names or there]


def execute(path: Path, *, cell_seconds: int) -> nbformat.NotebookNode:
    """Executes a notebook in a copy of this checkout, and returns it with its outputs.

    Args:
      path: path of the notebook.
      cell_seconds: time limit of a cell, seconds.

    Raises:
      ValueError: at the first cell that fails, takes too long, or ends the kernel.
    """
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory(prefix="refref_jax_notebooks_") as folder:
        copy = Path(folder).resolve()
        for name in _COPIED:
            ignored = shutil.ignore_patterns("__pycache__", "*.ipynb")
            shutil.copytree(ROOT / name, copy / name, ignore=ignored)
        (copy / "experiments" / "colab").mkdir(exist_ok=True)
        _run_cells(notebook, path.stem, copy, cell_seconds)
        tidy(notebook, {f"{copy}/": "", str(copy): ".", sys.prefix: "PYTHON"})
    return notebook


def write(path: Path, notebook: nbformat.NotebookNode) -> None:
    """Writes a notebook atomically.

    Raises:
      ValueError: if it is larger than `LARGEST`.
    """
    text = as_text(notebook)
    if len(text.encode()) > LARGEST:
        raise ValueError(
            f"{path.name} would have {len(text.encode()) / 1e6:.1f} MB, more than "
            f"{LARGEST / 1e6:.1f}. Draw its images smaller, or as JPEG."
        )
    with atomic_files.written_file(path) as draft:
        draft.write_text(text, encoding="utf-8")


def as_text(notebook: nbformat.NotebookNode) -> str:
    """Returns the text of a notebook's file."""
    return nbformat.writes(notebook) + "\n"


def tidy(notebook: nbformat.NotebookNode, names: dict[str, str]) -> None:
    """Removes machine-dependent data from an executed notebook.

    Args:
      notebook: notebook to change in place.
      names: replacements in texts, such as folders of this machine, applied in this order.
    """
    notebook.metadata = nbformat.from_dict(METADATA)
    for cell in notebook.cells:
        cell.metadata = nbformat.from_dict({})
        for output in cell.get("outputs", []):
            if output.output_type == "stream":
                output.text = _replaced(output.text, names)
            for kind, value in output.get("data", {}).items():
                if not kind.startswith("image/"):
                    output.data[kind] = _replaced(value, names)


def _replaced(text: Any, names: dict[str, str]) -> Any:
    for old, new in names.items():
        text = text.replace(old, new) if isinstance(text, str) else text
    return text


def _run_cells(notebook: nbformat.NotebookNode, name: str, copy: Path, cell_seconds: int) -> None:
    """Executes all cells in a kernel whose working directory is the copy's `experiments/colab`."""
    client = nbclient.NotebookClient(
        notebook,
        timeout=cell_seconds,
        kernel_name="python3",
        record_timing=False,
        coalesce_streams=True,
        extra_arguments=["--log-level=ERROR"],
        resources={"metadata": {"path": str(copy / "experiments" / "colab")}},
    )
    number = {i: n for n, i in enumerate(_code_cells(notebook), start=1)}
    with ProgressBar(name, len(number)) as bar:
        current = _follow(client, lambda i, text: bar.show(number[i], text))
        try:
            # The user's own IPython settings are ignored.
            client.execute(env={**os.environ, "IPYTHONDIR": str(copy / "ipython")})
        except (
            exceptions.CellExecutionError,
            exceptions.CellTimeoutError,
            RuntimeError,  # if the kernel is dead, before the first cell or later
        ) as error:
            if not current:
                atexit.unregister(client._cleanup_kernel)  # it fails if no kernel has started
                raise ValueError(
                    f"{name}: the kernel ended before the first cell ({error}). Run python -m "
                    "ipykernel_launcher to see the reason."
                ) from error
            cell = notebook.cells[current[-1]]
            raise ValueError(_explain(name, number[current[-1]], cell, error)) from error


def _follow(client: nbclient.NotebookClient, show: Callable[[int, str], None]) -> list[int]:
    """Reports each finished cell with its duration; returns the growing list of started cells."""
    begun: list[int] = []
    starts: list[float] = []

    def begin(cell: Any, cell_index: int) -> None:
        if cell.cell_type == "code":
            begun.append(cell_index)
            starts.append(time.monotonic())

    def end(cell: Any, cell_index: int, execute_reply: Any) -> None:
        del execute_reply
        show(cell_index, f"{cell.id}  {time.monotonic() - starts[-1]:.1f} s")

    client.on_cell_start, client.on_cell_executed = begin, end
    return begun


def _code_cells(notebook: nbformat.NotebookNode) -> list[int]:
    return [i for i, cell in enumerate(notebook.cells) if cell.cell_type == "code"]


def _explain(name: str, number: int, cell: nbformat.NotebookNode, error: Exception) -> str:
    """Returns the number of the failed cell, its error and its last output."""
    if isinstance(error, exceptions.CellExecutionError):
        what = f"{error.ename}: {error.evalue}"
    elif isinstance(error, exceptions.CellTimeoutError):
        what = "it exceeded the time limit; increase --cell_seconds"
    else:
        what = "the kernel died, perhaps because memory ran out"
    printed = [out.text for out in cell.outputs if out.output_type == "stream"]
    last = "".join(printed).splitlines()[-_LINES_OF_AN_ERROR:]
    return "\n  ".join([f"{name}, code cell {number} ({cell.id}): {what}", *last])


if __name__ == "__main__":
    app.run(main, again="repeat the command to execute them again; --write stores the outputs.")
