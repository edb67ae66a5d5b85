"""Families of closed surfaces with few unknowns, fitted to noisy meshes (NumPy only).

A mesh from masks is wrong by a few percent of a face's length, so its normals are off by degrees.
If the object is a ball, a cylinder or a vase, the right few numbers describe it without noise.
`candidates` returns the families near a mesh as shapes (`shapes`), which a solver fits to images.

All fits are equivariant: a mesh that is moved and scaled has the same fit, moved and scaled.

Sources: Pottmann and Randrup (1998) for axes, see `revolution`; the rest is ours.
"""

import copy
from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from trimesh.creation import icosphere

from refref_jax.geometry.triangle_meshes import Mesh, diameter
from refref_jax.reconstruct.polyhedra import fit_polyhedron
from refref_jax.reconstruct.relief import Offsets, Relief, bends_around
from refref_jax.reconstruct.revolution import (
    Axis,
    Curve,
    Fit,
    Lathe,
    Profile,
    even_profile,
    find_axis,
    fit_axis_and_profile,
    lathe,
    lengths,
    profile_places,
    turn_right,
)
from refref_jax.reconstruct.shapes import (
    FURTHEST,
    LARGEST_STEP,
    LARGEST_TURN,
    FreeSurface,
    Matrix,
    Posed,
    Shape,
    Unknowns,
    cloud_of,
    independent_prior,
    mesh_of,
    rms,
    robust_weights,
    tilt,
)
from refref_jax.reconstruct.turned import (
    Turned,
    place,
    place_on_axis,
    place_raised,
    without_unknowns,
)
from refref_jax.reconstruct.turned_fit import fit_turned

# Standard deviations of the priors: positions and radii, as shares of the diameter, and angles, in
# radians. Offsets of a profile: second differences between knots, and their size.
_LENGTH, _ANGLE = 0.01, 0.02
_BEND, _OFFSET = 0.004, 0.008

# Mesh of a ball, of a torus (around the tube, around the axis), and of other bodies of revolution.
_SUBDIVISIONS = 5
_AROUND_TUBE, _AROUND_TORUS = 96, 160
_ALONG_PROFILE, _AROUND_AXIS = 192, 128

# Knots of the offset along a profile.
_KNOTS = 36

# Rounds of robust weights. A torus is not tried if the first guess is further from the mesh than
# this multiple of what is accepted; its tube is at most this share of the radius of its circle.
_ROUNDS = 8
_HOPELESS = 3.0
_FATTEST = 0.98
_EVALUATIONS = 30


class Sphere:
    """A ball: its centre and its radius.

    Attributes:
      name: kind of the shape.
    """

    name = "sphere"

    def __init__(
        self, centre: Float[np.ndarray, "3"], radius: float, *, subdivisions: int = _SUBDIVISIONS
    ) -> None:
        """Takes the centre and the radius in world units, and how fine the mesh is."""
        self._start = np.append(centre, radius)
        ball = icosphere(subdivisions=subdivisions)
        self._faces = np.asarray(ball.faces, np.int64)
        directions = np.asarray(ball.vertices, np.float64)
        self._directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)

    def start(self) -> Unknowns:
        """Returns centre and radius of the fit, world units."""
        return self._start.copy()

    def pose(self, unknowns: Unknowns) -> Posed:
        """Returns an icosphere, whose vertices lie on the ball."""
        directions = self._directions
        still = np.broadcast_to(np.eye(3), (len(directions), 3, 3))
        return Posed(
            unknowns[:3] + unknowns[3] * directions,
            self._faces,
            directions,
            self._faces,
            np.concatenate([still, directions[..., None]], axis=-1).reshape(-1, 4),
            np.zeros((3 * len(directions), 4)),
        )

    def prior(self, unknowns: Unknowns) -> tuple[Matrix, Unknowns]:
        """Returns the prior: unknowns are near those of the fit, within 1 % of the diameter."""
        deviations = np.full(4, 2.0 * _LENGTH * self._start[3])
        return independent_prior(deviations, unknowns - self._start)

    def scales(self) -> Unknowns:
        """Returns 0.77 % of the diameter."""
        return np.full(4, 2.0 * LARGEST_STEP * self._start[3])


