"""Modules that are imported when they are first used, so that wrong options are told at once.

JAX and what stands on it take seconds to import. A command defines its options first, and takes the
modules that do its work from here: it has read its options, and refused wrong ones, before any of
them is imported. Who reads types, and who checks them, is shown plain imports:

    if TYPE_CHECKING:
        from experiments import trainer
    else:
        trainer = late("experiments.trainer")
"""

import importlib
from typing import Any


def late(name: str) -> Any:
    """Returns what stands for a module, and imports it when one of its names is first asked for."""
    return _Late(name)


class _Late:
    """A module that may not be imported yet."""

    __slots__ = ("_name",)

    def __init__(self, name: str) -> None:
        object.__setattr__(self, "_name", name)

    def __getattr__(self, attribute: str) -> Any:
        return getattr(importlib.import_module(self._name), attribute)

    def __setattr__(self, attribute: str, value: Any) -> None:
        setattr(importlib.import_module(self._name), attribute, value)

    def __repr__(self) -> str:
        return f"late({self._name!r})"
