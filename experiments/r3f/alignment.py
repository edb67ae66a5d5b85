"""Moves, turns and scales an object of known meshes until it is where the images show it.

    {out}/placement.json         rotation, shift and size, with their standard deviations
    {out}/reconstruction.json    the record of a reconstruction, for --reconstruction of train
    {out}/light/*.ply            the aligned parts
    {out}/errors.png             pixels before and after

Outlines of the masks come first (`fit_placement`), then the light refracted
through the object, with all parts, indices and colours as they are given. Pixels that were not
fitted judge each step, and the better placement is kept. Where the background is a field, outlines
alone place the object.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.sparse
from jaxtyping import Float

from experiments.cli.progress import ProgressBar
from experiments.r3f import chain, geometry_stage, index_stage, light_figures, light_stage, records
from experiments.r3f.light_stage import Seen
from refref_jax import configuration
from refref_jax.choices import Position, Space
from refref_jax.data import SceneError, mesh_queries, meshes, scene_names
from refref_jax.data.mesh_queries import Containment
from refref_jax.data.meshes import MeshPart
from refref_jax.data.scene_assembly import shaded_mesh
from refref_jax.geometry.triangle_meshes import Mesh, diameter, is_closed, volume
from refref_jax.optics.interface_rules import NO_PARENT, nested
from refref_jax.optics.media import Interfaces
from refref_jax.reconstruct import ReconstructionError, gauss_newton, model_selection
from refref_jax.reconstruct.gauss_newton import Candidate, Fit, Steps
from refref_jax.reconstruct.model_selection import Trial
from refref_jax.reconstruct.outlines import OUTLINE_DEVIATION, Outlines
from refref_jax.reconstruct.photometry import Backdrop
from refref_jax.reconstruct.shapes import LARGEST_STEP, LARGEST_TURN, Posed

PLACEMENT, FIGURE = "placement.json", "errors.png"

# Steps of the fit of a placement, and the change, relative to the scales of the unknowns, that ends
# it; standard deviations of its prior: radians, shares of the diameter, logarithm of the size.
_PLACEMENT_ROUNDS, _PLACED = 30, 1e-4
_TURN, _SHIFT, _GROWTH = 0.2, 0.1, 0.2

# Reach of the outlines in the rounds of the first fit, pixels.
_REACHES = (20.0, 8.0, 3.0)

# Largest components of a placement, in standard deviations of the prior; largest mean distance of
# the outlines, in pixels, and their least number of points.
_FARTHEST, _MOST_PIXELS, _FEWEST_POINTS = 3.0, 1.0, 100

# Steps by light: outlines have placed the object within the detail of a backdrop blurred once.
_STEPS = Steps(blurs=(1, 0, 0, 0, 0, 0), rays=20_000)


@dataclasses.dataclass(frozen=True)
class PlacementFacts:
    """Where an object is: `x -> centre + shift + size * rotation (x - centre)`.

    Attributes:
      rotation: rotation vector, degrees.
      shift: world units.
      size: factor.
      centre: middle of the box around the object as it is given, world units.
      rotation_deviation: standard deviation of each component of the rotation, degrees; that of the
        prior, 11 degrees, where nothing determines it.
      shift_deviation: standard deviation of the shift, world units.
      size_deviation: standard deviation of the size.
      given: mean error of the judges with the object as it is given, sRGB; `None` without light.
      outlines: the same with the object placed by outlines.
      light: the same with the object placed by light.
      split: split of the judges.
    """

    rotation: Position
    shift: Position
    size: float
    centre: Position
    rotation_deviation: Position
    shift_deviation: Position
    size_deviation: float
    given: float | None
    outlines: float | None
    light: float | None
    split: str

    @property
    def error(self) -> float | None:
        """Mean error of the judges that is left, sRGB."""
        if self.given is None or self.outlines is None or self.light is None:
            return None
        return min(self.given, self.outlines, self.light)


class Background(NamedTuple):
    """The background, where it is not that of `scene.json`; see `index_stage.learn_background`."""

    space: Space | None
    radius: float | None
    centre: Position | None


class PlacedObject:
    """An object of known shape whose direction, place and size are unknown, for `gauss_newton`.

    The unknowns are a rotation vector about the middle of the object, in radians; a shift in world
    units; and the logarithm of its size. Indices, tints and absorptions are known.

    Attributes:
      meshes: surface of each part as it is given, the order of `interfaces`.
      interfaces: interfaces of the parts.
      centre: middle of the box around all parts, world units.
    """

    def __init__(self, meshes: Sequence[Mesh], interfaces: Interfaces) -> None:
        """Takes the parts.

        Raises:
          ReconstructionError: if there are none.
        """
        if not meshes:
            raise ReconstructionError("The object has no parts. Pass at least one closed mesh.")
        self.meshes, self.interfaces = tuple(meshes), interfaces
        vertices = np.concatenate([mesh.vertices for mesh in meshes])
        self.centre = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        self._size = diameter(vertices)

    def start(self) -> Float[np.ndarray, "7"]:
        """Returns zeros: the object as it is given."""
        return np.zeros(7)

    def pose(self, x: Float[np.ndarray, "7"]) -> Candidate:
        """Returns the placed object."""
        nothing = scipy.sparse.csr_array((len(self.meshes), 7))
        posed = [self._placed(mesh, x) for mesh in self.meshes]
        return Candidate(posed, self.interfaces, nothing, nothing[:0])

    def index_of(self, x: Float[np.ndarray, "7"]) -> float:
        """Returns the index of the first part, which is known."""
        del x
        return float(self.interfaces.index_inside[0])

    def placed(self, x: Float[np.ndarray, "7"]) -> tuple[Mesh, ...]:
        """Returns the surfaces of the placed parts."""
        posed = [self._placed(mesh, x) for mesh in self.meshes]
        return tuple(Mesh(p.vertices, p.faces, p.normals[p.normal_ids]) for p in posed)

    def prior(
        self, x: Float[np.ndarray, "7"]
    ) -> tuple[Float[np.ndarray, "7 7"], Float[np.ndarray, "7"]]:
        """Returns a wide prior around the object as it is given.

        It keeps what neither outlines nor light determine, such as the rotation of a ball.
        """
        deviations = np.repeat([_TURN, _SHIFT * self._size, _GROWTH], [3, 3, 1])
        return np.diag(deviations**-2.0), x / deviations**2

    def scales(self) -> Float[np.ndarray, "7"]:
        """Returns 0.02 radians, 0.77 % of the diameter, and 1 % of the size."""
        return np.repeat([LARGEST_TURN, LARGEST_STEP * self._size, 0.01], [3, 3, 1])

    def _placed(self, mesh: Mesh, x: Float[np.ndarray, "7"]) -> Posed:
        turn, tangent = rotation(x[:3])
        arms = math.exp(x[6]) * (mesh.vertices - self.centre) @ turn.T
        normals, ids = np.unique(mesh.normals.reshape(-1, 3), axis=0, return_inverse=True)
        normals = normals @ turn.T
        moves = np.broadcast_to(np.eye(3), (len(arms), 3, 3))
        still = np.zeros((len(normals), 3, 4))
        by_vertices = np.concatenate([-_crosses(arms) @ tangent, moves, arms[..., None]], axis=-1)
        by_normals = np.concatenate([-_crosses(normals) @ tangent, still], axis=-1)
        return Posed(
            self.centre + x[3:6] + arms,
            mesh.faces,
            normals,
            ids.reshape(-1, 3),
            by_vertices.reshape(-1, 7),
            by_normals.reshape(-1, 7),
        )


def rotation(
    vector: Float[np.ndarray, "3"],
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]]:
    """Returns the rotation of a rotation vector, and its left Jacobian.

    A change `dv` of the vector turns the rotated object by the further rotation vector `J dv`.

    Source: Rodrigues' formula; Sola, Deray and Atchuthan, A micro Lie theory (2018), Eq 145.
    """
    angle = float(np.linalg.norm(vector))
    cross = _crosses(vector)
    if angle < 1e-6:
        return np.eye(3) + cross, np.eye(3) + 0.5 * cross
    sine, cosine = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle**2
    turn = np.eye(3) + sine * cross + cosine * cross @ cross
    return turn, np.eye(3) + cosine * cross + (1.0 - sine) / angle**2 * cross @ cross


def _crosses(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Returns the matrices of the cross products with vectors."""
    return np.swapaxes(np.cross(vectors[..., None, :], np.eye(3)), -1, -2)


