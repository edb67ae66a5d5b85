"""Where the suite finds bytecode.

While jaxtyping imports a module of ours, to have its arguments checked, it looks for all bytecode
under a name of its own, also for that of other packages that the module imports. Nobody writes
those files, so each process of the suite compiled over 1,600 of them from source.
"""

import importlib.util
import os

from jaxtyping import _import_hook


def reuse_that_of_other_packages() -> None:
    """Has jaxtyping look for bytecode under its own name for our modules alone."""
    marked = getattr(_import_hook, "_optimized_cache_from_source", None)
    found = importlib.util.find_spec("refref_jax")
    if marked is None or found is None or found.origin is None:
        return
    ours, usual = os.path.dirname(found.origin) + os.sep, _import_hook.cache_from_source

    def cache_from_source(checker, /, path, *arguments, **options):
        if os.fspath(path).startswith(ours):
            return marked(checker, path, *arguments, **options)
        return usual(path, *arguments, **options)

    _import_hook._optimized_cache_from_source = cache_from_source
