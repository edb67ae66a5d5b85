"""The scenes of the data set: every object with every kind of background.

Objects that compare materials have scenes of the same form, which are not part of the data set.
"""

import fnmatch
from collections.abc import Mapping

from experiments.cli import app
from experiments.dataset.parts import Object
from refref_jax.data.scene_names import BACKGROUNDS, SceneName

# Category of the objects that compare materials.
_COMPARED = "materials"


def all_scenes(objects: Mapping[str, Object]) -> list[SceneName]:
    """Returns all scenes; those of one object follow each other."""
    return [
        SceneName(background, item.category, item.name)
        for item in objects.values()
        for background in BACKGROUNDS
    ]


def choose(text: str, objects: Mapping[str, Object]) -> list[SceneName]:
    """Returns the scenes selected by an option, in the order of `all_scenes`.

    Args:
      text: `all`, or names separated by commas: of scenes, or of objects for all their scenes. Both
        may have wildcards, such as `cube_*` and `ball*`. `all` and patterns that match scenes of
        the data set leave out the comparisons of materials.
      objects: objects by name.

    Raises:
      ValueError: if nothing matches a name.
    """
    scenes = all_scenes(objects)
    chosen: set[SceneName] = set()
    for word in text.split(","):
        pattern = "*" if word.strip() == "all" else word.strip()
        fitting = _matching(pattern, [each for each in scenes if each.category != _COMPARED])
        fitting = fitting or _matching(pattern, scenes)
        if not fitting:
            names = [*map(str, scenes), *objects]
            near = app.did_you_mean(pattern, names, most=3)
            raise ValueError(
                f"No scene or object is named {pattern!r}.{near or f' One name is {names[0]}.'} "
                "Use 'all' for all of them."
            )
        chosen.update(fitting)
    return [scene for scene in scenes if scene in chosen]


def _matching(pattern: str, scenes: list[SceneName]) -> list[SceneName]:
    # `cube_*` matches scenes with a background cube, not those of a coloured cube.
    fitting = [scene for scene in scenes if fnmatch.fnmatchcase(str(scene), pattern)]
    return fitting or [scene for scene in scenes if fnmatch.fnmatchcase(scene.object, pattern)]
