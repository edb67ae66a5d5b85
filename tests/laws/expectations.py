"""What the tests of `data` expect of an error."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from refref_jax.data import SceneError


@contextmanager
def scene_error(*words: str) -> Iterator[None]:
    """Expects a `SceneError` whose message holds all of the words and ends as a sentence."""
    with pytest.raises(SceneError) as caught:
        yield
    message = str(caught.value)
    assert message.endswith(".")
    for word in words:
        assert word in message


def only(findings):
    """Returns the one finding that there is."""
    [finding] = findings
    return finding
