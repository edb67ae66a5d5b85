"""Names of scenes and configurations in the published data set (NumPy only).

    cube_smcvx_ball              a scene: background, category, object
    cubebg_single-convex         its configuration on Hugging Face: background, category
    textured_cube_scene/single-convex/ball          its folder in the raw release; the folder of an
                                 object ends with _sphere or _hdr before these backgrounds
    hf:CONFIG/SCENE              a scene on Hugging Face, or in a local copy
    hf:all, hf:CONFIG, hf:cubebg_*/*, hf:*/*_ball      several of them: a pattern

Errors of the parser suggest the nearest names.
"""

import glob
from collections.abc import Iterable
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

from refref_jax import configuration
from refref_jax.choices import RuleName
from refref_jax.data import SceneError


class _Background(NamedTuple):
    """Names of a type of background: in configurations, and in the raw release."""

    config: str
    raw_folders: tuple[str, ...]
    raw_suffix: str


_BACKGROUNDS: dict[str, _Background] = {
    "cube": _Background("cubebg", ("textured_cube_scene",), ""),
    "sphere": _Background("spherebg", ("textured_sphere_scene",), "_sphere"),
    "env": _Background(
        "envbg", ("environment_map_scene", "env_map_scene", "HDR_map_scene"), "_hdr"
    ),
}

BACKGROUNDS = tuple(_BACKGROUNDS)
"""Types of background, which start the names of scenes."""

CATEGORIES: dict[str, str] = {
    "smcvx": "single-convex",
    "smncvx": "single-non-convex",
    "mmncvx": "multiple-non-convex",
}
"""Categories of objects: in the names of scenes, and in configurations and folders."""

CONFIGS = tuple(
    f"{background.config}_{category}"
    for background in _BACKGROUNDS.values()
    for category in CATEGORIES.values()
)
"""The nine configurations."""

PUBLISHED_RULE: RuleName = "facing"
"""Interface rule of the authors' scenes: Cycles decides the medium outside a face by its side."""

_ALL = "all"


class SceneName(NamedTuple):
    """The published name of a scene.

    Attributes:
      background: `cube`, `sphere` or `env`.
      category: `smcvx`, `smncvx` or `mmncvx`.
      object: name of the object in the data set, with underscores.
    """

    background: str
    category: str
    object: str

    def __str__(self) -> str:
        return "_".join(self)

    @property
    def config(self) -> str:
        """The scene's configuration on Hugging Face."""
        return f"{_BACKGROUNDS[self.background].config}_{CATEGORIES[self.category]}"

    @property
    def source(self) -> str:
        """The scene as `hf:CONFIG/SCENE`."""
        return f"hf:{self.config}/{self}"

    @property
    def raw_folder(self) -> str:
        """The scene's folder below `image_data` of the raw release."""
        background = _BACKGROUNDS[self.background]
        place = f"{background.raw_folders[0]}/{CATEGORIES[self.category]}"
        return f"{place}/{self.object}{background.raw_suffix}"


def is_name(name: str) -> bool:
    """Returns whether a name is a valid name of a scene."""
    background, _, rest = name.partition("_")
    category, _, thing = rest.partition("_")
    known = background in _BACKGROUNDS and category in CATEGORIES
    return known and bool(thing) and Path(thing).name == thing


def parse(name: str) -> SceneName:
    """Returns the parts of a scene's name.

    Raises:
      SceneError: if it is not a valid name.
    """
    if is_name(name):
        return SceneName(*name.split("_", 2))
    words = Path(name).name.split("_")
    background, category = configuration.nearest(words[0], BACKGROUNDS), None
    words = words[background is not None :]
    if words:
        category = configuration.nearest(words[0], CATEGORIES)
        words = words[category is not None :]
    wanted = SceneName(background or "cube", category or "smcvx", "_".join(words) or "ball")
    raise SceneError(
        f"{name!r} is not the name of a scene: names are {{{','.join(BACKGROUNDS)}}}_"
        f"{{{','.join(CATEGORIES)}}}_{{object}}. Use a name such as {wanted}."
    )


def parse_source(source: str) -> SceneName:
    """Returns the scene of `hf:CONFIG/SCENE`.

    Raises:
      SceneError: if it is not of that form, if there is no such configuration, or if the scene
        belongs to another one.
    """
    config, separator, text = source.removeprefix("hf:").partition("/")
    if not separator:
        example = parse(config) if is_name(config) else SceneName("cube", "smcvx", "ball")
        raise SceneError(f"{source} is not hf:CONFIG/SCENE. Write it as in {example.source}.")
    if config not in CONFIGS:
        raise SceneError(
            f"{config!r} is not a configuration of the data set. Write "
            f"{configuration.nearest(config, CONFIGS) or 'one of ' + ', '.join(CONFIGS)}."
        )
    name = parse(text)
    if name.config != config:
        raise SceneError(f"The scene {name} is not in {config}. Write {name.source}.")
    return name


def is_pattern(source: str) -> bool:
    """Returns whether a source is `hf:all`, `hf:CONFIG`, or has wildcards, and is no folder."""
    text = source.removeprefix("hf:")
    return text != source and (text == _ALL or text in CONFIGS or glob.has_magic(text))


def select(source: str, names: Iterable[SceneName]) -> list[SceneName]:
    """Returns the scenes that match a pattern.

    Args:
      source: pattern, see `is_pattern`; wildcards are those of the shell, separately for the
        configuration and the scene. A configuration alone stands for all its scenes.
      names: scenes to select from.
    """
    text = source.removeprefix("hf:")
    config, _, scene = ("*" if text == _ALL else text).partition("/")
    return [
        name
        for name in names
        if fnmatchcase(name.config, config) and fnmatchcase(str(name), scene or "*")
    ]


def published_rule(scene: Path) -> RuleName | None:
    """Returns the interface rule that a scene's layout implies, unless `scene.json` states one.

    A folder of the raw release implies that of Cycles. A scene unpacked from parquet files has it
    in its `scene.json`. All other folders imply none.
    """
    return None if of_raw_folder(scene) is None else PUBLISHED_RULE


def of_raw_folder(scene: Path) -> SceneName | None:
    """Returns the scene of a folder in the raw release, or `None` for another folder."""
    folder = scene.resolve()
    categories = {long: short for short, long in CATEGORIES.items()}
    category = categories.get(folder.parent.name)
    for kind, background in _BACKGROUNDS.items():
        if category is not None and folder.parent.parent.name in background.raw_folders:
            return SceneName(kind, category, folder.name.removesuffix(background.raw_suffix))
    return None


def of_folder(scene: Path) -> str:
    """Returns the name of a scene's folder, or the published name in the raw release."""
    return str(of_raw_folder(scene) or scene.resolve().name)
