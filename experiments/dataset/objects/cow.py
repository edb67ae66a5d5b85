"""A standing cow: clear glass around a white core (NumPy only).

Fields are those of `distance_fields`; z is up, and the cow faces -y.
"""

from experiments.dataset.objects.distance_fields import Field, ellipsoid
from experiments.dataset.objects.field_operations import both_sides, subtraction, union
from experiments.dataset.objects.formed import filled_glass
from experiments.dataset.objects.space_curves import limb


def _cow() -> Field:
    return union(_body(), _head(), *_legs(), _udder(), _tail(), blend=0.13)


def _body() -> Field:
    return union(
        ellipsoid((0.0, 0.1, 0.1), (0.52, 1.02, 0.54)),
        ellipsoid((0.0, -0.62, 0.16), (0.44, 0.48, 0.54)),
        ellipsoid((0.0, 0.8, 0.22), (0.46, 0.46, 0.48)),
        limb((0.0, -0.75, 0.3, 0.4), (0.0, -1.1, 0.52, 0.3), (0.0, -1.35, 0.68, 0.26)),
        # The hips protrude, and the dewlap hangs.
        *both_sides(ellipsoid((0.3, 0.85, 0.5), (0.16, 0.2, 0.16))),
        ellipsoid((0.0, -1.02, 0.1), (0.12, 0.3, 0.32)),
        blend=0.2,
    )


def _head() -> Field:
    skull = union(
        ellipsoid((0.0, -1.45, 0.82), (0.29, 0.3, 0.28)),
        limb((0.0, -1.52, 0.78, 0.25), (0.0, -1.78, 0.54, 0.2), (0.0, -1.95, 0.4, 0.19)),
        ellipsoid((0.0, -1.99, 0.4), (0.25, 0.18, 0.18)),
        blend=0.12,
    )
    ears = both_sides(
        limb((0.25, -1.38, 0.92, 0.09), (0.5, -1.34, 0.9, 0.12), (0.7, -1.36, 0.8, 0.05))
    )
    horns = both_sides(
        limb(
            (0.14, -1.38, 1.03, 0.1),
            (0.36, -1.38, 1.14, 0.09),
            (0.46, -1.44, 1.34, 0.065),
            (0.4, -1.52, 1.5, 0.03),
        )
    )
    hollows = both_sides(
        ellipsoid((0.24, -1.66, 0.86), (0.07, 0.08, 0.06)),
        ellipsoid((0.1, -2.16, 0.44), (0.05, 0.06, 0.04)),
    )
    return subtraction(union(skull, *ears, *horns, blend=0.07), union(*hollows), blend=0.06)


def _legs() -> list[Field]:
    return both_sides(
        limb(
            (0.28, -0.66, 0.0, 0.26),
            (0.29, -0.68, -0.5, 0.17),
            (0.29, -0.68, -0.85, 0.13),
            (0.29, -0.7, -1.2, 0.14),
        ),
        limb((0.29, -0.72, -1.24, 0.16), (0.29, -0.78, -1.3, 0.14)),
        ellipsoid((0.3, 0.9, 0.05), (0.22, 0.36, 0.46)),
        limb(
            (0.3, 0.88, -0.1, 0.27),
            (0.3, 0.86, -0.48, 0.17),
            (0.3, 1.02, -0.8, 0.13),
            (0.3, 0.96, -1.2, 0.14),
        ),
        limb((0.3, 0.93, -1.24, 0.16), (0.3, 0.87, -1.3, 0.14)),
    )


def _udder() -> Field:
    teats = both_sides(
        limb((0.12, 0.32, -0.55, 0.07), (0.13, 0.31, -0.74, 0.05)),
        limb((0.12, 0.6, -0.55, 0.07), (0.13, 0.6, -0.74, 0.05)),
    )
    return union(ellipsoid((0.0, 0.46, -0.42), (0.27, 0.34, 0.2)), *teats, blend=0.06)


def _tail() -> Field:
    return limb(
        (0.0, 1.18, 0.5, 0.1),
        (0.0, 1.38, 0.32, 0.075),
        (0.0, 1.42, -0.2, 0.07),
        (0.0, 1.4, -0.5, 0.09),
        (0.0, 1.4, -0.72, 0.13),
        (0.0, 1.4, -1.0, 0.05),
    )


OBJECTS = (
    filled_glass(
        "cow",
        _cow,
        radius=1.9,
        thinnest=0.1,
        medium="alcohol",
        absorption=(0.9, 0.25, 0.5),
        fineness=1.2,
    ),
)
