"""Blending and its derivative, in both forms, against a plain blend in float64 and closed forms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from refref_jax.splats import gaussians as splats
from refref_jax.splats import images, rasterizer
from refref_jax.splats.gaussians import Projected
from refref_jax.splats.rasterizer import Grid
from tests.factories import made_splats
from tests.laws import gradients
from tests.oracles import reference_splats

pytestmark = pytest.mark.longest

_SIZE = made_splats.WIDTH, made_splats.HEIGHT
_GRID, _SMALL = Grid(*_SIZE, 8), Grid(16, 16, 8)
_CAPACITY = 20_000

_FORMS = {
    "native": ("_blend_native", "_differentiate_native", "_filled_lists"),
    "chunks": ("_blend_chunks", "_differentiate_chunks", "_sorted_lists"),
}


@pytest.fixture(params=_FORMS)
def form(request, monkeypatch):
    """Both forms, each on this platform."""
    forward, backward, lists = _FORMS[request.param]
    monkeypatch.setattr(rasterizer, "_forward", getattr(rasterizer, forward))
    monkeypatch.setattr(rasterizer, "_backward", getattr(rasterizer, backward))
    monkeypatch.setattr(images, "_listed", getattr(images, lists))
    return request.param


_each_form = pytest.mark.parametrize("form", _FORMS, indirect=True)


def _often(name):
    """Every run of the suite tests one form, and slow ones the other."""
    marks = {each: () if each == name else pytest.mark.slow for each in _FORMS}
    forms = [pytest.param(each, marks=mark) for each, mark in marks.items()]
    return pytest.mark.parametrize("form", forms, indirect=True)


def _projected(values, view, grid=_GRID):
    return splats.project_all(values, view, width=grid.width, height=grid.height, kernel="classic")


def _blended(projected, grid=_GRID, capacity=_CAPACITY):
    lists = images.make_lists(projected, grid, capacity=capacity)
    return rasterizer.rasterize(projected, lists, grid)


_PROJECT = jax.jit(_projected, static_argnames="grid")


def _compiled(function, *fixed):
    """Returns a function of this module in one program, for the form that is set.

    JAX knows programs by their functions alone, which are the same for both forms.
    """
    return _compiled_for(rasterizer._forward, function, *fixed)


@functools.cache
def _compiled_for(form, function, *fixed):
    del form
    return jax.jit(lambda *arguments: function(*arguments, *fixed))


def _rendered(values, view, grid):
    return _blended(_projected(values, view, grid), grid)


def _image(values, view=made_splats.AHEAD, grid=_SMALL):
    """Returns the blend of Gaussians."""
    return _compiled(_rendered, grid)(values, view)


@pytest.fixture(scope="module")
def scene():
    """300 Gaussians, and their image as the reference has it."""
    values, view = made_splats.gaussians(300), made_splats.view()
    found = jax.device_get(_PROJECT(values, view))
    visible = np.flatnonzero(found.radii[:, 0] > 0)
    exact = jax.tree.map(np.float64, jax.tree.map(lambda x: x[visible], found))
    seen = reference_splats.blend(
        *(exact.means, exact.conics, exact.opacities, exact.colours, exact.depths), *_SIZE
    )
    return values, view, found, visible, exact, seen


def test_the_image_is_that_of_a_plain_blend(form, scene):
    _, _, found, visible, _, (image, left, _) = scene
    assert len(visible) > 100 and left.min() < 0.01 and left.max() > 0.2
    seen = _compiled(_blended, _GRID, _CAPACITY)(found)
    np.testing.assert_allclose(seen.colours, image, atol=1e-5)
    np.testing.assert_allclose(seen.transmittance, left, atol=1e-5)


def test_the_derivatives_are_those_of_a_plain_blend(form, scene):
    _, _, found, visible, exact, (image, left, visits) = scene
    draw = np.random.default_rng(0)
    weights, others = draw.normal(size=image.shape), draw.normal(size=left.shape)

    def loss(projected):
        seen = _blended(projected)
        return jnp.sum(seen.colours * jnp.float32(weights)) + jnp.sum(
            seen.transmittance * jnp.float32(others)
        )

    slopes = jax.device_get(jax.jit(jax.grad(loss))(jax.tree.map(jnp.asarray, found)))
    expected = reference_splats.slopes(exact.conics, exact.colours, visits, weights, others)
    ours = slopes.means, slopes.conics, slopes.opacities, slopes.colours
    for theirs, mine in zip(expected, ours, strict=True):
        largest = np.abs(theirs).max()
        np.testing.assert_allclose(mine[visible], theirs, atol=1e-4 * largest)
        hidden = np.delete(mine, visible, axis=0)
        assert not np.any(hidden)
    assert not np.any(slopes.depths) and not np.any(slopes.radii)


@pytest.mark.slow
@_each_form
def test_the_derivatives_of_gaussians_are_those_of_float64(form, scene):
    """From the reference's derivatives of the features, through the projection in float64."""
    values, view, _, visible, exact, (image, left, visits) = scene
    target = np.random.default_rng(1).uniform(size=image.shape)
    by_image = 2.0 * (image - target)

    def loss(values):
        seen = _blended(_projected(values, view))
        return jnp.sum(jnp.square(seen.colours - jnp.float32(target)))

    ours = jax.jit(jax.grad(loss))(values)
    slopes = reference_splats.slopes(
        exact.conics, exact.colours, visits, by_image, np.zeros_like(left)
    )
    with jax.enable_x64(True):
        wide, eye = jax.tree.map(lambda x: jnp.float64(np.asarray(x)), (values, view))
        projected, pull_back = jax.vjp(lambda v: _PROJECT(v, eye), wide)
        filled = jax.tree.map(lambda x: np.zeros(x.shape), projected)
        for name, slope in zip(("means", "conics", "opacities", "colours"), slopes, strict=True):
            getattr(filled, name)[visible] = slope
        (expected,) = pull_back(jax.tree.map(jnp.asarray, filled))
    for theirs, mine in zip(expected, ours, strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-4 * np.abs(theirs).max())


