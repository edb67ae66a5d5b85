"""Imports captures of nerfstudio, COLMAP and others as scenes, and writes scenes for nerfstudio.

python -m experiments.import_capture --source=CAPTURE --out=SCENE
python -m experiments.import_capture --source=MODEL --images=PHOTOS --mask_folder=MASKS --out=SCENE
python -m experiments.import_capture --source=SCENE --out=CAPTURE --to=nerfstudio

A capture is a folder with transforms.json, or with the model of COLMAP. Distorted lenses, different
sizes and focal lengths are resampled into one pinhole per split. The object is moved to the origin
and scaled. `docs/data_formats.md` describes the steps. Nothing is overwritten.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from absl import flags
from etils import epy

from experiments.cli import app
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from experiments.cli.progress import ProgressBar
from refref_jax.data import FARTHEST, SceneError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from experiments.captures.capture import Capture
    from experiments.captures.scenes import Layout, Written
    from experiments.captures.world import Ball, Placement

with epy.lazy_imports():
    import numpy as np

    from experiments.captures import capture as captures
    from experiments.captures import colmap, export, nerfstudio, scenes, world
    from refref_jax.data import meshes as mesh_files
    from refref_jax.reconstruct.masks import REACH

_SOURCE = flags.DEFINE_string("source", None, "Folder or transforms.json to import.", required=True)
_OUT = cli_flags.out("Folder to write, which must not exist.")
_TO = flags.DEFINE_enum("to", "scene", ["scene", "nerfstudio"], "Format to write.")
_IMAGES = flags.DEFINE_string(
    "images", None, "Folder of the photographs of a COLMAP model; by default images/ beside it."
)
_MASKS = flags.DEFINE_enum(
    "masks",
    "object",
    ["object", "background", "none"],
    "Meaning of white in masks: the object, or all but the object; none drops them. nerfstudio "
    "ignores black pixels.",
)
_MASK_FOLDER = flags.DEFINE_string(
    "mask_folder", None, "Folder of masks that are named like the photographs, with ending .png."
)
_MESHES = flags.DEFINE_string(
    "meshes", None, "Folder of PLY files of the object in the world of the capture, moved with it."
)
_TEST_EVERY = flags.DEFINE_integer(
    "test_every", 8, "Every n-th image is a test image, if the capture has no lists.", 2
)
_WIDTH = flags.DEFINE_integer(
    "width", None, "Width of the images, pixels; by default they keep their focal length.", 8
)
_RESAMPLE = flags.DEFINE_enum(
    "resample",
    "auto",
    ["auto", "never"],
    "Where photographs are not those of one pinhole: resample them, or only crop them, which "
    "refuses distortion and leaves errors of up to half a pixel.",
)
_WORLD = flags.DEFINE_enum(
    "world",
    "file",
    ["file", "original"],
    "Frame of the poses: that of the file, or that before its applied_transform (as in COLMAP).",
)
_CENTRE = flags.DEFINE_string(
    "centre",
    "auto",
    "New origin: x,y,z; meshes, masks, or axes (where the optical axes meet); auto for the first "
    "of these three that there is.",
)
_SCALE = flags.DEFINE_string(
    "scale",
    "auto",
    "Factor of all lengths; object (its radius becomes 1.5); cameras (their mean distance to the "
    "origin becomes 4); auto for object if meshes or masks show it.",
)
_UP = flags.DEFINE_enum(
    "up",
    "auto",
    ["auto", "cameras", "keep"],
    "What becomes +z: the mean upward direction of the cameras, or z; auto turns COLMAP's only.",
)
cli_flags.allow_outside()


def main() -> None:
    """Imports or exports one folder."""
    if not _SOURCE.value.endswith(".json"):
        cli_scenes.check_place(_SOURCE.value)
    if _TO.value == "scene":
        _make_scene(Path(_SOURCE.value), Path(_OUT.value))
    else:
        _make_capture(Path(_SOURCE.value), Path(_OUT.value))


def _make_scene(source: Path, out: Path) -> None:
    scenes.refuse_existing(out)
    capture, lacking, is_colmap = _read(source)
    poses = _poses(capture)
    splits = capture.splits or captures.every_nth(len(capture.frames), every=_TEST_EVERY.value)
    layouts = {
        split: scenes.find_layout(
            [capture.frames[number] for number in numbers],
            width=_WIDTH.value,
            resample=_RESAMPLE.value == "auto",
        )
        for split, numbers in splits.items()
    }
    split_poses = {
        split: scenes.turned_poses(layout, poses[list(splits[split])])
        for split, layout in layouts.items()
    }
    given = {} if _MESHES.value is None else scenes.read_meshes(Path(_MESHES.value))
    ball, seen_by = _object(given, layouts["train"], split_poses["train"])
    where = _placement(ball, poses, is_colmap)
    content = _content(capture, source, where, given)
    placed = {split: world.place(each, where) for split, each in split_poses.items()}
    _check_placed(placed.values())
    total = sum(len(each) for each in splits.values())
    with ProgressBar("import", total) as bar:
        steps = iter(range(1, total + 1))
        written = scenes.write_scene(
            layouts,
            placed,
            out,
            content,
            _MASKS.value,
            step=lambda: bar.show(next(steps), "images"),
        )
    _tell_splits(layouts, written)
    _tell_masks(written, lacking, layouts["train"], seen_by)
    _tell_left_out(capture, len(capture.frames) - total)
    _tell_placement(np.concatenate(list(placed.values())), where, ball)
    for name in given:
        if mesh_files.material_of(Path(name)) is None:
            print(f"warning: {name} ends on no material. Rename it, or give it an index by --ior.")
    print(f"Scene:   {out}")
    masked = bool(written["train"].masked)
    run = ("reconstruct" if masked and not given else "train", f"--scene={out}")
    print(f"Next: {app.shell(*run, f'--out={out}_run')}")


def _check_placed(poses: Iterable[np.ndarray]) -> None:
    """Rejects a placement that leaves the cameras at one place, or too far away for a scene."""
    positions = np.concatenate([each[:, :, 3] for each in poses])
    furthest = float(np.max(np.abs(positions)))
    if not furthest <= FARTHEST:
        raise SceneError(
            f"--centre and --scale put a camera {furthest:.3g} units from the origin, beyond "
            f"{FARTHEST:g}. Give others."
        )
    if len(positions) > 1 and not np.ptp(positions, axis=0).max() > 1.0 / FARTHEST:
        raise SceneError(
            "All cameras are at one place, or --centre and --scale put them there. Give others."
        )


def _content(
    capture: Capture,
    source: Path,
    where: Placement,
    given: Mapping[str, tuple[np.ndarray, np.ndarray]],
) -> scenes.Content:
    return scenes.Content(
        properties={"version": 1, "background": {"type": "env"}},
        record={"source": source.name, "world": where.record(), "frame": _WORLD.value},
        meshes={name: (world.move(v, where), f) for name, (v, f) in given.items()},
        points=_moved_points(capture, where),
    )


def _read(source: Path) -> tuple[Capture, tuple[str, ...], bool]:
    """Returns a capture, the frames without a mask, and whether its world is COLMAP's own."""
    model = None
    if not (source.suffix == ".json" or (source / nerfstudio.FILE).is_file()):
        model = colmap.find_model(source)
    if model is None:
        if _IMAGES.value is not None:
            raise SceneError(
                f"--images is for a model of COLMAP, but {source} has none (cameras.txt or .bin). "
                "transforms.json names its images: leave it out."
            )
        capture = nerfstudio.read_capture(source)
    else:
        capture = colmap.read_capture(model, _image_folder(source, model))
        if others := colmap.other_models(model):
            print(
                f"warning: {model} is read, with {len(capture.frames)} images, but not "
                f"{', '.join(str(other) for other in others)}. Each has its own world; --source "
                "takes another, with --images."
            )
    if _MASKS.value == "none":
        return capture, (), model is not None
    if _MASK_FOLDER.value is not None:
        folder = Path(_MASK_FOLDER.value)
        if not folder.is_dir():
            raise SceneError(f"{folder} is not a folder. Give the folder of the masks.")
        capture = captures.with_masks(capture, folder)
    return *captures.masked_frames(capture), model is not None


