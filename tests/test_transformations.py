"""Every cell of the table of transformations in `docs/library.md`."""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import refref_jax
from refref_jax.render import (
    Environment,
    LinearTexture,
    Model,
    images,
    init_params,
    radiance_of,
    render_image,
    render_known,
    render_rays,
    shade,
)
from tests.factories.small_model import MODEL
from tests.laws import gradients

_PAGE = Path(__file__).parents[1] / "docs" / "library.md"

_GLASS = refref_jax.single_object(trimesh.creation.box(), index=1.5)
_SETTINGS = refref_jax.PathSettings(max_bends=2, reflections="all")
_STRAIGHT = refref_jax.PATH_PRESETS["straight"]
_AHEAD = np.array([1.0, 0.0, 0.0])

# Head-on, glass lets 4 n / (n + 1)^2 through at each of its two faces.
_THROUGH = 0.96**2
_SLOPE = 2.0 * 0.96 * -0.128


def _rays(*heights):
    """Returns rays that meet the cube head-on, or pass by it."""
    origins = np.stack([[-2.0, height, 0.2] for height in heights])
    return refref_jax.Rays(origins, np.tile(_AHEAD, (len(heights), 1)), np.full(len(heights), 1e-3))


_ROW = _rays(-0.3, 0.1, 0.2, 4.0)
_RAY = jax.tree.map(lambda x: x[1], _ROW)
_ROWS = jax.tree.map(lambda x: np.stack([x, x[::-1]]), _ROW)


def _wall(origin, direction):
    return jnp.where(direction[0] > 0.0, jnp.ones_like(origin), 0.0)


def _same(got, expected, atol=1e-6):
    for ours, theirs in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=atol)


def _kinds(tree):
    return {x.dtype for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)}


_CHECKS = {}


def _cell(function, transformation, *marks):
    def register(check):
        _CHECKS[function, transformation] = pytest.param(
            check, marks=marks, id=f"{function}-{transformation}"
        )
        return check

    return register


# --- trace ---

_trace = functools.partial(refref_jax.trace, settings=_SETTINGS)
_traced = jax.jit(_trace)


def _check_traced(traced):
    paths = jax.tree.map(np.asarray, traced.paths)
    light = np.zeros((4, 3))
    np.add.at(light, paths.rays, paths.throughput)
    np.testing.assert_allclose(light + traced.dropped, 1.0, atol=1e-5)
    heaviest = paths.throughput[[np.argmax(paths.rays == ray) for ray in range(4)], 0]
    np.testing.assert_allclose(heaviest, [_THROUGH, _THROUGH, _THROUGH, 1.0], atol=1e-5)


@_cell("trace", "jit")
def _():
    _check_traced(_traced(_GLASS, _ROW))


@_cell("trace", "vmap", pytest.mark.slow)
def _():
    mapped = jax.jit(jax.vmap(_trace, in_axes=(None, 0)))(_GLASS, _ROWS)
    for number in range(2):
        batch = jax.tree.map(lambda x: x[number], _ROWS)  # noqa: B023
        _same(jax.tree.map(lambda x: x[number], mapped), _traced(_GLASS, batch))  # noqa: B023


@_cell("trace", "grad")
def _():
    def light(index):
        return jnp.sum(_trace(refref_jax.with_index(_GLASS, index), _ROW).paths.throughput)

    with pytest.raises(TypeError, match="Use follow_branch"):
        jax.grad(light)(1.5)


@_cell("trace", "in double precision")
def _():
    with jax.enable_x64(True):
        traced = _traced(_GLASS, _ROW)
        assert _kinds(traced) == {jnp.dtype("float64")}
        _check_traced(traced)


# --- single paths ---


def _transmitted(index, ray, *, reflects=(False, False)):
    scene = refref_jax.with_index(_GLASS, index)
    path = refref_jax.follow_branch(scene, ray, jnp.asarray(reflects), settings=_SETTINGS)
    return path.throughput[0]


def _colour(index, ray):
    scene = refref_jax.with_index(_GLASS, index)
    paths = refref_jax.follow_main_branches(scene, ray, settings=_SETTINGS, reflections=1)
    return shade(paths, _wall, rays=1)[0, 0]


