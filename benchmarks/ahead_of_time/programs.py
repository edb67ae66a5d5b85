"""Programs of training whose compiled form is counted, with the shapes of the bundled scene."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.training_setup import usual_samples
from refref_jax.geometry.rays import Rays
from refref_jax.optics.light_paths import straight_ends
from refref_jax.optics.path_settings import capacity_for
from refref_jax.render import backdrop, images
from refref_jax.render.model import path_detail
from refref_jax.sampling.scene_bounds import Domain
from refref_jax.training import backdrop_equations, loop
from refref_jax.training.backdrop_equations import Block
from refref_jax.training.config import TrainConfig, require
from refref_jax.training.fit import prepare

SCENE = Path(__file__).parents[2] / "experiments" / "data" / "cube_smcvx_ball"

# Paths per camera ray that the survey finds on the bundled scene: mean and standard deviation.
_PATHS, _DEVIATION = 1.5772, 1.0327

# Pixels in one block of equations, and cells per side of a face of the backdrop.
_PIXELS, _RESOLUTION = 1 << 20, 256


class Program(NamedTuple):
    """A compiled function with its arguments.

    Attributes:
      function: function that `jax.jit` returned.
      arguments: shapes of the arguments.
      options: static arguments.
    """

    function: Any
    arguments: tuple[Any, ...]
    options: dict[str, Any]

    def trace(self, place: Callable[[Any], Any] = lambda tree: tree) -> Any:
        """Traces the function, with its arguments on a device."""
        return self.function.trace(*place(self.arguments), **self.options)


def training(preset: str, multiple: int = loop.MULTIPLE) -> tuple[Program, Program]:
    """Returns the programs that trace light paths along the tree, and that take training steps.

    Steps take the preset's usual samples, although fewer suffice on this scene.

    Args:
      preset: name of a preset.
      multiple: number that divides the capacity for paths; by default as on accelerators.
    """
    asked = TrainConfig().override(
        scene=str(SCENE), preset=preset, paths="tree", samples_per_ray=usual_samples(preset)
    )
    (config, model, *_), scene = prepare(asked, report=lambda line: None)
    scene = jax.tree.map(lambda x: jax.ShapeDtypeStruct(np.shape(x), x.dtype), scene)
    batch = require(config.schedule.batch)
    batches = require(config.schedule.pretraced_batches)
    capacity = capacity_for(
        model.settings, batch, mean=_PATHS, deviation=_DEVIATION, multiple=multiple
    )
    rays = jax.eval_shape(lambda: _rays(batches, batch))
    tracing = {
        "settings": model.settings,
        "capacity": capacity,
        "detail": path_detail(model.config, model.settings),
    }
    traced = loop.pretrace.eval_shape(scene, rays, **tracing)
    pretraced = loop.PretracedBatches(
        traced,
        jax.ShapeDtypeStruct((batches, batch, 3), jnp.uint8),
        jax.ShapeDtypeStruct((batches,), jnp.int32),
    )
    state = jax.eval_shape(lambda: loop.init_state(0, model.config, config.schedule))
    place = jax.ShapeDtypeStruct((), jnp.int32)
    return (
        Program(loop.pretrace, (scene, rays), tracing),
        Program(
            loop.train_steps,
            (state, pretraced, place, place),
            {"config": config, "model": model.config},
        ),
    )


def backdrop_product() -> Program:
    """Returns the product that the backdrop's solver forms in each iteration, and its transpose."""
    domain = Domain(1.0, "unbounded")
    rays = jax.eval_shape(lambda: _rays(_PIXELS))
    shape = jax.ShapeDtypeStruct
    ends = jax.eval_shape(lambda rays: _straight_lookups(rays, domain), rays)
    colours, numbers = shape((_PIXELS, 3), jnp.float32), shape((_PIXELS,), jnp.float32)
    views = shape((_PIXELS,), jnp.int32)
    block = Block(ends, shape((_PIXELS, 0), jnp.float32), colours, colours, numbers, views)
    levels = jax.eval_shape(lambda: backdrop.init(_RESOLUTION, radiance=jnp.zeros(3)))
    return Program(jax.jit(_product), (levels, block), {})


def _product(levels: backdrop.Pyramid, block: Block) -> backdrop.Pyramid:
    # Programs with options of their own cannot be a part of another one.
    mipmap, predict, transposed, mipmap_transposed = (
        compiled.__wrapped__
        for compiled in (
            images.mipmap,
            backdrop_equations._predict,
            backdrop_equations._transposed,
            backdrop_equations._mipmap_transposed,
        )
    )
    spread = transposed(predict(mipmap(levels, "unbounded"), block), block, resolution=_RESOLUTION)
    return mipmap_transposed(spread, "unbounded")


def _straight_lookups(rays: Rays, domain: Domain) -> backdrop.Lookups:
    ends = straight_ends(rays, footprint="differential")
    return backdrop.locate(domain, ends, ends.rays, resolution=_RESOLUTION, most_taps=3, axes=0)


def _rays(*shape: int) -> Rays:
    vectors = jnp.zeros((*shape, 3), jnp.float32)
    return Rays(vectors, vectors, vectors[..., 0])