@pytest.mark.slow
@_each_form
def test_one_gaussian_by_hand(form):
    scale, depth, focal = 0.1, 2.0, 20.0
    seen = _image(made_splats.one((0, 0, depth), opacity=0.8))
    variance = (focal * scale / depth) ** 2 + 0.3
    row, column = np.indices((16, 16)) + 0.5
    alpha = 0.8 * np.exp(-((row - 8) ** 2 + (column - 8) ** 2) / (2 * variance))
    alpha = np.where(alpha >= 1 / 255, alpha, 0.0)
    np.testing.assert_allclose(seen.colours[..., 0], alpha, atol=1e-6)
    np.testing.assert_allclose(seen.transmittance, 1.0 - alpha, atol=1e-6)
    np.testing.assert_allclose(seen.depths, depth * alpha, atol=2e-6)
    inside = seen.transmittance < 0.5
    assert inside.any() and np.all(seen.median_depths[inside] == depth)
    assert not np.any(seen.median_depths[~inside])


@pytest.mark.slow
@_each_form
def test_pixels_of_three_gaussians_by_hand(form):
    """Numbers of gsplat's projection and a plain blend, to six decimals."""
    values = made_splats.joined(
        made_splats.one((0, 0, 2)),
        made_splats.one(
            (0.2, -0.1, 2.5),
            scale=(0.05, 0.2, 0.1),
            quaternion=(0.9, 0.1, -0.2, 0.3),
            opacity=0.6,
            colour=(0, 1, 0),
        ),
        made_splats.one(
            (-0.3, 0.25, 1.6),
            scale=(0.3, 0.1, 0.02),
            quaternion=(1, 1, -1, 1),
            opacity=0.9,
            colour=(0, 0, 1),
        ),
    )
    seen = _image(values)
    for (x, y), colour, left in [
        ((8, 8), (0.660042, 0.122808, 0), 0.217149),
        ((5, 10), (0.002828, 0, 0.567116), 0.430056),
        ((10, 7), (0.065668, 0.273134, 0), 0.661198),
    ]:
        np.testing.assert_allclose(seen.colours[y, x], colour, atol=2e-6)
        assert float(seen.transmittance[y, x]) == pytest.approx(left, abs=2e-6)