class Torus:
    """A torus.

    The unknowns are two angles that tilt the axis, the shift of the centre along the three
    directions of the frame of the fit, the radius of the circle in the middle of the tube, and that
    of the tube.

    Attributes:
      name: kind of the shape.
      axis: axis of the fit, through its centre.
    """

    name = "torus"

    def __init__(self, axis: Axis, radius: float, tube: float) -> None:
        """Takes the axis, whose point is the centre, and the two radii in world units."""
        self.axis = axis
        self._start = np.array([0.0, 0.0, 0.0, 0.0, 0.0, radius, tube])
        self._size = 2.0 * (radius + tube)
        number = np.arange(_AROUND_TUBE)
        segments = np.stack([number, (number + 1) % _AROUND_TUBE], axis=-1)
        self._lathe = lathe(np.zeros(_AROUND_TUBE, bool), segments, segments, _AROUND_TORUS)
        angle = 2.0 * np.pi / _AROUND_TUBE * number
        self._directions = np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    def start(self) -> Unknowns:
        """Returns the unknowns of the fit."""
        return self._start.copy()

    def pose(self, unknowns: Unknowns) -> Posed:
        """Returns the torus, with vertices on it."""
        normals = self._directions
        points = [unknowns[5], 0.0] + unknowns[6] * normals
        outward = np.broadcast_to([1.0, 0.0], points.shape)
        turned = Turned(
            points, np.stack([outward, normals], axis=-1), normals, np.zeros((*normals.shape, 2))
        )
        return place(turned, self._lathe, _AROUND_TORUS, self.axis, unknowns[:5])

    def prior(self, unknowns: Unknowns) -> tuple[Matrix, Unknowns]:
        """Returns the prior: near the fit, within 1 % of the diameter and 0.02 radians."""
        deviations = np.repeat([_ANGLE, _LENGTH * self._size], [2, 5])
        return independent_prior(deviations, unknowns - self._start)

    def scales(self) -> Unknowns:
        """Returns 0.02 radians and 0.77 % of the diameter."""
        return np.repeat([LARGEST_TURN, LARGEST_STEP * self._size], [2, 5])


