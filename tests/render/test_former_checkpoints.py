"""Checkpoints of earlier versions, whose records had other fields."""

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest

from refref_jax.fields.neus import NeusParams
from refref_jax.render import checkpoint_io
from refref_jax.render.checkpoint_io import PARAMS_ITEM, TRAINING_ITEM
from refref_jax.render.model import Params


def _surface(record, *more):
    return record({"a": jnp.arange(3.0)}, {"b": jnp.ones(2)}, jnp.float32(2.0), *more)


@pytest.mark.parametrize(
    ("before", "now"),
    [
        (
            Params((), _surface(checkpoint_io._FormerNeusParams), None),
            Params((), _surface(NeusParams), None),
        ),
        (checkpoint_io._FormerParams((), jnp.arange(4.0), None), Params((), jnp.arange(4.0), None)),
    ],
    ids=["neus without a learned index", "dyes"],
)
def test_checkpoints_of_earlier_versions_are_read(before, now, tmp_path):
    def items(params):
        return {PARAMS_ITEM: params, TRAINING_ITEM: {"optimizer": (params, jnp.zeros(2))}}

    saved = {name: ocp.args.StandardSave(x) for name, x in items(before).items()}
    with checkpoint_io.open_checkpoints(tmp_path, keep=1) as manager:
        manager.save(5, args=ocp.args.Composite(**saved))
        manager.wait_until_finished()
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), items(now))
    with checkpoint_io.open_checkpoints(tmp_path) as manager:
        read = checkpoint_io.restore(manager, 5, shapes)
    found = {name: read[name] for name in shapes}
    assert jax.tree.structure(found) == jax.tree.structure(items(now))
    for one, other in zip(*map(jax.tree.leaves, (found, items(now))), strict=True):
        np.testing.assert_array_equal(one, other)