def fit_placement(
    model: PlacedObject,
    outlines: Outlines,
    *,
    outermost: Sequence[int] = (0,),
    x: Float[np.ndarray, "7"] | None = None,
) -> Float[np.ndarray, "7"]:
    """Fits direction, place and size of an object to outlines alone.

    What outlines do not determine, such as the direction of a ball, stays.

    Args:
      model: the object.
      outlines: the outlines; those with a long reach first, if the object is far away.
      outermost: numbers of the parts that no other part contains.
      x: placement to begin with; the object as it is given by default.
    """
    x = model.start() if x is None else x
    for _ in range(_PLACEMENT_ROUNDS):
        parts = model.pose(x).parts
        rows = outlines.of_surfaces([parts[number] for number in outermost])
        weighted = rows.weights[:, None] * rows.derivatives
        precision, gradient = model.prior(x)
        matrix = weighted.T @ rows.derivatives + precision
        change = -np.linalg.solve(matrix, weighted.T @ rows.errors + gradient)
        x = x + change
        if np.max(np.abs(change) / model.scales()) < _PLACED:
            break
    return x


def align(
    scene: Path, parts: Sequence[MeshPart], out: Path, background: Background, *, seed: int
) -> PlacementFacts:
    """Aligns an object with the images of a scene, and writes it.

    Args:
      scene: folder of the scene, whose training images and masks are read.
      parts: parts of the object.
      out: folder to write to.
      background: background of the scene.
      seed: random seed.

    Raises:
      SceneError: if there are no parts, or one is not a dielectric.
      ValueError: if the scene has no masks, or no pixel inside or outside of them, or the object
        cannot be aligned with them.
    """
    model, tree = placed_object(parts)
    outer = [part for part, parent in enumerate(tree.parents) if parent == NO_PARENT]
    views = light_stage.read_views(scene)
    seen = light_stage.read(scene, seed=seed)
    x = model.start()
    for reach in _REACHES:
        outlines = Outlines(views, seed=seed, reach=reach, creased=True)
        x = fit_placement(model, outlines, outermost=outer, x=x)
    _refuse_far(model, x, outlines, outer)
    by_outlines = _as_fit(model, x, outlines, outer)
    surface = index_stage.learn_backdrop(scene, out, seed=seed, **background._asdict())
    if surface is None:
        facts = _facts(model, by_outlines, (None, None, None), seen)
    else:
        outlines = Outlines(views, common=light_stage.WIDER, seed=seed, creased=True)
        found = _by_light(model, by_outlines, surface, seen, outlines, outer)
        before, after = found[0], min(found, key=lambda trial: trial.error)
        facts = _facts(model, after.fit, tuple(trial.error for trial in found), seen)
        _draw(out / FIGURE, scene, before, after, surface, seen)
    configuration.write(out / PLACEMENT, facts)
    _write_reconstruction(scene, parts, model, facts, out, background, seed)
    return facts


