import pytest

from refref_jax.geometry.cameras import image_rays
from tests.factories.small_model import CAMERAS


@pytest.fixture(scope="module")
def rays():
    """The rays of the small model's first view."""
    return image_rays(CAMERAS, 0)
