"""Converts nerfstudio's captures (transforms.json) to scenes, and scenes to captures.

python -m experiments.convert_nerfstudio --source=CAPTURE --out=SCENE --centre=auto --scale=auto
python -m experiments.convert_nerfstudio --source=SCENE --out=CAPTURE --to=nerfstudio

COLMAP captures are converted in the same way after nerfstudio's ns-process-data.
`docs/data_formats.md` describes the steps, and which parts of a capture a scene supports. Nothing
is overwritten.
"""

from __future__ import annotations

import math
from pathlib import Path

from absl import flags
from etils import epy

from experiments.cli import app
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from experiments.cli.progress import ProgressBar

with epy.lazy_imports():
    import numpy as np

    from experiments.captures import conversion, nerfstudio
    from experiments.captures import conversion as from_nerfstudio
    from experiments.captures import conversion as to_nerfstudio
    from refref_jax.reconstruct import visual_hull

_SOURCE = flags.DEFINE_string("source", None, "Folder to convert.", required=True)
_OUT = cli_flags.out("Folder to write, which must not exist.")
_TO = flags.DEFINE_enum("to", "scene", ["scene", "nerfstudio"], "Format to write.")
_MASKS = flags.DEFINE_enum(
    "masks",
    "object",
    ["object", "background", "none"],
    "Meaning of white in nerfstudio's masks: the object, or all but the object; none drops them. "
    "nerfstudio ignores black pixels.",
)
_TEST_EVERY = flags.DEFINE_integer(
    "test_every", 8, "Every n-th image is a test image, if the capture has no lists.", 2
)
_WORLD = flags.DEFINE_enum(
    "world",
    "file",
    ["file", "original"],
    "Frame of the poses: that of the file, or that before its applied_transform (as in COLMAP).",
)
_CENTRE = flags.DEFINE_string(
    "centre", "0,0,0", "New origin: x,y,z, or auto for the point where the optical axes meet."
)
_SCALE = flags.DEFINE_string(
    "scale", "1", "Factor of all lengths, or auto: mean distance of the cameras to the origin is 4."
)
cli_flags.allow_outside()


def main() -> None:
    """Converts one folder."""
    cli_scenes.check_place(_SOURCE.value)
    if _TO.value == "scene":
        _make_scene(Path(_SOURCE.value), Path(_OUT.value))
    else:
        _make_capture(Path(_SOURCE.value), Path(_OUT.value))


def _make_scene(source: Path, out: Path) -> None:
    capture = nerfstudio.read_capture(source)
    poses = from_nerfstudio.positions(capture, original=_WORLD.value == "original")
    where = _chosen_placement(poses)
    poses = conversion.place(poses, where)
    splits = capture.splits or nerfstudio.every_nth(len(capture.frames), every=_TEST_EVERY.value)
    views = {
        split: [from_nerfstudio.View(capture.frames[number], poses[number]) for number in numbers]
        for split, numbers in splits.items()
    }
    total = sum(map(len, views.values()))
    with ProgressBar("convert", total) as bar:
        steps = iter(range(1, total + 1))
        written = from_nerfstudio.write_scene(
            views, out, _MASKS.value, step=lambda: bar.show(next(steps), "images")
        )
    listed = {number for numbers in splits.values() for number in numbers}
    _tell_splits(written)
    _tell_left_out(capture, len(capture.frames) - len(listed))
    _tell_placement(poses, where)
    print(f"Scene:   {out}")
    masked = next(iter(written.values())).masked is not None
    run = ("reconstruct" if masked else "train", f"--scene={out}")
    print(f"Next: {app.shell(*run, '--background=unbounded', f'--out={out}_run')}")


