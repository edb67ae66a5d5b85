import dataclasses

import numpy as np
import pytest
import trimesh

from refref_jax.geometry.triangle_meshes import Mesh, face_normals, is_closed, make_mesh, pieces
from refref_jax.reconstruct import ReconstructionError, convex, refinement, smoothing
from refref_jax.reconstruct.grids import Box, find_isosurface, sample
from refref_jax.reconstruct.masks import Views, some_of
from refref_jax.reconstruct.mesh_distance import ClosestSearch, compare_meshes, silhouette_overlap
from refref_jax.reconstruct.refinement import Refinement, keep_pieces, refine
from refref_jax.reconstruct.smoothing import denoise_within
from tests.factories import bodies
from tests.factories.scenes import volume_of

_BOX = Box(np.full(3, -1.6), np.full(3, 1.6))

_NOTHING = Refinement(denoising=0.0, convex_depth=0.0)


def _surface(body, spacing=0.07):
    return find_isosurface(sample(body, _BOX, spacing=spacing))


def _shaken(mesh, amount, seed=0):
    noise = np.random.default_rng(seed).normal(size=mesh.vertices.shape)
    return make_mesh(mesh.vertices + amount * noise, mesh.faces)


def _rippled(level, *, wavelength, height):
    """A ball with ripples around its equator."""
    mesh = bodies.icosphere(level)
    azimuth = np.arctan2(mesh.vertices[:, 1], mesh.vertices[:, 0])
    flat = np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 1])
    ripple = height * np.cos(np.rint(2.0 * np.pi / wavelength) * azimuth) * flat**2
    return make_mesh(mesh.vertices * (1.0 + ripple)[:, None], mesh.faces)


def _ripple_left(mesh, wavelength):
    radius = np.linalg.norm(mesh.vertices, axis=-1)
    azimuth = np.arctan2(mesh.vertices[:, 1], mesh.vertices[:, 0])
    some = np.abs(mesh.vertices[:, 2]) < 0.15
    wave = np.cos(np.rint(2.0 * np.pi / wavelength) * azimuth[some])
    return np.linalg.lstsq(np.stack([np.ones_like(wave), wave], -1), radius[some])[0][1]


def test_diffusion_damps_a_ripple_as_the_heat_kernel_does_at_any_edge_length():
    wavelength, length = 2.0 * np.pi / 12.0, 0.1
    expected = np.exp(-0.5 * (2.0 * np.pi * length / wavelength) ** 2)
    left = []
    for level in (4, 5):
        before = _rippled(level, wavelength=wavelength, height=0.02)
        after = smoothing.diffuse(before, length)
        left.append(_ripple_left(after, wavelength) / _ripple_left(before, wavelength))
    assert left == pytest.approx([expected] * 2, abs=0.06)
    assert left[0] == pytest.approx(left[1], abs=0.02)


@pytest.mark.parametrize("smooth", [smoothing.diffuse, smoothing.denoise])
def test_smoothing_keeps_the_volume_and_does_nothing_over_no_length(smooth):
    mesh = _shaken(bodies.icosphere(4), 0.01)
    assert volume_of(smooth(mesh, 0.2)) == pytest.approx(volume_of(mesh), rel=1e-4)
    assert smooth(mesh, 0.0) is mesh


def test_diffusion_does_not_shrink_a_thin_ring():
    mesh = _surface(bodies.torus)
    after = smoothing.diffuse(mesh, 0.15)
    assert volume_of(after) == pytest.approx(volume_of(mesh), rel=1e-3)
    assert np.ptp(after.vertices[:, 0]) == pytest.approx(3.0, abs=0.06)


def test_denoising_takes_noise_and_leaves_edges():
    clean = bodies.fine_box(spacing=0.05)
    noisy = _shaken(clean, 0.003)
    truth = bodies.as_mesh(trimesh.creation.box((1.6, 1.6, 1.6)))
    before = compare_meshes(noisy, truth, samples=4000)
    after = compare_meshes(smoothing.denoise(noisy, 0.1), truth, samples=4000)
    rounded = compare_meshes(smoothing.diffuse(noisy, 0.1), truth, samples=4000)
    assert after.normal_error < 0.4 * before.normal_error
    assert after.normal_error < 0.4 * rounded.normal_error
    assert after.furthest < 0.01 < rounded.furthest


def test_denoising_is_independent_of_edge_length():
    wavelength = 2.0 * np.pi / 20.0
    left = []
    for level in (4, 5):
        before = _rippled(level, wavelength=wavelength, height=0.004)
        after = smoothing.denoise(before, 0.1, rounds=1)
        left.append(_ripple_left(after, wavelength) / _ripple_left(before, wavelength))
    assert max(left) < 0.5 and left[0] == pytest.approx(left[1], abs=0.12)