def placed_object(parts: Sequence[MeshPart]) -> tuple[PlacedObject, Containment]:
    """Returns the object as a model of its placement, and its nesting.

    Raises:
      SceneError: if there are no parts, or one is open, or no smooth, clear or stained dielectric.
    """
    if not parts:
        raise SceneError("There are no meshes to align. Give --mesh, or add them to the scene.")
    for part in parts:
        material = part.material
        if material.kind != "dielectric" or material.roughness or material.dispersion:
            raise SceneError(
                f"{part.name} is rough or dispersive, or not a dielectric, and alignment follows "
                "light through smooth glass and liquids of one index only. Align other parts alone."
            )
        if not is_closed(part.faces):
            raise SceneError(f"{part.name} is not closed, so it has no outline. Close the mesh.")
    tree = mesh_queries.find_containment(parts)
    interfaces = nested(
        [part.index for part in parts],
        tree.parents,
        tints=[part.tint for part in parts],
        absorptions=[part.absorption for part in parts],
    )
    return PlacedObject([shaded_mesh(part) for part in parts], interfaces), tree


def _as_fit(
    model: PlacedObject, x: Float[np.ndarray, "7"], outlines: Outlines, outer: Sequence[int]
) -> Fit:
    """Returns a placement by outlines, with its covariance."""
    rows = _rows(outlines, outer)(model.pose(x))
    matrix = (rows.weights[:, None] * rows.derivatives).T @ rows.derivatives
    return Fit(x, np.linalg.inv(matrix + model.prior(x)[0]), ())


