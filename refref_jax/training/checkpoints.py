"""Saves and restores the state of a run with Orbax: atomic, the newest few kept."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp

from refref_jax.render.saved import (
    PARAMS_ITEM,
    TRAINING_ITEM,
    find_step,
    open_checkpoints,
    restore,
)
from refref_jax.training.state import TrainState


class Checkpoints:
    """The checkpoints of one run, open for writing. Use it in a `with` statement."""

    def __init__(self, run: Path, *, keep: int) -> None:
        """Opens or creates the checkpoints of a run folder, keeping the newest `keep`."""
        self._run = run
        self._manager = open_checkpoints(run, keep=keep)

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(self, *exception: object) -> None:
        self._manager.close()

    def newest(self) -> int | None:
        """Returns the step of the newest checkpoint, if there is one."""
        return self._manager.latest_step()

    def save(self, state: TrainState) -> None:
        """Writes a state, and waits: its buffers belong to the next step.

        Raises:
          ValueError: if a parameter is not finite. The checkpoints there are stay.
        """
        step = int(state.step)
        if step == self.newest():
            return
        if not all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(state.params)):
            raise ValueError(
                f"Parameters are not finite at step {step}, so no checkpoint is written. Evaluate "
                "an earlier one, or train again with another seed, in another folder."
            )
        items = {
            PARAMS_ITEM: ocp.args.StandardSave(state.params),
            TRAINING_ITEM: ocp.args.StandardSave(_training_item(state)),
        }
        self._manager.save(step, args=ocp.args.Composite(**items), force=True)
        self._manager.wait_until_finished()

    def restore(self, like: TrainState) -> TrainState:
        """Reads the newest state.

        Args:
          like: a state of the same run, or its shapes. What is read lies on the same devices, or
            on the first one if `like` lies on none; which devices it was written from is no matter.

        Raises:
          ValueError: if there is no checkpoint.
        """
        shapes = jax.tree.map(_abstract, like)
        step = find_step(self._manager, self._run, None)
        items = restore(
            self._manager,
            step,
            {PARAMS_ITEM: shapes.params, TRAINING_ITEM: _training_item(shapes)},
        )
        training = items[TRAINING_ITEM]
        return TrainState(training["step"], items[PARAMS_ITEM], training["optimizer"])


def _abstract(leaf: jax.Array | jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding)


def _training_item(state: TrainState) -> dict[str, Any]:
    return {"step": state.step, "optimizer": state.optimizer}