def _image_folder(source: Path, model: Path) -> Path:
    if _IMAGES.value is not None:
        if not Path(_IMAGES.value).is_dir():
            raise SceneError(f"{_IMAGES.value} is not a folder. Give that of the photographs.")
        return Path(_IMAGES.value)
    places = [each / "images" for each in (source, model, *model.resolve().parents[:2])]
    found = next((place for place in places if place.is_dir()), None)
    if found is None:
        raise SceneError(f"{places[0]} does not exist. Give the folder of the images: --images.")
    return found


def _poses(capture: Capture) -> np.ndarray:
    poses = np.stack([frame.pose for frame in capture.frames])
    if _WORLD.value == "original":
        return world.undo_motion(poses, capture.applied, capture.applied_scale)
    return poses


def _object(
    given: Mapping[str, tuple[np.ndarray, np.ndarray]], layout: Layout, poses: np.ndarray
) -> tuple[Ball | None, np.ndarray | None]:
    """Returns the ball around the object, if known, and which training views have it in view."""
    asked = read_centre(_CENTRE.value)
    masked = _MASKS.value != "none" and any(each.mask is not None for each in layout.photographs)
    if asked == "meshes" and not given:
        raise SceneError("--centre=meshes, but there are no meshes. Give their folder: --meshes.")
    if asked == "masks" and not masked:
        raise SceneError("--centre=masks, but the capture has no masks. Give --mask_folder.")
    if given and asked != "masks":
        return world.ball_of_points(np.concatenate([v for v, _ in given.values()])), None
    if not masked or asked == "axes" or (isinstance(asked, list) and _SCALE.value != "object"):
        return None, None
    masks, cameras = scenes.coarse_masks(layout, poses, _MASKS.value)
    if not masks.any() and asked == "auto":
        return None, None
    ball = world.ball_of_masks(masks, cameras)
    return ball, world.sees(ball, cameras)