def test_a_noisy_cube_without_its_edges_becomes_the_cube():
    cut_off = smoothing.denoise(_shaken(_surface(bodies.box, 0.04), 0.002), 0.1)
    assert 0.0 < convex.depth_below_hull(cut_off) < 0.03
    body = convex.from_tangents(cut_off)
    assert len(body.vertices) == 8
    expected = 0.8 * np.sign(body.vertices)
    assert np.allclose(body.vertices, expected, atol=0.01)
    assert is_closed(body.faces) and volume_of(body) > 0.0


def test_a_smooth_body_becomes_its_hull():
    mesh = bodies.icosphere(3)
    found = convex.from_tangents(mesh)
    assert len(found.vertices) == len(mesh.vertices)
    assert volume_of(found) == pytest.approx(volume_of(mesh))
    assert np.all(np.sum(face_normals(found.vertices[found.faces]) * found.normals[:, 0], -1) > 0.9)


def test_depth_below_the_hull_is_known_by_hand():
    # The lowest points of the ring's hole lie 0.4 below the flat lids of its hull.
    assert convex.depth_below_hull(_surface(bodies.torus)) == pytest.approx(0.4, abs=0.02)
    assert convex.depth_below_hull(bodies.icosphere(2)) < 1e-12


def test_depths_below_a_hull_are_distances_from_it():
    dented = bodies.icosphere(4)
    vertices = dented.vertices * (1.0 - 0.3 * np.exp(-40.0 * (dented.vertices[:, :1] - 0.8) ** 2))
    hull = convex.hull(dented._replace(vertices=vertices))
    expected = ClosestSearch(hull.vertices, hull.faces)(vertices).distances.max()
    found = convex.depth_below_hull(dented._replace(vertices=vertices))
    assert found == pytest.approx(expected, abs=1e-12) and found > 0.05


def test_few_vertices_of_a_convex_mesh_are_compared_with_all_planes(monkeypatch):
    """All of them, on 40,000 vertices, would take a minute."""
    ball = bodies.icosphere(6)
    measured = []
    find = np.argsort

    def counted(bounds):
        for vertex in find(bounds):
            measured.append(vertex)
            yield vertex

    monkeypatch.setattr(convex.np, "argsort", counted)
    assert convex.depth_below_hull(ball) < 1e-12
    assert len(ball.vertices) == 40_962 and len(measured) < 2000


def test_floaters_go_and_the_largest_piece_stays_whatever_the_share():
    body, speck = bodies.icosphere(3), bodies.icosphere(1, radius=0.1, centre=(3.0, 0.0, 0.0))
    both = bodies.joined(speck, body)
    assert len(keep_pieces(both, smallest=0.01).faces) == len(body.faces)
    assert len(keep_pieces(both, smallest=0.0).faces) == len(both.faces)
    assert len(keep_pieces(both, smallest=1.1).faces) == len(body.faces)
    assert volume_of(keep_pieces(both, smallest=0.9)) == pytest.approx(volume_of(body))


def test_a_cavity_is_no_floater():
    shell = bodies.joined(bodies.icosphere(3), bodies.inverted(bodies.icosphere(3, radius=0.7)))
    kept = keep_pieces(shell, smallest=0.05)
    assert volume_of(kept) == pytest.approx(volume_of(shell))


@pytest.mark.slow
def test_rounding_a_cube_leaves_the_volume_of_a_rounded_cube():
    mesh = bodies.as_mesh(trimesh.creation.box((1.6, 1.6, 1.6)))
    radius, inner = 0.2, 1.2
    expected = inner**3 + 6 * inner**2 * radius + 3 * np.pi * inner * radius**2
    expected += 4.0 / 3.0 * np.pi * radius**3
    found = refinement.round_edges(mesh, radius, spacing=0.08)
    assert expected * 0.95 < volume_of(found) < expected * 1.005
    assert np.ptp(found.vertices, axis=0) == pytest.approx(1.6, abs=0.01)


@pytest.mark.slow
def test_meshing_anew_keeps_a_ball_and_its_normals():
    found = refinement.remesh(bodies.icosphere(4), 0.1)
    away = np.linalg.norm(found.vertices, axis=-1)
    assert np.all(np.abs(away - 1.0) < 6e-3)
    cosine = np.sum(found.normals * found.vertices[found.faces] / away[found.faces][..., None], -1)
    assert np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).mean() < 0.5


