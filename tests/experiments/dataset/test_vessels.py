import numpy as np
import pytest
import trimesh

from experiments.dataset.objects.placing import centred, enlarged, moved, tilted, united
from experiments.dataset.objects.profiles import Sampling, arc, filleted
from experiments.dataset.objects.regions import box, profiles, region
from experiments.dataset.objects.vessels import (
    FILM,
    GLASS,
    Look,
    body,
    filled,
    hollow,
    open_mouth,
    resized,
    sealed,
    space_in,
    vessel,
)
from tests.oracles.polylines import distances

_FINE = Sampling(edge=0.04, turn=0.1, segments=180)
_WATER = Look("water", tint=(0.5, 0.8, 0.9))


def _tub(wall=0.1):
    outline = region(filleted((0, 0), (1.0, 0, 0.15), (1.0, 2.0), (0, 2.0)))
    mouth = open_mouth(outline, wall=wall)
    return outline, space_in(outline, wall=wall, corner=0.05, mouth=mouth)


def _volume(shape):
    part = body("x", GLASS, shape, _FINE)
    return trimesh.Trimesh(part.vertices, part.faces, process=False).volume


def _radius_at(shape, height):
    """Largest radius of a region at a height."""
    return (shape ^ box(5.0, height - 1e-4, height + 1e-4)).bounds()[2]


# Spaces.


def test_the_wall_has_its_thickness_and_the_mouth_is_open():
    outline, space = _tub(wall=0.1)
    assert space.bounds()[1] == pytest.approx(0.1, abs=1e-4)
    for height in (0.5, 1.999, 2.5):
        assert _radius_at(space, height) == pytest.approx(0.9, abs=1e-4)
    assert open_mouth(outline, wall=0.1) == pytest.approx(0.9)
    closed = space_in(outline, wall=0.1, floor=0.4).bounds()
    assert (closed[1], closed[3]) == pytest.approx((0.4, 1.9), abs=1e-4)


def test_an_empty_vessel_is_glass_between_outline_and_space():
    outline, space = _tub()
    # What a fillet cuts off a corner, by Pappus; its middle is about a quarter of its radius away.
    off = {r: (1.0 - np.pi / 4.0) * r**2 for r in (0.15, 0.05, 0.04)}
    rounds = 0.966 * off[0.15] - 0.889 * off[0.05] + (0.991 + 0.909) * off[0.04]
    expected = np.pi * (1.0**2 * 2.0 - 0.9**2 * 1.9 - 2.0 * rounds)
    assert _volume(hollow(outline, space, rim=0.04)) == pytest.approx(expected, rel=2e-3)


def test_a_liquid_fills_the_space_up_to_the_film_and_stays_apart():
    outline, space = _tub()
    shapes = filled(outline, space, level=1.2, rim=0.04)
    assert shapes.air is None and (shapes.liquid - shapes.glass).is_empty()
    # Flat in the middle, drawn up at the wall, where it ends within the meniscus.
    liquid, glass = profiles(shapes.liquid)[0], profiles(shapes.glass)[0]
    assert liquid[-1] == pytest.approx([0.0, 1.2 - FILM], abs=1e-4)
    assert 1.2 - FILM < shapes.liquid.bounds()[3] < 1.2 + 0.06
    assert glass[-1] == pytest.approx([0.0, 1.2], abs=1e-4) and glass[:, 1].max() <= 2.0
    assert distances(liquid, glass).min() == pytest.approx(FILM, abs=2e-4)
    assert _volume(shapes.liquid) == pytest.approx(np.pi * 0.81 * (1.1 - FILM), rel=0.02)
    small = resized(shapes, 0.5)
    assert small.glass.bounds() == pytest.approx((-0.5, 0.0, 0.5, 1.0), abs=1e-3)
    assert _volume(small.liquid) == pytest.approx(_volume(shapes.liquid) / 8.0, rel=0.02)


def test_a_sealed_vessel_holds_liquid_and_air_with_a_film_between():
    outline, _ = _tub()
    space = space_in(outline, wall=0.1)
    shapes = sealed(outline, space, level=1.2, film=0.02)
    assert shapes.glass is outline
    liquid, air = profiles(shapes.liquid)[0], profiles(shapes.air)[0]
    assert liquid[-1] == pytest.approx([0.0, 1.19], abs=1e-4)
    assert air[0] == pytest.approx([0.0, 1.21], abs=1e-4)
    assert distances(liquid, air).min() == pytest.approx(0.02, abs=2e-4)
    assert (shapes.liquid ^ shapes.air).is_empty()


def test_a_vessel_becomes_named_parts():
    outline, space = _tub()
    shell, liquid = vessel(
        filled(outline, space, level=1.0, rim=0.04), _FINE, liquid=_WATER, name="tub"
    )
    assert (shell.name, shell.material) == ("tub_shell", "glass")
    assert (liquid.name, liquid.material, liquid.tint) == ("tub_liquid", "water", _WATER.tint)
    closed = sealed(outline, space_in(outline, wall=0.1), level=1.0)
    names = [part.name for part in vessel(closed, _FINE, liquid=_WATER)]
    assert names == ["shell", "liquid", "air"]


def test_a_body_with_a_cavity_is_one_part():
    ball = region(arc((0.0, 0.0), 1.0, -90.0, 90.0))
    part = body("bulb", GLASS, ball - box(0.3, -0.3, 0.3), _FINE)
    mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
    assert mesh.is_watertight and mesh.body_count == 2
    expected = 4.0 / 3.0 * np.pi - np.pi * 0.09 * 0.6
    assert mesh.volume == pytest.approx(expected, rel=5e-3)


def test_placing_keeps_shapes():
    part = body("x", GLASS, box(0.5, 0.0, 1.0), _FINE)
    [there] = moved([part], (1.0, 2.0, 3.0))
    np.testing.assert_allclose(there.vertices, np.add(part.vertices, (1.0, 2.0, 3.0)))
    [middle] = centred([there])
    ends = middle.vertices.max(axis=0) + middle.vertices.min(axis=0)
    np.testing.assert_allclose(ends, 0.0, atol=1e-12)
    [larger] = enlarged([middle], 2.0)
    assert np.ptp(larger.vertices[:, 2]) == pytest.approx(2.0)
    [lying] = tilted([middle], axis="y", degrees=90.0)
    assert np.ptp(lying.vertices[:, 0]) == pytest.approx(1.0)
    both = united([part, there])
    assert both.name == "x" and len(both.faces) == 2 * len(part.faces)
    assert both.faces.max() == len(both.vertices) - 1
