"""Opaque caps, feet and labels: where they are, what is left, and what is none."""

import numpy as np
import pytest

from refref_jax.geometry.triangle_meshes import (
    face_vectors,
    is_watertight,
    unit_vectors,
    volume,
)
from refref_jax.reconstruct import opaque_parts, photometry, walls
from refref_jax.reconstruct.contents import COARSE, Interior
from refref_jax.reconstruct.families import Revolution
from refref_jax.reconstruct.interiors import Vessel
from refref_jax.reconstruct.mesh_distance import signed_distance
from refref_jax.reconstruct.opaque_parts import OpaquePart, clear_part, find_opaque_parts
from refref_jax.reconstruct.photometry import Backdrop
from refref_jax.reconstruct.revolution import Profile
from refref_jax.reconstruct.shape_from_refraction import SingleObject
from refref_jax.reconstruct.shapes import FixedShape, mesh_of
from tests.factories import revolved, scenes, vessels

_BLUE, _ROW = (0.02, 0.05, 0.3), 2.6 / 128


def _cap(body, height, colour=_BLUE):
    top = float(body.points[:, 1].max())
    return OpaquePart(top - height, top, colour)


def _foot(body, height, colour=_BLUE):
    bottom = float(body.points[:, 1].min())
    return OpaquePart(bottom, bottom + height, colour)


@pytest.fixture(scope="module")
def body():
    return vessels.bottle()


@pytest.fixture(scope="module")
def surface():
    return vessels.smooth_backdrop()


@pytest.fixture(scope="module")
def clear(body, surface):
    """Pixels of solid glass."""
    model = SingleObject(FixedShape(mesh_of(body.pose(body.start()))), 1.5, deviation=1.0)
    return vessels.photographs(model, surface, count=24_000, reach=1.4)


def _painted(body, pixels, *parts):
    """The same pixels where parts are opaque, with some noise."""
    colours = opaque_parts.colours_seen(body, parts, pixels.rays)
    seen = ~np.isnan(colours[:, 0])
    rgb = pixels.rgb.copy()
    rgb[seen] = photometry.encode(colours[seen])
    noise = np.random.default_rng(0).normal(scale=0.01, size=rgb.shape)
    return pixels._replace(rgb=np.clip(rgb + noise, 0.0, 1.0))


@pytest.mark.slow
def test_a_cap_is_found_where_it_is(body, surface, clear):
    cap = _cap(body, 0.55)
    (found,) = find_opaque_parts(body, surface, _painted(body, clear, cap))
    assert found.low == pytest.approx(cap.low, abs=2.0 * _ROW)
    assert found.high == pytest.approx(cap.high, abs=0.01)
    assert found.colour == pytest.approx(_BLUE, abs=0.01)


@pytest.mark.slow
def test_a_cap_and_a_foot_are_two_ends(body, surface, clear):
    ends = (_foot(body, 0.3, (0.5, 0.2, 0.1)), _cap(body, 0.4))
    found = find_opaque_parts(body, surface, _painted(body, clear, *ends))
    for end, true in zip(found, ends, strict=True):
        assert (end.low, end.high) == pytest.approx((true.low, true.high), abs=2.0 * _ROW)
        assert end.colour == pytest.approx(true.colour, abs=0.02)


@pytest.mark.slow
def test_a_label_is_found_below_a_cap(body, surface, clear):
    middle = float(body.points[:, 1].min()) + 0.9
    label = OpaquePart(middle, middle + 0.5, (0.7, 0.7, 0.6))
    found = find_opaque_parts(body, surface, _painted(body, clear, label, _cap(body, 0.4)))
    assert [part.kind(body) for part in found] == ["label", "cap"]
    assert (found[0].low, found[0].high) == pytest.approx((label.low, label.high), abs=2.0 * _ROW)
    assert found[0].colour == pytest.approx(label.colour, abs=0.03)


