"""The shape of the package: which way imports fall, how long things are, who may compile."""

import ast
from pathlib import Path

from benchmarks import planted_bugs
from tests.laws import syntax
from tests.laws.conventions import holds_of_all

_ROOT = Path(__file__).parents[1]
_PACKAGE = _ROOT / "refref_jax"

# A module may import from its own floor's package and from lower floors only.
_FLOORS = {
    "choices": 0,
    "numerics": 0,
    "atomic_files": 0,
    "compilation": 0,
    "configuration": 1,
    "geometry": 1,
    "optics": 2,
    "sampling": 3,
    "fields": 4,
    "splats": 5,
    "render": 6,
    "metrics": 7,
    "data": 8,
    "training": 9,
    "reconstruct": 9,
}

_MODULES = sorted(_PACKAGE.rglob("*.py"))
_SCRIPTS = sorted((_ROOT / "experiments").rglob("*.py"))
_BENCHMARKS = sorted((_ROOT / "benchmarks").rglob("*.py"))
_TESTS = sorted((_ROOT / "tests").rglob("*.py"))

# Folders of tests/ for what tests share; elsewhere there are tests and what prepares them.
_SHARED = {"oracles", "factories", "fakes", "laws", "processes"}

_LONGEST_MODULE = 500
_LONGEST_FUNCTION = 45

# Deep modules: few, long enough to hold a topic, and seldom made for a single importer.
_MOST_MODULES = 110
_LEAST_MEAN_LENGTH = 180
_MOST_WITH_ONE_IMPORTER = 20

_MAY_JIT = {
    "render/images.py",
    "render/background_rendering.py",
    "training/backdrop_equations.py",
    "training/backdrop_solver.py",
    "render/pixel_paths.py",
    "splats/images.py",
    "splats/training.py",
    "training/devices.py",
    "training/loop.py",
    "training/evaluation.py",
    "reconstruct/occupancy.py",
    "compilation.py",
    "reconstruct/photometry.py",
    "reconstruct/refractive_index.py",
}

# Bodies of functions are compared from this many statements on, or nodes of the syntax tree.
_STATEMENTS_COMPARED, _NODES_COMPARED = 3, 12

_VAGUE_NAMES = {"utils", "util", "misc", "helpers", "common", "math"}


def _name(path):
    return path.relative_to(_PACKAGE).as_posix()


def _late_imports(path):
    """Yields the names of modules that a command imports when they are first used."""
    for node in syntax.nodes(path):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "late":
            yield ast.literal_eval(node.args[0])


def _functions(path):
    for node in syntax.nodes(path):
        if isinstance(node, ast.FunctionDef):
            yield node


def _is_jit(node):
    """Returns whether code, rather than an example in a docstring, says `jax.jit`."""
    return isinstance(node, ast.Attribute) and ast.unparse(node) == "jax.jit"


def _body(function):
    """Returns the statements of a function, without its docstring."""
    first = function.body[0]
    documented = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
    return function.body[1:] if documented else function.body


def _body_lines(function):
    body = _body(function)
    return body[-1].end_lineno - body[0].lineno + 1 if body else 0


@holds_of_all(_MODULES)
def test_imports_fall(path):
    here = path.relative_to(_PACKAGE).with_suffix("").parts[0]
    if here == "__init__":
        return
    for name in syntax.imports(path):
        parts = name.split(".")
        if parts[0] != "refref_jax":
            continue
        there = parts[1]
        assert there == here or _FLOORS[there] < _FLOORS[here], f"imports {name}"


@holds_of_all(_MODULES)
def test_the_library_imports_no_command(path):
    assert not {name.split(".")[0] for name in syntax.imports(path)} & {"experiments", "benchmarks"}


@holds_of_all(_BENCHMARKS)
def test_benchmarks_import_no_test(path):
    assert "tests" not in {name.split(".")[0] for name in syntax.imports(path)}


def test_what_tests_share_has_its_folders():
    for path in _TESTS:
        if path.parent.name not in _SHARED:
            assert path.stem in ("__init__", "conftest") or path.stem.startswith("test_"), path


