"""Checks generated scenes: files, meshes, and images against our own renderer.

python -m experiments.dataset.check runs/dataset --limit=3

Each scene's meshes are linted and all of its images opened. Some of its test views are rendered
again along the path tree, and compared with the image. This uses a lower throughput threshold and
more bends than the defaults of `render_known --paths=tree`, but no light with more bends than
Cycles traces. Depth map, mask and normals are compared with the first surface that our rays hit.
{out}/check.html shows all results, {out}/check.json has the numbers; {out} is the folder itself by
default. If a scene fails, the command ends with status 1.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from absl import flags
from etils import epy

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from experiments.cli.progress import ProgressBar
from experiments.dataset import render_settings
from refref_jax import choices, configuration

if TYPE_CHECKING:
    from experiments.dataset.check_page import SceneReport

with epy.lazy_imports():
    from experiments.dataset import check_page, scene_check

_SCENES = flags.DEFINE_list("scenes", None, "Names of the scenes to check; all if not given.")
_LIMIT = flags.DEFINE_integer("limit", 3, "Number of test images, evenly spaced; 0: none.", 0)
cli_flags.alias("views", "limit")
_OUT = flags.DEFINE_string("out", None, "Folder of the report; FOLDER if not given.")
_OVERWRITE = cli_flags.overwrite("the report of an earlier check")
# The diamond traps light for so long that the tree's own threshold costs 5 dB of 39, and Cycles'
# limit of 64 bounces another 6. Paths are checked here, not their truncation.
_SETTINGS = cli_flags.settings(min_throughput=0.004, max_bends=render_settings.BOUNCES)
# Few rays per pixel alias where Cycles averages over hundreds: a face of the cube is 41 dB off with
# 25 rays per pixel of 200 x 200, and 48 with 100.
_RAYS_PER_PIXEL = cli_flags.rays_per_pixel(100)

_SHOWN_COMPLAINTS = 3
cli_flags.allow_outside()


def main(folder: str) -> None:
    """Checks every scene of a folder, and writes the report."""
    settings = dataclasses.replace(_SETTINGS.chosen("tree"), truncated_paths="black")
    checked, side = Path(folder), choices.side_of(_RAYS_PER_PIXEL.value)
    out = Path(_OUT.value) if _OUT.value else checked
    page, figures = out / "check.html", out / "check.json"
    for path in (page, figures):
        outputs.check_file(path, overwrite=_OVERWRITE.value)
    cli_scenes.check_place(folder)
    scenes = scene_check.find_scenes(checked, _SCENES.value)
    reports = []
    with ProgressBar("check", len(scenes)) as bar:
        for done, scene in enumerate(scenes, 1):
            reports.append(scene_check.check_scene(scene, settings, views=_LIMIT.value, side=side))
            bar.show(done, _summary(reports[-1]))
    content = configuration.string_safe([_record(report) for report in reports])
    for path, text in (
        (page, check_page.write_page(reports, title=f"Check of {checked.resolve().name}")),
        (figures, json.dumps(content, indent=2, allow_nan=False) + "\n"),
    ):
        with outputs.fresh_file(path, overwrite=_OVERWRITE.value) as draft:
            draft.write_text(text, "utf-8")
    bad = [report for report in reports if report.complaints]
    for report in bad:
        for complaint in report.complaints[:_SHOWN_COMPLAINTS]:
            print(f"{report.name}: {complaint}")
    print(f"{len(reports) - len(bad)} of {len(reports)} scenes passed.")
    print(f"Report:  {page}")
    print(f"Figures: {figures}")
    if (scenes[0] / "transforms_train.json").is_file():
        given = (f"--scene={scenes[0]}", f"--out=runs/{scenes[0].resolve().name}")
        print(f"Next: {app.shell('train', *given)}")
    else:
        print("Next: python -m experiments.dataset.make without --preview, for training scenes")
    if bad:
        sys.exit(1)


def _summary(report: SceneReport) -> str:
    if report.complaints:
        return f"{report.name}  failed"
    if not report.views:
        return f"{report.name}  passed"
    return f"{report.name}  {min(view.psnr_masked for view in report.views):.1f} dB masked PSNR"


def _record(report: SceneReport) -> dict[str, Any]:
    pictures = {"target", "rgb"}
    views = [
        {key: value for key, value in view._asdict().items() if key not in pictures}
        for view in report.views
    ]
    return {**report._asdict(), "views": views}


if __name__ == "__main__":
    app.run(
        main,
        arguments=("FOLDER",),
        again="it repeats the check; --overwrite replaces the report.",
    )
