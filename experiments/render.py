"""Renders the views of a split, or an orbit, as images, distance maps and video.

python -m experiments.render --run=runs/ball --views=orbit --frames=60
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from absl import flags
from etils import epy

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from experiments.cli.progress import ProgressBar

if TYPE_CHECKING:
    from refref_jax.render import Model

with epy.lazy_imports():
    from experiments.figures import comparison, video
    from refref_jax.data import image_files, scene_folder
    from refref_jax.geometry import cameras
    from refref_jax.render import checkpoint_io, images
    from refref_jax.training import run_folder

_RUN = cli_flags.run()
_VIEWS = flags.DEFINE_enum(
    "views", "orbit", ["orbit", *cli_flags.SPLITS], "Cameras: an orbit, or those of a split."
)
_STEP = cli_flags.step()
_SCENE = cli_flags.scene("The scene, if it has been moved", required=False)
_OUT = flags.DEFINE_string("out", None, "Folder to write; {run}/render/{views} by default.")
_FRAMES = flags.DEFINE_integer("frames", 60, "Number of frames of an orbit.", 1)
_SIZE = flags.DEFINE_integer("size", 200, "Width and height of an orbit's frames, pixels.", 1)
_FOV = flags.DEFINE_float("fov", 66.785, "Horizontal field of view of an orbit, degrees.", 1, 179)
_DISTANCE = flags.DEFINE_float("distance", 4.0, "Distance of an orbit from the centre.", 1e-3)
_ELEVATION = flags.DEFINE_float("elevation", 20.0, "Elevation of an orbit, degrees.", -89, 89)
_FPS = flags.DEFINE_float("fps", 15.0, "Frames per second of the video.", 0.1)
_RAYS_PER_PIXEL = cli_flags.rays_per_pixel(1)
_CHUNK = cli_flags.chunk()
_OVERWRITE = cli_flags.overwrite("earlier images of these views")

_WRITES = ("rgb", "distance", "rgb.gif", "rgb.mp4", "distance.gif", "distance.mp4")
cli_flags.allow_outside()


def main() -> None:
    """Renders the selected cameras."""
    run = Path(_RUN.value)
    out = Path(_OUT.value) if _OUT.value else run / "render" / _VIEWS.value
    place = {"module": __name__, "writes": _WRITES, "overwrite": _OVERWRITE.value}
    outputs.replaceable(out, **place)
    cli_flags.check_run(run)
    cli_scenes.check(_SCENE.value)
    model = checkpoint_io.load_model(run, step=_STEP.value)
    seen_by, names = _cameras(run, model)
    with outputs.fresh(out, **place) as draft:
        written = render(model, seen_by, names, draft)
    for name in written:
        print(f"Video: {out / name}")
    if not video.has_ffmpeg():
        print(f"For videos as mp4: {video.INSTALL}")
    print(f"Images: {out / 'rgb'}")
    print(f"Distance in world units: {out / 'distance'}")
    print(f"Next: {app.shell('view', f'--run={run}')}")


def render(model: Model, seen_by: cameras.Cameras, names: tuple[str, ...], out: Path) -> list[str]:
    """Renders each view, writes images and videos, and returns the names of the videos."""
    rays_per_pixel, chunk = _RAYS_PER_PIXEL.value, _CHUNK.value
    for folder in ("rgb", "distance"):
        (out / folder).mkdir()
    frames, distances = [], []
    with ProgressBar("render", len(names)) as bar:
        for i, name in enumerate(names):
            seen = images.render_camera(
                model, seen_by, i, rays_per_pixel=rays_per_pixel, chunk=chunk
            )
            image_files.write_rgb(out / "rgb" / f"{name}.png", seen.rgb)
            image_files.write_exr(out / "distance" / f"{name}.exr", seen.distance)
            frames.append(image_files.to_bytes(seen.rgb))
            distances.append(seen.distance)
            bar.show(i + 1, name)
    coloured = comparison.colour_distances(distances)
    return [
        path.name
        for name, pictures in (("rgb", frames), ("distance", coloured))
        for path in video.write(out / name, pictures, fps=_FPS.value)
    ]


def _cameras(run: Path, model: Model) -> tuple[cameras.Cameras, tuple[str, ...]]:
    if _VIEWS.value == "orbit":
        around = cameras.orbit(
            _FRAMES.value,
            distance=_DISTANCE.value,
            elevation=math.radians(_ELEVATION.value),
            size=_SIZE.value,
            angle_x=math.radians(_FOV.value),
            centre=model.config.centre,
        )
        return around, tuple(f"r_{i:03d}" for i in range(_FRAMES.value))
    scene = cli_scenes.opened(_SCENE.value or run_folder.read_config(run).scene.path)
    frames = scene_folder.read_frames(scene, _VIEWS.value)
    return frames.cameras, frames.names


if __name__ == "__main__":
    app.run(
        main,
        again="repeat the command to render again; --overwrite replaces the images.",
    )
