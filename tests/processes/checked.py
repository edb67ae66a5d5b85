"""When the suite has the arguments and results of a function checked: from its first call on.

jaxtyping has beartype write code for every function of a module that is imported, which took five
seconds in each process of the suite. Functions that are not called, and those without annotations,
are spared it; so an annotation that beartype refuses fails at the first call, not at the import.
"""

import functools
import inspect
from collections.abc import Callable

import jaxtyping

_decorate = jaxtyping.jaxtyped


def from_the_first_call() -> None:
    """Has jaxtyping decorate a function when it is called, and never one without annotations."""
    jaxtyping.jaxtyped = _jaxtyped


def _jaxtyped(*functions, typechecker):
    if not functions:
        return functools.partial(_jaxtyped, typechecker=typechecker)
    (function,) = functions
    # Classes are few.
    if not inspect.isfunction(function):
        return _decorate(function, typechecker=typechecker)
    return _checked(function, typechecker) if function.__annotations__ else function


def _checked(function: Callable, typechecker: Callable) -> Callable:
    decorated = functools.cache(lambda: _decorate(function, typechecker=typechecker))

    @functools.wraps(function)
    def checked(*arguments, **options):
        __tracebackhide__ = True
        return decorated()(*arguments, **options)

    return checked
