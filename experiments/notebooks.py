"""Executes the notebooks of `experiments/colab`, each from top to bottom in a kernel of its own.

python -m experiments.notebooks             # executes them, and reports
python -m experiments.notebooks --write     # and writes them back with what they print and draw

They run in a temporary copy of the package and the experiments, so that nothing they train stays
behind and no earlier run helps them. The first error ends it, with the cell and its message; the
notebooks before it are written by then. The extra `notebooks` has what this needs, and the extras
`experiments` and `r3f` what the notebooks need.
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

_WRITE = flags.DEFINE_bool("write", False, "Write the notebooks back, with their outputs.")
_ONLY = flags.DEFINE_list("only", [], "Names of the notebooks to execute; all if not given.")
_CELL_SECONDS = flags.DEFINE_integer("cell_seconds", 1200, "Most seconds that a cell may take.", 1)

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "experiments" / "colab"

METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}
"""Of every notebook; more would change with each machine that executes them."""

LARGEST = 1_500_000
"""Most bytes of a notebook: what hosts of code still show as a page."""

_COPIED = ("refref_jax", "experiments")

_LINES_OF_AN_ERROR = 15


def main() -> None:
    """Executes the chosen notebooks."""
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
        print("Next: look at the pictures, and then git diff --stat")
    else:
        print("All ran; nothing was written.")
        print(f"Next: {app.shell('notebooks', '--write')}")


def find(names: Sequence[str], *, folder: Path = FOLDER) -> list[Path]:
    """Returns the files of notebooks, all if none is named.

    Raises:
      ValueError: if there is no such notebook.
    """
    there = {path.stem: path for path in sorted(folder.glob("*.ipynb"))}
    for name in names:
        if name not in there:
            raise ValueError(f"There is no notebook {name!r}. Give some of {', '.join(there)}.")
    return [there[name] for name in names or there]


def execute(path: Path, *, cell_seconds: int) -> nbformat.NotebookNode:
    """Executes a notebook in a copy of this checkout, and returns it with its outputs.

    Args:
      path: of the notebook.
      cell_seconds: most that a cell may take.

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
    """Writes a notebook, whole or not at all.

    Raises:
      ValueError: if it is larger than `LARGEST`.
    """
    text = as_text(notebook)
    if len(text.encode()) > LARGEST:
        raise ValueError(
            f"{path.name} would have {len(text.encode()) / 1e6:.1f} MB, more than "
            f"{LARGEST / 1e6:.1f}. Draw its pictures smaller, or as JPEG."
        )
    with atomic_files.written_file(path) as draft:
        draft.write_text(text, encoding="utf-8")


def as_text(notebook: nbformat.NotebookNode) -> str:
    """Returns what a notebook's file holds."""
    return nbformat.writes(notebook) + "\n"


def tidy(notebook: nbformat.NotebookNode, names: dict[str, str]) -> None:
    """Removes from an executed notebook what differs from machine to machine.

    Args:
      notebook: is changed.
      names: what to replace in texts, such as folders of this machine, in this order.
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
            # The reader's own settings of IPython have no say.
            client.execute(env={**os.environ, "IPYTHONDIR": str(copy / "ipython")})
        except (
            exceptions.CellExecutionError,
            exceptions.CellTimeoutError,
            RuntimeError,  # of a kernel that is dead, before the first cell or later
        ) as error:
            if not current:
                atexit.unregister(client._cleanup_kernel)  # which fails where none has started
                raise ValueError(
                    f"{name}: the kernel ended before the first cell ({error}). Try python -m "
                    "ipykernel_launcher, which says why."
                ) from error
            cell = notebook.cells[current[-1]]
            raise ValueError(_explain(name, number[current[-1]], cell, error)) from error


def _follow(client: nbclient.NotebookClient, show: Callable[[int, str], None]) -> list[int]:
    """Has each finished cell shown with its seconds; returns a list of those that were begun."""
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
    """Says which cell failed, how, and what it had printed last."""
    if isinstance(error, exceptions.CellExecutionError):
        what = f"{error.ename}: {error.evalue}"
    elif isinstance(error, exceptions.CellTimeoutError):
        what = "it took too long; --cell_seconds gives it more"
    else:
        what = "the kernel died, perhaps for want of memory"
    printed = [out.text for out in cell.outputs if out.output_type == "stream"]
    last = "".join(printed).splitlines()[-_LINES_OF_AN_ERROR:]
    return "\n  ".join([f"{name}, code cell {number} ({cell.id}): {what}", *last])


if __name__ == "__main__":
    app.run(main, again="it executes them anew; only --write replaces what is stored.")