def _make_capture(source: Path, out: Path) -> None:
    splits = to_nerfstudio.read_splits(source)
    total = sum(len(frames.names) for frames in splits.values())
    with ProgressBar("convert", total) as bar:
        steps = iter(range(1, total + 1))
        to_nerfstudio.write_capture(
            splits, out, _MASKS.value, step=lambda: bar.show(next(steps), "images")
        )
    for split, frames in splits.items():
        print(f"{split}: {len(frames.names)} images")
    if _MASKS.value != "none" and splits["train"].masks is not None:
        kept = "the object only" if _MASKS.value == "object" else "all but the object"
        print(f"Masks: nerfstudio will train on {kept}; --masks=none for whole images.")
    print("Skipped: depth, meshes and scene.json, which the format does not support.")
    print(f"Capture: {out}")
    print(f"Next: ns-train nerfacto --data {out}")


def _chosen_placement(poses: np.ndarray) -> conversion.Placement:
    given = read_centre(_CENTRE.value)
    centre = conversion.meeting_point(poses) if given is None else np.array(given)
    scale = read_scale(_SCALE.value)
    if scale is None:
        distance = np.linalg.norm(poses[:, :, 3] - centre, axis=-1).mean()
        if distance == 0.0:
            raise ValueError("All cameras are in the centre. Give --scale a number.")
        return conversion.Placement(centre, conversion.USUAL_DISTANCE / distance)
    return conversion.Placement(centre, scale)


def read_centre(word: str) -> list[float] | None:
    """Parses the value of --centre; `None` for auto.

    Raises:
      ValueError: if it is not a point.
    """
    if word == "auto":
        return None
    centre = [_number("centre", each) for each in word.split(",")]
    if len(centre) != 3:
        raise ValueError(f"--centre is {word}. Give x,y,z, as in 0,0.5,1, or auto.")
    return centre


def read_scale(word: str) -> float | None:
    """Parses the value of --scale; `None` for auto.

    Raises:
      ValueError: if it is not positive.
    """
    if word == "auto":
        return None
    scale = _number("scale", word)
    if not scale > 0.0:
        raise ValueError(f"--scale is {scale:g}. Give a positive number, or auto.")
    return scale


def _number(flag: str, word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"--{flag} has {word!r}, which is not a finite number. Give one, or auto.")
    return value


def _tell_splits(written: dict[str, from_nerfstudio.Converted]) -> None:
    for split, done in written.items():
        columns, rows, _, stretch = done.lens
        size, before = f"{columns.size} x {rows.size}", f"{done.before[0]} x {done.before[1]}"
        cut = "" if size == before else f", cropped from {before} around the principal point"
        print(f"{split}: {done.frames} images of {size}{cut}")
        if off := max(columns.shift, rows.shift) + stretch:
            print(f"{split}: pixels are displaced by up to {off:.2f}, see docs/data_formats.md")
        if done.masked is not None:
            print(f"{split}: masks mark {100 * done.masked:.1f} % of the pixels as object")


def _tell_left_out(capture: nerfstudio.Capture, unlisted: int) -> None:
    if unlisted:
        print(f"Skipped: {unlisted} frames that are not in the capture's lists.")
    if capture.has_depth:
        print("Skipped: depth maps, which are only useful for evaluation.")
    if "test" not in (capture.splits or {"test": ()}):
        print("warning: there are no test images, so the test split cannot be evaluated.")


def _tell_placement(poses: np.ndarray, where: conversion.Placement) -> None:
    centre = ",".join(f"{value:.6g}" for value in where.centre)
    print(f"World: x -> {where.scale:.6g} (x - ({centre})), which applies to meshes too")
    distances = np.linalg.norm(poses[:, :, 3], axis=-1)
    print(f"Cameras: {distances.min():.3g} to {distances.max():.3g} from the origin")
    if where.scale == 1.0 and not where.centre.any():
        print(
            f"R3F searches for the object within {visual_hull.REACH} units of the origin along "
            "each axis: use --centre and --scale to move it there."
        )


app.check(_CENTRE, read_centre)
app.check(_SCALE, read_scale)


if __name__ == "__main__":
    app.run(main, again="a converted folder is never replaced.")
