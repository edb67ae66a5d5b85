"""Analyses a scene: the features that a model of it requires (NumPy only).

`overridden` compares the properties in `scene.json` with those that are used, and `misfits` the
images with the background, whose size `size_in_images` measures by its parallax.

A model only includes what its scene requires, so that no computation is spent on the rest. The
analysis runs on the host, from the meshes, their description in `scene.json`, and the cameras; it
determines which code is compiled. The background is opaque in every scene, so it is not listed.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8

from refref_jax.choices import (
    CLEAR,
    NO_ABSORPTION,
    ORIGIN,
    SATURATED,
    Exposure,
    PartKind,
    Position,
    RuleName,
    Space,
    Tints,
)
from refref_jax.data import background_fit, image_files, scene_folder
from refref_jax.data.background_fit import Kind
from refref_jax.data.mesh_queries import (
    Containment,
    any_inside,
    encloses,
    is_one_convex_object,
    misses_boxes,
)
from refref_jax.data.meshes import MeshPart
from refref_jax.data.scene_folder import Frames
from refref_jax.data.scene_properties import PartDescription, SceneProperties
from refref_jax.geometry.cameras import Cameras, planar_directions
from refref_jax.optics.interface_rules import NO_PARENT
from refref_jax.optics.path_settings import Reentry

NeededInterior = Literal["none", "clear", "absorbing"]
"""Interior of the objects; `none` without objects."""

# Most images that are compared with the background; patches per edge of an image, and the number of
# pixels along it that are enough; cells per side of a face of the background.
_MOST_IMAGES, _PATCHES, _EDGE, _CELLS = 60, 16, 128, 128

# Mean sRGB error of a patch that differs.
_MISFIT = 0.05

# Power of sRGB that is nearly linear light; rounds in which gains of images are found, and the gain
# below which 8 bits show too little of an image.
_GAMMA, _GAIN_ROUNDS, _DARK = 2.2, 20, 0.1

# Largest size of a background that is searched for, relative to the cameras' distance from its
# centre; number of sizes at first; then cells per side of a face and steps between sizes.
_LARGEST, _SIZES, _ZOOMS = 16.0, 40, ((64, 0.035), (128, 0.01), (256, 0.004))

# Relative change of the size that shows whether the images determine it; least increase of their
# variance; groups of images that the standard error is estimated from.
_OFF, _LEAST_INCREASE, _GROUPS = 0.05, 1.5, 4

MOST_MISFITS = 5e-3
"""Share of misfits beyond which the world behind the objects is not the background's surface."""


class SceneAnalysis(NamedTuple):
    """Features that a scene requires of a model.

    Attributes:
      parts: number of meshes; without any, rays are straight.
      objects: number of outermost parts, which no other part contains.
      convex: whether there is exactly one object, and it is convex and contains all other parts.
      reentry: `impossible` if a ray that has left the objects cannot meet any again.
      interior: interior of the objects: `none` without objects, `clear` if their colours are known
        and absorb no light, otherwise `absorbing`.
      tints: colours of interfaces and media: `none` if they are clear, `given` if `scene.json` has
        them for every part, otherwise to be `learned`.
      embedded: kinds of parts that are not dielectrics.
      rough: whether a surface is rough.
      dispersion: whether indices differ between red, green and blue.
      field_parts: parts whose inside is to be modelled by a field.
      space: `unbounded` if the background is infinitely far away, `spherical` if it is a sphere.
    """

    parts: int
    objects: int
    convex: bool
    reentry: Reentry
    interior: NeededInterior
    tints: Tints
    space: Space
    embedded: tuple[PartKind, ...] = ()
    rough: bool = False
    dispersion: bool = False
    field_parts: tuple[int, ...] = ()


