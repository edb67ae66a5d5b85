"""Opens the scenes that a flag names: folders, or `hf:CONFIG/SCENE`."""

import contextlib
import glob
import warnings
from collections.abc import Sequence
from pathlib import Path

from etils import epy

from experiments.cli.flags import SCENE_FORMS
from experiments.cli.progress import ProgressBar
from refref_jax.data import SceneError, scene_names

with epy.lazy_imports():
    from refref_jax.data import scene_source


def check(source: str | Path | None) -> None:
    """Rejects sources that are obviously not scenes, before their readers are imported.

    Raises:
      SceneError: if the folder does not exist, if it contains neither views nor parquet files, or
        if `hf:...` is not a name of the data set.
    """
    if source is None:
        return
    if not str(source):
        raise SceneError(f"--scene is empty. Give {SCENE_FORMS}.")
    if str(source).startswith("hf:"):
        scene_names.parse_source(str(source))
        return
    folder = Path(source)
    if not any(any(folder.glob(each)) for each in ("transforms_*.json", "*/*.parquet")):
        raise SceneError(
            f"{folder / 'transforms_train.json'} does not exist. Give a scene: {SCENE_FORMS}."
        )


def check_all(sources: Sequence[str]) -> None:
    """Calls `check` for each source, except empty ones and patterns."""
    for source in sources:
        if source and not has_wildcards(source) and not scene_names.is_pattern(source):
            check(source)


def expanded(sources: Sequence[str]) -> list[str]:
    """Returns sources with the patterns of `hf:...` replaced by the scenes that match them.

    Raises:
      SceneError: if no scene matches one of them.
    """
    return [each for source in sources for each in scene_source.expand(source.strip())]


def has_wildcards(source: str) -> bool:
    """Returns whether a name is a pattern; an existing path is taken literally."""
    return not source.startswith("hf:") and glob.has_magic(source) and not Path(source).exists()


def check_place(place: str) -> None:
    """Rejects a source of one or many scenes that is neither a folder nor `hf:...`."""
    if not place.startswith("hf:") and not Path(place).is_dir():
        raise SceneError(f"{place} is not a folder. Give one that exists.")


def opened(source: str | Path) -> Path:
    """Returns the folder of a scene; a scene in parquet files is unpacked, with a progress bar.

    Raises:
      SceneError: if the scene is missing or broken, see `scene_source.open_scene`.
    """
    check(source)
    bar: ProgressBar | None = None

    def show(done: int, total: int) -> None:
        nonlocal bar
        if bar is None:
            bar = bars.enter_context(ProgressBar(f"unpack {Path(source).name}", total))
        bar.show(done, "images")

    with contextlib.ExitStack() as bars, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", scene_source.SceneWarning)
        scene = scene_source.open_scene(source, progress=show)
    for warning in caught:
        print(f"warning: {warning.message}")
    return scene