@functools.cache
def _compiled(function):
    """Returns the values of a row of rays, and their derivatives by the index."""
    slopes = jax.vmap(jax.value_and_grad(function), in_axes=(None, 0))
    return jax.jit(slopes)(1.5, _ROW)


def _check_values(function):
    values, _ = _compiled(function)
    np.testing.assert_allclose(values, [_THROUGH, _THROUGH, _THROUGH, 1.0], atol=1e-5)


def _check_slopes(function):
    _, slopes = _compiled(function)
    np.testing.assert_allclose(slopes, [_SLOPE, _SLOPE, _SLOPE, 0.0], atol=1e-5)


def _check_double(function):
    with jax.enable_x64(True):
        index = jnp.float64(1.5)
        value, slope = jax.jit(jax.value_and_grad(function))(index, _RAY)
        # The corners were rounded, but those of a cube are exact.
        np.testing.assert_allclose([value, slope], [_THROUGH, _SLOPE], rtol=1e-12)
        assert value.dtype == jnp.float64


for _name, _function in {"follow_branch": _transmitted, "follow_main_branches": _colour}.items():
    # One compiled program is all three: the same numbers say so.
    for _column in ("jit", "vmap"):
        _cell(_name, _column)(functools.partial(_check_values, _function))
    _cell(_name, "grad")(functools.partial(_check_slopes, _function))
    _cell(_name, "in double precision")(functools.partial(_check_double, _function))


# --- with_index ---


def _indices(index):
    return refref_jax.with_index(_GLASS, index).interfaces.index_inside[0]


@_cell("with_index", "jit")
def _():
    assert jax.jit(_indices)(1.25) == 1.25


@_cell("with_index", "vmap")
def _():
    np.testing.assert_array_equal(jax.vmap(_indices)(jnp.array([1.25, 1.5])), [1.25, 1.5])


@_cell("with_index", "grad")
def _():
    assert jax.grad(_indices)(1.25) == 1.0


@_cell("with_index", "in double precision")
def _():
    with jax.enable_x64(True):
        double = _GLASS.interfaces._replace(index_inside=np.array([1.5]))
        changed = refref_jax.with_index(_GLASS._replace(interfaces=double), 1.1)
        assert changed.interfaces.index_inside.dtype == jnp.float64
        assert float(changed.interfaces.index_inside[0]) == 1.1


# --- shade and backgrounds ---


def _straight():
    return refref_jax.trace(_GLASS, _ROW, settings=_STRAIGHT).paths


def _brightness(scale, paths):
    return shade(paths, lambda origin, direction: scale * _wall(origin, direction), rays=4)


@_cell("shade", "jit")
def _():
    _same(jax.jit(_brightness)(0.5, _straight()), np.full((4, 3), 0.5))


@_cell("shade", "vmap")
def _():
    twice = jax.tree.map(lambda x: jnp.stack([x, x]), _straight())
    twice = twice._replace(throughput=twice.throughput * jnp.array([1.0, 0.5])[:, None, None])
    expected = np.stack([np.full((4, 3), 0.5), np.full((4, 3), 0.25)])
    _same(jax.vmap(_brightness, in_axes=(None, 0))(0.5, twice), expected)


@_cell("shade", "grad")
def _():
    paths = _straight()
    light = lambda scale, weights: jnp.sum(_brightness(scale, paths._replace(throughput=weights)))
    by_scale, by_weights = jax.grad(light, argnums=(0, 1))(0.5, paths.throughput)
    _same((by_scale, by_weights), (12.0, np.full((4, 3), 0.5)))


@_cell("shade", "in double precision")
def _():
    with jax.enable_x64(True):
        seen = shade(_straight(), lambda origin, direction: jnp.ones(3, jnp.float32), rays=4)
        assert seen.dtype == jnp.float64


_TEXELS = np.linspace(0.1, 0.9, 24).reshape(2, 4, 3)


def _look(texels, direction):
    background = Environment(LinearTexture(texels))
    return jnp.sum(radiance_of(background)(jnp.zeros_like(direction), direction))


