"""How commands open the scene that an option names: a folder, or `hf:CONFIG/SCENE`."""

import contextlib
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from experiments import commands
from experiments.late_imports import late

if TYPE_CHECKING:
    from refref_jax.data import scene_source
else:
    scene_source = late("refref_jax.data.scene_source")


def opened(source: str | Path) -> Path:
    """Returns the folder of a scene; one in parquet files is unpacked, with a bar of progress.

    Raises:
      ValueError: if there is none, or it is broken, see `scene_source.open_scene`.
    """
    bar: commands.ProgressBar | None = None

    def show(done: int, total: int) -> None:
        nonlocal bar
        if bar is None:
            bar = bars.enter_context(commands.ProgressBar(f"unpack {Path(source).name}", total))
        bar.show(done, "images")

    with contextlib.ExitStack() as bars, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", scene_source.SceneWarning)
        scene = scene_source.open_scene(source, progress=show)
    for warning in caught:
        print(f"warning: {warning.message}")
    return scene
