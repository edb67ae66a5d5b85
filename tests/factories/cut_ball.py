"""Copies a few frames of the bundled scene."""

import json
import shutil
from pathlib import Path

from tests.processes.command import ROOT

BALL = ROOT / "experiments" / "data" / "cube_smcvx_ball"

COUNTS = {"train": 3, "val": 1, "test": 2}


def cut_ball(scene: Path) -> Path:
    """Copies the scene with the first frames of each split, and what lies beside them."""
    for split, count in COUNTS.items():
        content = json.loads((BALL / f"transforms_{split}.json").read_text())
        content["frames"] = content["frames"][:count]
        for record in content["frames"]:
            stem = record["file_path"]
            depth = record["depth_file_path"]
            for name in (f"{stem}.png", record["mask_file_path"], depth):
                _copy(BALL / name, scene / name)
            for name in (f"{stem}.exr", str(Path(depth).with_suffix(".exr"))):
                if (BALL / name).is_file():
                    _copy(BALL / name, scene / name)
        (scene / f"transforms_{split}.json").write_text(json.dumps(content))
    for name in ("meshes", "background"):
        shutil.copytree(BALL / name, scene / name)
    shutil.copyfile(BALL / "scene.json", scene / "scene.json")
    return scene


def _copy(path: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, target)
