"""Conventions that hold of many things: modules, functions, classes."""

import functools
from collections.abc import Callable, Iterable


def holds_of_all(things: Iterable, *, name: Callable = str):
    """Makes one test of a check of one thing; it fails with a line for each that breaks it.

    With a test for each thing, half of the suite's tests were conventions.

    Args:
      things: what the convention holds of.
      name: name of one of them, for the lines.
    """

    def decorate(check):
        @functools.wraps(check)
        def test():
            found = [(name(thing), _broken(check, thing)) for thing in things]
            assert found, "There is nothing to look at."
            assert not (lines := [f"{where}: {why}" for where, why in found if why]), "\n".join(
                lines
            )

        del test.__wrapped__  # pytest would take the argument of the check for a fixture
        return test

    return decorate


def _broken(check, thing):
    try:
        check(thing)
    except AssertionError as error:
        return str(error) or "does not hold"
    return None
