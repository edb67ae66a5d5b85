"""What tests expect of an error, of findings, and of two trees of arrays."""

from collections.abc import Iterator
from contextlib import contextmanager

import jax
import numpy as np
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


def assert_same(first, second):
    """Asserts that two trees of arrays are equal, bit for bit."""
    for ours, theirs in zip(*map(jax.tree.leaves, (first, second)), strict=True):
        np.testing.assert_array_equal(ours, theirs)