_EVERY_STAGE = Refinement(
    denoising=0.05, smoothing=0.05, convex_depth=0.04, rounding=0.3, spacing=0.15
)


@pytest.mark.parametrize(
    "mesh",
    [
        pytest.param(bodies.icosphere(3), marks=pytest.mark.slow),
        pytest.param(
            bodies.joined(bodies.icosphere(3), bodies.icosphere(1, radius=0.1, centre=(1.3, 0, 0))),
            marks=pytest.mark.slow,
        ),
        bodies.as_mesh(trimesh.creation.box((1.6, 1.6, 0.05)).subdivide_to_size(0.15)),
        pytest.param(_shaken(_surface(bodies.torus, 0.1), 0.004), marks=pytest.mark.slow),
    ],
    ids=["ball", "floater", "thin wall", "torus"],
)
def test_no_stage_empties_flips_tears_or_inflates(mesh):
    stages = refine(mesh, _EVERY_STAGE)
    assert [stage.name for stage in stages] == [
        "pieces",
        "denoised",
        "smoothed",
        "convex",
        "rounded",
        "remeshed",
    ]
    for stage in stages:
        assert is_closed(stage.mesh.faces) and np.all(np.isfinite(stage.mesh.vertices))
        assert volume_of(stage.mesh) == pytest.approx(volume_of(stages[0].mesh), rel=0.08), (
            stage.name
        )
    holes = [trimesh.Trimesh(*stage.mesh[:2], process=False).euler_number for stage in stages]
    assert len(set(holes)) == 1


def test_what_would_vanish_is_refused_with_the_reason():
    plate = bodies.as_mesh(trimesh.creation.box((1.6, 1.6, 0.05)).subdivide_to_size(0.2))
    settings = dataclasses.replace(_NOTHING, rounding=0.1)
    last = refine(plate, settings)[-1]
    assert last.refused == "nothing would be left"
    assert np.array_equal(last.mesh.vertices, plate.vertices)
    dumbbell = bodies.joined(
        bodies.icosphere(3, radius=0.5), bodies.icosphere(3, radius=0.5, centre=(1.5, 0, 0))
    )
    assert len(np.unique(pieces(dumbbell.faces, len(dumbbell.vertices)))) == 2
    assert volume_of(refine(dumbbell, Refinement())[-1].mesh) == pytest.approx(
        volume_of(dumbbell), 0.02
    )


def test_a_dent_deeper_than_the_threshold_stays():
    mesh = _surface(bodies.torus)
    assert refine(mesh, dataclasses.replace(_NOTHING, convex_depth=0.3))[-1].mesh.faces.shape == (
        mesh.faces.shape
    )


def test_meshes_that_bound_no_body_are_errors():
    mesh = bodies.icosphere(2)
    with pytest.raises(ReconstructionError, match="is empty"):
        refine(Mesh(mesh.vertices[:0], mesh.faces[:0], mesh.normals[:0]), Refinement())
    with pytest.raises(ReconstructionError, match="is not closed"):
        refine(make_mesh(mesh.vertices, mesh.faces[1:]), Refinement())
    with pytest.raises(ReconstructionError, match="inside out"):
        refine(bodies.inverted(mesh), Refinement())


def _finned(points):
    """A ball with a fin as thin as denoising is long."""
    fin = bodies.box(points, half=(1.0, 1.0, 0.06))
    return np.minimum(bodies.ball(points, radius=0.6), fin)


@pytest.mark.slow
def test_denoising_goes_as_far_as_masks_allow():
    cameras = bodies.cameras_around(8, size=96)
    views = Views(bodies.masks_of(_finned, cameras, steps=200), cameras)
    raw = _surface(_finned, spacing=0.05)
    free = denoise_within(raw, 0.4, crease_angle=0.26, views=None)
    held = denoise_within(raw, 0.4, crease_angle=0.26, views=views)
    before, freely, within = (silhouette_overlap(m, *views).mean() for m in (raw, free, held))
    assert freely < before - 0.05 and within > before - 0.01
    half = denoise_within(raw, 0.2, crease_angle=0.26, views=None)
    np.testing.assert_array_equal(held.vertices, half.vertices)
    with pytest.raises(ReconstructionError, match="reduce the overlap with the masks too much"):
        denoise_within(raw, 0.4, crease_angle=1.0, views=views)


def test_some_views_are_spread_over_all():
    cameras = bodies.cameras_around(9, size=8)
    views = Views(np.ones((9, 8, 8), bool), cameras)
    few = some_of(views, 3)
    np.testing.assert_array_equal(few.cameras.poses, cameras.poses[[0, 4, 8]])
    assert len(some_of(views, 20).masks) == 9