def _refuse_far(
    model: PlacedObject, x: Float[np.ndarray, "7"], outlines: Outlines, outer: Sequence[int]
) -> None:
    """Refuses a placement that does not explain the outlines.

    Raises:
      ValueError: if the object went far from where it was, or its outlines are not those of masks.
    """
    rows = _rows(outlines, outer)(model.pose(x))
    precision, _ = model.prior(x)
    far = np.abs(x) * np.sqrt(np.diag(precision)) > _FARTHEST
    mean = float(np.mean(np.abs([*rows.errors, 0.0]))) * OUTLINE_DEVIATION
    if far.any() or mean > _MOST_PIXELS or len(rows.errors) < _FEWEST_POINTS:
        turn, shift = np.degrees(np.linalg.norm(x[:3])), np.linalg.norm(x[3:6])
        raise ValueError(
            f"The object cannot be aligned: turned by {turn:.1f} degrees, moved by {shift:.3g} "
            f"world units and scaled by {math.exp(x[6]):.3g}, {len(rows.errors)} points of its "
            f"outlines are near those of the masks, {mean:.2g} pixels off on average. Check that "
            "the meshes are those of the scene, in its units, or bring them within some 5 degrees "
            "and 5 percent first."
        )


def _rows(
    outlines: Outlines, outer: Sequence[int]
) -> Callable[[gauss_newton.Candidate], gauss_newton.Rows]:
    return lambda candidate: outlines.of_surfaces([candidate.parts[part] for part in outer])


def _by_light(
    model: PlacedObject,
    begun: Fit,
    surface: Backdrop,
    seen: Seen,
    outlines: Outlines,
    outer: Sequence[int],
) -> tuple[Trial, Trial, Trial]:
    """Returns the object as given, as placed by outlines, and as placed by light."""
    with ProgressBar("align", len(_STEPS.blurs)) as bar:
        fit = gauss_newton.fit(
            model,
            begun.x,
            surface,
            seen.fitted,
            settings=_STEPS,
            outlines=_rows(outlines, outer),
            progress=lambda step, facts: bar.show(
                step, f"error {min(facts.before, facts.after):.4f}"
            ),
        )
    given = Fit(model.start(), np.linalg.inv(model.prior(model.start())[0]), ())
    named = {"as given": given, "by outlines": begun, "by light": fit}
    first, second, third = (
        model_selection.judged(name, model, each, surface, seen.judges)
        for name, each in named.items()
    )
    return first, second, third


def _facts(
    model: PlacedObject, fit: Fit, errors: tuple[float | None, ...], seen: Seen
) -> PlacementFacts:
    given, outlines, light = errors
    deviations = np.sqrt(np.diag(fit.covariance))
    return PlacementFacts(
        rotation=_triple(np.degrees(fit.x[:3])),
        shift=_triple(fit.x[3:6]),
        size=math.exp(fit.x[6]),
        centre=_triple(model.centre),
        rotation_deviation=_triple(np.degrees(deviations[:3])),
        shift_deviation=_triple(deviations[3:6]),
        size_deviation=math.exp(fit.x[6]) * float(deviations[6]),
        given=given,
        outlines=outlines,
        light=light,
        split=seen.split,
    )


