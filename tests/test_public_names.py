"""The names of `refref_jax` and of `refref_jax.render`: that they are there, cheap, and listed."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import refref_jax
import refref_jax.render

_PAGE = Path(__file__).parents[1] / "docs" / "library.md"


def _re_exports(module):
    """Returns the names that a module's source imports under their own names, with their homes."""
    tree = ast.parse(Path(module.__file__).read_text())
    found = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    return {
        alias.asname: node.module
        for node in found
        for alias in node.names
        if alias.asname is not None
    }


def _listed():
    rows = [
        line.split("`")[1] for line in _PAGE.read_text().splitlines() if "| `refref_jax." in line
    ]
    return [name.removeprefix("refref_jax.") for name in rows]


def test_what_readers_of_types_see_is_what_is_imported():
    seen = _re_exports(refref_jax)
    assert seen == {name: f"refref_jax.{home}" for name, home in refref_jax._HOMES.items()}
    assert len(seen) > 15


@pytest.mark.parametrize("name", sorted(refref_jax._HOMES))
def test_a_public_name_is_the_one_definition(name):
    home = importlib.import_module(f"refref_jax.{refref_jax._HOMES[name]}")
    assert getattr(refref_jax, name) is getattr(home, name)
    # Later uses do not search again.
    assert vars(refref_jax)[name] is getattr(home, name)


def test_an_unknown_name_is_an_attribute_error_as_of_any_module():
    with pytest.raises(AttributeError, match="'refref_jax' has no attribute 'ray_trace'"):
        refref_jax.ray_trace  # noqa: B018


def test_all_names_can_be_found_by_completion():
    assert set(refref_jax._HOMES) <= set(dir(refref_jax))
    assert "__version__" in dir(refref_jax)


def test_the_page_lists_every_public_name_once():
    render = {f"render.{name}" for name in _re_exports(refref_jax.render)}
    # The three that both have stand once, with the others of their module.
    render -= {f"render.{name}" for name in ("Rays", "PathSettings", "PATH_PRESETS")}
    assert sorted(_listed()) == sorted({*refref_jax._HOMES, *render})


def test_importing_imports_nothing_and_touches_no_device():
    code = """
import sys
import refref_jax
assert "jax" not in sys.modules and "numpy" not in sys.modules

import importlib, pkgutil
import jax
before = dict(jax.config.values)
import refref_jax.render
for name in dir(refref_jax):
    getattr(refref_jax, name)
for module in pkgutil.walk_packages(refref_jax.__path__, "refref_jax."):
    importlib.import_module(module.name)
from jax._src import xla_bridge
assert not xla_bridge.backends_are_initialized(), xla_bridge._backends
assert {name: jax.config.values[name] for name in before} == before
"""
    subprocess.run([sys.executable, "-c", code], check=True)
