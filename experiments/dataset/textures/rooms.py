"""Square rooms seen from their middle, papered with images of `faces`."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from experiments.dataset.textures import (
    books,
    cloth,
    drawn,
    masonry,
    minerals,
    painted,
    penrose_tiles,
    plants,
    posters,
    tilings,
    timber,
)
from experiments.dataset.textures.fields import (
    Field,
    Picture,
    blend,
    fbm,
    lookup,
    random_of,
    reflected,
    smooth,
)
from experiments.dataset.textures.shading import chosen, colour, graded
from experiments.dataset.textures.sphere_fields import directions, fbm3


class Seen(NamedTuple):
    """Visible point of a box room for every sample.

    Attributes:
      wall: 0 to 3 for walls (+x, +y, -x, -y), 4 for the floor and 5 for the ceiling.
      across: position along a wall to the right, from its middle; x on floor and ceiling. World
        units.
      up: height over the eye; y on floor and ceiling.
      half: half the wall's width.
      nearest: distance to the nearest edge of the room.
      far: distance from the eye.
    """

    wall: Int[np.ndarray, "h w"]
    across: Field
    up: Field
    half: Field
    nearest: Field
    far: Field


def box_room(height: int, half: tuple[float, float], floor: float, ceiling: float) -> Seen:
    """Returns the visible points of a box.

    Args:
      height: rows of the image.
      half: half the room's length along x and along y.
      floor: distance of the floor below the eye.
      ceiling: distance of the ceiling above the eye.
    """
    points = directions(height)
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    tiny = np.float32(1e-6)
    scale = np.stack(
        [np.abs(x) / half[0], np.abs(y) / half[1], np.where(z > 0.0, z / ceiling, -z / floor)]
    )
    far = 1.0 / np.maximum(scale.max(0), tiny)
    side = scale.argmax(0)
    a, b, c = x * far, y * far, z * far
    wall = np.where(side == 0, np.where(x > 0, 0, 2), np.where(y > 0, 1, 3))
    wall = np.where(side == 2, np.where(z > 0, 5, 4), wall)
    sign = np.where(wall == 0, -b, np.where(wall == 1, a, np.where(wall == 2, b, -a)))
    level = wall >= 4
    across, up = np.where(level, a, sign), np.where(level, b, c)
    width = np.where(level | (side == 1), half[0], half[1]).astype(np.float32)
    gaps = np.sort(
        np.stack([half[0] - np.abs(a), half[1] - np.abs(b), np.minimum(c + floor, ceiling - c)]),
        axis=0,
    )
    return Seen(wall, across, up, width, gaps[1], far)


def _shaded(picture: Picture, seen: Seen, *, lamp: float, corners: float) -> Picture:
    """Returns a room lit by a lamp at the eye, darker in its corners."""
    falloff = 1.0 / (1.0 + (seen.far / lamp) ** 2)
    shade = 1.0 - 0.5 * np.exp(-seen.nearest / corners)
    return picture * (1.75 * falloff * shade)[..., None]


def library(height: int) -> Picture:
    """A library: books up to a coffered ceiling of wood, a carpet, and windows at its ends."""
    seen = box_room(height, (4.0, 3.0), 1.6, 2.6)
    size = height // 2
    spines, rug, wood = books.bookshelf(size), cloth.carpet(size), timber.parquet(size)
    picture = lookup(spines, seen.across / 4.2 + 0.23 * seen.wall, 0.381 - seen.up / 4.2)
    picture = picture * 1.15
    pillar = np.abs((seen.across / seen.half * 2.0) % 1.0 - 0.5) * seen.half / 2.0
    grain = timber.grain_of(size, *(_unit(size)), np.zeros((size, size), np.int32))
    oak = graded(
        lookup(grain, 0.3 * seen.up, 0.5 * seen.across),
        (0.0, "#9a6636"),
        (0.5, "#6b4020"),
        (1.0, "#2e1a0c"),
    )
    flute = 0.75 + 0.35 * np.cos(pillar * 110.0)
    picture = np.where((pillar < 0.11)[..., None], oak * flute[..., None], picture)
    ends = (seen.wall % 2 == 0) & (seen.wall < 4)
    window = np.maximum(np.abs(seen.across) / 0.95, np.abs(seen.up - 0.5) / 1.35)
    panes = np.minimum(np.abs(seen.across * 3.2 % 1.0 - 0.5), np.abs(seen.up * 3.2 % 1.0 - 0.5))
    glass = lookup(
        tilings.stained_glass(size), seen.across / 2.4 + 0.5, 0.5 - (seen.up - 0.5) / 2.8
    )
    glass = blend(colour("#20160d") * np.ones(3), 1.5 * glass, smooth(0.46, 0.44, panes))
    view = blend(oak, glass, smooth(1.0, 0.98, window))
    picture = np.where((ends & (window < 1.12))[..., None], view, picture)
    level = lookup(wood, reflected(seen.across / 2.9), reflected(seen.up / 2.9))
    on_rug = np.maximum(np.abs(seen.across) / 2.7, np.abs(seen.up) / 1.9)
    mat = lookup(rug, 0.5 + seen.across / 5.4, 0.5 + seen.up / 3.8)
    picture = np.where(
        (seen.wall == 4)[..., None], np.where((on_rug < 1.0)[..., None], mat, level), picture
    )
    coffer = np.maximum(np.abs(seen.across % 1.0 - 0.5), np.abs(seen.up % 1.0 - 0.5))
    ceiling = oak * (1.25 - 0.8 * smooth(0.40, 0.34, coffer))[..., None]
    rose = np.hypot(seen.across % 1.0 - 0.5, seen.up % 1.0 - 0.5)
    petals = 0.2 + 0.06 * np.cos(8.0 * np.arctan2(seen.up % 1.0 - 0.5, seen.across % 1.0 - 0.5))
    ceiling = blend(ceiling, colour("#d9ab4e"), smooth(0.01, -0.01, rose - petals) * 0.9)
    ceiling = blend(ceiling, colour("#5a1c1a"), smooth(0.01, -0.01, rose - 0.6 * petals))
    picture = np.where((seen.wall == 5)[..., None], ceiling, picture)
    return _shaded(picture, seen, lamp=5.0, corners=0.35)


def _unit(n: int) -> tuple[Field, Field]:
    ticks = ((np.arange(n) + 0.5) / n).astype(np.float32)
    return tuple(np.meshgrid(ticks, ticks))


_WORKS = (
    painted.painting,
    drawn.contours,
    plants.flowers,
    minerals.turing,
    tilings.mosaic,
    cloth.tartan,
    plants.leaves,
    penrose_tiles.penrose,
    posters.posters,
    minerals.marble,
    cloth.carpet,
    masonry.pebbles,
)


def gallery(height: int) -> Picture:
    """A gallery: paintings in gilded frames, two rows on silk, a skylight over polished oak."""
    seen = box_room(height, (4.2, 3.2), 1.5, 2.4)
    size = max(height // 4, 64)
    columns = np.where(seen.half > 3.5, 5, 4)
    place = (seen.across / seen.half + 1.0) * 0.5 * columns
    column = np.clip(np.floor(place), 0, columns - 1).astype(np.int32)
    rows = (seen.up + 1.0) / 1.62
    row = np.clip(np.floor(rows), 0, 1).astype(np.int32)
    pitch = 2.0 * seen.half / columns
    index = seen.wall * 12 + row * columns + column
    wide = pitch * (0.34 + 0.09 * random_of(index, 2))
    high = 0.45 + 0.22 * random_of(index, 3)
    u, v = (place - column - 0.5) * pitch / wide, (rows - row - 0.5) * 1.62 / high
    rim = np.minimum((1.0 - np.abs(u)) * wide, (1.0 - np.abs(v)) * high)
    work = (seen.wall * 9 + row * columns + column + 4 * row) % len(_WORKS)
    works = np.concatenate([make(size) for make in _WORKS])
    inner = lookup(works, 0.5 + 0.48 * u, (work + 0.5 - 0.48 * v) / len(_WORKS))
    inner = inner * 1.1
    silk = fbm(size, 6, 5, octaves=6)
    damask = np.cos(9.0 * seen.across) * np.cos(9.0 * seen.up) + 0.5 * np.cos(27.0 * seen.across)
    wall = blend(
        colour("#7a1f2b"),
        colour("#a8443a"),
        smooth(-0.1, 0.1, damask + 0.15 * lookup(silk, seen.across, seen.up)),
    )
    wall = wall * (1.0 - 0.45 * smooth(-0.14, 0.0, rim) * (rim < 0.0))[..., None]
    ornament = 0.75 + 0.25 * np.cos(rim * 90.0) * np.cos(55.0 * (u * wide + v * high))
    gilt = graded(ornament, (0.4, "#5a3a12"), (0.75, "#c9993f"), (1.0, "#ffe7a0"))
    picture = np.where((rim > 0.09)[..., None], inner, np.where((rim > 0.0)[..., None], gilt, wall))
    dado = (seen.up < -1.06) | (seen.up > 2.26)
    moulding = 0.6 + 0.4 * np.cos(seen.up * 80.0) + 0.12 * np.cos(40.0 * seen.across)
    picture = np.where(dado[..., None], colour("#d8c9a8") * moulding[..., None], picture)
    oak = lookup(
        timber.parquet(2 * size),
        reflected(seen.across / 2.8 + 0.37),
        reflected(seen.up / 2.8 + 0.61),
    )
    picture = np.where((seen.wall == 4)[..., None], oak, picture)
    return _skylight(_shaded(picture, seen, lamp=5.5, corners=0.3), seen)


def _skylight(picture: Picture, seen: Seen) -> Picture:
    """Returns a room with a glazed ceiling in a stuccoed border, and clouds behind it."""
    clouds = fbm(512, 4, 9, octaves=7, gain=0.6)
    sky = graded(
        lookup(clouds, seen.across / 7.0, seen.up / 7.0),
        (-1.2, "#4d8fd1"),
        (0.3, "#9cc6ea"),
        (1.2, "#f4f8fb"),
    )
    bars = np.minimum(np.abs(seen.across / 0.6 % 1.0 - 0.5), np.abs(seen.up / 0.9 % 1.0 - 0.5))
    sky = blend(sky, colour("#3a3f45"), smooth(0.05, 0.03, bars))
    rim = np.minimum(3.3 - np.abs(seen.across), 2.3 - np.abs(seen.up))
    leaf = 0.75 + 0.25 * np.cos(24.0 * seen.across) * np.cos(24.0 * seen.up)
    stucco = graded(leaf, (0.5, "#b09a70"), (0.8, "#efe3c6"), (1.0, "#fff9ea"))
    ceiling = np.where((rim > 0.0)[..., None], sky, stucco)
    return np.where((seen.wall == 5)[..., None], ceiling, picture)


def courtyard(height: int) -> Picture:
    """A court: brick walls with shuttered windows and ivy, cobbles, and the sky above."""
    seen = box_room(height, (4.5, 3.5), 1.6, 3.4)
    size = height // 2
    brick = lookup(masonry.brick(size), seen.across / 3.0 + 0.3 * seen.wall, -seen.up / 3.0)
    ground = lookup(masonry.cobbles(size), seen.across / 3.4, seen.up / 3.4)
    column = np.floor(seen.across / 1.5).astype(np.int32)
    row = np.floor((seen.up + 1.6) / 1.68).astype(np.int32)
    index = (column + 9) * 7 + row * 31 + seen.wall * 101
    u, v = seen.across % 1.5 - 0.75, (seen.up + 1.6) % 1.68 - 0.88
    pane = np.maximum(np.abs(u) / 0.30, np.abs(v) / 0.52)
    bars = np.minimum(np.abs(u), np.abs((v + 0.52) % 0.35 - 0.175) + 0.02)
    warm = random_of(index, 3) < 0.4
    glow = np.where(warm[..., None], colour("#ffd27a"), colour("#3d5c78"))
    glow = glow * (0.7 + 0.5 * lookup(fbm(256, 8, 3, octaves=5), u + 0.1 * index, v))[..., None]
    window = blend(glow, colour("#f2ead8"), smooth(0.035, 0.022, bars))
    frame = colour("#d9cdb4") * (0.9 + 0.1 * np.cos(60.0 * v))[..., None]
    front = np.where((pane < 1.0)[..., None], window, brick)
    front = np.where(((pane >= 1.0) & (pane < 1.22))[..., None], frame, front)
    shutter = (np.abs(np.abs(u) - 0.55) < 0.17) & (np.abs(v) < 0.56)
    paint = chosen(random_of(index, 5), "#1f6f5c", "#23527c", "#8a2b2b", "#b9862b", "#4c6b3a")
    slats = paint * (0.72 + 0.4 * np.abs(np.sin(60.0 * v)))[..., None]
    front = np.where(shutter[..., None], slats, front)
    ivy = lookup(plants.leaves(size), seen.across / 1.9 + 0.4 * seen.wall, -seen.up / 1.9)
    ivy = ivy[..., [1, 0, 2]] * np.array([0.75, 1.0, 0.6], np.float32)
    climbs = fbm3(directions(height), 2.6, 61, octaves=6, gain=0.6) - 0.28 * seen.up
    front = np.where((climbs > 0.62)[..., None], ivy, front)
    picture = np.where((seen.wall == 4)[..., None], ground, front)
    light = 0.62 + 0.22 * np.clip(seen.up, -1.6, 3.0) / 3.0 * (seen.wall < 4)
    side = np.array([1.25, 1.0, 0.78, 0.95, 0.95, 1.0], np.float32)[seen.wall]
    picture = picture * (1.25 * light * side * (1 - 0.4 * np.exp(-seen.nearest / 0.3)))[..., None]
    clouds = fbm3(directions(height), 3.0, 71, octaves=7, gain=0.58)
    sky = graded(clouds, (-1.0, "#2f72bf"), (0.3, "#79b1e3"), (0.9, "#f4f6f8"), (1.8, "#ffffff"))
    return np.where((seen.wall == 5)[..., None], sky, picture)
