import pytest

from refref_jax.reconstruct import photometry


@pytest.fixture(autouse=True, scope="module")
def _small_tiles():
    """Traces as many rays at once as tests have; any number is filled up to those of a tile."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(photometry, "_TILE", 1024)
        yield
