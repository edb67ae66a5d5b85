"""Moves, turns and scales an object of known meshes until it is where the images show it.

    {out}/placement.json         rotation, shift and size, with their standard deviations
    {out}/reconstruction.json    the record of a reconstruction, for --reconstruction of train
    {out}/light/*.ply            the aligned parts
    {out}/errors.png             pixels before and after

Outlines of the masks come first (`reconstruct.masks.fit_placement`), then the light refracted
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
from refref_jax.geometry.triangle_meshes import Mesh, diameter, volume
from refref_jax.optics.interface_rules import NO_PARENT, nested
from refref_jax.reconstruct import gauss_newton, model_selection
from refref_jax.reconstruct.gauss_newton import Fit, Steps
from refref_jax.reconstruct.masks import Outlines, PlacedObject, fit_placement, rotation
from refref_jax.reconstruct.model_selection import Trial
from refref_jax.reconstruct.photometry import Backdrop

PLACEMENT, FIGURE = "placement.json", "errors.png"

WRITES = (PLACEMENT, records.FILE, FIGURE, "background", light_stage.FOLDER, geometry_stage.FOLDER)
"""Names of what is written."""

# Reach of the outlines in the rounds of the first fit, pixels.
_REACHES = (20.0, 8.0, 3.0)

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
        return None if self.outlines is None else min(self.outlines, self.light or math.inf)


class Background(NamedTuple):
    """The background, where it is not that of `scene.json`; see `index_stage.learn_background`."""

    space: Space | None
    radius: float | None
    centre: Position | None


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
      ValueError: if the scene has no masks, or no pixel inside or outside of them.
    """
    model, tree = placed_object(parts)
    outer = [part for part, parent in enumerate(tree.parents) if parent == NO_PARENT]
    views = light_stage.read_views(scene)
    seen = light_stage.read(scene, seed=seed)
    x = model.start()
    for reach in _REACHES:
        outlines = Outlines(views, seed=seed, reach=reach)
        x = fit_placement(model, outlines, outermost=outer, x=x)
    surface = index_stage.learn_backdrop(scene, out, seed=seed, **background._asdict())
    by_outlines = _as_fit(model, x, outlines, outer)
    if surface is None:
        facts = _facts(model, by_outlines, (None, None, None), seen)
    else:
        outlines = Outlines(views, common=light_stage.WIDER, seed=seed)
        found = _by_light(model, by_outlines, surface, seen, outlines, outer)
        before, after = found[0], min(found[1:], key=lambda trial: trial.error)
        facts = _facts(model, after.fit, tuple(trial.error for trial in found), seen)
        _draw(out / FIGURE, scene, before, after, surface, seen)
    configuration.write(out / PLACEMENT, facts)
    _write_reconstruction(scene, parts, model, facts, out, background, seed)
    return facts


def placed_object(parts: Sequence[MeshPart]) -> tuple[PlacedObject, Containment]:
    """Returns the object as a model of its placement, and its nesting.

    Raises:
      SceneError: if there are no parts, or one is not a smooth, clear or stained dielectric.
    """
    if not parts:
        raise SceneError("There are no meshes to align. Give --mesh, or add them to the scene.")
    for part in parts:
        if part.material.kind != "dielectric" or part.material.roughness:
            raise SceneError(
                f"{part.name} is rough, or not a dielectric, and alignment follows light through "
                "smooth glass and liquids only. Align the other parts alone."
            )
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
    rows = _rows(model, outlines, outer)(model.pose(x))
    matrix = (rows.weights[:, None] * rows.derivatives).T @ rows.derivatives
    return Fit(x, np.linalg.inv(matrix + model.prior(x)[0]), ())


def _rows(
    model: PlacedObject, outlines: Outlines, outer: Sequence[int]
) -> Callable[[gauss_newton.Candidate], gauss_newton.Rows]:
    del model
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
            outlines=_rows(model, outlines, outer),
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
    nothing = light_stage.RevolvedObject(None).ends_seen
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
    geometry = records.GeometryFacts(
        mesh=listed[0].mesh,
        masks=len(views.masks),
        width=views.cameras.width,
        height=views.cameras.height,
        vertices=len(outer.vertices),
        faces=len(outer.faces),
        volume=volume(outer.vertices, outer.faces),
        diameter=diameter(outer.vertices),
        stages=("aligned",),
        refused=(),
        warnings=(),
    )
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
