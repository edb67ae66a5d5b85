"""Light paths and bodies in the 3D scene of a page: colours, thickness, and what is removed."""

import dataclasses

import numpy as np
import pytest

from experiments.viewer import controls
from refref_jax.geometry.rays import Rays
from refref_jax.optics.path_settings import TREE
from refref_jax.render import pixel_paths
from tests.factories import scenes


@pytest.fixture(scope="module")
def straight_down(slab):
    ray = Rays(np.array([0.1, 0.2, 4.0]), np.array([0.0, 0.0, -1.0]), np.float64(1e-3))
    settings = dataclasses.replace(TREE, max_bends=6, min_throughput=1e-3)
    return pixel_paths.trace_pixel(slab, ray, settings=settings, reach=2.0)


def test_the_strength_of_light_is_logarithmic():
    shares = np.array([1e-5, 1e-3, 0.0316228, 1.0, 2.0])
    np.testing.assert_allclose(controls.strength(shares), [0.0, 0.0, 0.5, 1.0, 1.0], atol=1e-6)


class _Scene:
    """Takes notes of what is added to it."""

    def __init__(self):
        self.nodes = {}

    def add_line_segments(self, name, points, colors, *, thickness, thickness_units):
        assert points.shape == colors.shape and thickness_units == "screen"
        self.nodes[name] = (points, thickness)
        return _Node(lambda: self.nodes.pop(name))

    def add_mesh_simple(self, name, vertices, faces, **_):
        self.nodes[name] = vertices[faces]
        return _Node(lambda: None)


class _Node:
    def __init__(self, remove):
        self.remove, self.visible = remove, False


@pytest.mark.slow
def test_the_scene_shows_each_piece_once_and_nothing_of_the_last_pixel(straight_down, slab):
    scene = _Scene()
    made = controls.Scenery(scene, slab.surfaces, None)
    np.testing.assert_allclose(
        np.sort(scene.nodes.pop("/bodies/0").reshape(-1, 3), axis=0),
        np.sort(
            np.asarray(scenes.box((8.0, 8.0, 1.0)).vertices)[scenes.box().faces].reshape(-1, 3), 0
        ),
        atol=1e-6,
    )
    pieces = pixel_paths.pieces(straight_down)
    for _ in range(2):
        made.show_paths(pieces)
        lines = [points for points, _ in scene.nodes.values()]
        assert sum(map(len, lines)) == len(pieces.ends)
    thickness = {points[0].tobytes(): thick for points, thick in scene.nodes.values()}
    strongest = pieces.ends[np.argmax(pieces.shares)].tobytes()
    assert thickness[strongest] == max(controls.THICKNESSES)
    made.remove_paths()
    assert scene.nodes == {}
