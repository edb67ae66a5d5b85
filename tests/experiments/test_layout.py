"""The shape of experiments/: a file is a command, and no command leans on another."""

import ast

import pytest

from tests.laws import syntax
from tests.laws.conventions import holds_of_all
from tests.processes.command import ROOT

pytestmark = pytest.mark.loose

_FOLDER = ROOT / "experiments"
_FILES = sorted(path for path in _FOLDER.glob("*.py") if path.name != "__init__.py")
_COMMANDS = tuple(f"experiments.{path.stem}." for path in _FILES)

_MOST_LINES_OF_THE_COMMAND_LINE = 900


@holds_of_all(_FILES)
def test_every_file_is_a_command(path):
    last = syntax.nodes(path)[0].body[-1]
    assert isinstance(last, ast.If), "it does not end with `if`"
    assert ast.unparse(last.test) == "__name__ == '__main__'"
    assert ast.unparse(last.body[0]).startswith("app.run(main")


@holds_of_all(sorted(_FOLDER.rglob("*.py")))
def test_no_module_imports_a_command(path):
    assert not [name for name in syntax.imports(path) if f"{name}.".startswith(_COMMANDS)]


def test_the_command_line_is_small():
    files = (_FOLDER / "cli").glob("*.py")
    lines = sum(len(path.read_text("utf-8").splitlines()) for path in files)
    assert lines < _MOST_LINES_OF_THE_COMMAND_LINE
