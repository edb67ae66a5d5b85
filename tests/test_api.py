"""Conventions of the public functions, by inspection."""

import dataclasses
import importlib
import inspect
import pkgutil

import refref_jax
from tests.laws.conventions import holds_of_all

_MODULES = [
    importlib.import_module(info.name)
    for info in pkgutil.walk_packages(refref_jax.__path__, "refref_jax.")
]


def _public(kind):
    found = []
    for module in _MODULES:
        for name, value in vars(module).items():
            if (
                kind(inspect.unwrap(value))
                and value.__module__ == module.__name__
                and not name.startswith("_")
            ):
                found.append(value)
    return found


def _qualified(value):
    return f"{value.__module__}.{value.__qualname__}".removeprefix("refref_jax.")


_FUNCTIONS = _public(inspect.isfunction)
_CLASSES = _public(inspect.isclass)


def test_there_is_something_to_inspect():
    assert len(_FUNCTIONS) > 50 and len(_CLASSES) > 20


@holds_of_all(_FUNCTIONS, name=_qualified)
def test_functions_are_documented_and_annotated(function):
    assert inspect.getdoc(function)
    signature = inspect.signature(function)
    assert signature.return_annotation is not inspect.Signature.empty
    for parameter in signature.parameters.values():
        assert parameter.annotation is not inspect.Parameter.empty, parameter.name


@holds_of_all(_FUNCTIONS, name=_qualified)
def test_options_are_keyword_only_and_the_key_comes_first(function):
    parameters = inspect.signature(function).parameters
    for parameter in parameters.values():
        assert parameter.name != "rng"
        if parameter.default is not inspect.Parameter.empty:
            assert parameter.kind is inspect.Parameter.KEYWORD_ONLY, parameter.name
            assert not isinstance(parameter.default, bool), parameter.name
    if "key" in parameters:
        assert next(iter(parameters)) == "key"


@holds_of_all(_CLASSES, name=_qualified)
def test_records_are_named_tuples_and_configurations_are_frozen(cls):
    assert inspect.getdoc(cls)
    if dataclasses.is_dataclass(cls):
        is_module = any(base.__name__ == "Module" for base in cls.__mro__)
        assert is_module or cls.__dataclass_params__.frozen
    elif cls.__name__.endswith(("Config", "Hits", "Paths", "Rays")):
        assert issubclass(cls, tuple)
