"""Cloth: a jacquard weave, a quilt of tartans, and a knotted carpet."""

import numpy as np
from jaxtyping import Float, Int

from experiments.dataset.textures.fields import (
    Field,
    Picture,
    blend,
    coordinates,
    fbm,
    noise,
    random_of,
    smooth,
)
from experiments.dataset.textures.shading import chosen, colour, colours, lit


def jacquard(n: int) -> Picture:
    """A heavy weave of warp and weft in many yarns, patterned with diamonds and waves."""
    x, y = coordinates(n)
    x, y = x + 0.0012 * noise(n, 14, 1), y + 0.0012 * noise(n, 14, 2)
    threads = 84
    i, j = np.floor(x * threads).astype(np.int32), np.floor(y * threads).astype(np.int32)
    u, v = x * threads - i - 0.5, y * threads - j - 0.5
    a, b = np.abs(i % 28 - 14), np.abs(j % 28 - 14)
    diamond = (a + b) % 7 < 3
    wave = (j + np.abs((i % 12) - 6)) % 6 < 3
    band = (j // 28) % 2 == 0
    lifted = np.where(band, diamond, wave)
    plain = (i + j) % 2 == 0
    # Where the pattern lifts the warp, it floats over three of four wefts.
    over = np.where(lifted, (i + 2 * j) % 4 != 0, (i + 2 * j) % 4 == 0) ^ (plain & ((a + b) == 14))
    warp = chosen(random_of(i // 7, 11), "#f1e3c6", "#e9c46a", "#f4a261", "#f7ead2", "#dfa08a")
    weft = chosen(
        random_of(j // 4, 12), "#264653", "#9b2335", "#1d3557", "#2a7f78", "#6d2e46", "#33415c"
    )
    yarn = blend(weft, warp, over)
    yarn = yarn * (0.8 + 0.35 * random_of(np.where(over, i, j + 997), 13))[..., None]
    along, across = np.where(over, v, u), np.where(over, u, v)
    twist = np.sin(2.0 * np.pi * (2.0 * along + 1.3 * across) * np.where(over, 1.0, -1.0))
    fuzz = fbm(n, 120, 3, octaves=3, gain=0.9)
    yarn = yarn * (1.0 + 0.10 * twist + 0.09 * fuzz)[..., None]
    swell = np.sqrt(np.clip(1.0 - (across / 0.5) ** 2, 0.0, 1.0))
    dive = smooth(0.5, 0.30, np.abs(along))
    height = (0.0045 * swell * (0.55 + 0.45 * dive) + 0.0004 * twist + 0.0002 * fuzz) * 1.1
    cloth = lit(yarn * (0.35 + 0.65 * swell * (0.6 + 0.4 * dive))[..., None], height)
    folds = 1.0 + 0.10 * fbm(n, 3, 23, octaves=3)
    return 1.25 * cloth * folds[..., None]


_SETTS = (
    ("#16324f", "#1e5945", "#0b1420", "#d9b44a", "#a4243b"),
    ("#a4161a", "#660708", "#0b3d2e", "#f5f3f4", "#1b263b"),
    ("#e0d3b8", "#8c5e3c", "#26221f", "#b23a48", "#5b7a6a"),
    ("#14532d", "#1e3a5f", "#0f0f14", "#e63946", "#f1faee"),
    ("#d98e04", "#2b2d42", "#7f1d1d", "#fefae0", "#2f5d62"),
    ("#4a3b76", "#8e7cc3", "#1b1b2f", "#e5d352", "#2e8b7a"),
    ("#c6d2dc", "#3c5a7d", "#20252d", "#d1495b", "#edae49"),
)


def tartan(n: int) -> Picture:
    """A quilt of twill tartans, each patch from another clan, with stitched seams."""
    x, y = coordinates(n)
    patches = 4
    column, row = np.floor(x * patches).astype(np.int32), np.floor(y * patches).astype(np.int32)
    patch = row * patches + column
    kind = (column + 2 * row + row // 2) % len(_SETTS)
    threads = 480
    i, j = np.floor(x * threads).astype(np.int32), np.floor(y * threads).astype(np.int32)
    warp, weft = _stripes(i, kind), _stripes(j + 13, kind)
    over = (i + j) % 4 < 2
    yarns = colours(*(code for sett in _SETTS for code in sett))
    cloth = yarns[np.where(over, warp, weft)]
    cloth = cloth * (0.86 + 0.28 * random_of(np.where(over, i, j + 700), 5))[..., None]
    fuzz = fbm(n, 100, 9, octaves=4, gain=0.85)
    cloth = cloth * (1.0 + 0.09 * fuzz)[..., None]
    ridge = np.abs(((x + y) * threads / 4.0) % 1.0 - 0.5)
    u, v = x * patches - column, y * patches - row
    rim = np.minimum(np.minimum(u, 1.0 - u), np.minimum(v, 1.0 - v))
    along = np.where(np.minimum(u, 1.0 - u) < np.minimum(v, 1.0 - v), v, u)
    stitch = smooth(0.010, 0.006, np.abs(rim - 0.035)) * (np.abs(along * 22.0 % 1.0 - 0.5) < 0.3)
    cloth = blend(cloth, colour("#f3e7cb"), 0.9 * stitch)
    puff = 0.010 * np.sqrt(np.clip(rim * 2.0, 0.0, 1.0)) + 0.0015 * fbm(n, 9, 4, octaves=3)
    quilt = np.minimum(np.abs((u + v) * 3.0 % 1.0 - 0.5), np.abs((u - v) * 3.0 % 1.0 - 0.5))
    puff = puff + 0.003 * np.sqrt(np.clip(quilt * 4.0, 0.0, 1.0))
    height = puff + 0.0007 * ridge + 0.001 * stitch + 0.0001 * fuzz
    tone = 0.88 + 0.24 * random_of(patch, 6)
    return 1.15 * lit(cloth * tone[..., None], height)


def _stripes(thread: Int[np.ndarray, "h w"], kind: Int[np.ndarray, "h w"]) -> np.ndarray:
    """Returns the yarn of each thread: a mirrored sett of 60, with other widths for other clans."""
    widths = np.random.default_rng(3).integers(3, 14, (len(_SETTS), 9))
    order = np.array([0, 2, 1, 3, 1, 2, 0, 4, 0])
    setts = np.stack(
        [
            np.resize(np.repeat(order, each)[: 60 if each.sum() >= 60 else None], 60)
            for each in widths
        ]
    )
    position = thread % 120
    position = np.where(position < 60, position, 119 - position)
    return kind * 5 + setts[kind, position]


_KNOTS = 232


def carpet(n: int) -> Picture:
    """A Persian carpet: a medallion, corners, borders and flowers in knots of wool."""
    x, y = coordinates(n)
    wave = 0.0011 * noise(n, 20, 2)
    i = np.floor((x + wave) * _KNOTS).astype(np.int32).clip(0, _KNOTS - 1)
    j = np.floor((y - wave) * _KNOTS).astype(np.int32).clip(0, _KNOTS - 1)
    dye = _woven()[j, i]
    wool = colours(
        "#7a1420",
        "#12203f",
        "#e9d8b4",
        "#c58a2b",
        "#2f5e58",
        "#a8402c",
        "#0d1120",
        "#d9a9a0",
        "#5a7fa0",
    )[dye]
    knot = j * _KNOTS + i
    abrash = noise(n, (2, 26), 7)  # bands between batches of dye
    fuzz = fbm(n, 130, 5, octaves=3, gain=0.9)
    wool = wool * (0.87 + 0.26 * random_of(knot, 4) + 0.06 * abrash + 0.10 * fuzz)[..., None]
    u, v = (x + wave) * _KNOTS % 1.0 - 0.5, (y - wave) * _KNOTS % 1.0 - 0.5
    tuft = np.clip(1.0 - 2.6 * (u * u + v * v), 0.0, 1.0)
    height = 0.0020 * tuft + 0.0012 * noise(n, 12, 8) + 0.0003 * fuzz
    return 1.2 * lit(wool * (0.6 + 0.4 * tuft)[..., None], height)


def _woven() -> Int[np.ndarray, "knots knots"]:
    """Returns the dye of each knot, symmetric in all four quarters."""
    ticks = (np.arange(_KNOTS) + 0.5) / _KNOTS * 2.0 - 1.0
    a, b = (np.abs(each) for each in np.meshgrid(ticks, ticks))
    out = np.maximum(a, b)
    along = np.where(a > b, b, a)
    dye = np.zeros(a.shape, np.int64)
    radius, turn = np.hypot(a, b), np.arctan2(b, a)
    # Flowers on a lattice, and vines between them, fill the field.
    petals = _flower(a, b, 9.0, 6)
    vine = np.abs(np.sin(14.0 * a + 2.2 * np.sin(11.0 * b)) + np.cos(13.0 * b)) < 0.16
    dye[vine] = 4
    dye = np.where(petals > 0, np.array([0, 2, 3, 8, 1])[petals], dye)
    # The medallion: lobed rings.
    lobes = 0.46 + 0.045 * np.cos(16.0 * turn) + 0.04 * np.cos(8.0 * turn) ** 3
    for share, tone in (
        (1.0, 6),
        (0.965, 3),
        (0.92, 1),
        (0.70, 2),
        (0.66, 5),
        (0.44, 6),
        (0.41, 4),
        (0.24, 3),
        (0.18, 0),
        (0.09, 2),
    ):
        dye = np.where(radius < share * lobes, tone, dye)
    ring = (radius > 0.70 * lobes) & (radius < 0.92 * lobes)
    dye = np.where(ring & (np.cos(16.0 * turn) * np.cos(60.0 * radius) > 0.3), 7, dye)
    ring = (radius > 0.44 * lobes) & (radius < 0.66 * lobes)
    dye = np.where(ring & (np.cos(24.0 * turn + 30.0 * radius) > 0.35), 3, dye)
    corner = np.hypot(0.80 - a, 0.80 - b)
    edge = 0.34 + 0.03 * np.cos(14.0 * np.arctan2(0.80 - b, 0.80 - a))
    for share, tone in ((1.0, 6), (0.95, 3), (0.90, 4), (0.55, 1), (0.50, 2), (0.30, 5)):
        dye = np.where(corner < share * edge, tone, dye)
    return _borders(dye, out, along)


def _borders(
    dye: Int[np.ndarray, "k k"], out: Float[np.ndarray, "k k"], along: Float[np.ndarray, "k k"]
) -> Int[np.ndarray, "k k"]:
    """Returns the carpet with its stripes: guards, the main border with palmettes, a fringe."""
    for low, tone in (
        (0.775, 6),
        (0.785, 2),
        (0.815, 6),
        (0.825, 1),
        (0.935, 6),
        (0.945, 3),
        (0.975, 0),
    ):
        dye = np.where(out > low, tone, dye)
    guard = ((out > 0.785) & (out < 0.815)) | ((out > 0.945) & (out < 0.975))
    dye = np.where(guard & ((along * 30.0 + out * 33.0) % 1.0 < 0.45), 5, dye)
    main = (out > 0.825) & (out < 0.935)
    palmette = np.hypot((along * 8.0) % 1.0 - 0.5, (out - 0.88) * 7.0)
    turn = np.arctan2((out - 0.88) * 7.0, (along * 8.0) % 1.0 - 0.5)
    petal = palmette * (1.0 - 0.25 * np.cos(8.0 * turn))
    for share, tone in ((0.42, 3), (0.36, 0), (0.24, 2), (0.13, 4)):
        dye = np.where(main & (petal < share), tone, dye)
    leaf = np.hypot(((along * 8.0 + 0.5) % 1.0 - 0.5) * 1.5, (out - 0.88) * 9.0)
    return np.where(main & (leaf < 0.22), 4, np.where(main & (leaf < 0.27), 2, dye))


def _flower(a: Field, b: Field, count: float, petals: int) -> Int[np.ndarray, "k k"]:
    """Returns the ring index inside flowers on a staggered lattice, and 0 elsewhere."""
    row = np.floor(b * count)
    u, v = (a * count + 0.5 * (row % 2)) % 1.0 - 0.5, b * count - row - 0.5
    radius = np.hypot(u, v) * (1.0 + 0.22 * np.cos(petals * np.arctan2(v, u)))
    return np.digitize(-radius, [-0.36, -0.30, -0.16, -0.07])
