"""Moves meshes and arranges them side by side (NumPy only)."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from experiments.dataset.parts import ObjectPart

Mesh = tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]


def merged(meshes: Sequence[Mesh]) -> Mesh:
    """Returns one mesh with the pieces of several."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes[:-1])])
    return (
        np.concatenate([vertices for vertices, _ in meshes]),
        np.concatenate([faces + start for (_, faces), start in zip(meshes, starts, strict=True)]),
    )


def united(parts: Sequence[ObjectPart]) -> ObjectPart:
    """Joins separate parts of the same material to one part, named like the first."""
    vertices, faces = merged([(part.vertices, part.faces) for part in parts])
    return parts[0]._replace(vertices=vertices, faces=faces)


def moved(parts: Sequence[ObjectPart], by: tuple[float, float, float]) -> list[ObjectPart]:
    """Returns parts moved by a vector, in world units."""
    return [part._replace(vertices=part.vertices + np.asarray(by)) for part in parts]


def tilted(parts: Sequence[ObjectPart], *, axis: str, degrees: float) -> list[ObjectPart]:
    """Returns parts rotated around an axis of the world, `x`, `y` or `z`, through the origin."""
    matrix = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return [part._replace(vertices=part.vertices @ matrix.T) for part in parts]


def enlarged(parts: Sequence[ObjectPart], factor: float) -> list[ObjectPart]:
    """Returns parts scaled about the origin, including the gaps between them."""
    return [part._replace(vertices=part.vertices * factor) for part in parts]


def centred(parts: Sequence[ObjectPart]) -> list[ObjectPart]:
    """Returns parts moved so that their common bounding box is centred at the origin."""
    vertices = np.concatenate([part.vertices for part in parts])
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    return [part._replace(vertices=part.vertices - middle) for part in parts]
