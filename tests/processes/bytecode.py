"""Where the suite finds bytecode.

While jaxtyping imports a module of ours, to have its arguments checked, it looks for all bytecode
under a name of its own: also for that of what the module imports from others. There is none, so
that over 1,600 files were compiled from source by each process of the suite, unless one before had
kept what it compiled.
"""

import os
from pathlib import Path

from jaxtyping import _import_hook

_OURS = os.path.join(Path(__file__).parents[2], "refref_jax", "")


def find_that_of_others() -> None:
    """Has jaxtyping look for bytecode under its own name for our modules alone."""
    marked = getattr(_import_hook, "_optimized_cache_from_source", None)
    if marked is None:  # a version that does it otherwise
        return
    usual = _import_hook.cache_from_source

    def cache_from_source(checker, /, path, *arguments, **options):
        if os.fspath(path).startswith(_OURS):
            return marked(checker, path, *arguments, **options)
        return usual(path, *arguments, **options)

    _import_hook._optimized_cache_from_source = cache_from_source
