"""Exported backdrops against rays that a stranger casts and textures that are read again."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from experiments.exporting import backdrop_surface
from refref_jax.geometry.rays import Rays
from refref_jax.optics import light_paths
from refref_jax.render import backdrop, pixels
from refref_jax.render.model import BackdropConfig, Model, Params
from refref_jax.sampling.scene_bounds import Domain
from tests.factories import small_model

_SIDE = 16
_each_space = pytest.mark.parametrize(
    "space", ["bounded", pytest.param("spherical", marks=pytest.mark.slow), "unbounded"]
)


def _model(space):
    random = np.random.default_rng(4)
    pyramid = tuple(
        jnp.asarray(random.uniform(0.0, 0.3, size=(6, side + 1, side + 1, 3)), jnp.float32)
        for side in backdrop.sides(_SIDE)
    )
    shape = dataclasses.replace(
        small_model.MODEL,
        radius=2.0,
        space=space,
        centre=(0.1, -0.2, 0.3),
        backdrop=BackdropConfig(_SIDE),
    )
    return Model(shape, None, None, Params((), pyramid, None))


def _seen(model, domain, directions):
    """Returns the linear RGB that rays from the centre see."""
    count = len(directions)
    origins = np.broadcast_to(np.asarray(domain.centre), (count, 3))
    rays = Rays(*(np.asarray(x, np.float32) for x in (origins, directions, np.zeros(count))))
    return np.asarray(_look(model.params.field, rays, domain=domain))


@functools.partial(jax.jit, static_argnames="domain")
def _look(pyramid, rays, *, domain):
    numbers = jnp.arange(len(rays.radii), dtype=jnp.int32)
    ends = light_paths.straight_ends(rays)
    lookups = backdrop.locate(domain, ends, numbers, resolution=_SIDE, most_taps=1)
    return backdrop.radiance(backdrop.mipmap(pyramid, domain.space), lookups)


def _directions(count=400):
    drawn = np.random.default_rng(5).normal(size=(count, 3))
    return drawn / np.linalg.norm(drawn, axis=-1, keepdims=True)


def _bilinear(image, uv):
    """Returns texels at texture coordinates; those of the origin are at the lower left."""
    height, width = image.shape[:2]
    place = np.stack([uv[:, 0] * width, (1.0 - uv[:, 1]) * height], axis=-1) - 0.5
    column, row = np.clip(np.floor(place).astype(int), 0, [width - 2, height - 2]).T
    right, down = (place - np.stack([column, row], axis=-1)).T[..., None]
    above = (1.0 - right) * image[row, column] + right * image[row, column + 1]
    below = (1.0 - right) * image[row + 1, column] + right * image[row + 1, column + 1]
    return (1.0 - down) * above + down * below


@pytest.mark.slow
@pytest.mark.parametrize("space", ["bounded", "spherical", "unbounded"])
def test_rays_into_the_textured_mesh_see_the_backdrop(space, tmp_path):
    model, domain = _model(space), Domain(2.0, space, (0.1, -0.2, 0.3))
    path = tmp_path / "room.glb"
    backdrop_surface.write_textured_mesh(path, model)
    read = trimesh.load(path)
    assert sorted(read.geometry) == sorted(f"{sign}{axis}" for sign in "-+" for axis in "xyz")
    directions = _directions()
    expected = np.asarray(pixels.linear_to_srgb(jnp.asarray(_seen(model, domain, directions))))
    seen = np.full_like(expected, np.nan)
    for mesh in read.geometry.values():
        origins = np.broadcast_to(np.asarray(domain.centre), directions.shape)
        points, rays, faces = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
        assert np.all(np.sum(mesh.face_normals[faces] * directions[rays], axis=-1) < 0.0)
        weights = trimesh.triangles.points_to_barycentric(mesh.triangles[faces], points)
        uv = np.einsum("rc,rcu->ru", weights, mesh.visual.uv[mesh.faces[faces]])
        texture = np.asarray(mesh.visual.material.emissiveTexture, np.float64)[..., :3] / 255.0
        seen[rays] = _bilinear(texture, uv)
    # Bytes are rounded, and bilinear in sRGB is not quite bilinear in linear light.
    assert np.nanmax(np.abs(seen - expected)) < 0.05 and not np.any(np.isnan(seen))
    assert np.mean(np.abs(seen - expected)) < 0.006


@pytest.mark.slow
@_each_space
def test_a_panorama_looks_along_x_with_y_to_the_left(space):
    model, domain = _model(space), Domain(2.0, space, (0.1, -0.2, 0.3))
    image = backdrop_surface.panorama(model, height=64)
    assert image.shape == (64, 128, 3)
    for row, column, towards in ((32, 64, (1, 0, 0)), (32, 32, (0, 1, 0)), (0, 9, (0, 0, 1))):
        direction = np.asarray([towards], np.float64) + 1e-3
        direction /= np.linalg.norm(direction)
        np.testing.assert_allclose(image[row, column], _seen(model, domain, direction)[0], atol=0.1)


def test_the_coverage_flags_vertices_that_no_pixel_sees():
    seen = np.zeros((6, 3, 3))
    seen[2, 1, 1], seen[5, 0, 2] = 100.0, 0.5
    sheet = backdrop_surface.as_heat(seen)
    assert sheet.shape == (9, 6, 3)
    np.testing.assert_allclose(sheet[4, 1], 1.0)
    assert 0.3 < sheet[6, 5, 0] < 0.6 and np.ptp(sheet[6, 5]) == 0.0
    flagged = np.all(sheet == [1.0, 0.0, 1.0], axis=-1)
    assert np.sum(flagged) == 54 - 2


def test_a_model_with_fields_is_refused(tmp_path):
    model = Model(small_model.MODEL, None, None, None)
    with pytest.raises(ValueError, match="has a field, not a backdrop"):
        backdrop_surface.check(model, tmp_path)
