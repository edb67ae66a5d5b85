"""The shape of experiments/: a file is a command, and no command leans on another."""

import ast

import pytest

from tests.processes.command import ROOT

pytestmark = pytest.mark.loose

_FOLDER = ROOT / "experiments"
_FILES = sorted(path for path in _FOLDER.glob("*.py") if path.name != "__init__.py")
_COMMANDS = {f"experiments.{path.stem}" for path in _FILES}

_MOST_LINES_OF_THE_COMMAND_LINE = 900


def _imports(path):
    """Yields the dotted names that a module imports."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("path", _FILES, ids=lambda path: path.stem)
def test_every_file_is_a_command(path):
    last = ast.parse(path.read_text("utf-8")).body[-1]
    assert isinstance(last, ast.If) and ast.unparse(last.test) == "__name__ == '__main__'"
    assert ast.unparse(last.body[0]).startswith("app.run(main")


@pytest.mark.parametrize(
    "path", sorted(_FOLDER.rglob("*.py")), ids=lambda path: str(path.relative_to(_FOLDER))
)
def test_no_module_imports_a_command(path):
    assert not _COMMANDS & set(_imports(path))


def test_the_command_line_is_small():
    files = (_FOLDER / "cli").glob("*.py")
    lines = sum(len(path.read_text("utf-8").splitlines()) for path in files)
    assert lines < _MOST_LINES_OF_THE_COMMAND_LINE