def analyse(
    parts: Sequence[MeshPart],
    tree: Containment,
    cameras: Cameras,
    *,
    rule: RuleName,
    space: Space,
) -> SceneAnalysis:
    """Analyses a scene.

    Parts nested inside one convex object do not affect `reentry`: a ray that has left the object
    meets nothing again. Re-entry is assumed possible for several parts that may overlap (rule
    `priority`), and for a camera inside the object.

    Args:
      parts: meshes of the scene.
      tree: containment of the meshes, from `mesh_queries.find_containment`.
      cameras: cameras at which rays start.
      rule: interface rule, which determines the medium outside a part; see
        `optics.interface_rules`.
      space: geometry of the background.
    """
    bodies = [
        parts[i]
        for i, parent in enumerate(tree.parents)
        if parent == NO_PARENT and parts[i].material.kind == "dielectric"
    ]
    others = [part for part in parts if part.material.kind != "dielectric"]
    apart = [part for part in others if not any(encloses(body, part) for body in bodies)]
    outermost = bodies + apart
    convex = len(outermost) == 1 and is_one_convex_object(outermost[0], parts)
    # Under other rules, a ray between two parts may count as outside of all parts.
    told_apart = rule == "nested" or len(parts) == 1
    leaves_for_good = convex and told_apart and not any_inside(cameras.poses[:, :, 3], outermost[0])
    if convex and outermost[0].material.kind == "thin_sheet":
        leaves_for_good = False  # inside a closed sheet, light is still in the ambient medium
    return SceneAnalysis(
        parts=len(parts),
        objects=len(outermost),
        convex=convex,
        reentry="impossible" if leaves_for_good or not parts else "possible",
        interior=_interior(parts),
        tints=find_tints(parts),
        space=space,
        embedded=tuple(sorted({part.material.kind for part in others})),
        rough=any(part.material.roughness > 0.0 for part in parts),
        dispersion=any(part.material.dispersion is not None for part in parts),
        field_parts=tuple(i for i, part in enumerate(parts) if part.material.interior == "field"),
    )


def describe(analysis: SceneAnalysis) -> str:
    """Returns the required features in one line of text."""
    background = f"{analysis.space} background"
    if analysis.parts == 0:
        return f"this scene has no meshes: no tracer, {background}"
    tints = {
        "none": "no tint",
        "given": "tints and absorption (given)",
        "learned": "tints and absorption (to be learned)",
    }
    reentry = "re-entry" if analysis.reentry == "possible" else "no re-entry"
    words = [_objects(analysis), reentry, background, tints[analysis.tints]]
    words += [f"{kind.replace('_', ' ')} parts" for kind in analysis.embedded]
    words += ["rough surfaces"] * analysis.rough + ["dispersion"] * analysis.dispersion
    words += ["a field inside parts"] * bool(analysis.field_parts)
    return f"this scene needs: {', '.join(words)}"


def overridden(
    properties: SceneProperties,
    parts: Sequence[MeshPart],
    *,
    rule: RuleName,
    space: Space | None = None,
    radius: float | None = None,
    centre: Position | None = None,
) -> tuple[str, ...]:
    """Returns a line of text for each property of `scene.json` that another value overrides.

    Args:
      properties: properties in `scene.json`.
      parts: meshes, with the indices of refraction that are used.
      rule: interface rule that is used.
      space: geometry of the background that is used, if it may differ.
      radius: size of the background that is used, if it is given.
      centre: centre of the background that is used, if it is given.
    """
    background = properties.background
    lines: list[tuple[str, str, str]] = []
    if properties.rule is not None and properties.rule != rule:
        lines.append(("rule", f"rule={rule}", properties.rule))
    if background.kind is not None and space not in (None, properties.space):
        lines.append(("background", f"background={space}", background.kind))
    elif background.extent is not None and radius not in (None, background.extent):
        lines.append(("background", f"radius={radius:g}", f"{background.extent:g}"))
    if background.centre is not None and centre not in (None, background.centre):
        lines.append(("background", f"centre={centre}", f"{background.centre}"))
    for part in parts:
        for name, described in properties.parts.items():
            index = described.index
            if Path(name).stem == part.name and index not in (None, part.index):
                lines.append((name, f"index={part.index:g} of {part.name}", f"{index:g}"))
    return tuple(
        f"note: {used} overrides {properties.origins[key].name}: {x}." for key, used, x in lines
    )


def _objects(analysis: SceneAnalysis) -> str:
    before = ["clear"] if analysis.interior == "clear" else []
    if analysis.convex:
        before.append("convex")
    noun = "object" if analysis.objects == 1 else "objects"
    text = " ".join([str(analysis.objects), *before, noun])
    if analysis.parts > analysis.objects:
        text = f"{analysis.parts} parts in {text}"
    return text if analysis.convex or analysis.objects > 1 else f"{text} that is not convex"


