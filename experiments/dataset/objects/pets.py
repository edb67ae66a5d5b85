"""Cat, fox and dog: figures of clear glass around a tinted core (NumPy only).

Fields are those of `distance_fields`; z is up, and they face -y.
"""

from experiments.dataset.objects.distance_fields import Field, ellipsoid
from experiments.dataset.objects.field_operations import both_sides, subtraction, union
from experiments.dataset.objects.formed import filled_glass
from experiments.dataset.objects.space_curves import limb


def _cat() -> Field:
    body = union(
        ellipsoid((0.0, 0.35, -0.7), (0.66, 0.76, 0.6)),
        limb((0.0, 0.35, -0.6, 0.56), (0.0, 0.05, 0.0, 0.46), (0.0, -0.2, 0.5, 0.32)),
        ellipsoid((0.0, -0.28, 0.1), (0.38, 0.32, 0.46)),
        *both_sides(
            ellipsoid((0.5, 0.2, -0.8), (0.3, 0.55, 0.46)),
            ellipsoid((0.5, -0.4, -1.16), (0.17, 0.36, 0.13)),
        ),
        blend=0.2,
    )
    legs = both_sides(
        limb((0.22, -0.4, 0.05, 0.2), (0.23, -0.56, -0.55, 0.15), (0.23, -0.58, -1.1, 0.13)),
        ellipsoid((0.23, -0.7, -1.17), (0.16, 0.24, 0.13)),
    )
    head = union(
        ellipsoid((0.0, -0.36, 0.95), (0.48, 0.42, 0.4)),
        *both_sides(
            ellipsoid((0.24, -0.5, 0.82), (0.22, 0.22, 0.19)),
            limb((0.25, -0.32, 1.15, 0.19), (0.37, -0.28, 1.58, 0.045)),
        ),
        blend=0.12,
    )
    muzzle = both_sides(ellipsoid((0.09, -0.74, 0.82), (0.13, 0.14, 0.11)))
    nose = ellipsoid((0.0, -0.84, 0.9), (0.06, 0.06, 0.05))
    head = union(head, *muzzle, nose, blend=0.08)
    hollows = both_sides(
        ellipsoid((0.33, -0.48, 1.34), (0.09, 0.1, 0.16)),
        ellipsoid((0.19, -0.78, 1.02), (0.1, 0.07, 0.06)),
    )
    head = subtraction(head, union(*hollows), blend=0.08)
    tail = limb(
        (0.0, 1.0, -1.08, 0.17),
        (0.6, 1.1, -1.14, 0.15),
        (1.05, 0.6, -1.15, 0.14),
        (1.08, -0.1, -1.15, 0.14),
        (0.85, -0.7, -1.14, 0.13),
        (0.5, -1.0, -1.1, 0.11),
    )
    return union(body, *legs, head, tail, blend=0.14)


def _fox() -> Field:
    body = union(
        limb((0.0, -0.62, 0.1, 0.38), (0.0, 0.0, 0.1, 0.33), (0.0, 0.62, 0.12, 0.34)),
        limb((0.0, -0.7, 0.15, 0.33), (0.0, -0.98, 0.5, 0.26), (0.0, -1.08, 0.72, 0.24)),
        ellipsoid((0.0, -0.82, -0.02), (0.28, 0.26, 0.34)),
        blend=0.15,
    )
    head = union(
        ellipsoid((0.0, -1.16, 0.82), (0.33, 0.3, 0.27)),
        limb((0.0, -1.3, 0.78, 0.2), (0.0, -1.55, 0.7, 0.12), (0.0, -1.86, 0.64, 0.06)),
        *both_sides(
            limb((0.22, -1.15, 0.74, 0.15), (0.4, -1.08, 0.66, 0.06)),
            limb((0.17, -1.06, 0.98, 0.16), (0.27, -1.02, 1.4, 0.035)),
        ),
        blend=0.1,
    )
    nose = ellipsoid((0.0, -1.91, 0.66), (0.06, 0.06, 0.055))
    hollows = both_sides(
        ellipsoid((0.225, -1.2, 1.15), (0.075, 0.09, 0.16)),
        ellipsoid((0.15, -1.42, 0.9), (0.07, 0.07, 0.05)),
    )
    head = subtraction(union(head, nose, blend=0.04), union(*hollows), blend=0.07)
    legs = both_sides(
        limb((0.17, -0.7, 0.0, 0.2), (0.19, -0.72, -0.5, 0.12), (0.19, -0.72, -1.05, 0.1)),
        ellipsoid((0.19, -0.8, -1.1), (0.11, 0.18, 0.1)),
        ellipsoid((0.19, 0.62, 0.0), (0.2, 0.36, 0.36)),
        limb(
            (0.19, 0.6, -0.1, 0.22),
            (0.2, 0.55, -0.45, 0.13),
            (0.2, 0.78, -0.75, 0.1),
            (0.2, 0.72, -1.06, 0.095),
        ),
        ellipsoid((0.2, 0.64, -1.1), (0.11, 0.18, 0.1)),
    )
    tail = limb(
        (0.0, 0.85, 0.22, 0.13),
        (0.0, 1.15, 0.1, 0.2),
        (0.0, 1.5, -0.2, 0.31),
        (0.0, 1.82, -0.5, 0.22),
        (0.0, 2.02, -0.72, 0.05),
    )
    return union(body, head, *legs, tail, blend=0.12)


