"""The fifty objects at the detail that is rendered."""

import collections

import numpy as np
import pytest

from experiments.dataset import catalogue, scene_record
from experiments.dataset.parts import RADIUS
from refref_jax.data import containment, lint


def test_there_are_as_many_of_each_category_as_in_the_paper():
    counts = collections.Counter(each.category for each in catalogue.OBJECTS.values())
    assert counts == {"smcvx": 9, "smncvx": 20, "mmncvx": 21}


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(catalogue.OBJECTS))
def test_the_lint_finds_nothing(name):
    if name == "monkey" and not catalogue.SUZANNE.is_file():
        pytest.skip("the monkey is exported by the first dataset.make that renders it")
    parts = [scene_record.mesh_part(part) for part in catalogue.OBJECTS[name].make(1.0)]
    tree = containment.find_containment(parts)
    assert [str(each) for each in lint.lint(parts, tree) if each.severity != "note"] == []
    assert max(np.linalg.norm(part.vertices, axis=1).max() for part in parts) <= RADIUS
    if catalogue.OBJECTS[name].category != "mmncvx":
        assert len({part.index for part in parts}) == 1
