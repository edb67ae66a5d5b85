"""Modules that are imported when they are first used, so that wrong options are told at once.

JAX and what stands on it take seconds to import. A command defines its options first, and takes the
modules that do its work from here: it has read its options, and refused wrong ones, before any of
them is imported. Who reads types, and who checks them, is shown plain imports:

    if TYPE_CHECKING:
        from experiments import trainer
    else:
        trainer = late("experiments.runs.trainer")
"""

import contextlib
import importlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from types import ModuleType
from typing import Any

from experiments.cli.first_interrupt import INTERRUPTED


def late(name: str) -> Any:
    """Returns what stands for a module, and imports it when one of its names is first asked for."""
    return _Late(name)


class _Late:
    """A module that may not be imported yet."""

    __slots__ = ("_name",)

    def __init__(self, name: str) -> None:
        object.__setattr__(self, "_name", name)

    def __getattr__(self, attribute: str) -> Any:
        return getattr(_import(self._name), attribute)

    def __setattr__(self, attribute: str, value: Any) -> None:
        setattr(_import(self._name), attribute, value)

    def __repr__(self) -> str:
        return f"late({self._name!r})"


def _import(name: str) -> ModuleType:
    if name in sys.modules:
        return importlib.import_module(name)
    with _interrupted_afterwards():
        return importlib.import_module(name)


@contextlib.contextmanager
def _interrupted_afterwards() -> Iterator[None]:
    """Puts Ctrl-C off: JAX's compiled modules crash where it meets them while they are imported.

    The second ends the process at once: nothing has been begun yet.
    """
    raises = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not raises or threading.current_thread() is not threading.main_thread():
        yield
        return
    met: list[int] = []

    def note(number: int, frame: object) -> None:
        del frame
        if met:
            os._exit(INTERRUPTED)
        met.append(number)
        os.write(2, b"Stopping when JAX is imported; once more to stop at once.\n")

    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if met:
            raise KeyboardInterrupt
