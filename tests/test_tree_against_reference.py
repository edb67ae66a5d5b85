"""The library's path tree against the slow one in float64, on rows of pixels of test views.

The bundled scene is always there. The folders of other scenes can be named in the environment
variable `REFREF_SCENES`, separated like the entries of `PATH`.
"""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.oracles import reference_images, reference_surfaces, reference_tree
from refref_jax.geometry.rays import Rays
from refref_jax.optics import path_settings
from refref_jax.optics.light_paths import PathStatus
from tests.factories import scenes

pytestmark = pytest.mark.computing

_BUNDLED = Path(__file__).parents[1] / "experiments" / "data" / "cube_smcvx_ball"
_SCENES = [_BUNDLED, *map(Path, filter(None, os.environ.get("REFREF_SCENES", "").split(":")))]

# Where light is trapped for many bends, rounding decides which way it leaves: the exact tree of
# rays that were merely rounded to float32 is at 45 dB from itself on a torus, at 55 dB on a flask,
# and beyond 130 dB on a ball and a pyramid.
_SAME_IMAGE = 36.0

# Rays a pixel along each axis, rows of an image, and views.
_FINE = 3
_ROWS = 8
_VIEWS = (0, 10)

_RULES = [
    (path_settings.STRAIGHT, reference_tree.STRAIGHT),
    (path_settings.PAPER, reference_tree.PAPER),
    (path_settings.TREE, reference_tree.TREE),
]


def _rays(origins, directions):
    origins, directions = (jnp.asarray(x, jnp.float32) for x in (origins, directions))
    return Rays(origins, directions, jnp.full(len(origins), 1e-3, jnp.float32))


def _rows(view):
    """Returns rows spread over the object."""
    object_rows = np.flatnonzero(view.mask.any(axis=1))
    return object_rows[np.linspace(0, len(object_rows) - 1, _ROWS + 2).astype(int)[1:-1]]


@pytest.mark.slow
@pytest.mark.parametrize("scene", _SCENES, ids=lambda scene: scene.name)
@pytest.mark.parametrize(("settings", "rule"), _RULES, ids=["straight", "paper", "tree"])
def test_images_are_those_of_the_slow_tree(scene, settings, rule):
    surfaces = reference_surfaces.read_surfaces(scene)
    few = len(surfaces.corners) < 50
    cast = (reference_surfaces.BruteForce if few else reference_surfaces.Embree)(surfaces)
    background = reference_images.read_background(scene)
    for number in _VIEWS:
        view = reference_images.read_view(scene, number)
        rows = _rows(view)
        shaped = reference_images.pixel_rays(view, rows, _FINE)
        origins, directions = (x.reshape(-1, 3) for x in shaped)
        slow = reference_tree.trace(surfaces, cast, origins, directions, rule)
        traced = jax.tree.map(
            np.asarray,
            scenes.trace_ends(
                scenes.read_geometry(scene), _rays(origins, directions), settings=settings
            ),
        )
        assert not traced.dropped.any()
        quality, images = [], []
        for ends in (slow, traced.ends):
            seen, _ = background.look(
                np.asarray(ends.origins, float), np.asarray(ends.directions, float)
            )
            images.append(
                reference_images.image(ends.rays, ends.throughput, seen, shaped[0].shape[:4])
            )
            quality.append(reference_images.psnr(images[-1], view.image[rows], view.mask[rows]))
        assert abs(quality[0] - quality[1]) < 0.5
        assert reference_images.psnr(*images, view.mask[rows]) > _SAME_IMAGE
        paths = np.sum(traced.ends.statuses != PathStatus.EMPTY)
        np.testing.assert_allclose(paths, len(slow.rays), rtol=0.02)
        if settings.max_bends > 0:
            np.testing.assert_allclose(int(traced.casts), slow.casts, rtol=0.02)
