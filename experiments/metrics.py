"""Compares two folders of images, without any model: a table of all metrics for each image.

python -m experiments.metrics RENDERED TRUTH --masks=MASKS --out=metrics.json

Files are paired by name. Images are 8-bit .png files. If both folders contain .exr files, alone or
in addition, these are compared as distances along the ray in world units, as `evaluate` writes
them. (A scene's own depth maps are planar and cannot be compared with them.) `docs/metrics.md`
explains each metric.
"""

import json
from pathlib import Path
from typing import Any

from absl import flags
from etils import epy

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags
from experiments.cli.progress import ProgressBar
from refref_jax import configuration

with epy.lazy_imports():
    from experiments.runs import image_folders, perceptual

_MASKS = flags.DEFINE_string("masks", None, "Folder of masks, named like the images: 0 is outside.")
_OUT = flags.DEFINE_string("out", None, "JSON file to write; nothing is written by default.")
_OVERWRITE = cli_flags.overwrite("the file of --out if it exists")
_LPIPS_WEIGHTS = cli_flags.lpips_weights()


def main(rendered: str, truth: str) -> None:
    """Compares the folders."""
    out = None if _OUT.value is None else Path(_OUT.value)
    if out is not None:
        outputs.check_file(out, overwrite=_OVERWRITE.value)
    masks = None if _MASKS.value is None else Path(_MASKS.value)
    pairs = image_folders.match(Path(rendered), Path(truth), masks)
    lpips = perceptual.chosen(_LPIPS_WEIGHTS.value)
    rows = []
    with ProgressBar("compare", len(pairs)) as bar:
        for row in image_folders.compare(pairs, lpips):
            rows.append(row)
            bar.show(len(rows), row[image_folders.NAME])
    print(image_folders.table(rows))
    if out is None:
        print(f"Nothing was written. Next, to store all digits: {_again(rendered, truth)}")
        return
    _write(out, {"rendered": rendered, "truth": truth, "masks": _MASKS.value}, rows)
    print(f"Metrics: {out}")
    print("Next: repeat this for other renderings with another --out, and compare the two.")


def _again(rendered: str, truth: str) -> str:
    """Returns the same command with an output file."""
    given = [each.serialize() for each in (_MASKS, _LPIPS_WEIGHTS) if each.value is not None]
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