_DIRECTIONS = np.array([[0.6, 0.8, 0.0], [0.0, 0.6, 0.8]])


@_cell("radiance_of(...)", "jit")
def _():
    texels = jnp.full((2, 4, 3), 0.5)
    np.testing.assert_allclose(jax.jit(_look)(texels, jnp.array([0.6, 0.8, 0.0])), 1.5, rtol=1e-6)


@_cell("radiance_of(...)", "vmap")
def _():
    texels, directions = jnp.asarray(_TEXELS, jnp.float32), jnp.asarray(_DIRECTIONS, jnp.float32)
    mapped = jax.vmap(_look, in_axes=(None, 0))(texels, directions)
    _same(mapped, jnp.stack([_look(texels, direction) for direction in directions]))


@_cell("radiance_of(...)", "grad")
def _():
    gradients.assert_numerical(_look, _TEXELS, _DIRECTIONS[0])


@_cell("radiance_of(...)", "in double precision")
def _():
    with jax.enable_x64(True):
        seen = _look(jnp.asarray(_TEXELS), jnp.asarray(_DIRECTIONS[0]))
        assert seen.dtype == jnp.float64


# --- models ---


@functools.cache
def _model():
    """Returns a model whose light is not bent: what is transformed here are its fields."""
    params = init_params(jax.random.key(0), MODEL)
    return Model(MODEL, _STRAIGHT, _GLASS, params)


def _render(params, rays):
    return render_rays(_model()._replace(params=params), rays).linear


_rendered = jax.jit(_render)


@_cell("render_rays", "jit")
def _():
    seen = _rendered(_model().params, _ROW)
    assert seen.shape == (4, 3) and np.all(np.isfinite(seen)) and np.all(seen > 0.0)


@_cell("render_rays", "vmap")
def _():
    params = _model().params
    mapped = jax.jit(jax.vmap(_render, in_axes=(None, 0)))(params, _ROWS)
    _same(mapped[0], _rendered(params, _ROW), atol=1e-5)
    _same(mapped[1], mapped[0][::-1], atol=1e-5)


@_cell("render_rays", "grad")
def _():
    slopes = jax.jit(jax.grad(lambda params: jnp.sum(_render(params, _ROW))))(_model().params)
    assert gradients.all_finite(slopes)
    assert any(np.any(slope != 0.0) for slope in jax.tree.leaves(slopes.field))


@_cell("render_rays", "in double precision")
def _():
    params, expected = _model().params, _rendered(_model().params, _ROW)
    with jax.enable_x64(True):
        seen = _rendered(params, _ROW)
        assert seen.dtype == jnp.float32
        _same(seen, expected, atol=1e-5)


@_cell("init_params", "jit", pytest.mark.slow)
def _():
    compiled = jax.jit(functools.partial(init_params, config=MODEL))(jax.random.key(0))
    _same(compiled, _model().params)


@_cell("init_params", "vmap", pytest.mark.slow)
def _():
    keys = jnp.stack([jax.random.key(0), jax.random.key(1)])
    both = jax.vmap(functools.partial(init_params, config=MODEL))(keys)
    _same(jax.tree.map(lambda x: x[0], both), _model().params)
    first, second = both.field["params"], jax.tree.map(lambda x: x[1], both.field["params"])
    assert any(
        np.any(a[0] != b) for a, b in zip(*map(jax.tree.leaves, (first, second)), strict=True)
    )


@_cell("init_params", "grad")
def _():
    with pytest.raises(TypeError):
        jax.grad(lambda key: jnp.sum(init_params(key, MODEL).proposals[0]))(jax.random.key(0))


@_cell("init_params", "in double precision")
def _():
    with jax.enable_x64(True):
        dyed = dataclasses.replace(MODEL, learned_tints=2)
        assert _kinds(init_params(jax.random.key(0), dyed)) == {jnp.dtype("float32")}


def _picture(rays, glass=_GLASS, settings=_STRAIGHT):
    return render_known(glass, _wall, rays, settings=settings).linear


