"""Shows a trained run in a browser: orbit, layers, and the light paths of any pixel.

python -m experiments.view --run=runs/ball

The objects' indices of refraction, the throughput threshold and the maximum of bends can be
changed; the fields stay as trained. See `docs/viewer.md`.
"""

from __future__ import annotations

import threading
from pathlib import Path

from absl import flags
from etils import epy

from experiments.cli import app
from experiments.cli import flags as cli_flags
from experiments.cli import scenes as cli_scenes
from refref_jax.data import SceneError

with epy.lazy_imports():
    from experiments.viewer import session
    from refref_jax.render import checkpoint_io
    from refref_jax.training import run_folder

_RUN = cli_flags.run()
_STEP = cli_flags.step()
_SCENE = cli_flags.scene("The scene of the test views, if it has been moved", required=False)
_HOST = flags.DEFINE_string(
    "host", "127.0.0.1", "Address to listen on; 0.0.0.0 admits everyone who can reach this machine."
)
_PORT = flags.DEFINE_integer(
    "port", 8080, "Port; the next free one is used if it is taken.", 1, 65535
)
_HEIGHTS = flags.DEFINE_list(
    "heights",
    ["36", "90", "180"],
    "Heights of the images in pixels: while the camera moves, and of the successive refinements. "
    "Widths are 16/9 of them.",
)
_CHUNK = cli_flags.chunk()
cli_flags.allow_outside()


def main() -> None:
    """Serves a run until it is interrupted."""
    heights = read_heights(_HEIGHTS.value)
    cli_flags.check_run(Path(_RUN.value))
    cli_scenes.check(_SCENE.value)
    try:
        from experiments.viewer import server
    except ModuleNotFoundError as error:
        if error.name != "viser":
            raise
        raise ValueError("The viewer needs viser. Run pip install -e '.[viewer]'.") from error
    subject = read_subject(heights)
    running = server.serve(subject, host=_HOST.value, port=_PORT.value)
    print(f"Viewer: http://{_HOST.value}:{running.get_port()}", flush=True)
    if subject.frames is None:
        print("There are no test views, so no errors can be shown. Set the scene with --scene.")
    print("The first image takes longer, because it is compiled. Stop with Ctrl-C.", flush=True)
    try:
        threading.Event().wait()
    finally:
        running.stop()
        what = "mesh" if subject.has_paths else "splats"
        given = (f"--run={_RUN.value}", f"--what={what}", f"--out={_RUN.value}.ply")
        print(f"Next: {app.shell('export', *given)}")


def read_heights(words: list[str]) -> tuple[int, ...]:
    """Parses the heights of images.

    Raises:
      ValueError: if they are not two or more increasing numbers.
    """
    try:
        heights = tuple(int(word) for word in words)
    except ValueError:
        heights = ()
    if len(heights) < 2 or heights[0] < 1 or list(heights) != sorted(set(heights)):
        raise ValueError(
            f"--heights={','.join(words)} are not two or more increasing integers. Write as in "
            "--heights=36,90,180."
        )
    return heights


app.check(_HEIGHTS, read_heights)


def read_subject(heights: tuple[int, ...]) -> session.Subject:
    """Reads the run, and its scene if it exists."""
    run = Path(_RUN.value)
    config = run_folder.read_config(run)
    scene = _scene(config.scene.path)
    model = checkpoint_io.load_model(run, step=_STEP.value)
    return session.Subject(
        name=run.resolve().name,
        model=model,
        rule=config.scene.rule or "nested",
        frames=None if scene is None else session.read_test_views(scene),
        parts=session.part_names(scene, len(model.scene.interfaces.index_inside)),
        heights=heights,
        chunk=_CHUNK.value,
    )


def _scene(trained_on: str) -> Path | None:
    if _SCENE.value is not None:
        return cli_scenes.opened(_SCENE.value)
    try:
        return cli_scenes.opened(trained_on)
    except (SceneError, OSError) as error:
        print(f"warning: the scene of the run cannot be read: {error}")
        return None


if __name__ == "__main__":
    app.run(main, again="repeat the command to show the run again; nothing is written.")