def _placement(ball: Ball | None, poses: np.ndarray, is_colmap: bool) -> Placement:
    asked, scale = read_centre(_CENTRE.value), read_scale(_SCALE.value)
    if isinstance(asked, list):
        centre = np.array(asked)
    else:
        known = ball is not None and asked != "axes"
        centre = ball.centre if known else world.meeting_point(poses)
    if scale == "object" and ball is None:
        raise SceneError("--scale=object, but neither meshes nor masks show it. Give a number.")
    if scale == "object" or (scale == "auto" and ball is not None):
        scale = world.OBJECT_RADIUS / ball.radius
    elif not isinstance(scale, float):
        distance = np.linalg.norm(poses[:, :, 3] - centre, axis=-1).mean()
        if distance == 0.0:
            raise SceneError("All cameras are in the centre. Give --scale a number.")
        scale = float(world.USUAL_DISTANCE / distance)
    turn = _UP.value == "cameras" or (_UP.value == "auto" and is_colmap)
    return world.Placement(centre, scale, world.upright(poses) if turn else np.eye(3))


def _moved_points(capture: Capture, where: Placement) -> captures.PointCloud | None:
    points = capture.points
    if points is None:
        return None
    positions = points.positions
    if _WORLD.value == "original":
        as_poses = np.concatenate(
            [np.broadcast_to(np.eye(3), (len(positions), 3, 3)), positions[..., None]], axis=-1
        )
        positions = world.undo_motion(as_poses, capture.applied, capture.applied_scale)[..., 3]
    return points._replace(positions=world.move(positions, where))


