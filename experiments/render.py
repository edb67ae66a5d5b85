"""Renders the views of a split, or an orbit, as pictures, distance maps and videos.

python -m experiments.render --run=runs/ball --views=orbit --frames=60
"""

import math
from pathlib import Path

from absl import flags

from experiments import commands, figures, scene_option, supersampling, videos
from refref_jax.data import files, local_layout
from refref_jax.data.cameras import Cameras, orbit
from refref_jax.render import load_model
from refref_jax.training import run_folder

_RUN = flags.DEFINE_string("run", None, "Folder of a trained run.", required=True)
_VIEWS = flags.DEFINE_enum(
    "views", "orbit", ["orbit", *local_layout.SPLITS], "Cameras: an orbit, or those of a split."
)
_STEP = flags.DEFINE_integer("step", None, "Checkpoint to use; the newest if not given.", 0)
_SCENE = flags.DEFINE_string("scene", None, f"The scene, if it has moved: {scene_option.FORMS}.")
_OUT = flags.DEFINE_string("out", None, "Where to write; {run}/render/{views} if not given.")
_FRAMES = flags.DEFINE_integer("frames", 60, "Frames of an orbit.", 1)
_SIZE = flags.DEFINE_integer("size", 200, "Width and height of an orbit's frames, pixels.", 1)
_FOV = flags.DEFINE_float("fov", 66.785, "Horizontal field of view of an orbit, degrees.", 1, 179)
_DISTANCE = flags.DEFINE_float("distance", 4.0, "Distance of an orbit from the origin.", 1e-3)
_ELEVATION = flags.DEFINE_float("elevation", 20.0, "Elevation of an orbit, degrees.", -89, 89)
_FPS = flags.DEFINE_float("fps", 15.0, "Frames a second of the videos.", 0.1)
_RAYS_PER_PIXEL = flags.DEFINE_integer(
    "rays_per_pixel", 1, "Rays in each pixel, a square: 1, 4, 9, 16. They are averaged."
)
_CHUNK = flags.DEFINE_integer("chunk", 4096, "Paths at once: lower it if memory runs out.", 1)


def main() -> None:
    """Renders the chosen cameras."""
    side, chunk = supersampling.side_of(_RAYS_PER_PIXEL.value), _CHUNK.value
    run = Path(_RUN.value)
    model = load_model(run, step=_STEP.value)
    cameras, names = _cameras(run)
    out = Path(_OUT.value) if _OUT.value else run / "render" / _VIEWS.value
    for folder in ("rgb", "distance"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    frames, distances = [], []
    with commands.ProgressBar("render", len(names)) as bar:
        for i, name in enumerate(names):
            seen = supersampling.render_view(model, cameras, i, side=side, chunk=chunk)
            files.write_rgb(out / "rgb" / f"{name}.png", seen.rgb)
            files.write_exr(out / "distance" / f"{name}.exr", seen.distance)
            frames.append(files.to_bytes(seen.rgb))
            distances.append(seen.distance)
            bar.show(i + 1, name)
    coloured = figures.colour_distances(distances)
    for name, video in (("rgb", frames), ("distance", coloured)):
        for path in videos.write(out / name, video, fps=_FPS.value):
            print(f"Video: {path}")
    if not videos.has_ffmpeg():
        print(f"Videos as mp4 too: {videos.INSTALL}")
    print(f"Pictures: {out / 'rgb'}")
    print(f"Distance in world units: {out / 'distance'}")


def _cameras(run: Path) -> tuple[Cameras, tuple[str, ...]]:
    if _VIEWS.value == "orbit":
        cameras = orbit(
            _FRAMES.value,
            distance=_DISTANCE.value,
            elevation=math.radians(_ELEVATION.value),
            size=_SIZE.value,
            angle_x=math.radians(_FOV.value),
        )
        return cameras, tuple(f"r_{i:03d}" for i in range(_FRAMES.value))
    scene = scene_option.opened(_SCENE.value or run_folder.read_config(run).scene.path)
    frames = local_layout.read_frames(scene, _VIEWS.value)
    return frames.cameras, frames.names


if __name__ == "__main__":
    commands.run(main)