@pytest.mark.slow
@_each_form
def test_the_nearer_of_two_planes_is_in_front(form):
    near = made_splats.one((0, 0, 2), scale=(5, 5, 0.01), opacity=0.75, colour=(1, 0, 0))
    far = made_splats.one((0, 0, 3), scale=(5, 5, 0.01), opacity=0.75, colour=(0, 1, 0))
    for values in (made_splats.joined(near, far), made_splats.joined(far, near)):
        seen = _image(values)
        np.testing.assert_allclose(seen.colours[8, 8], (0.75, 0.1875, 0.0), atol=1e-3)
        assert float(seen.median_depths[8, 8]) == 2.0


@pytest.mark.slow
@_each_form
def test_weights_and_transmittance_add_up_to_one(form, scene):
    values, view, *_ = scene
    white = values._replace(
        colours=jnp.full_like(values.colours, 0.5 / splats.CONSTANT),
        harmonics=jnp.zeros_like(values.harmonics),
    )
    seen = _image(white, view, _GRID)
    left = np.asarray(seen.transmittance)
    assert np.all((left > 0.0) & (left <= 1.0))
    np.testing.assert_allclose(seen.colours[..., 1] + left, 1.0, atol=1e-5)


@pytest.mark.slow
@_each_form
def test_the_order_of_gaussians_does_not_matter(form, scene):
    values, view, *_ = scene
    order = np.random.default_rng(3).permutation(300)
    seen = (
        _image(values, view, _GRID),
        _image(jax.tree.map(lambda x: x[order], values), view, _GRID),
    )
    for first, second in zip(*seen, strict=True):
        np.testing.assert_allclose(first, second, atol=1e-6)


@pytest.mark.slow
def test_moving_scene_and_camera_together_changes_nothing(form):
    """Quaternions are multiplied by that of the motion; colours without harmonics."""
    values, view = made_splats.gaussians(100), made_splats.view()
    values = values._replace(harmonics=jnp.zeros_like(values.harmonics))
    w, x, y, z = (np.float32(0.5),) * 4
    turn = np.asarray(splats.rotation(jnp.stack([w, x, y, z])))
    shift = np.float32([3.0, -2.0, 1.0])
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    moved = values._replace(
        means=values.means @ turn.T + shift[None], quaternions=values.quaternions @ left.T
    )
    seen = view._replace(rotation=view.rotation @ turn.T, position=turn @ view.position + shift)
    for first, second in zip(_image(values, view, _GRID), _image(moved, seen, _GRID), strict=True):
        # A few of them change their order or cross the threshold of 1/255.
        assert np.mean(np.abs(np.asarray(first - second)) > 1e-4) < 1e-3


