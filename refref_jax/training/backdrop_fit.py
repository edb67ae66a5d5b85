"""Trains the backdrop of a run: reads its images, solves, and saves rounds of iterations.

`solve` is the whole training of a model that is a backdrop. `behind_field` solves for the backdrop
of a model with a field in front of it, whose steps `fit` takes afterwards; `read_front` tells which
pixels see the field, and where masks show the object.
"""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Bool, UInt8
from scipy.ndimage import distance_transform_edt

from refref_jax import configuration
from refref_jax.choices import BallOption
from refref_jax.data import image_files, scene_folder
from refref_jax.data.scene_folder import Frames
from refref_jax.geometry import cameras as pinholes
from refref_jax.optics.media import Scene
from refref_jax.render import backdrop, pixels
from refref_jax.render.backdrop import Pyramid
from refref_jax.render.checkpoint_io import SavedModel
from refref_jax.render.model import ModelConfig, Params, init_params, path_detail, surface_of
from refref_jax.sampling.scene_bounds import OccupancyGrid
from refref_jax.training import backdrop_equations, backdrop_solver, run_folder
from refref_jax.training.backdrop_equations import Block, Gains
from refref_jax.training.config import TrainConfig, require
from refref_jax.training.loop import TrainState
from refref_jax.training.run_folder import Checkpoints

# The solver stops where the next round is expected to gain less than this, dB.
_WORTH = 0.05

# Number of values that determine the mean colour of the images.
_MOST_MEAN = 10_000_000

_Progress = Callable[[int, int, str], None]


class _SolverState(NamedTuple):
    """What continues the solver, beside the model; see `backdrop_solver.Progress`."""

    gains: Gains | None = None
    held: Pyramid | None = None

    def stored(self) -> Any:
        """Returns the state as a checkpoint stores it, like earlier versions if it is empty."""
        nothing = self.gains is None and self.held is None
        return optax.EmptyState() if nothing else self


def _solver_of(state: TrainState) -> _SolverState:
    """Returns the solver's part of a state."""
    stored = state.optimizer
    return stored if isinstance(stored, _SolverState) else _SolverState()


class Front(NamedTuple):
    """What is in front of a backdrop.

    Attributes:
      pixels: whether training pixels see more than the backdrop: an object, or a field in a ball.
      hull: hull of the masks in the ball of a field; `None` without a ball.
    """

    pixels: Bool[np.ndarray, "views h w"]
    hull: OccupancyGrid | None