class Revolution:
    """A surface of revolution.

    The unknowns are two angles that tilt the axis, the shift of its point along the two directions
    across it, and the offset of the profile along its normals at knots. Between knots, the offset
    is a cubic spline, even about the poles; a pole stays on the axis. The profile of the fit is a
    spline of the same knots, so that offsets can undo its waves. Normals are those of the spline
    through the offset points. The body is smooth: a crease of the mesh is rounded.

    Attributes:
      name: kind of the shape.
      axis: axis of the fit.
      points: profile of the fit, relative to the point of the axis.
      directions: its outward normals.
      closed: whether the profile is closed.
      size: diameter of the body, world units.
      relief: difference of the surface from one of revolution, if there is any.
      knots: number of knots of the profile and of its offsets.
    """

    name = "surface of revolution"

    def __init__(
        self,
        axis: Axis,
        profile: Profile,
        size: float,
        relief: Relief | None = None,
        *,
        knots: int = _KNOTS,
    ) -> None:
        """Takes the axis, its profile in even steps, the diameter, the relief, and the knots."""
        self.axis, self.closed, self.size = axis, profile.closed, size
        self.relief, self.knots = relief, knots
        at, length = profile_places(profile, max(_ALONG_PROFILE, 3 * knots))
        places, _ = profile_places(profile, _KNOTS)
        if knots > _KNOTS:
            places = np.linspace(0.0, length, knots)
        spline = _between_knots(profile, places)
        self.points, self._at_knots = spline(at), spline(places)
        self._along = _slope_matrices(at, length, profile.closed)
        along = np.stack([m @ self.points[:, i] for i, m in enumerate(self._along)], axis=-1)
        self.directions = turn_right(along) / np.linalg.norm(along, axis=-1, keepdims=True)
        hats = _even_spline(places, length, profile.closed)(at)
        moved = self.directions[:, :, None] * hats[:, None]
        self._slopes = moved
        number = np.arange(len(at) if profile.closed else len(at) - 1)
        segments = np.stack([number, (number + 1) % len(at)], axis=-1)
        poles = np.zeros(len(at), bool)
        poles[[0, -1]] = not profile.closed
        self._lathe = lathe(poles, segments, segments, _AROUND_AXIS)

    @property
    def is_fine(self) -> bool:
        """Whether it may have narrow ridges, or a relief."""
        return self.knots > _KNOTS or self.relief is not None

    def start(self) -> Unknowns:
        """Returns zeros: the axis and the profile of the fit."""
        return np.zeros(4 + self.knots)

    def profile(self, unknowns: Unknowns) -> Turned:
        """Returns points and normals of the profile, and their derivatives by the offsets."""
        points = self.points + self._slopes @ unknowns[4:]
        along = np.stack([m @ points[:, i] for i, m in enumerate(self._along)], axis=-1)
        moved = np.stack([m @ self._slopes[:, i] for i, m in enumerate(self._along)], axis=1)
        length = np.linalg.norm(along, axis=-1)[:, None]
        normals, turned = turn_right(along) / length, turn_right(moved) / length[..., None]
        turned = turned - normals[..., None] * np.sum(normals[..., None] * turned, axis=1)[:, None]
        return Turned(points, self._slopes, normals, turned)

    def pose(self, unknowns: Unknowns) -> Posed:
        """Returns the body; its vertices lie on the spline."""
        turned = self.profile(unknowns)
        return place_on_axis(
            turned, self._lathe, _AROUND_AXIS, self.axis, unknowns[:4], relief=self.relief
        )

    def mesh(self) -> Mesh:
        """Returns the body at rest."""
        return mesh_of(place(*self._at_rest(), relief=self.relief))

    def raised(self, relief: Relief, offsets: Offsets) -> Posed:
        """Returns the body with a relief and offsets of it, which are its last unknowns."""
        return place_raised(*self._at_rest(), relief, offsets)

    def _at_rest(self) -> tuple[Turned, Lathe, int, Axis, Unknowns]:
        """Returns the arguments that place the body at rest, without unknowns of its own."""
        turned = without_unknowns(self.profile(self.start()))
        return turned, self._lathe, _AROUND_AXIS, self.axis, np.zeros(5)

    def moved(self, unknowns: Unknowns) -> "Revolution":
        """Returns the body at given unknowns, at rest."""
        frame = self.axis.frame
        axis = Axis(self.axis.point + frame[:, :2] @ unknowns[2:4], frame @ tilt(unknowns[:2])[0])
        profile = even_profile(Profile(self.profile(unknowns).points, self.closed), self.size)
        return Revolution(axis, profile, self.size, self.relief, knots=self.knots)

    def with_knots(self, knots: int) -> "Revolution":
        """Returns the body with another number of knots."""
        profile = even_profile(Profile(self.points, self.closed), self.size)
        return Revolution(self.axis, profile, self.size, self.relief, knots=knots)

    def with_relief(self, relief: Relief | None) -> "Revolution":
        """Returns the body with another relief."""
        found = copy.copy(self)
        found.relief = relief
        return found

    def prior(self, unknowns: Unknowns, *, bend: float = _BEND) -> tuple[Matrix, Unknowns]:
        """Returns the prior: a small change of the axis, small offsets, and smaller bends.

        Standard deviations are 0.02 radians and 1 % of the diameter for the axis, and 0.8 % for an
        offset.

        Args:
          unknowns: the unknowns.
          bend: standard deviation of the second difference of three neighbouring offsets, as a
            share of the diameter.
        """
        bends = self.bends()
        deviations = [_ANGLE, _LENGTH * self.size, _OFFSET * self.size]
        precision = np.diag(np.repeat(deviations, [2, 2, self.knots]) ** -2.0)
        precision[4:, 4:] += bends.T @ bends / (bend * self.size) ** 2
        return precision, precision @ unknowns

    def bends(self) -> Float[np.ndarray, "bends knots"]:
        """Returns the second differences of neighbouring offsets, one in each row."""
        return bends_around(self.knots) if self.closed else np.diff(np.eye(self.knots), 2, axis=0)

    def curvature_changes(
        self,
    ) -> tuple[Float[np.ndarray, " changes"], Float[np.ndarray, "changes knots"]]:
        """Returns how second differences of the profile change between knots, at rest.

        Also their derivatives by the offsets. They are 0 along straight lines and arcs.
        """
        points, bends = self._at_knots, self.bends()
        along = np.gradient(points, axis=0)
        normals = turn_right(along) / np.linalg.norm(along, axis=-1, keepdims=True)
        middle = slice(None) if self.closed else slice(1, -1)
        rest = np.sum((bends @ points) * normals[middle], axis=-1)
        return np.diff(rest), np.diff(bends, axis=0)

    def scales(self) -> Unknowns:
        """Returns 0.02 radians and 0.77 % of the diameter."""
        return np.repeat([LARGEST_TURN, LARGEST_STEP * self.size], [2, 2 + self.knots])


