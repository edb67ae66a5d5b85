"""Checks scenes that were made: files, meshes, and pictures against our own light paths.

python -m experiments.dataset.check runs/dataset --views=3

Each scene's meshes are linted and all of its images opened. Some of its test views are rendered
again along the path tree, with a finer cut and more bends than `render_known --paths=tree` has by
default, and without light of more bends than Cycles follows, and compared with the image; depth
map, mask and normals are compared with the first surface that rays meet. {out}/check.html shows
it all, {out}/check.json has the figures; {out} is the folder itself by default. A scene that does
not hold makes the command end with status 1.
"""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

from absl import flags

from experiments import budget_options, commands, known_scenes, supersampling
from experiments.dataset import render_settings, scene_check
from experiments.dataset.check_page import SceneReport, write_page

_SCENES = flags.DEFINE_list("scenes", None, "Only these scenes of the folder, by name.")
_VIEWS = flags.DEFINE_integer("views", 3, "Test views to compare, evenly spread; 0 for none.", 0)
_OUT = flags.DEFINE_string("out", None, "Folder to write the report to.")
flags.adopt_module_key_flags(budget_options)
# Diamond keeps light for so long that the tree's own cut loses 5 dB of 39, and what Cycles drops
# after its 64 bounces another 6. Paths are to be judged here, not where they stop.
flags.set_default(budget_options.CUT, 0.004)
flags.set_default(budget_options.BENDS, render_settings.BOUNCES)
flags.declare_key_flag("rays_per_pixel")
# What Cycles averages over hundreds of rays aliases with few: a wall of the generator is 41 dB off
# with 25 rays a pixel of 200 x 200, and 48 with 100.
flags.set_default(known_scenes.RAYS_PER_PIXEL, 100)

_SHOWN_COMPLAINTS = 3


def main(folder: str) -> None:
    """Checks every scene of a folder, and writes the report."""
    side = supersampling.side_of(known_scenes.RAYS_PER_PIXEL.value)
    budget = dataclasses.replace(budget_options.chosen("tree"), unfinished="dark")
    checked = Path(folder)
    scenes = scene_check.find_scenes(checked, _SCENES.value)
    out = Path(_OUT.value) if _OUT.value else checked
    out.mkdir(parents=True, exist_ok=True)
    reports = []
    with commands.ProgressBar("check", len(scenes)) as bar:
        for done, scene in enumerate(scenes, 1):
            reports.append(scene_check.check_scene(scene, budget, views=_VIEWS.value, side=side))
            bar.show(done, _summary(reports[-1]))
    page, figures = out / "check.html", out / "check.json"
    page.write_text(write_page(reports, title=f"Check of {checked.resolve().name}"), "utf-8")
    content = commands.string_safe([_record(report) for report in reports])
    figures.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", "utf-8")
    bad = [report for report in reports if report.complaints]
    for report in bad:
        for complaint in report.complaints[:_SHOWN_COMPLAINTS]:
            print(f"{report.name}: {complaint}")
    print(f"{len(reports) - len(bad)} of {len(reports)} scenes hold.")
    print(f"Report:  {page}")
    print(f"Figures: {figures}")
    if (scenes[0] / "transforms_train.json").is_file():
        options = (f"--scene={scenes[0]}", f"--out=runs/{scenes[0].resolve().name}")
        print(f"Next: {commands.shell('train', *options)}")
    else:
        print("Next: python -m experiments.dataset.make without --preview, for scenes to train on")
    if bad:
        sys.exit(1)


def _summary(report: SceneReport) -> str:
    if report.complaints:
        return f"{report.name}  does not hold"
    if not report.views:
        return f"{report.name}  holds"
    return f"{report.name}  {min(view.psnr_masked for view in report.views):.1f} dB in the mask"


def _record(report: SceneReport) -> dict[str, Any]:
    pictures = {"target", "rgb"}
    views = [
        {key: value for key, value in view._asdict().items() if key not in pictures}
        for view in report.views
    ]
    return {**report._asdict(), "views": views}


if __name__ == "__main__":
    commands.run(main, arguments=("FOLDER",))