@pytest.mark.parametrize(
    ("rows", "parts"),
    [
        ("ooooo" + 95 * ".", [(0, 5)]),
        ("??ooo" + 95 * ".", [(0, 5)]),
        ("ooo" + 97 * ".", [(0, 3)]),
        ("oo" + 98 * ".", []),
        (97 * "." + "ooo", [(97, 100)]),
        (96 * "." + "ooo?", [(96, 100)]),
        (40 * "." + 5 * "o" + 55 * ".", [(40, 45)]),
        (40 * "." + "oo?ooo" + 54 * ".", [(40, 46)]),
        (40 * "." + "ooo..oo" + 53 * ".", [(40, 47)]),  # two lines of print
        (40 * "." + "ooo...oo" + 52 * ".", []),
        # What is not known does not make a label, nor a cap of it.
        (40 * "." + "?oooo?" + 54 * ".", []),
        (40 * "." + "o????o" + 54 * ".", []),
        (40 * "." + 8 * "o" + 52 * "?", [(40, 48)]),
        (20 * "." + 5 * "o" + 9 * "?" + 5 * "o" + 61 * ".", [(20, 25), (34, 39)]),
        (10 * "o" + 40 * "." + 10 * "o" + 30 * "." + 10 * "o", [(0, 10), (50, 60), (90, 100)]),
        # Stained glass, which as an end would be dark enough.
        (40 * "." + 10 * "-" + 50 * ".", []),
        (90 * "." + 10 * "-", [(90, 100)]),
        (85 * "." + 2 * "-" + 12 * "o" + "-", [(85, 100)]),  # one part, a cap
        (70 * "o" + 30 * ".", [(0, 70)]),
        (71 * "o" + 29 * ".", []),
        (
            22 * "." + 50 * "o" + 5 * "." + 23 * "-",
            [(77, 100)],
        ),  # too much with the label, not without
        (100 * "?", []),
    ],
)
def test_opaque_rows_are_a_foot_labels_or_a_cap(rows, parts):
    shares = {"o": 0.24, "-": 0.34, ".": 0.36, "?": np.nan}
    assert opaque_parts._opaque_rows(np.array([shares[letter] for letter in rows])) == parts


@pytest.mark.slow
def test_clear_glass_has_no_opaque_parts(body, surface, clear):
    assert find_opaque_parts(body, surface, _painted(body, clear)) == ()


@pytest.mark.slow
def test_in_front_of_a_plain_wall_nothing_is_told(body, surface, clear):
    grey = Backdrop(
        surface.domain, tuple(0.0 * mip + 0.4 for mip in surface.mips), surface.coverage
    )
    same = clear._replace(rgb=np.full_like(clear.rgb, 0.66))
    assert find_opaque_parts(body, grey, same) == ()


@pytest.mark.slow
def test_what_is_opaque_as_a_whole_has_no_ends(body, surface, clear):
    whole = OpaquePart(-4.0, 4.0, _BLUE)
    assert find_opaque_parts(body, surface, _painted(body, clear, whole)) == ()
    ring = Revolution(body.axis, Profile(revolved.ring(), closed=True), 2.0)
    assert find_opaque_parts(ring, surface, clear) == ()


@pytest.mark.slow
def test_two_ends_that_leave_little_are_none(body, surface, clear):
    ends = (_foot(body, 1.2), _cap(body, 1.2))
    assert find_opaque_parts(body, surface, _painted(body, clear, *ends)) == ()


def test_a_high_cap_is_no_foot(body):
    cap, foot = _cap(body, 1.7), _foot(body, 0.3)
    assert (cap.kind(body), foot.kind(body)) == ("cap", "foot")
    assert clear_part(body, (foot, cap)).points[:, 1].max() == pytest.approx(cap.low, abs=0.02)


@pytest.mark.slow
def test_few_pixels_tell_nothing(body, surface, clear):
    some = _painted(body, clear, _cap(body, 0.55)).chosen(np.arange(40))
    assert find_opaque_parts(body, surface, some) == ()


@pytest.mark.slow
def test_glass_and_ends_are_apart_and_fill_the_body(body):
    ends = (_foot(body, 0.3), _cap(body, 0.4))
    glass = clear_part(body, ends)
    found = (glass.points[:, 1].min(), glass.points[:, 1].max())
    assert found == pytest.approx((ends[0].high, ends[1].low), abs=0.02)
    whole, middle = (mesh_of(each.pose(each.start())) for each in (body, glass))
    meshes = [opaque_parts.mesh_of_end(body, end) for end in ends]
    inside = signed_distance(middle)
    for mesh in meshes:
        assert volume(mesh.vertices, mesh.faces) > 0.0
        assert inside(mesh.vertices).min() > 0.0
    total = sum(volume(mesh.vertices, mesh.faces) for mesh in (middle, *meshes))
    assert total == pytest.approx(volume(whole.vertices, whole.faces), rel=0.02)


