"""Recommends options of a backdrop for a time limit, from a trial of seconds on this machine.

No table is needed: what a backdrop costs follows from the time of tracing a view, of an iteration
and of a rendered ray (`try_out`), and what its options gain hardly depends on the scene, so that
`settings` lists few of them, from the cheapest to the best. Its resolution is that of the images:
a cell is as wide as the footprint of a pixel.
"""

import dataclasses
import functools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import jax
import numpy as np

from experiments.cli import app
from refref_jax import choices
from refref_jax.data import scene_folder, scene_names
from refref_jax.geometry.cameras import Cameras
from refref_jax.optics.media import Scene
from refref_jax.render import images as image_rendering
from refref_jax.render import model
from refref_jax.render.model import Model, Params
from refref_jax.training import backdrop_equations, backdrop_solver, evaluation, presets
from refref_jax.training.backdrop_equations import Block
from refref_jax.training.resolve import Resolved

# Pixels to trace in a trial, and the fewest and most views that they are spread over.
_PIXELS, _FEWEST, _MOST = 400_000, 4, 8

# Rays per pixel of the image that is rendered.
_TRIED_RAYS = 4

# Resolutions are multiples of the first number, so that the pyramid has many levels.
_MULTIPLE, _FINEST = 64, 4096

_Result = TypeVar("_Result")


@dataclasses.dataclass(frozen=True)
class Trial:
    """Times of a scene's backdrop on this machine, in seconds.

    Attributes:
      startup: starting a command, and reading and checking the scene.
      compiling: compiling a training.
      view: tracing the pixels of one training view.
      iteration: share of one training view in an iteration of the solver.
      grid: remaining time of an iteration, at `resolution`; it grows with the number of cells.
      image: rendering an image with one ray per pixel.
      views: number of training views.
      images: number of images that an evaluation renders.
      resolution: resolution at which a cell is as wide as a pixel.
    """

    startup: float
    compiling: float
    view: float
    iteration: float
    grid: float
    image: float
    views: int
    images: int
    resolution: int


class Setting(NamedTuple):
    """Options of a backdrop, and of its evaluation; see `FieldConfig`."""

    backdrop_resolution: int
    iterations: int
    rays_per_pixel: int

    def words(self) -> str:
        """Returns the options in words."""
        rays = f"{self.rays_per_pixel} ray{'s' if self.rays_per_pixel > 1 else ''} per pixel"
        return f"{self.backdrop_resolution} cells per side, {self.iterations} iterations, {rays}"


class Choice(NamedTuple):
    """The recommended setting, and those beside it, if there are any."""

    best: Setting
    cheaper: Setting | None
    dearer: Setting | None