class _Problem(NamedTuple):
    """A backdrop to solve for.

    Attributes:
      config: configuration of the run.
      model: static part of the model.
      scene: the scene.
      frames: training images and cameras.
      images: training images, 8-bit sRGB.
      among: mask of the pixels that are fitted; `None` if all are.
      traced: function that is called for each view that is traced, and may interrupt.
    """

    config: TrainConfig
    model: SavedModel
    scene: Scene
    frames: Frames
    images: UInt8[np.ndarray, "views h w 3"]
    among: Bool[np.ndarray, "views h w"] | None
    traced: Callable[[int, int], None]

    @property
    def share(self) -> float:
        """The share of the pixels whose equations are in memory at once."""
        return min(1.0, require(self.config.model.most_pixels) / (self.images.size // 3))

    @property
    def surface(self) -> dict[str, Any]:
        """Kind and resolution of the backdrop."""
        shape = self.model.config.backdrop
        assert shape is not None
        return {"space": self.model.config.space, "resolution": shape.resolution}

    def unsolved(self) -> TrainState:
        """Returns the state before the first iteration."""
        params = init_params(jax.random.key(0), self.model.config)
        per_image = self.config.model.exposure == "per_image"
        gains = jnp.zeros((len(self.images), 3)) if per_image else None
        held = jax.tree.map(jnp.zeros_like, surface_of(params)) if self.share < 1.0 else None
        solver = _SolverState(gains, held).stored()
        return TrainState(jnp.zeros((), jnp.int32), params, solver)

    def equations(self, draw: int) -> tuple[Block, ...]:
        """Returns the equations of all pixels, or of a share of them, drawn at random."""
        shape = self.model.config.backdrop
        assert shape is not None
        return backdrop_equations.read(
            self.scene,
            self.frames.cameras,
            self.images,
            settings=self.model.settings,
            domain=self.model.config.domain,
            resolution=shape.resolution,
            most_taps=shape.most_taps,
            axes=shape.axes,
            tally=path_detail(self.model.config, self.model.settings).tally,
            fields=self._interiors(),
            share=self.share,
            draw=draw,
            among=self.among,
            progress=self.traced,
        )

    def _write_coverage(self, run: Path, blocks: Sequence[Block], state: TrainState) -> None:
        """Writes how many pixels see each vertex, or an estimate from a share of them."""
        seen = backdrop_solver.coverage(blocks, **self.surface, tints=state.params.tints)
        run_folder.write_coverage(run, jax.device_get(seen / self.share))

    def _uniform(self) -> Pyramid:
        """Returns a surface with the mean colour of the images, or of some of many pixels."""
        shape, some = self.model.config.backdrop, self.images.reshape(-1, 3)
        assert shape is not None
        few = jnp.asarray(some[:: 1 + self.images.size // _MOST_MEAN], jnp.float32)
        mean = jnp.mean(pixels.srgb_to_linear(few / 255.0), axis=0)
        return backdrop.init(shape.resolution, radiance=mean, axes=shape.axes)

    def _interiors(self) -> tuple[int, ...]:
        """Returns the parts whose inside is a field."""
        if self.model.config.interior == "field":
            return tuple(range(self.scene.interfaces.index_inside.shape[0]))
        return self.model.config.field_parts

    def iterate(self, run: Path, state: TrainState) -> Iterator[backdrop_solver.Progress]:
        """Yields the progress of the solver from a state on; at first, the coverage is written.

        Where all pixels are in memory, it stops when another round would gain hardly anything.
        """
        step, streams = int(state.step), self.share < 1.0
        rounds = _reached(run, step)
        if not streams and _expected_gain(rounds) < _WORTH:  # it was interrupted there
            return
        with ThreadPoolExecutor(1) as beside:
            compiled = beside.submit(
                backdrop_equations.warm_up, self._uniform(), self.surface["space"]
            )
            first = [self.equations(step // backdrop_solver.ROUND if streams else 0)]
            compiled.result()
        if not step:
            self._write_coverage(run, first[0], state)

        def drawn(number: int) -> Sequence[Block]:
            return first.pop() if first else self.equations(number)

        for reached in backdrop_solver.solve(
            drawn if streams else first.pop(),
            iterations=require(self.config.model.iterations),
            start=(step, surface_of(state.params)) if step else None,
            **self.surface,
            tints=state.params.tints,
            gains=_solver_of(state).gains,
            held=_solver_of(state).held,
            uniform=self._uniform() if streams else None,
            tint_decay=self.config.losses.tint_decay,
        ):
            yield reached
            if reached.step % backdrop_solver.ROUND == 0:
                rounds.append(reached.held_out)
                if not streams and _expected_gain(rounds) < _WORTH:
                    return


def _reached(run: Path, step: int) -> list[float]:
    """Returns the PSNR of the held-out pixels after each round up to an iteration."""
    lines = run_folder.read_metrics(run) if step else []
    ends = range(backdrop_solver.ROUND, step + 1, backdrop_solver.ROUND)
    return [float(line["psnr_held_out"]) for line in lines if line["step"] in ends]


def _expected_gain(rounds: Sequence[float]) -> float:
    """Returns by how much a PSNR will rise in the next round, dB, if gains fall geometrically.

    It is infinite before the third round, as the first two do not take all pixels.
    """
    if len(rounds) < 3:
        return math.inf
    before, last = rounds[-2] - rounds[-3], rounds[-1] - rounds[-2]
    return last * min(1.0, last / before) if last > 0.0 < before else last


def _read(
    config: TrainConfig,
    model: SavedModel,
    scene: Scene,
    folder: Path,
    report: Callable[[str], None],
    stop: Callable[[], bool],
    front: Front | None = None,
) -> _Problem:
    """Reads the training images of a run."""

    def traced(view: int, views: int) -> None:
        report(f"tracing view {view} of {views}")
        if stop():
            raise KeyboardInterrupt  # there is no new state to save

    frames = scene_folder.read_frames(folder, "train")
    images, among = scene_folder.read_images(frames), None
    if config.scene.pixels == "background":
        among = image_files.well_outside(scene_folder.read_masks(frames))
    if front is not None and front.hull is not None:
        among = ~front.pixels
    if among is not None and not among.any():
        raise ValueError(
            f"No pixel of the train views of {folder} sees the background alone: masks or objects "
            "fill the images. Use images with room around the object, or check the masks."
        )
    return _Problem(config, model, scene, frames, images, among, traced)


def solve(
    run: Path,
    config: TrainConfig,
    model: SavedModel,
    scene: Scene,
    folder: Path,
    checkpoints: Checkpoints,
    progress: _Progress,
    stop: Callable[[], bool],
) -> int:
    """Solves for the backdrop of a run, and returns the number of the last iteration.

    A checkpoint is written after each round of iterations; the solver may stop before the last.

    Args:
      run: folder of the run.
      config: its configuration.
      model: static part of its model.
      scene: its scene.
      folder: folder of its training images.
      checkpoints: its checkpoints; the newest one is continued.
      progress: function of iteration, their largest number, and a line of text.
      stop: function that is called between rounds, and between traced views; if it returns `True`,
        solving ends.

    Raises:
      KeyboardInterrupt: if `stop` returned `True` while views were traced.
    """
    begun, total = time.monotonic(), require(config.model.iterations)
    problem = _read(config, model, scene, folder, lambda text: progress(0, total, text), stop)
    state = problem.unsolved()
    if checkpoints.newest() is not None:
        state = checkpoints.restore(state)
    step = int(state.step)
    earlier = run_folder.rewind_metrics(run, step)
    for reached in problem.iterate(run, state):
        step = reached.step
        line = {"step": step, "psnr": reached.fitted, "psnr_held_out": reached.held_out}
        line |= {"seconds": earlier + time.monotonic() - begun}
        run_folder.append_metrics(run, configuration.string_safe(line))
        progress(step, total, f"PSNR {reached.fitted:.2f}  held out {reached.held_out:.2f}")
        params = Params((), reached.pyramid, reached.tints)
        solver = _SolverState(reached.gains, reached.held).stored()
        state = TrainState(state.step, params, solver)
        if step % backdrop_solver.ROUND == 0 and step < total:
            checkpoints.save(state._replace(step=jnp.asarray(step, jnp.int32)))
            if stop():
                return step
    checkpoints.save(state._replace(step=jnp.asarray(total, jnp.int32)))
    if step < total:
        why = f"another round would gain less than {_WORTH:g} dB"
        progress(total, total, f"solved in {step} iterations: {why}")
    if (learned := _solver_of(state).gains) is not None:
        gains = jax.device_get(jnp.exp(learned))
        run_folder.write_gains(run, problem.frames.names, gains)
    return total


def behind_field(
    run: Path,
    state: TrainState,
    config: TrainConfig,
    model: SavedModel,
    scene: Scene,
    folder: Path,
    front: Front,
    progress: _Progress,
    stop: Callable[[], bool],
) -> TrainState:
    """Solves for the backdrop behind a field, from the pixels that see nothing but the backdrop.

    If the field is sampled in a ball, the hull of the masks is stored with the parameters, too.

    Args:
      run: folder of the run.
      state: state before the first step of the field.
      config: configuration of the run.
      model: static part of its model.
      scene: its scene.
      folder: folder of its training images.
      front: what is in front of the backdrop.
      progress: function of step, number of steps, and a line of text.
      stop: function that is called between iterations; if it returns `True`, solving ends.

    Raises:
      KeyboardInterrupt: if `stop` returned `True`.
    """
    total = require(config.schedule.steps)
    problem = _read(
        config, model, scene, folder, lambda text: progress(0, total, text), stop, front
    )
    params = state.params
    for reached in problem.iterate(run, problem.unsolved()):
        progress(0, total, f"backdrop, iteration {reached.step}  PSNR {reached.fitted:.2f}")
        if stop():
            raise KeyboardInterrupt  # there is no new state to save
        field = params.field._replace(backdrop=reached.pyramid)
        params = params._replace(field=field, tints=reached.tints)
    if front.hull is not None:
        hull = jax.device_put(front.hull.occupancy)
        params = params._replace(field=params.field._replace(hull=hull))
    return state._replace(params=params)


def read_front(config: ModelConfig, scene: Scene, folder: Path) -> Front:
    """Reads the masks of the training images, and returns what is in front of a backdrop.

    Raises:
      ValueError: if the field is sampled in a ball, but there are no masks, or they show nothing in
        it.
    """
    shape, frames = config.backdrop, scene_folder.read_frames(folder, "train")
    assert shape is not None
    ball = shape.field_ball
    hull = None if ball is None else _hull(frames, ball, cells=shape.hull_cells)
    return Front(backdrop_equations.meets(scene, frames.cameras, grid=hull), hull)


def _hull(frames: Frames, ball: BallOption, *, cells: int) -> OccupancyGrid:
    """Returns an occupancy grid of the masks' hull.

    A cell is occupied if at least one camera sees it, and every camera that does has the object in
    its mask, within the cell's footprint plus a pixel. The hull may be too large, unlike the
    surface of `reconstruct.masks`, which loses what is thinner than its cells.

    Source: Laurentini, The Visual Hull Concept for Silhouette-Based Image Understanding (1994).
    """
    frames, masks = scene_folder.read_object_views(frames)
    (*centre, radius), cameras = ball, frames.cameras
    middles = radius * ((2.0 * np.arange(cells) + 1.0) / cells - 1.0)
    points = np.stack(np.meshgrid(*3 * [middles], indexing="ij"), axis=-1).reshape(-1, 3) + centre
    reach = math.sqrt(3.0) * radius / cells  # half the diagonal of a cell
    within, seen = np.ones(len(points), bool), np.zeros(len(points), bool)
    for mask, pose in zip(masks, cameras.poses, strict=True):
        away, left = distance_transform_edt(~mask), np.flatnonzero(within)
        places, depths = pinholes.project(points[left], pose, cameras)
        column, row = np.floor(places).astype(np.int64).T
        told = (depths > 0.0) & (row >= 0) & (row < len(mask))
        told &= (column >= 0) & (column < mask.shape[1])
        seen[left[told]] = True
        footprint = reach * cameras.focal / depths[told]
        within[left[told]] = away[row[told], column[told]] <= 1.0 + footprint
    if not np.any(within & seen):
        raise ValueError(
            f"No point of field_ball={','.join(map(str, ball))} is in all masks that can see it. "
            "One wrong mask is enough for that. Correct the masks or the ball, or use "
            "interior=field without a ball."
        )
    return OccupancyGrid((within & seen).reshape(3 * (cells,)).astype(np.float32), ball)