def _triple(values: Float[np.ndarray, "3"]) -> Position:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _draw(
    path: Path, scene: Path, before: Trial, after: Trial, surface: Backdrop, seen: Seen
) -> None:
    names = ("as given", "aligned")
    nothing = light_stage.RevolvedObject(None).opaque_seen
    light_figures.draw(path, scene, seen.split, before, after, surface, None, nothing, names=names)


def placed_parts(parts: Sequence[MeshPart], facts: PlacementFacts) -> list[Mesh]:
    """Returns the surfaces of the parts where the images show them."""
    turn, _ = rotation(np.radians(facts.rotation))
    centre, found = np.array(facts.centre), []
    for mesh in map(shaded_mesh, parts):
        vertices = centre + facts.shift + facts.size * (mesh.vertices - centre) @ turn.T
        found.append(Mesh(vertices, mesh.faces, mesh.normals @ turn.T))
    return found


def _write_reconstruction(
    scene: Path,
    parts: Sequence[MeshPart],
    model: PlacedObject,
    facts: PlacementFacts,
    out: Path,
    background: Background,
    seed: int,
) -> None:
    """Writes the aligned parts as a reconstruction: the outermost part first."""
    placed = placed_parts(parts, facts)
    order = np.argsort([-volume(mesh.vertices, mesh.faces) for mesh in placed], kind="stable")
    for folder in (light_stage.FOLDER, geometry_stage.FOLDER):
        (out / folder).mkdir()
    listed = []
    for part, mesh in ((parts[number], placed[number]) for number in order):
        meshes.write_mesh(out / light_stage.FOLDER / f"{part.name}.ply", *mesh)
        colours = (part.tint, part.absorption) if part.colour_known else (None,)
        listed.append(records.PartFacts(f"{part.name}.ply", part.index, *colours))
    outer, first = placed[order[0]], parts[order[0]]
    meshes.write_mesh(out / geometry_stage.FOLDER / listed[0].mesh, *outer)
    views = light_stage.read_views(scene)
    geometry = geometry_stage.describe(listed[0].mesh, outer, views, stages=("aligned",))
    light = records.LightFacts(
        kept=True,
        index=first.index,
        shape="given, aligned",
        before=facts.given,
        after=facts.error,
        split=facts.split,
        parts=tuple(listed),
    )
    config = records.ReconstructionConfig(
        "given", 0, 0, first.index, background.space, background.radius, "none", seed
    )
    asked = records.Reconstruction(scene_names.of_folder(scene), chain.fingerprint(scene), config)
    index = records.IndexFacts("given", first.index, None, None)
    records.write(out, dataclasses.replace(asked, geometry=geometry, index=index, light=light))


def describe(facts: PlacementFacts) -> str:
    """Returns a few lines about a placement."""
    turn, shift = np.linalg.norm(facts.rotation), np.linalg.norm(facts.shift)
    lines = [
        f"rotation: {turn:.3f} degrees, vector {_told(facts.rotation, facts.rotation_deviation)}",
        f"shift:    {shift:.4f} world units, {_told(facts.shift, facts.shift_deviation)}",
        f"size:     {facts.size:.5f} +- {facts.size_deviation:.5f}",
    ]
    if facts.given is None:
        return "\n".join([*lines, "placed by outlines alone: the background is a field"])
    errors = f"{facts.given:.4f} as given, {facts.outlines:.4f} by outlines"
    lines.append(f"error of {facts.split} pixels, sRGB: {errors}, {facts.light:.4f} by light")
    if (facts.error or 0.0) > records.UNEXPLAINED:
        lines.append(
            f"warning: an error of {facts.error:.4f} is left. Check the meshes, their indices and "
            "the size of the background."
        )
    return "\n".join(lines)


def _told(values: Position, deviations: Position) -> str:
    pairs = zip(values, deviations, strict=True)
    return ", ".join(f"{value:.4f} +- {deviation:.4f}" for value, deviation in pairs)