def _make_capture(source: Path, out: Path) -> None:
    splits = export.read_splits(source)
    total = sum(len(frames.names) for frames in splits.values())
    with ProgressBar("export", total) as bar:
        steps = iter(range(1, total + 1))
        export.write_capture(
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


def read_centre(word: str) -> list[float] | str:
    """Parses the value of --centre.

    Raises:
      ValueError: if it is neither a point nor one of the words.
    """
    if word in ("auto", "meshes", "masks", "axes"):
        return word
    centre = [_number("centre", each) for each in word.split(",")]
    if len(centre) != 3:
        raise ValueError(f"--centre is {word}. Give x,y,z, as in 0,0.5,1, or auto.")
    return centre


def read_scale(word: str) -> float | str:
    """Parses the value of --scale.

    Raises:
      ValueError: if it is neither positive nor one of the words.
    """
    if word in ("auto", "object", "cameras"):
        return word
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


def _tell_splits(layouts: Mapping[str, Layout], written: Mapping[str, Written]) -> None:
    for split, layout in layouts.items():
        width, height, focal = layout.pinhole
        how = "resampled" if not layout.exact else "copied" if layout.crop is None else "cropped"
        print(
            f"{split}: {len(layout.frames)} images of {width} x {height}, {how}, focal length "
            f"{focal:.6g}"
        )
        if layout.kept.min() < 1.0 - 1e-6:
            print(
                f"{split}: {100 * layout.kept.mean():.0f} % of the photographs' pixels are kept on "
                f"average, at least {100 * layout.kept.min():.0f} %; {layout.narrowest} limits the "
                "field of view"
            )
        if crop := layout.crop:
            off = max(crop.columns.shift, crop.rows.shift) + crop.stretch
            if off:
                print(f"{split}: pixels are displaced by up to {off:.2f}, see docs/data_formats.md")
        if turned := sum(frame.turned for frame in layout.frames):
            print(f"{split}: {turned} images of the other format are turned by 90 degrees")
        if (share := written[split].masked) is not None:
            print(f"{split}: masks mark {100 * share:.1f} % of the pixels as object")


def _tell_masks(
    written: Mapping[str, Written],
    lacking: tuple[str, ...],
    layout: Layout,
    seen_by: np.ndarray | None,
) -> None:
    if lacking:
        print(
            f"Left out: {len(lacking)} photographs without a mask, such as {lacking[0]}. Give each "
            "one a mask to keep it, black where the object is not in view."
        )
    for split, done in written.items():
        if done.empty:
            print(
                f"{split}: {len(done.empty)} masks mark no object, such as that of "
                f"{done.empty[0]}: R3F leaves out these views"
            )
    names = [frame.name for frame in layout.frames]
    seen = np.zeros(len(names), bool) if seen_by is None else seen_by
    masked = len(names) - len(written["train"].empty)
    if seen_by is not None and masked < world.FEW_VIEWS:
        print(
            f"warning: {masked} masks hardly determine where the object is: compare its radius "
            "with what you know, or give --centre and --scale."
        )
    doubtful = [name for name in np.array(names)[seen] if name in written["train"].empty]
    if doubtful:
        print(
            f"warning: {len(doubtful)} training views without a marked pixel look at the object, "
            f"such as {doubtful[0]}. Where they show it, mark it, or leave them out."
        )


def _tell_left_out(capture: Capture, unlisted: int) -> None:
    if capture.missing:
        shown = ", ".join(capture.missing[:3]) + (", ..." if len(capture.missing) > 3 else "")
        print(f"warning: {len(capture.missing)} photographs do not exist and are left out: {shown}")
    if unlisted:
        print(f"Skipped: {unlisted} frames that are not in the capture's lists.")
    if capture.has_depth:
        print("Skipped: depth maps, which are only useful for evaluation.")
    if "test" not in (capture.splits or {"test": ()}):
        print("warning: there are no test images, so the test split cannot be evaluated.")


def _tell_placement(poses: np.ndarray, where: Placement, ball: Ball | None) -> None:
    centre = ",".join(f"{value:.6g}" for value in where.centre)
    turn = "" if np.array_equal(where.rotation, np.eye(3)) else " rotation"
    print(f"World: x -> {where.scale:.6g}{turn} (x - ({centre})), see {scenes.RECORD}")
    distances = np.linalg.norm(poses[:, :, 3], axis=-1)
    print(f"Cameras: {distances.min():.3g} to {distances.max():.3g} from the origin")
    if ball is not None:
        middle = np.linalg.norm(world.move(ball.centre, where))
        print(f"Object:  radius {where.scale * ball.radius:.3g}, {middle:.3g} from the origin")
    else:
        print(
            f"R3F searches for the object within {REACH} units of the origin along "
            "each axis: use --centre and --scale if it is elsewhere."
        )


app.check(_CENTRE, read_centre)
app.check(_SCALE, read_scale)


if __name__ == "__main__":
    app.run(main, again="an imported folder is never replaced.")
