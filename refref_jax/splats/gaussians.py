"""3D Gaussians, their initial values, their projection into an image, and their files.

Symbols, as in Kerbl et al. (2023): a Gaussian has a mean, a covariance `Sigma = R S S^T R^T` from a
rotation (quaternion `w, x, y, z`) and three scales, an opacity `o`, and a colour that depends on
the direction of view by spherical harmonics of degree 3. Its image is a Gaussian with covariance
`Sigma' = J W Sigma W^T J^T + 0.3 I`, square pixels, where `W` rotates the world into the camera and
`J` is the derivative of the perspective projection at the mean. Colours are sRGB.

Camera frame of this package: x right, y down, z forward, the rows of `View.rotation`.

Sources: Kerbl et al., 3D Gaussian Splatting for Real-Time Radiance Field Rendering (2023); Yu et
al., Mip-Splatting (2024), for `mip`; gsplat 1.5.3, from which the limits are.
"""

import math
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial import KDTree

from refref_jax import numerics
from refref_jax.choices import Position, SplatFilter
from refref_jax.fields.hash_grid import spherical_harmonics
from refref_jax.geometry.cameras import Cameras
from refref_jax.numerics import host_array
from refref_jax.sampling.scene_bounds import Domain

HARMONICS = 15
"""Number of spherical harmonics of degrees 1 to 3."""

CONSTANT = 0.28209479177387814
"""Spherical harmonic of degree 0."""