def _dog() -> Field:
    body = union(
        ellipsoid((0.0, -0.45, 0.1), (0.4, 0.52, 0.5)),
        limb((0.0, -0.5, 0.12, 0.42), (0.0, 0.2, 0.18, 0.36), (0.0, 0.72, 0.2, 0.36)),
        limb((0.0, -0.72, 0.3, 0.34), (0.0, -0.95, 0.7, 0.27), (0.0, -1.02, 0.95, 0.26)),
        blend=0.2,
    )
    head = union(
        ellipsoid((0.0, -1.08, 1.08), (0.34, 0.35, 0.31)),
        limb((0.0, -1.25, 1.0, 0.23), (0.0, -1.5, 0.94, 0.19), (0.0, -1.68, 0.93, 0.17)),
        ellipsoid((0.0, -1.86, 0.99), (0.09, 0.07, 0.07)),
        *both_sides(ellipsoid((0.09, -1.66, 0.88), (0.13, 0.17, 0.13))),
        blend=0.1,
    )
    hollows = both_sides(ellipsoid((0.16, -1.37, 1.17), (0.08, 0.08, 0.06)))
    head = subtraction(head, union(*hollows), blend=0.07)
    ears = both_sides(
        limb((0.27, -0.98, 1.28, 0.1), (0.42, -1.0, 1.12, 0.11), (0.45, -1.05, 0.78, 0.1)),
        ellipsoid((0.44, -1.04, 0.86), (0.1, 0.16, 0.22)),
    )
    legs = both_sides(
        limb((0.24, -0.55, 0.05, 0.24), (0.25, -0.56, -0.5, 0.15), (0.25, -0.58, -1.15, 0.125)),
        ellipsoid((0.25, -0.68, -1.2), (0.15, 0.22, 0.11)),
        ellipsoid((0.24, 0.72, 0.02), (0.24, 0.4, 0.42)),
        limb(
            (0.25, 0.68, -0.1, 0.28),
            (0.26, 0.62, -0.52, 0.16),
            (0.26, 0.88, -0.82, 0.125),
            (0.26, 0.8, -1.16, 0.12),
        ),
        ellipsoid((0.26, 0.7, -1.2), (0.15, 0.22, 0.11)),
    )
    tail = limb(
        (0.0, 0.95, 0.38, 0.15),
        (0.0, 1.25, 0.55, 0.12),
        (0.0, 1.45, 0.9, 0.1),
        (0.0, 1.42, 1.22, 0.06),
    )
    return union(body, union(head, *ears, blend=0.05), *legs, tail, blend=0.13)


OBJECTS = (
    filled_glass(
        "cat",
        _cat,
        radius=1.75,
        thinnest=0.1,
        medium="alcohol",
        absorption=(0.1, 0.6, 1.6),
        fineness=1.2,
    ),
    filled_glass(
        "fox",
        _fox,
        radius=1.9,
        thinnest=0.1,
        medium="perfume",
        absorption=(0.05, 0.9, 2.2),
        fineness=1.4,
    ),
    filled_glass(
        "dog",
        _dog,
        radius=1.85,
        thinnest=0.11,
        medium="water",
        absorption=(1.5, 0.5, 0.08),
        fineness=1.3,
    ),
)
