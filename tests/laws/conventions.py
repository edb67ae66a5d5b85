"""Conventions that hold of many things: modules, pages, functions, classes."""

import functools
from collections.abc import Callable, Iterable
from pathlib import Path

from tests.processes.command import ROOT


def _relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def holds_of_all(things: Iterable, *, name: Callable = _relative):
    """Makes one test of a check of one thing; it fails with a line for each that breaks it.

    A test for each of them would be collected, prepared and reported thousands of times.

    Args:
      things: what the convention holds of.
      name: name of one of them, for the lines; of a file, its path in the repository by default.
    """

    def decorate(check):
        @functools.wraps(check)
        def test():
            found = [(name(thing), _broken(check, thing)) for thing in things]
            assert found, "There is nothing to look at."
            lines = [f"{where}: {why}" for where, why in found if why]
            assert not lines, "\n".join(lines)

        del test.__wrapped__  # pytest would take the argument of the check for a fixture
        return test

    return decorate


def _broken(check, thing):
    try:
        check(thing)
    except AssertionError as error:
        return str(error) or "does not hold"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return None
