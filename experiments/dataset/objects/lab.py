"""Glassware of a laboratory, each with a liquid."""

from experiments.dataset.objects.glassware import (
    beaker,
    conical_flask,
    graduated_cylinder,
    hexagonal_foot,
    round_bottom_flask,
    spout,
    test_tube,
)
from experiments.dataset.objects.placing import centred, moved
from experiments.dataset.objects.profiles import sampling
from experiments.dataset.objects.revolve import Turned, polygon, round_about, section_angles
from experiments.dataset.objects.vessels import Look, resized, vessel
from experiments.dataset.parts import Object, ObjectPart

_BLUE = Look("water", tint=(0.55, 0.8, 0.97))
_GREEN = Look("water", tint=(0.6, 0.95, 0.7))
_ORANGE = Look("alcohol", absorption=(0.05, 0.55, 1.9))
_PINK = Look("water", tint=(0.97, 0.66, 0.82))
_YELLOW = Look("alcohol", tint=(0.98, 0.9, 0.5))


def _make_beaker(detail: float) -> list[ObjectPart]:
    cut = sampling(detail)
    turned = round_about(cut)._replace(warp=spout(2.3, 2.72, reach=0.13, width=0.3))
    return centred(vessel(beaker(level=1.7), cut, liquid=_BLUE, turned=turned))


def _make_conical_flask(detail: float) -> list[ObjectPart]:
    return centred(vessel(conical_flask(level=1.25), sampling(detail), liquid=_ORANGE))


def _make_round_bottom_flask(detail: float) -> list[ObjectPart]:
    return centred(vessel(round_bottom_flask(level=1.15), sampling(detail), liquid=_GREEN))


def _make_graduated_cylinder(detail: float) -> list[ObjectPart]:
    cut = sampling(0.85 * detail, segments=76)
    turned = Turned(section_angles(polygon(6, 0.2), cut), hexagonal_foot)
    return centred(vessel(graduated_cylinder(level=2.25), cut, liquid=_PINK, turned=turned))


def _make_test_tube(detail: float) -> list[ObjectPart]:
    cut = sampling(detail, segments=64)
    return centred(vessel(test_tube(level=2.1), cut, liquid=_YELLOW))


def _make_lab_equipment_set(detail: float) -> list[ObjectPart]:
    """A flask, a tube and a beaker; walls and films are as thick as those of the single vessels."""
    cut = sampling(detail, segments=72)
    flask = resized(conical_flask(level=1.3, wall=0.08, film=0.026), 0.66)
    tube = resized(test_tube(level=1.9, wall=0.075, film=0.024), 0.74)
    mug = resized(beaker(level=1.5, wall=0.085, film=0.03), 0.56)
    lip = round_about(cut)._replace(warp=spout(1.29, 1.52, reach=0.12, width=0.3))
    placed = [
        (vessel(flask, cut, liquid=_BLUE, name="flask"), (-0.72, 0.28)),
        (vessel(tube, cut, liquid=_PINK, name="tube"), (0.16, 0.62)),
        (vessel(mug, cut, liquid=_ORANGE, turned=lip, name="beaker"), (0.62, -0.42)),
    ]
    return centred([part for parts, (x, y) in placed for part in moved(parts, (x, y, 0.0))])


OBJECTS = (
    Object("beaker", "mmncvx", _make_beaker),
    Object("conical_flask", "mmncvx", _make_conical_flask),
    Object("round_bottom_flask", "mmncvx", _make_round_bottom_flask),
    Object("graduated_cylinder", "mmncvx", _make_graduated_cylinder),
    Object("test_tube", "mmncvx", _make_test_tube),
    Object("lab_equipment_set", "mmncvx", _make_lab_equipment_set),
)
