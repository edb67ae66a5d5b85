"""What stability means here: every extreme that is tried, and how large its error may be."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from benchmarks.stability import cases, laws, light
from benchmarks.stability.laws import Found


class Measure(NamedTuple):
    """One line of the table.

    Attributes:
      name: what is measured.
      unit: unit of the error.
      run: takes a density of the lattice, returns the worst error.
      bound: what it may be at any density.
      slow: whether it takes more than some seconds.
    """

    name: str
    unit: str
    run: Callable[[int], Found]
    bound: float
    slow: bool = False


def _law(name: str, law: Callable, single: float, double: float) -> list[Measure]:
    return [
        Measure(f"{name}, float32", "1", functools.partial(law, kind=np.float32), single),
        Measure(f"{name}, float64", "1", functools.partial(law, kind=np.float64), double),
    ]


MEASURES = [
    *_law("squared cosine of refraction", laws.refracted_cosine, 6e-7, 4e-15),
    *_law("refraction, 0.01 rad off the critical angle", laws.refracted_direction, 3e-6, 4e-14),
    *_law("refraction at all angles", laws.refracted_direction_anywhere, 1.5e-3, 2e-7),
    *_law("mirrored direction", laws.mirrored_direction, 1e-6, 4e-15),
    *_law("reflectance, 0.01 rad off the critical angle", laws.fresnel_reflectance, 5e-6, 3e-14),
    *_law("reflectance at all angles", laws.fresnel_reflectance_anywhere, 8e-3, 2e-6),
    Measure("NaN in single operations", "count", cases.no_nan_in_any_operation, 0.0),
    Measure("ball", "rad", cases.balls, 3e-6),
    Measure("ball, float64", "rad", cases.in_double, 1e-7),
    Measure("slabs of all ratios and angles", "rad", cases.slabs, 1.5e-3),
    Measure("slabs of all ratios and angles, float64", "rad", cases.slabs_in_double, 1e-6),
    Measure("scales 1e-3 to 1e3", "radius", cases.scales, 1e-5),
    Measure("scales of powers of two", "radius", cases.powers_of_two, 0.0),
    Measure("offsets 1 to 1e4", "rad per unit", cases.offsets, 5e-6),
    Measure("triangles of aspect 1e4 to 1e6", "share of rays", cases.needles, 0.02),
    Measure("spheres of 80 triangles and more", "rad", cases.sizes, 5e-6),
    Measure("1,310,720 triangles", "rad", cases.a_million_triangles, 5e-6, slow=True),
    Measure("through vertices and edges", "share of rays", cases.vertices_and_edges, 1e-3),
    Measure("in faces and along edges", "light", light.edge_on, 1e-5),
    Measure("starting on surfaces", "light", light.on_surfaces, 1e-5),
    Measure(
        "nested and overlapping bodies", "light", light.nested_and_overlapping, 1e-5, slow=True
    ),
    Measure("broken meshes", "light", light.broken_meshes, 1e-5, slow=True),
    Measure("whispering gallery", "light", light.whispering_gallery, 1e-5),
    Measure("index-matched bodies", "unit", light.index_matched, 1e-5),
    Measure("there and back", "rad", light.reversibility, 1e-4),
    Measure("white furnace, also overflowing", "light", light.white_furnace, 1e-5),
]
