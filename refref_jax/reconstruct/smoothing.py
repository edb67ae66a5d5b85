"""Smooths and denoises closed meshes over a length, keeping their volume (NumPy only).

Diffusion over a length `l` damps a ripple of wavelength `w` by `exp(-2 (pi l / w)^2)`: `l` is the
standard deviation of the heat kernel, in world units, after a time `l^2 / 2`. It is discretised by
finite elements (cotangent weights, areas) and integrated in implicit steps. Unlike repeated
averaging over neighbours, the result depends on neither the length nor the number of the edges.

`diffuse` moves the vertices, and rounds all detail smaller than the length. `denoise` diffuses the
normals of faces, less across sharp edges, and then fits the vertices to them: ripples vanish, edges
remain. It cuts off fillets narrower than the length, so `denoise_within` shortens the length if the
masks disagree.

Sources: Desbrun et al., Implicit Fairing of Irregular Meshes (1999); Yu et al., Mesh Editing with
Poisson-Based Gradient Field Manipulation (2004); Perona and Malik (1990) for the weight of an
angle.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.linalg import cg

from refref_jax.geometry.triangle_meshes import (
    Faces,
    Mesh,
    Vertices,
    face_normals,
    face_vectors,
    gather,
    make_mesh,
    neighbours,
    unit_vectors,
    vertex_vectors,
    volume,
)
from refref_jax.reconstruct import ReconstructionError
from refref_jax.reconstruct.masks import Views, some_of
from refref_jax.reconstruct.mesh_distance import silhouette_overlap

Pairs = Int[np.ndarray, " pairs"]

CREASE = np.radians(15.0)
"""Angle between neighbouring faces across which normals hardly diffuse, radians."""

# Implicit steps of one diffusion: four come within a few percent of the heat kernel.
_STEPS = 4

# Slivers have unbounded cotangents; these bounds keep the system well conditioned.
_SMALLEST, _LARGEST = 0.02, 20.0

_TOLERANCE = 1e-6
_MOST_ITERATIONS = 500

# Vertices are held in place on lengths above this many diffusion lengths.
_HOLD = 4.0

# Smallest distance between centres of faces, as a share of the edge between them.
_NEAREST_MIDDLES = 0.2

_VOLUME_STEPS = 4

# Smallest area of a face, as a share of the mean: a face of zero area would have no normal.
_LIGHTEST = 1e-6

# Faces whose normal would turn further are unchanged (given as a cosine): the arc is ambiguous.
_TURNED_OVER = -0.9


def diffuse(mesh: Mesh, length: float) -> Mesh:
    """Diffuses vertices over a length, then moves them along normals to restore the volume.

    Args:
      mesh: closed mesh.
      length: diffusion length, world units; 0 returns the mesh. Thinner parts may vanish.
    """
    if length <= 0.0:
        return mesh
    stiffness = cotangent_weights(mesh.vertices, mesh.faces)
    mass = vertex_areas(mesh.vertices, mesh.faces)
    vertices = _implicit(stiffness, mass, mesh.vertices, length)
    return make_mesh(keep_volume(vertices, mesh.faces, mesh), mesh.faces)


def denoise(mesh: Mesh, length: float, *, crease_angle: float = CREASE, rounds: int = 2) -> Mesh:
    """Diffuses normals over a length, but not across creases, and fits the vertices to them.

    An angle `a` between faces has the weight `exp(-(a / crease_angle)^2)`, recomputed at each of
    four steps. The volume and features larger than four diffusion lengths are preserved.

    Args:
      mesh: closed mesh.
      length: diffusion length, world units; 0 returns the mesh.
      crease_angle: angle at which diffusion stops, radians; above the noise of neighbouring
        normals, and below the angles by which marching cubes splits an edge into several steps.
      rounds: number of alternations between normals and vertices.
    """
    if length <= 0.0:
        return mesh
    vertices = mesh.vertices
    for _ in range(rounds):
        normals = _diffused_normals(vertices, mesh.faces, length, crease_angle)
        vertices = _fit_to_normals(vertices, mesh.faces, normals, length)
    return make_mesh(keep_volume(vertices, mesh.faces, mesh), mesh.faces)


def keep_volume(vertices: Vertices, faces: Faces, reference: Mesh) -> Vertices:
    """Moves vertices equally along their normals until the volume is that of a reference."""
    wanted = volume(reference.vertices, reference.faces)
    for _ in range(_VOLUME_STEPS):
        outward = vertex_vectors(vertices, faces)
        area = np.sum(np.linalg.norm(outward, axis=-1))
        missing = wanted - volume(vertices, faces)
        vertices = vertices + missing / area * unit_vectors(outward)
    return vertices


def cotangent_weights(vertices: Vertices, faces: Faces) -> csr_array:
    """Returns the stiffness matrix of the Laplacian: positive semi-definite, dimensionless."""
    weight = 0.5 * _cotangents(vertices, faces)
    first, second = faces[:, [1, 2, 0]].ravel(), faces[:, [2, 0, 1]].ravel()
    return _stiffness(first, second, weight.ravel(), len(vertices))


def vertex_areas(vertices: Vertices, faces: Faces) -> Float[np.ndarray, " vertices"]:
    """Returns a third of the area of the faces around each vertex."""
    area = np.linalg.norm(face_vectors(vertices, faces), axis=-1)
    return np.bincount(faces.ravel(), np.repeat(area / 3.0, 3), len(vertices))


def solve(
    matrix: csr_array, right: Float[np.ndarray, "n c"], start: Float[np.ndarray, "n c"]
) -> Float[np.ndarray, "n c"]:
    """Solves a positive definite system for several right-hand sides."""
    scale = matrix.diagonal()
    # Isolated vertices have zero weight.
    inverse = diags_array(np.divide(1.0, scale, out=np.ones_like(scale), where=scale > 0.0))
    options = {"rtol": _TOLERANCE, "maxiter": _MOST_ITERATIONS, "M": inverse}
    columns = range(right.shape[1])
    return np.stack([cg(matrix, right[:, i], start[:, i], **options)[0] for i in columns], axis=-1)


def _implicit(
    stiffness: csr_array,
    mass: Float[np.ndarray, " n"],
    values: Float[np.ndarray, "n c"],
    length: float,
    *,
    steps: int = _STEPS,
) -> Float[np.ndarray, "n c"]:
    time = 0.5 * length**2 / steps
    matrix = csr_array(diags_array(mass) + time * stiffness)
    for _ in range(steps):
        values = solve(matrix, mass[:, None] * values, values)
    return values


def _cotangents(vertices: Vertices, faces: Faces) -> Float[np.ndarray, "faces 3"]:
    """Returns the cotangent at each corner, clipped."""
    corners = vertices[faces]
    one, other = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    sine = np.linalg.norm(np.cross(one, other), axis=-1)
    cosine = np.sum(one * other, axis=-1)
    cotangent = np.divide(cosine, sine, out=np.full_like(sine, _LARGEST), where=sine > 0.0)
    return np.clip(cotangent, _SMALLEST, _LARGEST)


def _diffused_normals(
    vertices: Vertices, faces: Faces, length: float, crease_angle: float
) -> Float[np.ndarray, "faces 3"]:
    """Returns unit normals of faces after diffusion that stops at creases."""
    normals = face_normals(vertices[faces])
    mass = np.linalg.norm(face_vectors(vertices, faces), axis=-1)
    mass = np.maximum(mass, _LIGHTEST * mass.mean())
    a, b, weight = _bond(vertices, faces)
    for _ in range(_STEPS):
        stiffness = _stiffness(
            a, b, weight * _closeness(normals[a], normals[b], crease_angle), len(faces)
        )
        normals = _implicit(stiffness, mass, normals, length / np.sqrt(_STEPS), steps=1)
        normals = unit_vectors(normals)
    return normals


def _closeness(
    one: Float[np.ndarray, "n 3"], other: Float[np.ndarray, "n 3"], crease_angle: float
) -> Float[np.ndarray, " n"]:
    angle = np.arccos(np.clip(np.sum(one * other, axis=-1), -1.0, 1.0))
    return np.exp(-((angle / crease_angle) ** 2))


def _bond(vertices: Vertices, faces: Faces) -> tuple[Pairs, Pairs, Float[np.ndarray, " pairs"]]:
    """Returns the two faces at each edge, and its length over the distance of their centres."""
    a, b, ends = neighbours(faces)
    edge = vertices[ends]
    middles, ridge = vertices[faces].mean(axis=1), edge.mean(axis=1)
    across = sum(np.linalg.norm(middles[face] - ridge, axis=-1) for face in (a, b))
    along = np.linalg.norm(edge[:, 1] - edge[:, 0], axis=-1)
    across = np.maximum(across, _NEAREST_MIDDLES * along)
    return a, b, np.divide(along, across, out=np.zeros_like(along), where=across > 0.0)


def _stiffness(
    first: Pairs,
    second: Pairs,
    weight: Float[np.ndarray, " pairs"],
    count: int,
) -> csr_array:
    """Returns the graph Laplacian of weighted pairs."""
    half = coo_array((weight, (first, second)), shape=(count, count)).tocsr()
    weights = half + half.T
    return csr_array(diags_array(weights.sum(axis=1)) - weights)


def _fit_to_normals(
    vertices: Vertices, faces: Faces, normals: Float[np.ndarray, "faces 3"], length: float
) -> Vertices:
    """Returns the vertices whose faces best match the faces rotated onto given normals."""
    corners = vertices[faces]
    turned = _turn(corners, face_normals(corners), normals)
    cotangent = 0.5 * _cotangents(vertices, faces)
    # At corner i the edges to the next and the previous corner are weighted by their opposite
    # angles.
    next_, previous = np.roll(turned, -1, axis=1), np.roll(turned, 1, axis=1)
    force = np.roll(cotangent, 1, axis=1)[..., None] * (turned - next_)
    force += np.roll(cotangent, -1, axis=1)[..., None] * (turned - previous)
    hold = vertex_areas(vertices, faces) / (_HOLD * length) ** 2
    matrix = csr_array(cotangent_weights(vertices, faces) + diags_array(hold))
    right = gather(force, faces, vertices) + hold[:, None] * vertices
    return solve(matrix, right, vertices)


def _turn(
    corners: Float[np.ndarray, "f 3 3"],
    normals: Float[np.ndarray, "f 3"],
    onto: Float[np.ndarray, "f 3"],
) -> Float[np.ndarray, "f 3 3"]:
    """Rotates triangles about their centres by the smallest rotation between two normals."""
    middle = corners.mean(axis=1, keepdims=True)
    axis = np.cross(normals, onto)
    cosine = np.sum(normals * onto, axis=-1)
    # Rodrigues' formula for the shortest arc; reversed faces and those without normal are
    # unchanged.
    turns = cosine > _TURNED_OVER
    share = np.divide(1.0, 1.0 + cosine, out=np.zeros_like(cosine), where=turns)
    from_middle = corners - middle
    axis = np.where(turns[:, None] & np.any(normals != 0.0, axis=1)[:, None], axis, 0.0)
    across = np.cross(axis[:, None], from_middle)
    twice = np.cross(axis[:, None], across)
    return middle + from_middle + across + share[:, None, None] * twice


# Shares of the length that are tried, and the loss of mask overlap that is accepted: smooth objects
# lose a tenth of that, those with fillets twice as much.
_SHARES = (1.0, 0.5, 0.25)
_LOST = 0.01

# Number of views in which the overlap is measured.
_LOOKS = 20


def denoise_within(mesh: Mesh, length: float, *, crease_angle: float, views: Views | None) -> Mesh:
    """Denoises over the longest of a few lengths that the masks allow.

    Args:
      mesh: closed mesh.
      length: longest length, world units; half and a quarter of it are tried too.
      crease_angle: angle at which denoising stops, radians.
      views: masks that limit the length; the longest length is used without them.

    Raises:
      ReconstructionError: if the masks allow none of the lengths.
    """
    few = None if views is None else some_of(views, _LOOKS)
    least = -np.inf if few is None else silhouette_overlap(mesh, *few).mean() - _LOST
    for share in _SHARES:
        after = denoise(mesh, share * length, crease_angle=crease_angle)
        if few is None or silhouette_overlap(after, *few).mean() >= least:
            return after
    raise ReconstructionError("every length would reduce the overlap with the masks too much")
