"""All objects, gathered from the modules of `objects` (NumPy only)."""

import importlib
import pkgutil
from pathlib import Path

from experiments.dataset import objects
from experiments.dataset.objects import materials, monkey
from experiments.dataset.parts import Object, ObjectPart

SUZANNE = Path(__file__).parents[2] / "build" / "suzanne.npz"
"""Path of the monkey's mesh, written by `blender_meshes`."""

_ORDER = {"smcvx": 0, "smncvx": 1, "mmncvx": 2}


def gather() -> dict[str, Object]:
    """Returns the objects by name, ordered by category and name.

    They are the tuples `OBJECTS` of the modules, and the monkey, which requires its mesh file.
    Modules without such a tuple are helpers.

    Raises:
      ValueError: if two objects have the same name.
    """
    found = {"monkey": Object("monkey", "smncvx", _make_monkey)}
    for module in pkgutil.iter_modules(objects.__path__, f"{objects.__name__}."):
        for item in getattr(importlib.import_module(module.name), "OBJECTS", ()):
            if item.name in found:
                raise ValueError(
                    f"Two objects are named {item.name}, one of them in {module.name}. Rename it."
                )
            found[item.name] = item
    return dict(sorted(found.items(), key=lambda pair: (_ORDER[pair[1].category], pair[0])))


def _make_monkey(detail: float) -> list[ObjectPart]:
    return monkey.monkey(monkey.load_suzanne(SUZANNE)).make(detail)


OBJECTS: dict[str, Object] = gather()
"""Every object of the data set by name."""

COMPARISONS: dict[str, Object] = {item.name: item for item in materials.COMPARISONS}
"""Objects that compare materials with Cycles, by name."""
