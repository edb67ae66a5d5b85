from pathlib import Path

import jax
import pytest

# A silent broadcast between different ranks is a bug.
jax.config.update("jax_numpy_rank_promotion", "raise")

# optax adds steps (integers) to rates (floats); everything below training must be explicit.
_LOOSE = ("training", "experiments")


@pytest.fixture(autouse=True)
def _strict_dtypes(request):
    folder = Path(request.fspath).parent.name
    with jax.numpy_dtype_promotion("standard" if folder in _LOOSE else "strict"):
        yield


@pytest.fixture
def ball_scene() -> Path:
    """The bundled scene: a glass ball between textured walls, rendered by Blender Cycles."""
    return Path(__file__).parents[1] / "experiments" / "data" / "cube_smcvx_ball"
