"""Draws objects cut open along a vertical plane through their middle: what is inside them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float
from matplotlib.collections import PolyCollection
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Curve

from experiments.figures.cross_sections import Outline, outlines_in
from experiments.figures.style import COLOURS, pyplot
from refref_jax.data.meshes import MeshPart

# Height of the camera above the horizon, radians, and the direction of light in its frame.
_ELEVATION = 0.35
_LIGHT = np.array([-0.4, 0.5, 0.77])

# Indices below which a part is drawn as air, and from which it is drawn as glass.
_AIR, _GLASS = 1.05, 1.44

# Largest share of light that a clear medium takes.
_CLEAR = 0.05

# Colours of glass, of clear liquids, of the walls around air, and of opaque parts.
_GLASS_COLOUR, _LIQUID_COLOUR, _WALL_COLOUR, _OPAQUE_COLOUR = (
    np.array(colour)
    for colour in ((0.56, 0.67, 0.74), (0.45, 0.7, 0.95), (0.88, 0.92, 0.94), (0.42, 0.38, 0.36))
)


def write(path: Path, parts: Sequence[MeshPart], truth: Sequence[MeshPart] = ()) -> None:
    """Writes a figure of an object: cut open, and its cross-section.

    The half that is nearer to the camera is removed. Cut glass is grey, a cut liquid has the colour
    of light that went through a unit of it, opaque parts are brown, and where there is air its
    walls are seen.

    Args:
      path: file to write.
      parts: parts of the object, the outermost first.
      truth: parts of the true object, if they are known, in any order.
    """
    truth = sorted(truth, key=lambda part: -np.ptp(part.vertices, axis=0).max())
    titles = ["found", "true"] if truth else ["found"]
    figure, axes = pyplot.subplots(
        1, len(titles) + 1, figsize=(3.2 * (len(titles) + 1), 4.6), layout="constrained"
    )
    middle = parts[0].vertices.mean(axis=0)
    for axis, title, shown in zip(axes, titles, (parts, truth), strict=False):
        _draw_cut(axis, shown, middle)
        axis.set_title(title)
        axis.axis("off")
    for shown, colour, style in ((truth, "#000000", "-"), (parts, COLOURS[1], "--")):
        for part in shown:
            for loop in _cross_section(part, middle):
                axes[-1].plot(*np.append(loop, loop[:1], axis=0).T, style, color=colour, lw=1.2)
    axes[-1].set(title="cross-section", xlabel="world units")
    axes[-1].locator_params(axis="x", nbins=3)
    axes[-1].set_aspect("equal")
    if truth:
        axes[-1].plot([], [], "-", color="#000000", label="true")
        axes[-1].plot([], [], "--", color=COLOURS[1], label="found")
        figure.legend(loc="outside lower right", ncols=2, frameon=False)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _cross_section(part: MeshPart, middle: Float[np.ndarray, "3"]) -> list[Outline]:
    """Returns the outlines of a part in the plane of the x and the z axis through its middle."""
    return outlines_in(
        part.vertices, part.faces, origin=(0.0, middle[1], 0.0), axes=((1, 0, 0), (0, 0, 1))
    )


def _draw_cut(axis: pyplot.Axes, parts: Sequence[MeshPart], middle: Float[np.ndarray, "3"]) -> None:
    """Draws the farther half of all parts, and then the cut."""
    triangles, colours = [], []
    for part in parts:
        vertices, faces, _ = trimesh.intersections.slice_faces_plane(
            part.vertices, part.faces, plane_normal=(0.0, 1.0, 0.0), plane_origin=middle
        )
        corners = _in_camera(vertices, middle)[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
        lit = 0.55 + 0.45 * np.abs(normals @ (_LIGHT / np.linalg.norm(_LIGHT)))
        triangles.append(corners)
        colours.append(np.clip(lit[:, None] * _surface_colour(part), 0.0, 1.0))
    corners, shades = np.concatenate(triangles), np.concatenate(colours)
    order = np.argsort(corners[..., 2].mean(axis=-1))
    axis.add_collection(
        PolyCollection(
            list(corners[order][..., :2]),
            facecolors=shades[order],
            edgecolors=shades[order],
            lw=0.3,
        )
    )
    for number, part in enumerate(parts):
        if part.index >= _AIR or _is_opaque(part):
            holes = [each for each in parts[number + 1 :] if number == 0 and not _is_opaque(each)]
            _fill(axis, part, holes, middle)
    axis.set_aspect("equal")
    axis.autoscale_view()


def _fill(
    axis: pyplot.Axes, part: MeshPart, holes: Sequence[MeshPart], middle: Float[np.ndarray, "3"]
) -> None:
    """Fills the cross-section of a part, without those of the parts inside."""
    outside = [_oriented(loop, 1.0) for loop in _cross_section(part, middle)]
    inside = [_oriented(loop, -1.0) for hole in holes for loop in _cross_section(hole, middle)]
    curves = []
    for loop in (*outside, *inside):
        points = np.stack([loop[:, 0], np.full(len(loop), middle[1]), loop[:, 1]], axis=-1)
        curves.append(Curve(_in_camera(points, middle)[:, :2], closed=False))
    patch = PathPatch(
        Curve.make_compound_path(*curves), facecolor=_cut_colour(part), edgecolor="#333333", lw=0.6
    )
    axis.add_patch(patch)


def _oriented(loop: Outline, sign: float) -> Outline:
    """Returns a closed loop that turns to the left if `sign` is 1, and to the right if it is -1."""
    closed = np.append(loop, loop[:1], axis=0)
    x, y = closed.T
    area = np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])
    return closed if area * sign > 0.0 else closed[::-1]


def _in_camera(
    points: Float[np.ndarray, "n 3"], middle: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n 3"]:
    """Returns points in the frame of a camera on the negative y axis: right, up, backwards."""
    x, y, z = (points - middle).T
    sine, cosine = np.sin(_ELEVATION), np.cos(_ELEVATION)
    return np.stack([x, cosine * z + sine * y, sine * z - cosine * y], axis=-1)


def _is_opaque(part: MeshPart) -> bool:
    return part.material.kind == "opaque"


def _cut_colour(part: MeshPart) -> Float[np.ndarray, "3"]:
    """Returns the colour of a cut."""
    if _is_opaque(part):
        return _OPAQUE_COLOUR
    left = np.asarray(part.tint, float) ** 2 * np.exp(-np.asarray(part.absorption, float))
    base = _GLASS_COLOUR if part.index >= _GLASS else _LIQUID_COLOUR
    clear = np.allclose(left, 1.0, atol=_CLEAR)
    return base if clear else np.clip(left, 0.0, 1.0) ** (1.0 / 2.2)


def _surface_colour(part: MeshPart) -> Float[np.ndarray, "3"]:
    if _is_opaque(part):
        return _OPAQUE_COLOUR
    return _WALL_COLOUR if part.index < _AIR or part.index >= _GLASS else _cut_colour(part)
