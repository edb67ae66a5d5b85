"""The pool of pictures: rich, different from each other, the same every time, without seams."""

import itertools

import numpy as np
import pytest
import scipy.ndimage

from experiments.dataset.textures import cells, fields, shading, sphere_fields
from experiments.dataset.textures.faces import FACES, make_face
from experiments.dataset.textures.spheres import SPHERES, make_sphere

_FACE, _SPHERE = 96, 64


@pytest.fixture(scope="module")
def faces():
    return {name: make_face(name, _FACE) for name in FACES}


@pytest.fixture(scope="module")
def spheres():
    return {name: make_sphere(name, _SPHERE) for name in SPHERES}


def test_pictures_are_srgb_in_range_and_coloured(faces, spheres):
    assert len(FACES) == 24 and len(SPHERES) == 13
    for name, picture in (faces | spheres).items():
        wanted = (_FACE, _FACE, 3) if name in faces else (_SPHERE, 2 * _SPHERE, 3)
        assert picture.shape == wanted and picture.dtype == np.float32, name
        assert np.all(picture >= 0.0) and np.all(picture <= 1.0), name
        assert 0.15 < picture.mean() < 0.75, name
        assert (picture.max(-1) - picture.min(-1)).mean() > 0.05, name


@pytest.mark.parametrize("name", ["carpet", "cobbles", "planks", "rust"])
def test_more_samples_show_the_same(faces, name):
    finer = make_face(name, 2 * _FACE).reshape(_FACE, 2, _FACE, 2, 3).mean((1, 3))
    broad = [scipy.ndimage.gaussian_filter(each, (4, 4, 0)) for each in (finer, faces[name])]
    assert np.corrcoef(*(each.ravel() for each in broad))[0, 1] > 0.97


def test_spheres_have_no_seam_and_smooth_poles(spheres):
    for name, picture in spheres.items():
        steps = np.abs(np.roll(picture, -1, axis=1) - picture).mean(2)
        columns, rows = steps.mean(0), steps.mean(1)
        assert columns[-1] < 1.5 * np.quantile(columns[:-1], 0.9), name
        # A row at a pole is as long as a few samples of the equator.
        assert max(rows[0], rows[-1]) < 0.75 * rows[_SPHERE // 4 : -_SPHERE // 4].max(), name


def test_cells_are_those_of_the_nearest_seed():
    x, y = fields.coordinates(40)
    found = cells.voronoi(x, y, (5, 4), 9, jitter=0.8)
    offsets = (np.random.default_rng(9).random((4, 5, 2), np.float32) - 0.5) * 0.8 + 0.5
    column, row = np.meshgrid(np.arange(5), np.arange(4))
    seeds = np.stack([(column + offsets[..., 0]) / 5, (row + offsets[..., 1]) / 4], -1)
    shifts = np.array(list(itertools.product((-1, 0, 1), repeat=2)))
    copies = (seeds.reshape(-1, 1, 2) + shifts).reshape(-1, 2)
    points = np.stack([x, y], -1)[..., None, :]
    distance = np.linalg.norm(points - copies, axis=-1)
    order = np.argsort(distance, axis=-1)
    np.testing.assert_array_equal(found.index, order[..., 0] // len(shifts))
    first, second = (copies[order[..., each]] for each in (0, 1))
    np.testing.assert_allclose(np.hypot(found.dx, found.dy), distance.min(-1), atol=1e-5)
    # The border is half-way between both seeds.
    normal = (second - first) / np.linalg.norm(second - first, axis=-1, keepdims=True)
    expected = np.sum((0.5 * (first + second) - points[..., 0, :]) * normal, axis=-1)
    np.testing.assert_allclose(found.border, expected, atol=1e-5)


def test_the_middle_column_looks_along_x_and_the_top_row_up():
    points = sphere_fields.directions(64)
    np.testing.assert_allclose(points[32, 63:65].mean(0), [1.0, 0.0, 0.0], atol=0.03)
    np.testing.assert_allclose(points[32, 31:33].mean(0), [0.0, 1.0, 0.0], atol=0.03)
    np.testing.assert_allclose(points[0].mean(0), [0.0, 0.0, 1.0], atol=0.03)
    np.testing.assert_allclose(np.linalg.norm(points, axis=-1), 1.0, atol=1e-6)


def test_linear_colours_are_those_of_the_standard():
    values = np.array([0.0, 0.04045, 0.5, 1.0])
    np.testing.assert_allclose(shading.linear(values), [0.0, 0.0031308, 0.2140411, 1.0], atol=1e-6)


def test_wrong_names_and_sizes_are_told():
    with pytest.raises(ValueError, match=r"no face 'checkerboard'\. Choose from brick"):
        make_face("checkerboard")
    with pytest.raises(ValueError, match=r"no sphere 'moon'\. Choose from nebula"):
        make_sphere("moon")
    for make, name in ((make_face, "brick"), (make_sphere, "nebula")):
        with pytest.raises(ValueError, match=r"8 samples is too small\. Request 16"):
            make(name, 8)