def _image(rays, scene=_GLASS):
    return render_image(_model()._replace(scene=scene), rays).linear


for _name, _function, _instead in [
    ("render_known", _picture, "shade"),
    ("render_image", _image, "render_rays"),
]:

    def _refused(transform, arguments, function=_function, instead=_instead):
        with pytest.raises(TypeError, match=f"tile by tile on the host.*{instead}"):
            transform(function)(*arguments)

    _cell(_name, "jit")(functools.partial(_refused, jax.jit, (_ROW,)))
    _cell(_name, "vmap")(functools.partial(_refused, jax.vmap, (_ROWS,)))
    _by_ray = lambda function: jax.grad(lambda rays: jnp.sum(function(rays)))
    _cell(_name, "grad")(functools.partial(_refused, _by_ray, (_ROW,)))


def test_a_picture_has_no_gradient_of_the_scene_and_says_what_has():
    by_index = lambda index: jnp.sum(
        _picture(_ROW, refref_jax.with_index(_GLASS, index), _SETTINGS)
    )
    with pytest.raises(TypeError, match="follow_main_branches"):
        jax.grad(by_index)(1.5)


def _image_of_params(x, model):
    params = jax.tree.map(lambda y: x * y, model.params)
    return render_image(model._replace(params=params), _ROW).linear


_WITH_TRACERS = {
    "scene": (lambda x, _: _image(_ROW, refref_jax.with_index(_GLASS, x)), "render_rays"),
    "parameters": (_image_of_params, "render_rays"),
    "surfaces": (
        lambda x, _: (
            images.find_first_surface(
                _GLASS.surfaces._replace(normals=x * _GLASS.surfaces.normals), _ROW
            ).distances
        ),
        "closest_hits",
    ),
    "radiance": (
        lambda x, _: render_known(_GLASS, lambda *_: x * _AHEAD, _ROW, settings=_STRAIGHT).linear,
        "shade",
    ),
}


@pytest.mark.parametrize("transform", [jax.jit, jax.grad])
@pytest.mark.parametrize("what", _WITH_TRACERS)
def test_functions_of_the_host_refuse_a_tracer_wherever_it_is(what, transform):
    (function, instead), model = _WITH_TRACERS[what], _model()
    with pytest.raises(TypeError, match=f"tile by tile on the host.*{instead}"):
        transform(lambda x: jnp.sum(function(x, model)))(1.0)


def test_functions_of_the_host_are_refused_in_a_compiled_function_of_other_arrays():
    model = _model()
    with pytest.raises(TypeError, match=r"tile by tile on the host.*render_rays"):
        jax.jit(lambda x: x * render_image(model, _ROW).linear)(1.0)


@_cell("render_known", "in double precision", pytest.mark.slow)
def _():
    with jax.enable_x64(True):
        seen = _picture(_ROW, settings=_SETTINGS)
    assert seen.dtype == np.float64
    np.testing.assert_allclose(seen[:, 0], [_THROUGH] * 3 + [1.0], rtol=1e-12)


@_cell("render_image", "in double precision", pytest.mark.slow)
def _():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(images, "TILE", 4)
        with jax.enable_x64(True):
            seen = _image(_ROW)
    assert seen.dtype == np.float32
    _same(seen, _rendered(_model().params, _ROW), atol=1e-5)


# --- the table ---


def _table():
    text = _PAGE.read_text().partition("## Supported transformations")[2]
    rows = [line.strip("|").split(" | ") for line in text.splitlines() if line.startswith("|")]
    head, _, *rows = [[cell.strip(" `|") for cell in row] for row in rows]
    return {(row[0], column): cell for row in rows for column, cell in zip(head, row, strict=True)}


@pytest.mark.slow
@pytest.mark.parametrize("check", _CHECKS.values())
def test_what_a_cell_says(check):
    check()


def test_every_cell_is_tested_and_has_an_answer():
    cells = {place: cell for place, cell in _table().items() if place[1] != "function"}
    assert set(cells) == set(_CHECKS)
    assert all(cell.startswith(("yes", "no: ", "computes", "gives")) for cell in cells.values())
