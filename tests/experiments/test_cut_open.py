"""Objects that are cut open: outlines in closed form, and the colours of what is cut."""

import imageio.v3 as iio
import numpy as np
import pytest
import trimesh

from experiments.figures import cross_sections, cut_open
from refref_jax import make_part
from refref_jax.choices import Material

_CENTRE = (0.3, -0.2, 0.1)


def _ball(radius, **options):
    ball = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return make_part(ball.apply_translation(_CENTRE), **options)


def _colour(path, column):
    """The colour in the middle of one of the columns of a figure with three."""
    image = iio.imread(path)[..., :3]
    return image[image.shape[0] // 2, int((column + 0.5) * image.shape[1] / 3)] / 255.0


def test_the_outline_in_a_vertical_plane_is_a_circle():
    part = _ball(0.8, index=1.5)
    (loop,) = cross_sections.outlines_in(
        part.vertices, part.faces, origin=_CENTRE, axes=((1, 0, 0), (0, 0, 1))
    )
    np.testing.assert_allclose(np.linalg.norm(loop, axis=-1), 0.8, atol=2e-3)
    steps = np.linalg.norm(np.diff(loop, axis=0), axis=-1)
    assert steps.max() < 0.2  # neighbours follow each other


def test_a_ring_has_two_outlines_beside_its_axis():
    ring = trimesh.creation.torus(1.0, 0.3)
    loops = cross_sections.outlines_in(
        np.asarray(ring.vertices), ring.faces, origin=(0, 0, 0), axes=((0, 1, 0), (0, 0, 1))
    )
    assert sorted(np.sign(loop[:, 0].mean()) for loop in loops) == [-1.0, 1.0]
    for loop in loops:
        away = np.linalg.norm(np.abs(loop) - (1.0, 0.0), axis=-1)
        np.testing.assert_allclose(away, 0.3, atol=0.02)


def test_a_cut_shows_the_liquid_in_its_colour_and_the_wall_behind_air(tmp_path):
    tint = (0.5, 0.8, 0.95)
    glass, liquid = _ball(1.0, index=1.5), _ball(0.7, index=1.36, tint=tint)
    cut_open.write(tmp_path / "full.png", [glass, liquid], [liquid, glass])
    cut_open.write(tmp_path / "empty.png", [glass, _ball(0.7, index=1.0)], [glass])
    seen = [_colour(tmp_path / "full.png", column) for column in (0, 1)]
    for each in seen:
        np.testing.assert_allclose(each, np.square(tint) ** (1.0 / 2.2), atol=0.01)
    behind, solid = (_colour(tmp_path / "empty.png", column) for column in (0, 1))
    np.testing.assert_allclose(solid, (0.56, 0.67, 0.74), atol=0.01)
    assert np.ptp(behind) < 0.1 and not np.allclose(behind, solid, atol=0.05)


def test_opaque_parts_are_filled_in_brown_and_cut_no_hole(tmp_path):
    opaque = _ball(0.7, index=1.0, material=Material("opaque"))
    cut_open.write(tmp_path / "opaque.png", [opaque], [_ball(1.0, index=1.5), opaque])
    for column in (0, 1):
        np.testing.assert_allclose(
            _colour(tmp_path / "opaque.png", column), (0.42, 0.38, 0.36), atol=0.01
        )


@pytest.mark.parametrize("plane", [0.0, 5.0])
def test_a_plane_that_meets_nothing_has_no_outline(plane):
    part = _ball(0.5, index=1.5)
    loops = cross_sections.outlines_in(
        part.vertices, part.faces, origin=(0.0, 0.0, plane), axes=((1, 0, 0), (0, 1, 0))
    )
    assert len(loops) == (plane == 0.0)


def test_a_part_that_the_plane_does_not_meet_leaves_the_cut_whole(tmp_path):
    drop = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    aside = make_part(drop.apply_translation(np.add(_CENTRE, (0.0, 0.5, 0.0))), index=1.333)
    cut_open.write(tmp_path / "drop.png", [_ball(1.0, index=1.5), aside], [_ball(1.0, index=1.5)])
    for column in (0, 1):
        np.testing.assert_allclose(
            _colour(tmp_path / "drop.png", column), (0.56, 0.67, 0.74), atol=0.01
        )