def _takes_light(part: MeshPart | PartDescription) -> bool:
    return tuple(part.tint) != CLEAR or tuple(part.absorption) != NO_ABSORPTION


def _interior(parts: Sequence[MeshPart]) -> NeededInterior:
    if not parts:
        return "none"
    return "clear" if find_tints(parts) == "none" else "absorbing"


def find_tints(
    parts: Sequence[MeshPart | PartDescription],
) -> Tints:
    """Returns the source of the colours of parts or their descriptions; see `SceneAnalysis`.

    Light ends on opaque parts, a conductor has the colour of its index, and a field inside a part
    learns its colour, so only the others have colours that may be unknown.
    """
    clear = ("dielectric", "thin_sheet")
    coloured = [x for x in parts if x.material.kind in clear and x.material.interior is None]
    if not all(part.colour_known for part in coloured):
        return "learned"
    return "given" if any(map(_takes_light, coloured)) else "none"


def read_misfits(
    scene: Path,
    parts: Sequence[MeshPart],
    *,
    space: Space,
    size: float,
    centre: Position,
    masked: bool,
    exposure: Exposure = "fixed",
) -> float:
    """Returns the share of `misfits` of the training images, of which at most 60 are read.

    Args:
      scene: folder of the scene.
      parts: meshes of the scene.
      space: geometry of the background.
      size: half edge of the cube, or radius of the sphere, world units.
      centre: centre of the background, world units.
      masked: whether the masks say where objects are, since the meshes are unknown.
      exposure: exposure of the images, see `misfits`.

    Raises:
      SceneError: if a file is missing or broken.
    """
    frames, images = _read_some(scene)
    among = image_files.well_outside(scene_folder.read_masks(frames)) if masked else None
    how: dict[str, Any] = {"among": among, "exposure": exposure}
    return misfits(frames.cameras, images, parts, space=space, size=size, centre=centre, **how)


def _read_some(scene: Path) -> tuple[Frames, UInt8[np.ndarray, "views h w 3"]]:
    """Returns training views that are evenly spread, at most 60, and their images."""
    frames = scene_folder.read_frames(scene, "train")
    count = len(frames.images)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _MOST_IMAGES)).astype(int))
    masks = frames.masks and tuple(frames.masks[i] for i in chosen)
    frames = frames._replace(
        images=tuple(frames.images[i] for i in chosen),
        masks=masks,
        cameras=frames.cameras._replace(poses=frames.cameras.poses[chosen]),
    )
    return frames, scene_folder.read_images(frames)


def size_in_images(
    scene: Path, parts: Sequence[MeshPart], kind: Kind, centre: Position
) -> tuple[float, float] | None:
    """Returns the size of the background and its standard error, as the images of a scene show it.

    Raises:
      SceneError: if a file is missing or broken.
    """
    frames, images = _read_some(scene)
    return fit_size_by_parallax(frames.cameras, images, parts, kind, centre=centre)