def test_no_two_functions_of_the_tests_have_equal_bodies():
    alike = {}
    for path in _TESTS:
        for function in _functions(path):
            body = _body(function)
            kinds = tuple(type(node) for statement in body for node in ast.walk(statement))
            if len(body) >= _STATEMENTS_COMPARED or len(kinds) >= _NODES_COMPARED:
                home = f"{path.relative_to(_ROOT)}:{function.lineno}"
                alike.setdefault(kinds, []).append((home, body))
    homes = {}
    for candidates in alike.values():
        # To write one out takes longest.
        for home, body in candidates if len(candidates) > 1 else ():
            homes.setdefault("\n".join(map(ast.dump, body)), []).append(home)
    assert not [found for found in homes.values() if len(found) > 1]


def test_only_the_generator_imports_the_generator():
    generator = _ROOT / "experiments" / "dataset"
    for path in _SCRIPTS + _BENCHMARKS:
        if not path.is_relative_to(generator):
            for name in (*syntax.imports(path), *_late_imports(path)):
                assert not f"{name}.".startswith("experiments.dataset."), f"{path} imports {name}"


def test_every_module_has_a_floor():
    tops = {path.relative_to(_PACKAGE).with_suffix("").parts[0] for path in _MODULES}
    assert tops - {"__init__"} == set(_FLOORS)


@holds_of_all([path for path in _MODULES if "data" in path.parts])
def test_data_is_numpy_only(path):
    allowed = {
        "geometry.cameras",
        "geometry.rays",
        "geometry.surfaces",
        "geometry.triangle_meshes",
    }
    for name in syntax.imports(path):
        assert name.split(".")[0] not in ("jax", "flax", "optax"), name
        if name.startswith("refref_jax.geometry"):
            assert any(name.startswith(f"refref_jax.{module}") for module in allowed), name


@holds_of_all(_MODULES)
def test_numpy_and_jax_never_meet_in_one_function(path):
    for function in _functions(path):
        names = {node.id for node in ast.walk(function) if isinstance(node, ast.Name)}
        assert not {"np", "jnp"} <= names, f"{function.name} uses both np and jnp"


@holds_of_all(_MODULES)
def test_only_the_rim_compiles(path):
    if _name(path) not in _MAY_JIT:
        lines = [node.lineno for node in syntax.nodes(path) if _is_jit(node)]
        assert not lines and "jax.jit" not in syntax.imports(path), f"jax.jit in lines {lines}"


@holds_of_all(_MODULES)
def test_guards_live_in_numerics(path):
    text = path.read_text()
    assert "nan_to_num" not in text
    if path.name != "numerics.py":
        assert "finfo" not in text


def test_modules_are_deep():
    modules = [path for path in _MODULES if path.name != "__init__.py"]
    lengths = [len(path.read_text().splitlines()) for path in modules]
    assert len(modules) <= _MOST_MODULES
    assert sum(lengths) >= _LEAST_MEAN_LENGTH * len(modules)
    importers = [path for path in modules + _SCRIPTS if path.name != "__init__.py"]
    imported = {path: set(syntax.imports(path)) for path in importers}
    lonely = [path for path in modules if _count_importers(path, imported) == 1]
    assert len(lonely) <= _MOST_WITH_ONE_IMPORTER, [_name(path) for path in lonely]


def _count_importers(path, imported):
    name = ".".join(path.relative_to(_ROOT).with_suffix("").parts)
    return sum(
        any(f"{other}.".startswith(f"{name}.") for other in names)
        for importer, names in imported.items()
        if importer != path
    )


@holds_of_all(_MODULES + _SCRIPTS)
def test_modules_and_functions_are_short_and_named(path):
    assert path.stem not in _VAGUE_NAMES
    assert len(path.read_text().splitlines()) <= _LONGEST_MODULE
    for function in _functions(path):
        assert _body_lines(function) <= _LONGEST_FUNCTION, function.name


def test_one_snell_and_one_fresnel():
    definitions = [
        (function.name, _name(path)) for path in _MODULES for function in _functions(path)
    ]
    for name, home in [
        ("refract", "optics/fresnel.py"),
        ("reflect", "optics/fresnel.py"),
        ("reflectance", "optics/fresnel.py"),
        ("follow", "optics/wavefront.py"),
    ]:
        assert [where for found, where in definitions if found == name] == [home]


def test_the_text_of_each_planted_bug_occurs_once():
    """Otherwise `benchmarks.planted_bugs`, which takes an hour, would have to tell."""
    for bug in planted_bugs.BUGS:
        text = (_PACKAGE / bug.file).read_text(encoding="utf-8")
        assert text.count(bug.old) == 1, f"{bug.name}: {bug.file}"
