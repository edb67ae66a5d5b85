"""The examples in the docstrings of the public names run, and print what they say."""

import doctest
import inspect

import pytest

import refref_jax
import refref_jax.render

_MODULES = {"refref_jax": refref_jax, "refref_jax.render": refref_jax.render}

_NAMED = {f"refref_jax.{name}": getattr(refref_jax, name) for name in refref_jax._HOMES} | {
    f"refref_jax.render.{name}": value
    for name, value in vars(refref_jax.render).items()
    if inspect.isroutine(value) or inspect.isclass(value)
}

# What reads a run of the user's, or renders one: `tests/experiments/test_documents.py` runs the
# snippets of README and docs that do.
_SHOWN_ELSEWHERE = {
    "refref_jax.evaluate",
    "refref_jax.fit",
    "refref_jax.read_meshes",
    "refref_jax.render.init_params",
    "refref_jax.render.load_model",
    "refref_jax.render.render_camera",
    "refref_jax.render.render_image",
    "refref_jax.render.render_ray",
    "refref_jax.render.render_rays",
}


def _examples(name, value):
    # Not by module: the run-time shape checks wrap functions, which `doctest` takes for foreign.
    finder = doctest.DocTestFinder(recurse=False)
    found = finder.find(value, name, module=False, globs={})
    return [test for test in found if test.examples]


_TESTS = [test for name, value in (_MODULES | _NAMED).items() for test in _examples(name, value)]


# Each compiles a tracer of its own, and its function is tested by every run of the suite.
_SLOW = {
    "refref_jax.follow_branch",
    "refref_jax.follow_main_branches",
    "refref_jax.render.render_known_camera",
    "refref_jax.render.shade",
    "refref_jax.trace",
}
assert {test.name for test in _TESTS} >= _SLOW


@pytest.mark.parametrize(
    "test",
    [pytest.param(x, marks=pytest.mark.slow if x.name in _SLOW else ()) for x in _TESTS],
    ids=lambda test: test.name,
)
def test_an_example_prints_what_it_says(test, capsys):
    results = doctest.DocTestRunner().run(test, clear_globs=False)
    assert results.attempted > 0
    assert results.failed == 0, capsys.readouterr().out


def test_every_public_function_has_an_example():
    functions = {name for name, value in _NAMED.items() if inspect.isroutine(value)}
    assert {test.name for test in _TESTS} >= functions - _SHOWN_ELSEWHERE
    assert functions > _SHOWN_ELSEWHERE