def try_out(resolved: Resolved, scene: Scene, *, startup: float, images: int) -> Trial:
    """Traces some views, takes some iterations and renders an image, and times them.

    Iterations on half of the views tell what an iteration takes without any.

    Args:
      resolved: complete configuration of a run with a backdrop.
      scene: surfaces and interfaces of the objects.
      startup: seconds that the command has taken up to here.
      images: number of images that an evaluation renders.
    """
    frames = scene_folder.read_frames(Path(resolved.config.scene.path), "train")
    cameras, count = frames.cameras, len(frames.names)
    pixels = cameras.width * cameras.height
    some = evaluation.spread(count, min(count, max(_FEWEST, min(_MOST, _PIXELS // pixels))))
    photographs = scene_folder.read_images(
        frames._replace(images=tuple(frames.images[i] for i in some))
    )
    half = max(1, len(some) // 2)
    trace = functools.partial(_trace, resolved, scene, cameras._replace(poses=cameras.poses[some]))
    rough = presets.BACKDROP_RESOLUTION
    resolution = resolution_of(trace(photographs[:half], rough), rough)
    first, fewer = _timed(lambda: trace(photographs[:half], resolution))
    tracing, blocks = _timed(lambda: trace(photographs, resolution))
    compiling, pace, solved = _solve(resolved, blocks, resolution)
    each = pace / len(some)
    if half < len(some):
        more = pace - _solve(resolved, fewer, resolution)[1]
        each = min(each, max(0.0, more) / (len(some) - half))
    built = Model(_with_resolution(resolved, resolution), resolved.model.settings, scene, solved)
    return Trial(
        startup=startup,
        compiling=max(0.0, first - tracing * half / len(some)) + compiling,
        view=tracing / len(some),
        iteration=each,
        grid=pace - each * len(some),
        image=_rendering(built, cameras),
        views=count,
        images=images,
        resolution=resolution,
    )


def resolution_of(blocks: Sequence[Block], resolution: int) -> int:
    """Returns the resolution at which a cell is as wide as the median footprint of a pixel.

    Args:
      blocks: equations of some views.
      resolution: resolution of these equations.
    """
    widths = []
    for block in blocks:
        taps, sides = np.asarray(block.lookups.taps), np.asarray(block.lookups.sides)
        axes = np.asarray(block.lookups.steps) * (taps * (resolution / sides)[:, None])[..., None]
        widths.append(np.sqrt(np.max(np.sum(np.square(axes), axis=-1), axis=-1)))
    cells = resolution / max(float(np.median(np.concatenate(widths))), resolution / _FINEST)
    return min(_FINEST, max(_MULTIPLE, _MULTIPLE * math.ceil(cells / _MULTIPLE)))


def settings(resolution: int) -> tuple[Setting, ...]:
    """Returns the settings to choose from, from the cheapest to the best.

    Args:
      resolution: resolution of the images' detail.
    """
    half = max(_MULTIPLE, resolution // 2 // _MULTIPLE * _MULTIPLE)
    round_, most = backdrop_solver.ROUND, presets.BACKDROP_ITERATIONS
    rungs = (
        Setting(half, round_, 1),
        Setting(resolution, round_, 1),
        Setting(resolution, round_, 4),
        Setting(resolution, 2 * round_, 4),
        Setting(resolution, 2 * round_, 9),
        Setting(resolution, most, 9),
    )
    return tuple(dict.fromkeys(rungs))


def seconds_of(setting: Setting, trial: Trial) -> tuple[float, float]:
    """Returns the expected seconds of training and of evaluation; the solver may end earlier."""
    grid = trial.grid * (setting.backdrop_resolution / trial.resolution) ** 2
    solving = setting.iterations * (trial.views * trial.iteration + grid)
    training = trial.startup + trial.compiling + trial.views * trial.view + solving
    return training, trial.startup + trial.images * setting.rays_per_pixel * trial.image


def choose(trial: Trial, seconds: float) -> Choice:
    """Returns the best setting in a time limit, and those beside it.

    Raises:
      ValueError: if no setting fits the limit.
    """
    ladder = settings(trial.resolution)
    costs = [sum(seconds_of(setting, trial)) for setting in ladder]
    fitting = [i for i, cost in enumerate(costs) if cost <= seconds]
    if not fitting:
        raise ValueError(
            f"No setting takes less than {costs[0] / 60:.1f} minutes here ({ladder[0].words()}). "
            "Give more time."
        )
    best = fitting[-1]
    return Choice(
        best=ladder[best],
        cheaper=ladder[best - 1] if best else None,
        dearer=ladder[best + 1] if best + 1 < len(ladder) else None,
    )


def describe(choice: Choice, trial: Trial, scene: Path) -> list[str]:
    """Returns the recommendation, line by line."""
    cells, views = trial.resolution, trial.views * trial.iteration
    lines = [
        f"Here an iteration takes {views + trial.grid:.2f} s at {cells} cells per side, which are "
        f"as wide as a pixel; tracing all {trial.views} views {trial.views * trial.view:.1f} s; "
        f"an image {trial.image:.2f} s per ray of a pixel; startup and compilation "
        f"{trial.startup + trial.compiling:.0f} s.",
        "",
        f"Use {choice.best.words()}: {_expected(choice.best, trial)}.",
        *_commands(choice.best, scene),
        "",
    ]
    for label, setting in (("Cheaper", choice.cheaper), ("Dearer", choice.dearer)):
        if setting is not None:
            lines.append(f"{label}: {setting.words()}: {_expected(setting, trial)}.")
            lines.append(f"  {' '.join((*_training(setting), *_rendering_options(setting)))}")
    if choice.dearer is None:
        lines.append("Dearer: more cells or iterations hardly gain anything.")
    return lines


def _expected(setting: Setting, trial: Trial) -> str:
    training, evaluating = seconds_of(setting, trial)
    return (
        f"about {(training + evaluating) / 60:.1f} minutes ({training:.0f} s of training, "
        f"{evaluating:.0f} s for {trial.images} test images)"
    )


def _training(setting: Setting) -> Iterator[str]:
    yield "--far_field=backdrop"
    yield f"--backdrop_resolution={setting.backdrop_resolution}"
    yield f"--iterations={setting.iterations}"


def _rendering_options(setting: Setting) -> Iterator[str]:
    yield f"--rays_per_pixel={setting.rays_per_pixel}"


def _commands(setting: Setting, scene: Path) -> list[str]:
    run = f"runs/{scene_names.of_folder(scene)}"
    train = app.shell("train", f"--scene={scene}", f"--out={run}", *_training(setting))
    options = ("--split=test", *_rendering_options(setting))
    return [f"  {train}", f"  {app.shell('evaluate', f'--run={run}', *options)}"]


def _with_resolution(resolved: Resolved, resolution: int) -> model.ModelConfig:
    config = resolved.model.config
    assert config.backdrop is not None
    backdrop = dataclasses.replace(config.backdrop, resolution=resolution)
    return dataclasses.replace(config, backdrop=backdrop)


def _trace(
    resolved: Resolved, scene: Scene, cameras: Cameras, photographs: np.ndarray, resolution: int
) -> tuple[Block, ...]:
    """Returns the equations of the first views, as many as there are photographs."""
    config, settings_ = resolved.model.config, resolved.model.settings
    assert config.backdrop is not None
    blocks = backdrop_equations.read(
        scene,
        cameras._replace(poses=cameras.poses[: len(photographs)]),
        photographs,
        settings=settings_,
        domain=config.domain,
        resolution=resolution,
        most_taps=config.backdrop.most_taps,
        tally=model.path_detail(config, settings_).tally,
    )
    return jax.block_until_ready(blocks)


def _solve(
    resolved: Resolved, blocks: Sequence[Block], resolution: int
) -> tuple[float, float, Params]:
    """Returns the seconds of compiling, those of an iteration, and the solution.

    There are two rounds of iterations, since tints are fitted in all but the first.
    """
    config = _with_resolution(resolved, resolution)
    params = model.init_params(jax.random.key(0), config)

    def solve() -> Params:
        *_, last = backdrop_solver.solve(
            blocks,
            space=config.domain.space,
            resolution=resolution,
            iterations=2 * backdrop_solver.ROUND,
            tints=params.tints,
            tint_decay=resolved.config.losses.tint_decay,
            thinned_rounds=0,
        )
        return Params((), jax.block_until_ready(last.pyramid), last.tints)

    first, _ = _timed(solve)
    again, solved = _timed(solve)
    return max(0.0, first - again), again / (2 * backdrop_solver.ROUND), solved


def _rendering(built: Model, cameras: Cameras) -> float:
    """Returns the seconds of rendering a view with one ray per pixel."""

    def render() -> None:
        image_rendering.render_camera(built, cameras, 0, rays_per_pixel=_TRIED_RAYS)

    _timed(render)
    return _timed(render)[0] / choices.side_of(_TRIED_RAYS) ** 2


def _timed(function: Callable[[], _Result]) -> tuple[float, _Result]:
    begun = time.monotonic()
    result = function()
    return time.monotonic() - begun, result