def fit_size_by_parallax(
    cameras: Cameras,
    photographs: UInt8[np.ndarray, "views h w 3"],
    parts: Sequence[MeshPart],
    kind: Kind,
    *,
    centre: Position = ORIGIN,
) -> tuple[float, float] | None:
    """Returns the size of a background, half edge or radius, and its standard error.

    With the right size, all pixels that see the same small cell of the background directly have the
    same colour; with a wrong one, parallax mixes different places. The size minimises the variance
    of the colours within the cells, from coarse cells to fine ones. The error is estimated from
    groups of the images.

    Args:
      cameras: cameras of the images.
      photographs: 8-bit sRGB images.
      parts: meshes of the scene; rays that meet the box around one are left out.
      kind: shape of the background.
      centre: centre of the background, world units.

    Returns:
      Size and standard error, world units; `None` if the variance is not at least half as large
      again for a size that is 5 % off, as in front of smooth walls.
    """
    views, height, width, _ = photographs.shape
    stride = max(1, 2 * min(height, width) // _EDGE)
    row, column = np.mgrid[stride // 2 : height : stride, stride // 2 : width : stride]
    planar = planar_directions(cameras, row.ravel(), column.ravel())
    rays = np.stack([planar @ pose[:, :3].T for pose in cameras.poses])
    origins = cameras.poses[:, :, 3] - np.array(centre)
    from_where = zip(cameras.poses[:, :, 3], rays, strict=True)
    sees = np.stack([misses_boxes(*each, parts) for each in from_where])
    seen = photographs[:, row.ravel(), column.ravel()] / 255.0
    space: Space = "spherical" if kind == "sphere" else "bounded"

    def variance(size: float, cells: int, group: slice = slice(None)) -> float:
        pairs = zip(origins[group], rays[group], strict=True)
        cell = np.stack([_cells(o, d, space=space, size=size, cells=cells) for o, d in pairs])
        return _variance(cell[sees[group]], seen[group][sees[group]])

    reach = np.abs(origins) if kind == "cube" else np.linalg.norm(origins, axis=1)
    sizes = 1.02 * np.max(reach) * np.geomspace(1.0, _LARGEST, _SIZES)
    size = min(sizes[1:-1].tolist(), key=lambda x: variance(x, _ZOOMS[0][0]))
    for cells, step in _ZOOMS:
        size = min(
            (size * (1.0 + step * n) for n in range(-3, 4)), key=lambda x: variance(x, cells)
        )
    off = min(variance(size * (1.0 + x), cells) for x in (-_OFF, _OFF))
    if not off > _LEAST_INCREASE * variance(size, cells):
        return None

    def vertex(group: slice) -> float:
        low, middle, high = (variance(size * (1.0 + n * step), cells, group) for n in (-1, 0, 1))
        curvature = low - 2.0 * middle + high
        return size * (1.0 + 0.5 * step * (low - high) / curvature) if curvature > 0.0 else size

    groups = min(_GROUPS, views)
    apart = np.std([vertex(slice(n, None, groups)) for n in range(groups)])
    return vertex(slice(None)), float(apart) / math.sqrt(max(groups - 1, 1))


def _variance(cell: Int[np.ndarray, " n"], seen: Float[np.ndarray, "n 3"]) -> float:
    """Returns the mean variance of the colours within the cells that two or more pixels see."""
    number = np.bincount(cell)
    shared = number[cell] > 1
    if not np.any(shared):
        return np.inf
    unbiased = number / np.maximum(number - 1, 1)
    means = [np.bincount(cell, each) / np.maximum(number, 1) for each in seen.T]
    squared = sum((each - mean[cell]) ** 2 for each, mean in zip(seen.T, means, strict=True))
    return float(np.mean((unbiased[cell] * squared)[shared]))


def misfits(
    cameras: Cameras,
    photographs: UInt8[np.ndarray, "views h w 3"],
    parts: Sequence[MeshPart],
    *,
    space: Space,
    size: float,
    centre: Position = ORIGIN,
    among: Bool[np.ndarray, "views h w"] | None = None,
    exposure: Exposure = "fixed",
) -> float:
    """Returns the share of patches of the images that see the background, but differ from it.

    The background is one colour in each of many small cells, the mean of all pixels that see it
    directly. Its errors at details of a texture average out over a patch, a sixteenth of an image's
    edge. Those of something in front of it do not, nor those of a background of another size: they
    have parallax.

    Args:
      cameras: cameras of the images.
      photographs: 8-bit sRGB images.
      parts: meshes of the scene; rays that meet the box around one are left out.
      space: geometry of the background.
      size: half edge of the cube, or radius of the sphere, world units.
      centre: centre of the background, world units.
      among: mask of the pixels that may see the background; all by default.
      exposure: exposure of the images; with `per_image`, each has gains of its own, which are
        estimated first, and saturated pixels are left out.

    Returns:
      The share among the patches all of whose rays miss the boxes; 0 if there are none.
    """
    views, height, width, _ = photographs.shape
    stride = max(1, min(height, width) // _EDGE)
    edge = max(1, min(height, width) // stride // _PATCHES)
    rows, columns = (side // stride // edge for side in (height, width))
    row, column = np.mgrid[: rows * edge, : columns * edge] * stride + stride // 2
    cells, direct = [], []
    for pose in cameras.poses:
        directions = planar_directions(cameras, row.ravel(), column.ravel()) @ pose[:, :3].T
        cells.append(_cells(pose[:, 3] - np.array(centre), directions, space=space, size=size))
        direct.append(misses_boxes(pose[:, 3], directions, parts))
    cell, sees = np.concatenate(cells), np.concatenate(direct)
    if among is not None:
        sees &= among[:, row, column].reshape(-1)
    seen = photographs[:, row, column].reshape(-1, 3).T / 255.0
    if exposure == "per_image":
        sees &= np.all(seen < SATURATED, axis=0)
        gains = _gains(seen**_GAMMA, cell, sees, views)
        sees &= np.all(gains > _DARK, axis=0)
        seen = np.where(sees, (seen**_GAMMA / np.maximum(gains, _DARK)) ** (1.0 / _GAMMA), 0.0)
    means = _cell_means(seen, cell, np.broadcast_to(sees, seen.shape))

    def averaged(values: np.ndarray) -> np.ndarray:
        return values.reshape(views, rows, edge, columns, edge).mean((2, 4))

    judged = averaged(sees.astype(np.float64)) == 1.0
    if not np.any(judged):
        return 0.0
    errors = [averaged(mean[cell] - each) for mean, each in zip(means, seen, strict=True)]
    return float(np.mean(np.max(np.abs(errors), axis=0)[judged] > _MISFIT))


def _cell_means(
    seen: Float[np.ndarray, "3 n"], cell: Int[np.ndarray, " n"], weights: Shaped[np.ndarray, "3 n"]
) -> Float[np.ndarray, "3 cells"]:
    """Returns the weighted mean of each channel in each cell; 0 in cells without weight."""
    count = 6 * _CELLS**2
    sums, total = (
        np.stack([np.bincount(cell, each, count) for each in values])
        for values in (weights * seen, weights)
    )
    return np.divide(sums, total, out=np.zeros_like(sums), where=total > 0.0)


def _gains(
    linear: Float[np.ndarray, "3 n"],
    cell: Int[np.ndarray, " n"],
    sees: Bool[np.ndarray, " n"],
    views: int,
) -> Float[np.ndarray, "3 n"]:
    """Returns the gain of the view of each pixel, whose pixels follow each other, by channel.

    Gains, whose mean is 1, and the radiance of cells are found in turn by least squares.
    """
    gains = np.ones_like(linear)
    for _ in range(_GAIN_ROUNDS):
        even = np.divide(linear, gains, out=np.zeros_like(linear), where=gains > 0.0)
        fitted = sees * np.take(_cell_means(even, cell, sees * gains**2), cell, axis=1)
        above, below = (
            np.sum((x * fitted).reshape(3, views, -1), axis=2, keepdims=True)
            for x in (linear, fitted)
        )
        of_views = np.divide(above, below, out=np.ones_like(above), where=below > 0.0)
        of_views /= np.mean(of_views, axis=1, keepdims=True)
        gains = np.repeat(of_views[..., 0], linear.shape[1] // views, axis=1)
    return gains


def _cells(
    origin: Float[np.ndarray, "3"],
    directions: Float[np.ndarray, "n 3"],
    *,
    space: Space,
    size: float,
    cells: int = _CELLS,
) -> Int[np.ndarray, " n"]:
    """Returns the cell of a cube map that each ray sees; the origin is relative to its centre."""
    towards = directions
    if space != "unbounded":
        kind: Kind = "sphere" if space == "spherical" else "cube"
        origins = np.broadcast_to(origin, directions.shape)
        depths = background_fit.depths_of(kind, origins, directions, size=size)
        towards = origin + depths[:, None] * directions
    axis = np.argmax(np.abs(towards), axis=1)[:, None]
    major = np.take_along_axis(towards, axis, 1)
    others = np.take_along_axis(towards, (axis + np.array([1, 2])) % 3, 1)
    place = np.clip(0.5 * cells * (others / np.abs(major) + 1.0), 0, cells - 1).astype(np.int64)
    face = 2 * axis[:, 0] + (major[:, 0] > 0.0)
    return (face * cells + place[:, 1]) * cells + place[:, 0]
