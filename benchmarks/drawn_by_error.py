"""Compares training on pixels drawn by their error with pixels drawn uniformly; asserts nothing.

    python -m benchmarks.drawn_by_error [--scene=FOLDER] [--steps=1200] [--seeds=1,2]

A first training's images of all training views give the error of each block of 8 x 8 pixels. Then
each seed trains twice from the same parameters: with pixels drawn uniformly, and with half of them
drawn in proportion to the root mean square error of their block. The map is that of a finished
training, and so better than any that is learned on the way. Prints PSNR and masked PSNR of test
views. The width and height of the images must be multiples of 8.
"""

from pathlib import Path

import jax
import numpy as np
from absl import app, flags
from jaxtyping import Float

from refref_jax.data import batches, scene_folder
from refref_jax.geometry import cameras
from refref_jax.render import images
from refref_jax.render.model import Model
from refref_jax.training import evaluation, loop
from refref_jax.training.config import TrainConfig
from refref_jax.training.fit import prepare, read_pixels

_SCENE = flags.DEFINE_string("scene", "experiments/data/cube_smcvx_ball", "Folder of the scene.")
_STEPS = flags.DEFINE_integer("steps", 1200, "Steps of each training.", lower_bound=1)
_SEEDS = flags.DEFINE_list("seeds", ["1", "2"], "Seeds; each trains both ways.")
_LIMIT = flags.DEFINE_integer("limit", 8, "Number of test views.", lower_bound=1)
_RAYS = flags.DEFINE_integer("rays_per_pixel", 4, "Rays per pixel of the test views.")

_BLOCK = 8
_SHARE = 0.5


class _ByError(batches.PixelSampler):
    """Draws some pixels by their weight, with replacement."""

    def weigh(self, weights: Float[np.ndarray, "frames h w"], seed: int) -> None:
        """Sets the weights of all pixels; their sum does not matter."""
        share = (weights / weights.sum()).reshape(-1).astype(np.float64)
        drawn = np.random.default_rng(seed).choice(share.size, share.size, p=share / share.sum())
        self._order = drawn.astype(np.uint32)


def _train(seed: int, weights: Float[np.ndarray, "frames h w"] | None) -> Model:
    """Trains a model, on pixels drawn by weights if they are given."""
    scene = Path(_SCENE.value)
    config = TrainConfig().override(
        scene=str(scene), preset="tiny", far_field="field", steps=_STEPS.value, seed=seed
    )
    (config, saved, *_), objects = prepare(config, report=lambda line: None)
    pixels = read_pixels(config, scene)
    setup = loop.set_up(config, saved.config, saved.settings, objects, pixels)
    if weights is not None:
        frames = scene_folder.read_frames(scene, "train")
        sampler = _ByError(
            scene_folder.read_images(frames),
            frames.cameras,
            seed=seed,
            batch=config.schedule.batch,
        )
        sampler.weigh(weights, seed)
        setup = setup._replace(sampler=sampler, epoch=None)
    first = loop.init_state(seed, saved.config, config.schedule)
    *_, (state, _) = loop.run_steps(setup, first, _STEPS.value, every=(_STEPS.value,))
    return Model(saved.config, saved.settings, setup.scene, state.params)


def _errors(model: Model) -> Float[np.ndarray, "frames h w"]:
    """Returns the root mean square error of each pixel's block in the training images."""
    frames = scene_folder.read_frames(Path(_SCENE.value), "train")
    truth = scene_folder.read_images(frames)
    found = []
    for view, image in enumerate(truth):
        rgb = np.asarray(images.render_camera(model, frames.cameras, view).rgb)
        squared = np.mean(np.square(rgb - image / 255.0), axis=-1)
        blocks = np.sqrt(cameras.box_filter(squared, _BLOCK))
        found.append(blocks.repeat(_BLOCK, axis=0).repeat(_BLOCK, axis=1))
    return np.stack(found)


def main(arguments: list[str]) -> None:
    del arguments
    errors = _errors(_train(0, None))
    weights = _SHARE * errors / errors.mean() + 1.0 - _SHARE
    print("| seed | pixels drawn | PSNR, dB | masked |\n|---|---|---|---|")
    for seed in map(int, _SEEDS.value):
        for name, given in (("uniformly", None), ("by error", weights)):
            model = jax.block_until_ready(_train(seed, given))
            seen = evaluation.evaluate(
                model, _SCENE.value, rays_per_pixel=_RAYS.value, limit=_LIMIT.value
            ).results
            print(
                f"| {seed} | {name} | {seen['psnr']:.2f} | {seen['psnr_masked']:.2f} |", flush=True
            )


if __name__ == "__main__":
    app.run(main)