@pytest.mark.slow
@_each_form
def test_an_image_depends_on_neither_tiles_nor_capacity(form, scene):
    values, view, *_ = scene
    found = _PROJECT(values, view)
    first = _compiled(_blended, _GRID, _CAPACITY)(found)
    for tile in (4, 16):
        other = _compiled(_blended, Grid(*_SIZE, tile), _CAPACITY)(found)
        for ours, theirs in zip(first, other, strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-6)
    total = int(images.count_entries(found, _GRID))
    for ours, theirs in zip(first, _compiled(_blended, _GRID, total)(found), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def _listed(projected, capacity):
    return images.make_lists(projected, _GRID, capacity=capacity)


@pytest.mark.slow
@_each_form
def test_lists_report_what_they_need(form):
    found = _PROJECT(made_splats.gaussians(300), made_splats.view())
    total = int(images.count_entries(found, _GRID))
    for capacity in (1, total // 2, total, 2 * total):
        lists = _compiled(_listed, capacity)(found)
        assert int(lists.total) == total
        assert int(lists.offsets[-1]) == min(total, capacity)
        assert np.all(np.asarray(lists.entries) < 300)


@pytest.mark.parametrize(
    ("gaussians", "side", "entries"),
    [(2, 30_000, 1_800_000_000), (3, 30_000, 2**31 - 1), (5000, 1000, 2**31 - 1)],
)
def test_more_entries_than_an_integer_holds_are_no_small_number(gaussians, side, entries):
    size = jnp.full((gaussians, 2), side, jnp.int32)
    assert int(images._count(images._Boxes(jnp.zeros_like(size), size))) == entries


def test_both_lists_are_equal():
    found = _PROJECT(made_splats.gaussians(300), made_splats.view())

    @jax.jit
    def listed(found):
        boxes = images._boxes(found.means, found.radii, _GRID)
        order = jnp.argsort(found.depths, stable=True).astype(jnp.int32)
        boxes = jax.tree.map(lambda x: x[order], boxes)
        return [
            make(order, boxes, grid=_GRID, capacity=_CAPACITY)
            for make in (images._filled_lists, images._sorted_lists)
        ]

    both = listed(found)
    total = int(both[0].total)
    assert total == int(both[1].total) > 1000
    np.testing.assert_array_equal(both[0].offsets, both[1].offsets)
    np.testing.assert_array_equal(both[0].entries[:total], both[1].entries[:total])


@pytest.mark.slow
@_each_form
def test_no_gaussians_and_empty_tiles(form):
    none = _image(splats.blank(0))
    assert np.all(none.transmittance == 1.0) and not np.any(none.colours)
    tiny = _image(made_splats.one((0, 0, 2)), grid=Grid(8, 8, 8))
    assert tiny.transmittance.shape == (8, 8) and tiny.transmittance.min() < 0.5
    lonely = _image(made_splats.one((-0.6, -0.6, 2), scale=0.01))
    assert np.all(lonely.transmittance[8:, 8:] == 1.0) and lonely.transmittance.min() < 0.9


@pytest.mark.slow
@_often("chunks")
def test_a_list_longer_than_a_chunk(form):
    """100 equal layers: the transmittance is a power, until it is below 1e-4."""
    layers = [made_splats.one((0, 0, 2 + 0.01 * n), scale=30, opacity=0.05) for n in range(100)]
    values = made_splats.joined(*layers)

    def left(values):
        seen = _rendered(values, made_splats.AHEAD, _SMALL)
        return jnp.sum(seen.transmittance), seen

    left = jax.jit(jax.grad(left, has_aux=True))
    slopes, seen = left(values)
    np.testing.assert_allclose(seen.transmittance[8, 8], 0.95**100, rtol=2e-3)
    slopes = slopes.logits
    np.testing.assert_allclose(slopes, np.full(100, slopes.mean()), rtol=2e-2)
    thick = values._replace(logits=jnp.full(100, 2.0))
    assert 1e-4 < float(left(thick)[1].transmittance[8, 8]) < 1e-2


@pytest.mark.slow
@_each_form
def test_opaque_gaussians_keep_a_thousandth_and_have_finite_derivatives(form):
    values = made_splats.joined(
        made_splats.one((0, 0, 2), scale=50, opacity=1.0),
        made_splats.one((0, 0, 3), scale=50, opacity=1.0, colour=(0, 1, 0)),
    )

    def total(values):
        seen = _rendered(values, made_splats.AHEAD, _SMALL)
        return jnp.sum(seen.colours), seen

    slopes, seen = jax.jit(jax.grad(total, has_aux=True))(values)
    # The second would bring the transmittance to 1e-6, so that the pixel ends before it.
    assert float(seen.transmittance[8, 8]) == pytest.approx(0.001, rel=1e-2)
    assert gradients.all_finite(slopes)


def test_records_have_no_gaussian_that_is_not_visible(form):
    """A hidden Gaussian has a radius of 0, so that no list has it."""
    hidden = Projected(*(jnp.zeros((3, *s), jnp.float32) for s in ((2,), (3,), (), (3,), (), (2,))))
    seen = _compiled(_blended, _SMALL, _CAPACITY)(hidden)
    assert np.all(seen.transmittance == 1.0)