# Properties of a vertex in PLY files of splats, and the signs of their harmonics.
_PROPERTIES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
    *(f"f_rest_{n}" for n in range(3 * HARMONICS)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
_SIGNS = (-1.0) ** np.arange(1, HARMONICS + 1)

# Variance that is added in the image, square pixels.
_BLUR = 0.3

# Least depth of a mean, world units: nearer Gaussians are not rendered.
_NEAR = 0.01

# Factor on half the field of view at which the tangents that enter `J` are limited.
_WIDER = 1.3

# Least determinant of a covariance in the image, and the largest radius of its box in standard
# deviations.
_LEAST_DETERMINANT, _FURTHEST = 1e-10, 3.33

LEAST_ALPHA = 1.0 / 255.0
"""Least opacity of a Gaussian at a pixel; smaller ones are left out."""

# Initial values: opacity, and scale as a share of the distance to neighbours; the share of the
# means on the background, the radius of the ball of the others as a share of the cameras'
# distance, and that of an environment's sphere.
_OPACITY, _SHARE_OF_DISTANCE = 0.5, 0.5
_ON_BACKGROUND, _BALL, _SKY = 0.7, 0.5, 250.0

# Number of neighbours whose mean distance is the initial size of a Gaussian.
_NEIGHBOURS = 3


class Gaussians(NamedTuple):
    """Gaussians of a scene, before their activations.

    Attributes:
      means: centres, world units.
      quaternions: rotations, `w, x, y, z`, of any length but 0.
      log_scales: natural logarithms of the standard deviations along the own axes, world units.
      logits: opacities before the sigmoid.
      colours: coefficients of the harmonic of degree 0, sRGB less 1/2.
      harmonics: coefficients of the harmonics of degrees 1 to 3.
    """

    means: Float[Array, "*gaussians 3"]
    quaternions: Float[Array, "*gaussians 4"]
    log_scales: Float[Array, "*gaussians 3"]
    logits: Float[Array, "*gaussians"]
    colours: Float[Array, "*gaussians 3"]
    harmonics: Float[Array, "*gaussians 15 3"]


class View(NamedTuple):
    """One camera, or several along the leading axes.

    Attributes:
      rotation: rotation from the world into the camera frame (x right, y down, z forward).
      position: position, world units.
      focal: focal length in pixels; the principal point is the middle of the image.
    """

    rotation: Float[Array, "*views 3 3"]
    position: Float[Array, "*views 3"]
    focal: Float[Array, "*views"]


class Projected(NamedTuple):
    """Gaussians in an image; pixel `(row, column)` has its centre at `(column, row) + 0.5`.

    Attributes:
      means: column and row of the centre, pixels.
      conics: inverse of the covariance: `xx`, `xy` and `yy`, per square pixel.
      opacities: opacity at the centre.
      colours: sRGB, not clipped above.
      depths: depth of the mean along the camera axis, world units.
      radii: half width and height of the box in which the Gaussian is visible, whole pixels; 0 if
        it is visible nowhere.
    """

    means: Float[Array, "*gaussians 2"]
    conics: Float[Array, "*gaussians 3"]
    opacities: Float[Array, "*gaussians"]
    colours: Float[Array, "*gaussians 3"]
    depths: Float[Array, "*gaussians"]
    radii: Float[Array, "*gaussians 2"]


def views_of(cameras: Cameras) -> View:
    """Returns cameras of a scene, which look along -z with y up, as views."""
    poses = cameras.poses.astype(np.float32)
    right, up, back = (poses[:, :, axis] for axis in range(3))
    return View(
        host_array(np.stack([right, -up, -back], axis=1)),
        host_array(poses[:, :, 3]),
        host_array(np.full(len(poses), cameras.focal, np.float32)),
    )


def rotation(quaternion: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Returns the rotation matrix of a quaternion of any length; the identity for zero."""
    w, x, y, z = numerics.normalize(quaternion)
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])


def colour(
    gaussian: Gaussians, direction: Float[Array, "3"], degree: Float[Array, ""] | int
) -> Float[Array, "3"]:
    """Returns the sRGB colour of one Gaussian, at least 0.

    Args:
      gaussian: the Gaussian.
      direction: unit direction from the camera to it.
      degree: largest degree of the harmonics, 0 to 3; those above are left out.
    """
    basis = spherical_harmonics(direction)[1:]
    degrees = jnp.floor(jnp.sqrt(jnp.arange(1, HARMONICS + 1, dtype=basis.dtype)))
    basis = jnp.where(degrees <= degree, basis, 0.0)
    varying = sum(basis[i] * gaussian.harmonics[i] for i in range(HARMONICS))
    return jnp.maximum(CONSTANT * gaussian.colours + varying + 0.5, 0.0)


def project(
    gaussian: Gaussians,
    view: View,
    *,
    width: int,
    height: int,
    kernel: SplatFilter,
    degree: Float[Array, ""] | int = 3,
) -> Projected:
    """Projects one Gaussian into the image of one view; map it over many.

    The gradients of a Gaussian that is not visible are 0.

    Args:
      gaussian: the Gaussian.
      view: the view.
      width: width of the image, pixels.
      height: height of the image, pixels.
      kernel: `mip` reduces the opacity by the factor by which the blur widens the image of the
        Gaussian, `classic` does not.
      degree: largest degree of the harmonics, 0 to 3.
    """
    away = gaussian.means - view.position
    x, y, z = (numerics.dot(view.rotation[i], away) for i in range(3))
    in_front = z > _NEAR
    z = jnp.where(in_front, z, 1.0)
    axes = _product(view.rotation, rotation(gaussian.quaternions))
    axes = axes * jnp.exp(gaussian.log_scales)[None]
    limits = 0.5 * _WIDER * jnp.asarray([width, height], z.dtype) / view.focal
    tangents = [jnp.clip(x / z, -limits[0], limits[0]), jnp.clip(y / z, -limits[1], limits[1])]
    rows = [view.focal / z * (axes[i] - tangents[i] * axes[2]) for i in range(2)]
    xx, xy, yy = (numerics.dot(rows[i], rows[j]) for i, j in ((0, 0), (0, 1), (1, 1)))
    determinant = jnp.maximum((xx + _BLUR) * (yy + _BLUR) - xy * xy, _LEAST_DETERMINANT)
    conic = jnp.stack([yy + _BLUR, -xy, xx + _BLUR]) / determinant
    opacity = jax.nn.sigmoid(gaussian.logits)
    if kernel == "mip":
        opacity = opacity * numerics.safe_sqrt((xx * yy - xy * xy) / determinant)
    middle = 0.5 * jnp.asarray([width, height], z.dtype)
    mean = view.focal * jnp.stack([x / z, y / z]) + middle
    deviations = jnp.sqrt(jnp.stack([xx, yy]) + _BLUR)
    radii = jax.lax.stop_gradient(jnp.ceil(_reach(opacity) * deviations))
    seen = in_front & (opacity >= LEAST_ALPHA)
    seen &= jnp.all((mean + radii > 0.0) & (mean - radii < 2.0 * middle))
    rgb = colour(gaussian, numerics.normalize(away), degree)
    projected = Projected(mean, conic, opacity, rgb, z, radii)
    return jax.tree.map(lambda value: jnp.where(seen, value, 0.0), projected)


def _product(a: Float[Array, "3 3"], b: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Returns the matrix product, component by component, which is faster when mapped."""
    return jnp.stack([a[i, 0] * b[0] + a[i, 1] * b[1] + a[i, 2] * b[2] for i in range(3)])


def _reach(opacity: Float[Array, ""]) -> Float[Array, ""]:
    """Returns the distance at which a Gaussian's opacity falls to 1/255, standard deviations."""
    ratio = jnp.maximum(opacity / LEAST_ALPHA, 1.0)
    return jnp.minimum(numerics.safe_sqrt(2.0 * jnp.log(ratio)), _FURTHEST)


def project_all(
    gaussians: Gaussians,
    view: View,
    *,
    width: int,
    height: int,
    kernel: SplatFilter,
    degree: Float[Array, ""] | int = 3,
) -> Projected:
    """Projects all Gaussians into one view; see `project`."""

    def one(gaussian: Gaussians) -> Projected:
        return project(gaussian, view, width=width, height=height, kernel=kernel, degree=degree)

    return jax.vmap(one)(gaussians)


def extent(cameras: Cameras, centre: Position) -> float:
    """Returns the distance of the farthest camera from the centre, world units."""
    return float(np.max(np.linalg.norm(cameras.poses[:, :, 3] - np.asarray(centre), axis=-1)))


def start(seed: int, count: int, cameras: Cameras, domain: Domain) -> Gaussians:
    """Returns initial Gaussians of a scene, as NumPy arrays in single precision.

    Most means are on the background: the faces of the cube, or the sphere, evenly by area; with an
    environment, a sphere of 250 times the cameras' distance, so far away that it has no parallax.
    The others fill a ball around the centre of half the cameras' distance. Colours and rotations
    are random.

    Args:
      seed: seed of the random numbers.
      count: number of Gaussians.
      cameras: cameras of the training images.
      domain: scene bounds, whose surface is the background.
    """
    draw = np.random.default_rng(seed)
    radius, space, centre = domain
    reach = extent(cameras, centre)
    behind = math.ceil(_ON_BACKGROUND * count)
    directions = draw.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    means = directions * _BALL * reach * draw.random((count, 1)) ** (1.0 / 3.0)
    if space == "bounded":
        faces = draw.uniform(-radius, radius, (behind, 3))
        axis, side = draw.integers(0, 3, behind), draw.choice([-radius, radius], behind)
        faces[np.arange(behind), axis] = side
        means[:behind] = faces
    else:
        means[:behind] = directions[:behind] * (radius if space == "spherical" else _SKY * reach)
    sizes = _SHARE_OF_DISTANCE * _distances_to_neighbours(means)
    values = Gaussians(
        means=host_array(means + np.asarray(centre)),
        quaternions=host_array(draw.normal(size=(count, 4))),
        log_scales=host_array(np.repeat(np.log(sizes)[:, None], 3, axis=1)),
        logits=host_array(np.full(count, math.log(_OPACITY / (1.0 - _OPACITY)))),
        colours=host_array((draw.random((count, 3)) - 0.5) / CONSTANT),
        harmonics=host_array(np.zeros((count, HARMONICS, 3))),
    )
    return jax.tree.map(np.float32, values)


def _distances_to_neighbours(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Returns the mean distance of each point to its nearest neighbours; 1 for a single point."""
    count = min(_NEIGHBOURS, len(points) - 1)
    if count < 1:
        return np.ones(len(points))
    distances, _ = KDTree(points).query(points, count + 1)
    return np.maximum(distances[:, 1:].mean(axis=1), 1e-6)


def blank(count: int) -> Gaussians:
    """Returns Gaussians of which only the shapes mean something."""
    shapes = {"log_scales": (3,), "logits": (), "harmonics": (HARMONICS, 3)}
    shapes |= {"means": (3,), "quaternions": (4,), "colours": (3,)}
    return Gaussians(**{n: jnp.zeros((count, *s), jnp.float32) for n, s in shapes.items()})


def write_ply(path: Path, gaussians: Gaussians) -> None:
    """Writes Gaussians as the PLY file that viewers of splats read, with float32 properties.

    In that format, the harmonics of each colour follow each other, and those with an odd index have
    the other sign.
    """
    flat = jax.tree.map(np.asarray, gaussians)
    count = len(flat.means)
    signed = _SIGNS[:, None] * flat.harmonics
    columns = np.concatenate(
        [
            *(flat.means, np.zeros((count, 3)), flat.colours),
            signed.transpose(0, 2, 1).reshape(count, 3 * HARMONICS),
            *(flat.logits[:, None], flat.log_scales, flat.quaternions),
        ],
        axis=1,
    )
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for name in _PROPERTIES]
    with path.open("wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
        file.write(columns.astype("<f4").tobytes())


def read_ply(path: Path) -> Gaussians:
    """Reads Gaussians from a PLY file of splats, as NumPy arrays.

    Harmonics may have a lower degree than 3; those above are 0. Other properties are ignored.

    Raises:
      ValueError: if the file is not a binary PLY file of splats, or has a NaN.
    """
    header, end, data = path.read_bytes().partition(b"end_header\n")
    count, names = _read_header(header)
    wanted = ["f_dc_0", *(name for name in _PROPERTIES if name[:2] not in ("f_", "nx", "ny", "nz"))]
    missing = [name for name in (*wanted, "f_dc_1", "f_dc_2") if name not in names]
    found = [name for name in names if name.startswith("f_rest_")]
    uneven = len(found) % 3 or set(found) != {f"f_rest_{n}" for n in range(len(found))}
    size = 4 * len(names) * count
    if not end or missing or uneven or len(set(names)) < len(names) or len(data) < size:
        raise ValueError(
            f"{path} is not a PLY file of Gaussian splats: it must be binary_little_endian, with "
            f"float properties, among them {', '.join(missing) or 'x, y, z and f_dc_0'}. Export it "
            "again."
        )
    rows = np.frombuffer(data[:size], "<f4").reshape(count, len(names)).astype(np.float32)
    if np.any(np.isnan(rows)):
        raise ValueError(f"{path} has Gaussians with NaN in place of numbers. Export them again.")

    def columns(*wanted: str) -> np.ndarray:
        return rows[:, [names.index(name) for name in wanted]]

    each = len(found) // 3
    rest = columns(*(f"f_rest_{n}" for n in range(len(found)))).reshape(count, 3, each)
    harmonics = np.zeros((count, HARMONICS, 3), np.float32)
    harmonics[:, :each] = rest.transpose(0, 2, 1)[:, :HARMONICS]
    return Gaussians(
        host_array(columns("x", "y", "z")),
        host_array(columns("rot_0", "rot_1", "rot_2", "rot_3")),
        host_array(columns("scale_0", "scale_1", "scale_2")),
        host_array(columns("opacity")[:, 0]),
        host_array(columns("f_dc_0", "f_dc_1", "f_dc_2")),
        host_array(_SIGNS.astype(np.float32)[:, None] * harmonics),
    )


def _read_header(header: bytes) -> tuple[int, list[str]]:
    """Returns the number of vertices and their properties; none if not all of them are floats."""
    lines = [line.split() for line in header.decode("ascii", "replace").splitlines()]
    lines = [line for line in lines if line[:1] not in ([], ["comment"], ["obj_info"])]
    start = [["ply"], ["format", "binary_little_endian", "1.0"]]
    match lines[:3], lines[3:]:
        case [*first, ["element", "vertex", count]], properties if first == start:
            floats = [line[2] for line in properties if len(line) == 3]
            kinds = {tuple(line[:2]) for line in properties}
            whole = len(floats) == len(properties) and kinds == {("property", "float")}
            if count.isdecimal() and whole:
                return int(count), floats
    return 0, []
