"""Compares two folders of images, without any model: a table of all metrics for each image.

python -m experiments.metrics RENDERED TRUTH --masks=MASKS --out=metrics.json

Files are paired by name. Images are 8-bit .png files. If both folders contain .exr files, alone or
in addition, these are compared as distances along the ray in world units, as `evaluate` writes
them.

TRUTH may also be the folder of a scene: RENDERED is then compared with the images, masks and depth
maps of --split, under the names of its views. `docs/metrics.md` explains each metric.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from absl import flags
from etils import epy

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags
from experiments.cli.progress import ProgressBar
from refref_jax import configuration

with epy.lazy_imports():
    from experiments.runs import image_folders, perceptual, renderings
    from refref_jax.data import scene_folder

_MASKS = flags.DEFINE_string("masks", None, "Folder of masks, named like the images: 0 is outside.")
_SPLIT = cli_flags.split("Views of a scene to compare with, if TRUTH is a scene.")
_LIMIT = cli_flags.limit()
_OUT = flags.DEFINE_string("out", None, "JSON file to write; nothing is written by default.")
_OVERWRITE = cli_flags.overwrite("the file of --out if it exists")
_LPIPS_WEIGHTS = cli_flags.lpips_weights()


def main(rendered: str, truth: str) -> None:
    """Compares the folders."""
    out = None if _OUT.value is None else Path(_OUT.value)
    if out is not None:
        outputs.check_file(out, overwrite=_OVERWRITE.value)
    total, measured = _compared(Path(rendered), Path(truth))
    rows = []
    with ProgressBar("compare", total) as bar:
        for row in measured:
            rows.append(row)
            bar.show(len(rows), row[image_folders.NAME])
    print(image_folders.table(rows))
    if out is None:
        print(f"Nothing was written. Next, to store all digits: {_again(rendered, truth)}")
        return
    _write(out, {"rendered": rendered, "truth": truth, "masks": _MASKS.value}, rows)
    print(f"Metrics: {out}")
    print("Next: repeat this for other renderings with another --out, and compare the two.")


def _compared(rendered: Path, truth: Path) -> tuple[int, Iterator[dict[str, Any]]]:
    """Returns the number of images, and an iterator over their metrics.

    Raises:
      ValueError: if the folders do not fit, or if a flag would have no effect.
    """
    whole = renderings.is_scene(truth)
    if unheeded := [f"--{each.name}" for each in _unheeded(whole=whole) if each.present]:
        kind = "a scene" if whole else "no scene"
        raise ValueError(
            f"{', '.join(unheeded)} would have no effect, because {truth} is {kind}. Remove it."
        )
    if not whole:
        masks = None if _MASKS.value is None else Path(_MASKS.value)
        pairs = image_folders.match(rendered, truth, masks)
        lpips = perceptual.chosen(_LPIPS_WEIGHTS.value)
        return len(pairs), image_folders.compare(pairs, lpips)
    frames = scene_folder.read_frames(truth, _SPLIT.value)
    found = renderings.find(rendered, frames, limit=_LIMIT.value)
    lpips = perceptual.chosen(_LPIPS_WEIGHTS.value)
    given = {"split": _SPLIT.value, "limit": _LIMIT.value, "perceptual": lpips}
    return len(found.names), renderings.measure(rendered, truth, **given)


def _unheeded(*, whole: bool) -> tuple[flags.FlagHolder, ...]:
    """Returns the flags that have no effect, if TRUTH is a whole scene or a folder of images."""
    return (_MASKS,) if whole else (_SPLIT, _LIMIT)


def _again(rendered: str, truth: str) -> str:
    """Returns the same command with an output file."""
    deciding = (_MASKS, _SPLIT, _LIMIT, _LPIPS_WEIGHTS)
    given = [each.serialize() for each in deciding if each.value != each.default]
    return app.shell("metrics", rendered, truth, *given, "--out=metrics.json")


def _write(out: Path, given: dict[str, Any], rows: list[dict[str, Any]]) -> None:
    summary = given | {"results": image_folders.summarise(rows), "per_image": rows}
    text = json.dumps(configuration.string_safe(summary), indent=2, allow_nan=False)
    with outputs.fresh_file(out, overwrite=_OVERWRITE.value) as path:
        path.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    app.run(
        main,
        arguments=("RENDERED", "TRUTH"),
        again="repeat the command to compare again; --overwrite replaces the file of --out.",
    )
