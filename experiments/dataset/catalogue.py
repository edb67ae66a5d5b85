"""All objects of the data set, gathered from the modules of `objects` (NumPy only)."""

import importlib
import pkgutil

from experiments.dataset import objects
from experiments.dataset.parts import Object


def gather() -> dict[str, Object]:
    """Returns the objects by name, ordered by category and name.

    They are the tuples `OBJECTS` of the modules; a module without one only lends to others.

    Raises:
      ValueError: if two objects have one name.
    """
    found: dict[str, Object] = {}
    for module in pkgutil.iter_modules(objects.__path__, f"{objects.__name__}."):
        for item in getattr(importlib.import_module(module.name), "OBJECTS", ()):
            if item.name in found:
                raise ValueError(
                    f"Two objects are called {item.name}, one of them in {module.name}. Rename it."
                )
            found[item.name] = item
    return dict(sorted(found.items(), key=lambda pair: (_ORDER[pair[1].category], pair[0])))


_ORDER = {"smcvx": 0, "smncvx": 1, "mmncvx": 2}

OBJECTS: dict[str, Object] = gather()
"""Every object by its name."""
