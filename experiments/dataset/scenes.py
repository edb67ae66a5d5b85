"""The scenes of the data set: every object before every kind of background.

A scene is called `{background}_{category}_{object}`, as `cube_smcvx_ball`.
"""

import difflib
import fnmatch
from collections.abc import Mapping
from typing import Literal, NamedTuple

from experiments.dataset.parts import Category, Object

Kind = Literal["cube", "sphere", "env"]

KINDS: tuple[Kind, ...] = ("cube", "sphere", "env")
"""Textured walls, a textured sphere, and an environment infinitely far away."""


class Scene(NamedTuple):
    """An object before a background.

    Attributes:
      kind: of the background.
      category: of the object.
      object: its name.
    """

    kind: Kind
    category: Category
    object: str

    @property
    def name(self) -> str:
        """What the scene is called."""
        return "_".join(self)


def all_scenes(objects: Mapping[str, Object]) -> list[Scene]:
    """Returns all scenes; those of one object follow each other."""
    return [Scene(kind, item.category, item.name) for item in objects.values() for kind in KINDS]


def choose(text: str, objects: Mapping[str, Object]) -> list[Scene]:
    """Returns the scenes that an option names, in the order of `all_scenes`.

    Args:
      text: `all`, or names parted by commas: of scenes, of objects for all their scenes, and of
        either with wildcards, as `cube_*` or `*_ball`.
      objects: by name.

    Raises:
      ValueError: if a name fits nothing.
    """
    scenes = all_scenes(objects)
    chosen = set()
    for word in text.split(","):
        pattern = "*" if word.strip() == "all" else word.strip()
        fitting = [scene for scene in scenes if _fits(scene, pattern)]
        if not fitting:
            names = [scene.name for scene in scenes] + list(objects)
            near = difflib.get_close_matches(pattern, names, n=3) or names[:3]
            raise ValueError(
                f"No scene or object is called {pattern!r}. Choose from names as "
                f"{', '.join(near)}, or all."
            )
        chosen.update(fitting)
    return [scene for scene in scenes if scene in chosen]


def _fits(scene: Scene, pattern: str) -> bool:
    return fnmatch.fnmatchcase(scene.name, pattern) or fnmatch.fnmatchcase(scene.object, pattern)
