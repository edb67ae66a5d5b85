"""The stored notebooks have run, in order and without an error; the command runs them again."""

import json
import re
from pathlib import Path

import nbformat
import pytest

from experiments import notebooks

pytestmark = pytest.mark.loose

_NAMES = ("index_of_refraction", "light_paths", "quickstart", "what_is_inside", "your_scene")

_STORED = [pytest.param(notebooks.FOLDER / f"{name}.ipynb", id=name) for name in _NAMES]

# A folder of somebody's machine, at the beginning of a word. Web addresses have another slash.
_ABSOLUTE = re.compile(r"(?:^|[\s'\"(=])/(?!/)[\w.-]+/[\w.-]+", re.MULTILINE)


def _code(path):
    return [cell for cell in _content(path)["cells"] if cell["cell_type"] == "code"]


def _content(path):
    return json.loads(path.read_text(encoding="utf-8"))


def _texts(cell):
    """Yields what a cell has written, without its pictures."""
    for output in cell["outputs"]:
        yield "".join(output.get("text", []))
        for kind, value in output.get("data", {}).items():
            if not kind.startswith("image/"):
                yield "".join(value)


@pytest.mark.parametrize("path", _STORED)
def test_a_stored_notebook_is_valid_and_small(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert path.stat().st_size < notebooks.LARGEST
    assert notebook.metadata == notebooks.METADATA
    assert all(cell.metadata == {} for cell in notebook.cells)
    assert notebooks.as_text(notebook) == path.read_text(encoding="utf-8")


@pytest.mark.parametrize("path", _STORED)
def test_a_stored_notebook_has_run_from_top_to_bottom(path):
    cells = _code(path)
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert not [output for output in outputs if output["output_type"] == "error"]
    assert "computes on: " in "".join(_texts(cells[0]))
    pictures = [out for out in outputs if {"image/png", "image/jpeg"} & set(out.get("data", {}))]
    assert len(pictures) >= 2


@pytest.mark.parametrize("path", _STORED)
def test_a_stored_notebook_tells_nothing_of_the_machine_that_ran_it(path):
    for cell in _code(path):
        for text in _texts(cell):
            assert not _ABSOLUTE.search(text), text
            assert not re.search("Warning|WARNING|Traceback", text), text


def test_all_notebooks_begin_with_the_same_cell():
    first = {"".join(_code(param.values[0])[0]["source"]) for param in _STORED}
    assert len(first) == 1
    assert tuple(path.stem for path in notebooks.find([])) == _NAMES
    with pytest.raises(ValueError, match=r"'quickstrat'.* quickstart"):
        notebooks.find(["quickstrat"])


@pytest.mark.parametrize("path", _STORED)
def test_files_that_a_notebook_names_are_there(path):
    text = "\n".join("".join(cell["source"]) for cell in _content(path)["cells"])
    named = set(re.findall(r"\*\*(\w+\.ipynb)\*\*", text)) | set(re.findall(r"docs/\w+\.md", text))
    assert named
    for name in named:
        there = notebooks.ROOT / name if "/" in name else notebooks.FOLDER / name
        assert there.exists(), name
    for command in re.findall(r"-m experiments\.(\w+)", text):
        assert (notebooks.ROOT / "experiments" / f"{command}.py").exists(), command


def _write_notebook(path, *sources):
    cells = [nbformat.v4.new_code_cell(text, id=f"cell{i}") for i, text in enumerate(sources)]
    nbformat.write(nbformat.v4.new_notebook(cells=cells), path)
    return path


def test_a_notebook_runs_in_a_copy_and_is_tidied(tmp_path, capsys):
    where = "from pathlib import Path; import sys\n"
    path = _write_notebook(
        tmp_path / "small.ipynb",
        f"{where}print(Path.cwd())\nprint(sys.prefix, file=sys.stderr)\nPath.cwd() / 'file'",
        "Path('../../runs').mkdir()\n(Path.cwd() / '../data').resolve().is_dir()",
    )
    before = path.read_bytes()
    notebook = notebooks.execute(path, cell_seconds=60)
    printed, error, value = notebook.cells[0].outputs
    assert printed.text == "experiments/colab\n"
    assert error.text == "PYTHON\n"
    assert value.data["text/plain"] == "PosixPath('experiments/colab/file')"
    assert notebook.cells[1].outputs[0].data["text/plain"] == "True"
    assert [cell.execution_count for cell in notebook.cells] == [1, 2]
    assert notebook.metadata == notebooks.METADATA and notebook.cells[0].metadata == {}
    assert path.read_bytes() == before
    assert re.search(r"small 2/2  cell1  \d+\.\d s", capsys.readouterr().out)
    notebooks.write(path, notebook)
    assert nbformat.read(path, as_version=4) == notebook
    assert [each.name for each in tmp_path.iterdir()] == ["small.ipynb"]


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("print('before')\nraise KeyError('lamp')", r"(?s)cell1.*KeyError: 'lamp'.*before"),
        ("%%bash\necho reason >&2\nexit 3", r"(?s)cell1.*CalledProcessError.*reason"),
        pytest.param("import time; time.sleep(90)", "cell1.*too long", marks=pytest.mark.slow),
        ("import os; os._exit(1)", "cell1.*died"),
    ],
    ids=["error", "command", "time", "death"],
)
def test_what_fails_is_named_with_its_cell(tmp_path, source, said):
    path = _write_notebook(tmp_path / "broken.ipynb", "1", source, "print('never')")
    with pytest.raises(ValueError, match=f"(?s)broken, code cell 2.*{said.removeprefix('(?s)')}"):
        notebooks.execute(path, cell_seconds=10)


def test_a_kernel_that_does_not_start_is_told(tmp_path, monkeypatch):
    kernel = tmp_path / "kernels" / "python3"
    kernel.mkdir(parents=True)
    words = {"argv": ["false"], "display_name": "Python 3", "language": "python"}
    (kernel / "kernel.json").write_text(json.dumps(words))
    monkeypatch.setenv("JUPYTER_PATH", str(tmp_path))
    path = _write_notebook(tmp_path / "dead.ipynb", "1")
    with pytest.raises(ValueError, match=r"dead: the kernel ended before the first cell .*died"):
        notebooks.execute(path, cell_seconds=10)


def test_a_notebook_too_large_is_not_written(tmp_path):
    path = _write_notebook(tmp_path / "large.ipynb", "1")
    before = path.read_bytes()
    notebook = nbformat.read(path, as_version=4)
    notebook.cells[0].source = "#" * notebooks.LARGEST
    with pytest.raises(ValueError, match=r"large\.ipynb.*JPEG"):
        notebooks.write(path, notebook)
    assert path.read_bytes() == before


@pytest.mark.slow
@pytest.mark.parametrize("name", _NAMES)
def test_a_notebook_executes(name, tmp_path):
    path = Path(tmp_path, f"{name}.ipynb")
    path.write_bytes((notebooks.FOLDER / path.name).read_bytes())
    notebook = notebooks.execute(path, cell_seconds=1200)
    counts = [cell.execution_count for cell in notebook.cells if cell.cell_type == "code"]
    assert counts == list(range(1, len(counts) + 1))
