import numpy as np
import pytest
import trimesh

from experiments.dataset.objects.profiles import Sampling, arc, resampled, smooth
from experiments.dataset.objects.regions import profiles, ring
from experiments.dataset.objects.revolve import (
    Turned,
    faded,
    polygon,
    revolve,
    round_about,
    section_angles,
    waves,
)

_FINE = Sampling(edge=0.02, turn=0.03, segments=360)


def _mesh(profile, turned=None, cut=_FINE):
    curve = resampled(np.asarray(profile, np.float64), cut)
    vertices, faces = revolve(curve, round_about(cut) if turned is None else turned)
    return trimesh.Trimesh(vertices, faces, process=False)


def _closed_and_outward(mesh):
    return mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0.0


# Closed forms.


_BALL = arc((0.0, 0.0), 1.5, -90.0, 90.0)
_SMOOTH = smooth([(0.0, 0.0), (0.8, 0.5), (0.4, 1.3), (0.6, 1.8), (0.0, 2.2)])


@pytest.mark.parametrize(
    ("profile", "volume", "holes"),
    [
        (_BALL, 4.0 / 3.0 * np.pi * 1.5**3, 0),
        ([(0.0, 0.0), (1.2, 0.0), (0.0, 0.9)], np.pi * 1.2**2 * 0.9 / 3.0, 0),
        (profiles(ring(1.1, 0.3, 0.5))[0], 2.0 * np.pi * 1.1 * np.pi * 0.25**2, 1),
        (_SMOOTH, np.pi * np.trapezoid(_SMOOTH[:, 0] ** 2, _SMOOTH[:, 1]), 0),
    ],
    ids=["ball", "cone", "torus", "smooth"],
)
def test_volumes_by_hand_and_by_pappus(profile, volume, holes):
    mesh = _mesh(profile)
    assert _closed_and_outward(mesh) and mesh.euler_number == 2 - 2 * holes
    assert mesh.volume == pytest.approx(volume, rel=1e-3)
    down = _mesh(np.asarray(profile)[::-1])  # encloses a cavity
    assert down.volume == pytest.approx(-volume, rel=1e-3)


def test_a_square_section_is_a_box_with_rounded_edges():
    corner = 0.2
    section = polygon(4, corner)
    turned = Turned(section_angles(section, _FINE), faded(section, lambda r, z: np.ones_like(r)))
    mesh = _mesh([(0.0, 0.0), (1.0, 0.0), (1.0, 1.5), (0.0, 1.5)], turned)
    assert _closed_and_outward(mesh)
    np.testing.assert_allclose(mesh.extents, [2.0, 2.0, 1.5], rtol=1e-6)
    assert mesh.volume == pytest.approx(1.5 * (4.0 - (4.0 - np.pi) * corner**2), rel=1e-3)


def test_a_twist_turns_sections_and_keeps_the_volume():
    section = waves(3, 0.2)
    angles = section_angles(section, _FINE)
    profile = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
    warp = faded(section, lambda r, z: np.ones_like(r))
    plain, twisted = _mesh(profile, Turned(angles, warp)), _mesh(profile, Turned(angles, warp, 0.7))
    assert twisted.volume == pytest.approx(plain.volume, rel=1e-3)
    highest = twisted.vertices[np.isclose(twisted.vertices[:, 2], 1.0)]
    ridge = highest[np.argmax(np.hypot(*highest[:, :2].T))]
    assert np.arctan2(ridge[1], ridge[0]) % (2.0 * np.pi / 3.0) == pytest.approx(0.7, abs=0.02)


# Sections.


# Meshes.


@pytest.mark.parametrize(
    "profile",
    [
        [(0.0, 0.0), (1.0, 0.5), (0.0, 1.0), (1.0, 1.5), (0.0, 2.0)],
        [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)],
        [(0.2, 0.0), (1.0, 0.0), (0.0, 1.0)],
    ],
    ids=["touches-the-axis", "ends-off-it", "begins-off-it"],
)
def test_profiles_that_bound_no_body_are_refused(profile):
    with pytest.raises(ValueError, match="touches the axis between its ends, or ends off the axis"):
        revolve(np.array(profile), round_about(_FINE))
