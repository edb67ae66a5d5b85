import pytest

from refref_jax.reconstruct import photometry


@pytest.fixture(autouse=True, scope="module")
def _small_tiles():
    """Rays are padded to whole tiles, and tests have few."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(photometry, "_TILE", 1024)
        yield
