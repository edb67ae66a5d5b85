"""Objects that compare materials with Cycles: one property of `scene.json` each (NumPy only).

They are not part of the data set; `all` does not make them.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8

from experiments.dataset.objects import quadrics
from experiments.dataset.parts import CONDUCTOR, OPAQUE, Object, ObjectPart
from refref_jax.choices import Colour

# Complex index of refraction of gold for red, green and blue light, as in renderers' tables of
# metals.
_GOLD_ETA: Colour = (0.143, 0.375, 1.442)
_GOLD_K: Colour = (3.983, 2.386, 1.603)

# A dense flint glass has 1.61, 1.62 and 1.64.
_DISPERSIVE: Colour = (1.48, 1.52, 1.58)

_CORE_SCALE = 0.5

# The thin sheet: the radius of its sphere, its angular radius, its rings and segments at detail 1,
# and the height by which it is moved down.
_SHEET_RADIUS, _SHEET_ANGLE, _SHEET_RINGS, _SHEET_SEGMENTS = 1.6, np.radians(75.0), 40, 128
_SHEET_DROP = 0.6

# The prism's cross-section is a triangle with this circumradius.
_PRISM_RADIUS, _PRISM_HALF_LENGTH = 1.3, 1.2


def _make_emissive_core(detail: float) -> list[ObjectPart]:
    """An opaque ball that emits light, in a ball of glass."""
    [shell] = quadrics.ball(detail)
    vertices = _CORE_SCALE * shell.vertices
    core = ObjectPart(
        "core", OPAQUE, vertices, shell.faces, kind="opaque", colours=_patches(vertices)
    )
    return [shell._replace(name="shell"), core]


def _make_gold_torus(detail: float) -> list[ObjectPart]:
    """A polished torus, which reflects itself."""
    [body] = quadrics.torus(detail)
    return [
        body._replace(material=CONDUCTOR, kind="conductor", eta=_GOLD_ETA, k=_GOLD_K),
    ]


def _make_thin_dome(detail: float) -> list[ObjectPart]:
    """A cap of a sphere, open at the bottom."""
    rings, segments = (max(3, round(detail * n)) for n in (_SHEET_RINGS, _SHEET_SEGMENTS))
    polar = np.linspace(0.0, _SHEET_ANGLE, rings + 1)[1:, None]
    turn = 2.0 * np.pi * np.arange(segments) / segments
    circles = [np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar) + 0 * turn]
    vertices = np.concatenate([[[0.0, 0.0, 1.0]], np.stack(circles, axis=-1).reshape(-1, 3)])
    grid = 1 + np.arange(rings * segments).reshape(rings, segments)
    after = np.roll(grid, -1, axis=1)
    top = np.stack([np.zeros(segments, int), grid[0], after[0]], axis=-1)
    first = np.stack([grid[:-1], grid[1:], after[1:]], axis=-1).reshape(-1, 3)
    second = np.stack([grid[:-1], after[1:], after[:-1]], axis=-1).reshape(-1, 3)
    placed = _SHEET_RADIUS * vertices - [0.0, 0.0, _SHEET_DROP]
    faces = np.concatenate([top, first, second])
    return [ObjectPart("sheet", "glass", placed, faces, kind="thin_sheet")]


def _make_prism(detail: float) -> list[ObjectPart]:
    """An upright triangular prism that disperses light; the same for all levels of detail."""
    del detail
    turn = np.radians([90.0, 210.0, 330.0])
    section = _PRISM_RADIUS * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    vertices = np.array(
        [[x, y, side * _PRISM_HALF_LENGTH] for side in (-1.0, 1.0) for x, y in section]
    )
    sides = [
        face for i in range(3) for j in [(i + 1) % 3] for face in ([i, j, 3 + j], [i, 3 + j, 3 + i])
    ]
    faces = _outward(vertices, [[0, 1, 2], [3, 4, 5], *sides])
    return [ObjectPart("body", "glass", vertices, faces, smooth=False, index=_DISPERSIVE)]


def _frosted(roughness: float) -> Object:
    def make(detail: float) -> list[ObjectPart]:
        [body] = quadrics.ball(detail)
        return [body._replace(roughness=roughness)]

    return Object(f"frosted_ball_{round(100.0 * roughness):03d}", "materials", make)


def _outward(vertices: Float[np.ndarray, "v 3"], faces: Sequence[Sequence[int]]) -> np.ndarray:
    """Returns the faces of a convex solid around the origin, counter-clockwise from outside."""
    a, b, c = (vertices[list(corner)] for corner in zip(*faces, strict=True))
    inward = np.sum(np.cross(b - a, c - a) * a, axis=-1) < 0.0
    return np.where(inward[:, None], np.array(faces)[:, ::-1], np.array(faces))


def _patches(vertices: Float[np.ndarray, "v 3"]) -> UInt8[np.ndarray, "v 3"]:
    """Returns colours that vary smoothly over a ball, and differ between its sides."""
    way = vertices / np.linalg.norm(vertices, axis=-1, keepdims=True)
    shares = 0.5 + 0.35 * way + 0.15 * np.sin(6.0 * np.roll(way, 1, axis=-1))
    return np.round(255.0 * np.clip(shares, 0.0, 1.0)).astype(np.uint8)


COMPARISONS = (
    Object("emissive_core", "materials", _make_emissive_core),
    Object("gold_torus", "materials", _make_gold_torus),
    Object("thin_dome", "materials", _make_thin_dome),
    Object("prism", "materials", _make_prism),
    _frosted(0.1),
    _frosted(0.3),
)