def _between_knots(profile: Profile, knots: Float[np.ndarray, " knots"]) -> Callable[..., Curve]:
    """Returns the spline of given knots nearest to a profile: radii odd about the poles.

    Shorter waves are noise, which no offset at the knots could remove.
    """
    points = profile.curve
    length = lengths(points)
    one = np.eye(len(knots))
    if profile.closed:
        cubics = [_even_spline(knots, float(length[-1]), True)] * 2
    else:
        radii = CubicSpline(knots, one[:, 1:-1], bc_type="natural")  # zero at both poles
        cubics = [radii, CubicSpline(knots, one, bc_type="clamped")]
    values = [
        np.linalg.lstsq(cubic(length), points[:, i], rcond=None)[0]
        for i, cubic in enumerate(cubics)
    ]
    return lambda s: np.stack([c(s) @ v for c, v in zip(cubics, values, strict=True)], axis=-1)


def _slope_matrices(
    at: Float[np.ndarray, " n"], length: float, closed: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the matrices from radii, and from heights, at places to derivatives there."""
    if closed:
        matrix = _even_spline(at, length, closed)(at, 1)
        return matrix, matrix
    one = np.eye(len(at))
    return (
        CubicSpline(at, one, bc_type="natural")(at, 1),
        CubicSpline(at, one, bc_type="clamped")(at, 1),
    )


def _even_spline(knots: Float[np.ndarray, " n"], length: float, closed: bool) -> CubicSpline:
    """Returns the splines that are 1 at one knot each: periodic, or even about both ends."""
    one = np.eye(len(knots))
    if closed:
        around = np.append(knots, knots[0] + length)
        return CubicSpline(around, np.concatenate([one, one[:1]]), bc_type="periodic")
    return CubicSpline(knots, one, bc_type="clamped")


def fit_sphere(mesh: Mesh, *, furthest: float = FURTHEST) -> Sphere | None:
    """Fits a ball by linear least squares of `|p|^2 = 2 c . p + k`, weighted by area and robust.

    Args:
      mesh: closed mesh.
      furthest: largest rms distance of the mesh from the ball, as a share of its diameter.

    Returns:
      The ball, or `None` if the mesh is further from it.

    Raises:
      ReconstructionError: if the mesh is empty, flat, inside out or not finite.
    """
    cloud, size = cloud_of(mesh), diameter(mesh.vertices)
    middle = cloud.areas @ cloud.points
    points = (cloud.points - middle) / size
    centre, radius = _fit_ball(points, cloud.areas)
    if rms(np.linalg.norm(points - centre, axis=-1) - radius, cloud.areas) > furthest:
        return None
    return Sphere(middle + size * centre, size * radius)


def _fit_ball(
    points: Float[np.ndarray, "points d"], areas: Float[np.ndarray, " points"]
) -> tuple[Float[np.ndarray, " d"], float]:
    """Returns centre and radius of the ball or circle through points."""
    rows = np.append(2.0 * points, np.ones((len(points), 1)), axis=-1)
    squares = np.sum(points**2, axis=-1)
    weights = areas
    for _ in range(_ROUNDS):
        root = np.sqrt(weights)
        found = np.linalg.lstsq(rows * root[:, None], squares * root, rcond=None)[0]
        weights = areas * robust_weights(squares - rows @ found)
    return found[:-1], float(np.sqrt(max(found[-1] + found[:-1] @ found[:-1], 0.0)))


def fit_torus(mesh: Mesh, *, furthest: float = FURTHEST) -> Torus | None:
    """Fits a torus by robust least squares of distances, from the axis that normals meet.

    Args:
      mesh: closed mesh.
      furthest: largest rms distance of the mesh from the torus, as a share of its diameter.

    Returns:
      The torus, or `None` if the mesh is further from it, or the torus has no hole.

    Raises:
      ReconstructionError: if the mesh is empty, flat, inside out or not finite.
    """
    cloud, size = cloud_of(mesh), diameter(mesh.vertices)
    axis = find_axis(cloud)
    local = (cloud.points - axis.point) @ axis.frame / size
    flat = np.stack([np.linalg.norm(local[:, :2], axis=-1), local[:, 2]], axis=-1)
    centre, tube = _fit_ball(flat, cloud.areas)
    first = np.array([0.0, 0.0, 0.0, 0.0, centre[1], centre[0], tube])
    errors = _torus_distances(local, first)
    if rms(errors, cloud.areas) > _HOPELESS * furthest:
        return None
    root = np.sqrt(cloud.areas * len(cloud.areas))
    found = least_squares(
        lambda x: root * _torus_distances(local, x),
        first,
        loss="soft_l1",
        f_scale=max(1.5 * float(np.median(np.abs(errors))), 1e-9),
        x_scale=0.1,
        max_nfev=_EVALUATIONS,
    ).x
    far = rms(_torus_distances(local, found), cloud.areas) > furthest
    if far or not 0.0 < found[6] < _FATTEST * found[5]:
        return None
    point = axis.point + size * axis.frame @ found[2:5]
    return Torus(
        Axis(point, axis.frame @ tilt(found[:2])[0]), size * found[5], size * float(found[6])
    )


def _torus_distances(
    local: Float[np.ndarray, "points 3"], unknowns: Float[np.ndarray, "7"]
) -> Float[np.ndarray, " points"]:
    """Returns distances from a torus, positive outside; unknowns as in `Torus`."""
    points = (local - unknowns[2:5]) @ tilt(unknowns[:2])[0]
    around = np.hypot(points[:, 0], points[:, 1]) - unknowns[5]
    return np.hypot(around, points[:, 2]) - unknowns[6]


def fit_revolution(
    mesh: Mesh, *, furthest: float = FURTHEST, smooth: Fit | None = None
) -> Revolution | None:
    """Fits a surface of revolution: see `revolution.fit_axis_and_profile`.

    Args:
      mesh: closed mesh, in one piece.
      furthest: largest rms distance of the mesh from the body, as a share of its diameter.
      smooth: result of `revolution.fit_axis_and_profile`, if it is known.

    Returns:
      The body, or `None` if the mesh is further from it.

    Raises:
      ReconstructionError: if the mesh is empty, flat, inside out or not finite, or
        scikit-image is not installed.
    """
    size = diameter(mesh.vertices)
    smooth = fit_axis_and_profile(mesh, cloud_of(mesh), size) if smooth is None else smooth
    if smooth is None or smooth.rms > furthest * size:
        return None
    return Revolution(smooth.axis, smooth.profile, size)


def candidates(mesh: Mesh, *, furthest: float = FURTHEST) -> list[Shape]:
    """Returns the families that come near a mesh, the fewest unknowns first, the free surface last.

    They are within an rms distance of `furthest`, a share of the diameter of the mesh.

    Example:
      >>> shapes = candidates(mesh)
      >>> [shape.name for shape in shapes]
      ['sphere', 'surface of revolution', 'free surface']

    Raises:
      ReconstructionError: if the mesh has no volume, or scikit-image is not installed.
    """
    first = fit_sphere, fit_torus, fit_polyhedron
    found: list[Shape | None] = [fit(mesh, furthest=furthest) for fit in first]
    if smooth := fit_axis_and_profile(mesh, cloud_of(mesh), diameter(mesh.vertices)):
        found += [f(mesh, furthest=furthest, smooth=smooth) for f in (fit_turned, fit_revolution)]
    shapes = sorted((fit for fit in found if fit is not None), key=lambda fit: len(fit.start()))
    return [*shapes, FreeSurface(mesh)]