@pytest.mark.slow
def test_pixels_that_see_the_back_of_a_label_are_left_out(body):
    low, high = (float(each(body.points[:, 1])) for each in (np.min, np.max))
    at = 0.7 * low + 0.3 * high
    label = OpaquePart(at - 0.2, at + 0.2, _BLUE)
    targets = np.array([[0.0, 0.0, at], [0.0, 0.0, at + 0.7], [9.0, 0.0, at]])
    eyes = np.array([[4.0, 0.0, at], [4.0, 0.0, at + 0.7], [9.0, 9.0, at]])
    down = (np.array([2.0, 0.0, at + 1.4]), np.array([-0.8, 0.0, at]))  # in above, out behind it
    eyes, targets = np.vstack([eyes, down[0]]), np.vstack([targets, down[1]])
    turned, point = body.axis.frame.T, body.axis.point
    rays = scenes.rays(eyes @ turned + point, (targets - eyes) @ turned)
    pixels = photometry.Photographs(rays, np.zeros((4, 3)), np.zeros(4, np.int32))
    assert opaque_parts.seen_by(body, (label,), pixels).tolist() == [True, False, True, True]
    assert opaque_parts.seen_by(body, (), pixels).tolist() == [False, False, True, False]
    # A row and a half beside it count as well.
    for rows, seen in ((1.0, True), (2.0, False)):
        beside = OpaquePart(at + rows * _ROW, at + 0.2, _BLUE)
        assert opaque_parts.seen_by(body, (beside,), pixels)[0] == seen


@pytest.mark.slow
def test_pixels_of_opaque_parts_are_left_out(body, clear):
    end = _cap(body, 0.55)
    seen = opaque_parts.seen_by(body, (end,), clear)
    painted = ~np.isnan(opaque_parts.colours_seen(body, (end,), clear.rays)[:, 0])
    assert np.all(seen[painted])
    assert not opaque_parts.seen_by(body, (OpaquePart(5.0, 6.0, _BLUE),), clear)[painted].any()


def test_without_ends_all_of_the_body_remains(body):
    whole = clear_part(body, ())
    assert np.ptp(whole.points[:, 1]) == pytest.approx(np.ptp(body.points[:, 1]), abs=1e-3)


def test_a_foot_may_be_hollow(body):
    hollow = Revolution(body.axis, walls.with_punt(Profile(body.points, closed=False), 0.5), 2.6)
    foot = _foot(hollow, 0.3)
    glass = clear_part(hollow, (foot,))
    assert glass.points[:, 1].min() == pytest.approx(foot.high, abs=0.02)
    mesh = opaque_parts.mesh_of_end(hollow, foot)
    areas = np.linalg.norm(face_vectors(mesh.vertices, mesh.faces), axis=-1)
    assert is_watertight(mesh.faces) and areas.min() > 0.0
    heights = (mesh.vertices - body.axis.point) @ body.axis.frame[:, 2]
    assert (heights.min(), heights.max()) == pytest.approx((foot.low, foot.high), abs=1e-6)


@pytest.mark.parametrize(
    ("low", "high", "moved"),
    [(0.9, 1.4, 0.02), (0.1, 0.3, 0.02), (2.3, 2.58, -0.03), (1.6, 2.0, 0.0), (0.3, 2.2, 0.0)],
    ids=["belly", "foot", "top", "neck", "all"],
)
def test_a_label_is_a_thin_ring_around_the_glass(body, low, high, moved):
    vessel = Vessel(body, Interior("none"), COARSE)
    x, bottom = vessel.start(), float(body.points[:, 1].min())
    x[:2], x[vessel.layout.outer] = (0.1, -0.05), moved
    part = OpaquePart(bottom + low, bottom + high, _BLUE)
    mesh = opaque_parts.mesh_of_label(vessel, x, part)
    (glass,) = (solid.mesh for solid in vessel.solids(x))
    away = signed_distance(glass)(mesh.vertices)
    assert is_watertight(mesh.faces)
    assert 0.001 * vessel.size < away.min() < 0.0022 * vessel.size
    if low == 0.9:  # elsewhere it bridges a hollow
        assert away.max() == pytest.approx(0.006 * vessel.size, rel=0.2)
    vectors = face_vectors(mesh.vertices, mesh.faces)
    facing = np.sum(unit_vectors(vectors) * mesh.normals[:, 0], -1)
    assert facing.min() > 0.9
    assert np.linalg.norm(vectors, axis=-1).min() > 1e-6
    assert volume(mesh.vertices, mesh.faces) > 0.0


def test_a_label_bridges_a_groove():
    points = [[0, 0], [1, 0.0], [1, 0.9], [0.9, 1.0], [1, 1.1], [1, 2], [0, 2]]
    tight = opaque_parts._tight(revolved.even(np.array(points[1:-1], float), 200))
    np.testing.assert_allclose(tight[:, 0], 1.0, atol=1e-12)
    bulge = revolved.even(np.array([[1, 0], [1.2, 0.5], [1, 1]], float), 201)
    np.testing.assert_allclose(opaque_parts._tight(bulge)[48], bulge[101], atol=0.02)
