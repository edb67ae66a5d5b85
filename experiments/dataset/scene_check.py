"""Finds the scenes of a folder and checks one scene of the data set; see `check`."""

from pathlib import Path

import numpy as np

from experiments.cli import app
from experiments.dataset import checks
from experiments.dataset.check_page import SceneReport
from refref_jax.optics.path_settings import PathSettings

_TRANSFORMS = "transforms_*.json"


def find_scenes(folder: Path, names: list[str] | None) -> list[Path]:
    """Returns the scenes of a folder, or the folder itself if it is one.

    Raises:
      ValueError: if the folder has no scene, or not one with a given name.
    """
    if any(folder.glob(_TRANSFORMS)):
        found = [folder]
    else:
        found = sorted({path.parent for path in folder.glob(f"*/{_TRANSFORMS}")})
    if not found:
        raise ValueError(
            f"{folder} holds no scene: no folder in it has a transforms_test.json. Give a scene, "
            "or the folder that `experiments.dataset.make --out` wrote."
        )
    there = {path.resolve().name for path in found}
    if missing := sorted(set(names or ()) - there):
        near = app.did_you_mean(missing[0], sorted(there))
        raise ValueError(
            f"{folder} holds no scene {missing[0]}.{near or ' Give one of its folders.'}"
        )
    return [path for path in found if names is None or path.resolve().name in names]


def check_scene(scene: Path, settings: PathSettings, *, views: int, side: int) -> SceneReport:
    """Checks one scene.

    Args:
      scene: folder of the scene.
      settings: path settings.
      views: number of test views to compare, evenly spaced.
      side: rays along each edge of a pixel.
    """
    name = scene.resolve().name
    findings = checks.check_files(scene) or checks.check_background(scene)
    made_of, about_meshes = checks.check_meshes(scene)
    findings += about_meshes
    compared = []
    if views and made_of and not any(each.severity == "error" for each in findings):
        known = checks.read_views(scene, made_of, count=views)
        compared = [
            checks.compare_view(known, i, settings=settings, side=side)
            for i in range(len(known.indices))
        ]
    convex = "smcvx" in name.split("_")
    notes = [str(each) for each in findings if each.severity == "note"]
    notes += [
        f"{view.name}: no depth was compared: no float map, or no pixels away from edges"
        for view in compared
        if np.isnan(view.depth_share)
    ]
    if dark := checks.unknown_light(scene) if compared else []:
        notes.append(
            f"{', '.join(dark)}: opaque, and the light is unknown, so colours are not compared. "
            "Make the scene with --opaque=emitting to compare them."
        )
    failed = checks.complaints(convex, findings, compared, colours=not dark)
    return SceneReport(name, failed, notes, compared)
