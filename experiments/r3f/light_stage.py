"""Refines the object with the light refracted through it, the third stage of R3F.

    {out}/light/{object}_{material}.ply    the refined surface, if it was kept
    {out}/light/errors.png                 pixels before and after, and the uncertainty of normals

Families of shapes and a free surface are fitted to pixels of the training views, together with the
index (`reconstruct.shape_from_refraction`). If the object is a body of revolution, and no solid
glass explains its pixels, the stage looks at what may be inside instead of a free surface
(`reconstruct.interior_search`). In a solid that was chosen, it looks for bubbles of air
(`reconstruct.bubble_search`). Vessels and solids with bubbles become several parts. Opaque caps,
feet and labels of bodies of revolution are parts of their own (`reconstruct.opaque_parts`). Where
nothing else explains the pixels, a vessel of any shape is fitted (`reconstruct.free_vessels`).
Pixels that were not fitted judge: those of the validation views, or of every eighth training view
where these have no masks. Where the background is a field, and where light explains nothing better,
the surface stays as it is.
"""

import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from experiments.cli.progress import ProgressBar
from experiments.r3f import index_stage, light_figures
from experiments.r3f.records import UNEXPLAINED, IndexFacts, LightFacts, PartFacts, TrialFacts
from refref_jax import atomic_files
from refref_jax.choices import CLEAR, Colour, Split
from refref_jax.data import meshes, scene_folder
from refref_jax.geometry.rays import Rays
from refref_jax.geometry.triangle_meshes import Mesh, face_vectors, volume
from refref_jax.optics.interface_rules import NO_PARENT
from refref_jax.optics.media import INDEX_OF_AIR
from refref_jax.reconstruct import (
    ReconstructionError,
    bubble_search,
    families,
    free_vessels,
    interior_looks,
    interior_search,
    model_selection,
    opaque_parts,
    shape_from_refraction,
)
from refref_jax.reconstruct.bubbles import ObjectWithBubbles
from refref_jax.reconstruct.contents import Solid
from refref_jax.reconstruct.families import Revolution
from refref_jax.reconstruct.free_vessels import FreeVessel
from refref_jax.reconstruct.interior_looks import SearchSettings
from refref_jax.reconstruct.interior_search import Finding
from refref_jax.reconstruct.interiors import Vessel
from refref_jax.reconstruct.masks import Views
from refref_jax.reconstruct.model_selection import Trial
from refref_jax.reconstruct.opaque_parts import OpaquePart
from refref_jax.reconstruct.outlines import Outlines, fit_profile
from refref_jax.reconstruct.photometry import Backdrop, Photographs
from refref_jax.reconstruct.refinement import objection
from refref_jax.reconstruct.relief import measure_relief

FOLDER = "light"

FIGURE = "errors.png"

# Number of pixels that judge, and one training view in this many, if there are no others.
_JUDGES, _ONE_IN = 16_384, 8

# Most pixels that steps draw from.
_FITTED = 2_000_000

# Largest rms distance of the surface from a body of revolution for which something may be inside,
# as a share of its diameter.
_FURTHEST = 0.03

# Materials that name the files of parts, with their indices.
_MATERIALS = [
    (name, meshes.INDEX_OF_REFRACTION[name]) for name in ("glass", "water", "alcohol", "air")
]

# Share of the volume that the refinement may change if pixels are small: it corrects normals, and
# outlines by a pixel.
_VOLUME_CHANGE = 0.02

WIDER = 0.5
"""Standard deviation of how much too wide all masks are, pixels."""

# Deviation of normals beyond which light has not determined them, degrees.
_UNKNOWN = 0.5


class Seen(NamedTuple):
    """Pixels that see the object.

    Attributes:
      fitted: pixels to fit.
      judges: other pixels.
      split: split of the judges.
    """

    fitted: Photographs
    judges: Photographs
    split: Split


class RevolvedObject(NamedTuple):
    """The object as a body of revolution.

    Attributes:
      outer: its outer surface; `None` if it is no such body, or a ring, which has no ends and holds
        nothing.
      opaque: its opaque parts.
    """

    outer: Revolution | None
    opaque: tuple[OpaquePart, ...] = ()

    @property
    def has_opaque_end(self) -> bool:
        """Whether an end is opaque, where the glass is cut off; a label leaves it as it is."""
        outer = self.outer
        return outer is not None and any(part.kind(outer) != "label" for part in self.opaque)

    def opaque_seen(self, rays: Rays) -> Float[np.ndarray, "rays 3"]:
        """Returns the linear RGB of the opaque part that each ray meets first, NaN without any."""
        if self.outer is None or not self.opaque:
            return np.full((rays.radii.size, 3), np.nan)
        return opaque_parts.colours_seen(self.outer, self.opaque, rays)


def run(
    scene: Path,
    mesh: Mesh,
    known: IndexFacts,
    surface: Backdrop | None,
    target: Path,
    *,
    seed: int,
    gains: Mapping[str, Colour] | None = None,
) -> LightFacts:
    """Refines an object, and writes it if it is better.

    Args:
      scene: folder of the scene; training and validation images and masks are read.
      mesh: mesh of the object.
      known: index of refraction, which is fixed if the user set it.
      surface: backdrop; `None` if the background is a field.
      target: path of the mesh to write, in a folder of its own.
      seed: random seed.
      gains: gain of each training image by its name; all images have one exposure by default.
    """
    if surface is None:
        reason = "the background is a field, not a surface at a known place"
        return LightFacts(kept=False, index=known.index, remark=reason)
    seen = read(scene, seed=seed, gains=gains)
    revolved = look_at_opaque_parts(scene, mesh, surface, seen, seed=seed)
    trials = fit(scene, mesh, known, surface, seen, revolved, seed=seed)
    masks, chosen, remark = choose(scene, mesh, trials)
    if revolved.has_opaque_end and chosen is not masks and not isinstance(chosen.model, Vessel):
        chosen, remark = masks, "an end is opaque, and what remains is no vessel"
    kept = chosen is not masks
    turned = isinstance(chosen.model, Vessel) and not isinstance(chosen.model, FreeVessel)
    written = revolved if turned else RevolvedObject(None)
    deviations = model_selection.normal_deviations(chosen) if kept else None
    parts: tuple[PartFacts, ...] = ()
    with atomic_files.written_folder(target.parent) as folder:
        if kept and isinstance(chosen.model, Vessel | ObjectWithBubbles):
            model, x = chosen.model, chosen.fit.x
            opaque = _opaque_solids(written, model, x) if isinstance(model, Vessel) else []
            parts = _write_parts(folder, target.stem, [*model.solids(x), *opaque], known)
        elif kept:
            meshes.write_mesh(folder / target.name, *chosen.mesh)
        views = (scene, seen.split)
        light_figures.draw(
            folder / FIGURE, *views, masks, chosen, surface, deviations, written.opaque_seen
        )
    unknown = 1.0 if deviations is None else float(np.mean(deviations > _UNKNOWN))
    estimated = known.source == "estimated"
    return LightFacts(
        kept=kept,
        index=chosen.outer_index if estimated else known.index,
        shape=chosen.name,
        before=masks.error,
        after=chosen.error,
        deviation=_index_deviation(chosen, trials) if kept and estimated else None,
        undetermined=unknown,
        split=seen.split,
        remark=remark,
        trials=tuple(_facts(trial, min(trials, key=lambda each: each.error)) for trial in trials),
        parts=parts,
    )


def _index_deviation(chosen: Trial, trials: Sequence[Trial]) -> float:
    """Returns the standard deviation of the index; hypotheses of vessels are rivals."""
    vessels = [each for each in trials if isinstance(each.model, Vessel)]
    rivals = vessels if isinstance(chosen.model, Vessel) else []
    return model_selection.index_deviation(chosen, rivals)


def choose(scene: Path, mesh: Mesh, trials: Sequence[Trial]) -> tuple[Trial, Trial, str]:
    """Returns the mesh from masks, the chosen trial, and the reason if both are the same.

    Trials that change the volume are left out; that of a vessel is of its glass alone, so that only
    its outer wall, which comes from masks, says that it is the same object. Bubbles were found in
    the chosen shape, and judged by the pixels that see them: they come with it.
    """
    masks, *others = trials
    most = max(_VOLUME_CHANGE, _volume_of_a_pixel(scene, mesh))
    complaints = {
        trial.name: objection(mesh, trial.mesh, most)
        for trial in others
        if not isinstance(trial.model, Vessel)
    }
    left = [trial for trial in others if not complaints.get(trial.name)]
    plain = [trial for trial in left if not isinstance(trial.model, ObjectWithBubbles)]
    with_bubbles = [trial for trial in left if isinstance(trial.model, ObjectWithBubbles)]
    chosen = model_selection.choose([masks, *plain])
    if chosen is not masks:
        return masks, with_bubbles[-1] if with_bubbles else chosen, ""
    best = min(trials, key=lambda trial: trial.error)
    if complaint := complaints.get(best.name):
        return masks, masks, f"the {best.name} was rejected: {complaint}"
    return masks, masks, "no shape explains the judges significantly better"


def _volume_of_a_pixel(scene: Path, mesh: Mesh) -> float:
    """Returns the share of the volume that a layer as thick as a pixel has."""
    cameras = scene_folder.read_frames(scene, "train").cameras
    away = np.linalg.norm(cameras.poses[:, :, 3] - mesh.vertices.mean(axis=0), axis=-1).mean()
    area = np.linalg.norm(face_vectors(mesh.vertices, mesh.faces), axis=-1).sum()
    return float(area * away / cameras.focal / volume(mesh.vertices, mesh.faces))


def _write_parts(
    folder: Path, stem: str, solids: Sequence[Solid], known: IndexFacts
) -> tuple[PartFacts, ...]:
    """Writes the parts; their files are named after materials of nearly their index."""
    facts, name = [], stem.rsplit("_", 1)[0]
    for solid in solids:
        material = min(_MATERIALS, key=lambda each: abs(each[1] - solid.index))[0]
        material = material if solid.radiance is None else "opaque"
        file = f"{name}_{solid.name}_{material}.ply"
        meshes.write_mesh(folder / file, *solid.mesh)
        given = known.source == "given" and solid.name == "glass"
        index = known.index if given else solid.index
        facts.append(PartFacts(file, index, solid.tint, solid.absorption, solid.radiance))
    return tuple(facts)


def _opaque_solids(
    revolved: RevolvedObject, vessel: Vessel, x: Float[np.ndarray, " unknowns"]
) -> list[Solid]:
    """Returns the opaque parts of a vessel."""
    outer, found, labels = revolved.outer, [], itertools.count(1)
    for part in revolved.opaque if outer is not None else ():
        name: str = part.kind(outer)
        if name == "label":
            mesh = opaque_parts.mesh_of_label(vessel, x, part)
            name = f"label{next(labels)}"
        else:
            mesh = opaque_parts.mesh_of_end(outer, part)
        found.append(Solid(name, mesh, INDEX_OF_AIR, NO_PARENT, CLEAR, radiance=part.colour))
    return found


def read(scene: Path, *, seed: int, gains: Mapping[str, Colour] | None = None) -> Seen:
    """Returns the pixels to fit, and those that judge.

    With gains of the training images, views of these judge, since others have unknown ones.

    Raises:
      ValueError: if no pixel is well inside a mask.
    """
    fitted = index_stage.photographs(scene, "train", seed=seed, rays=_FITTED, gains=gains)
    path = scene / "transforms_val.json"
    known = path.is_file() and gains is None
    held_out = scene_folder.read_frames(scene, "val") if known else None
    if held_out is not None and held_out.masks and scene_folder.read_masks(held_out).any():
        judges = index_stage.photographs(scene, "val", seed=seed + 1, rays=_JUDGES)
        return Seen(fitted, judges, "val")
    held = np.isin(fitted.views, np.unique(fitted.views)[::_ONE_IN])
    some = np.flatnonzero(held)
    some = np.random.default_rng(seed).permutation(some)[:_JUDGES]
    return Seen(fitted.chosen(np.flatnonzero(~held)), fitted.chosen(some), "train")


def read_views(scene: Path) -> Views:
    """Returns the masks of the training views that show the object, with their cameras."""
    frames, masks = scene_folder.read_object_views(scene_folder.read_frames(scene, "train"))
    return Views(masks, frames.cameras)


def look_at_opaque_parts(
    scene: Path, mesh: Mesh, surface: Backdrop, seen: Seen, *, seed: int
) -> RevolvedObject:
    """Returns the object as a body of revolution with its opaque parts, unless it is a ring."""
    outer = families.fit_revolution(mesh, furthest=_FURTHEST)
    if outer is None or outer.closed:
        return RevolvedObject(None)
    with ProgressBar("profile", 2) as bar:
        bar.show(0, "fitting to the outlines")
        relief = measure_relief(mesh, outer.axis)
        outer = fit_profile(outer, read_views(scene), relief=relief, seed=seed)
        bar.show(1, "looking for opaque parts")
        opaque = opaque_parts.find_opaque_parts(outer, surface, seen.fitted, seed=seed)
        bar.show(2, "done")
    return RevolvedObject(outer, opaque)


def fit(
    scene: Path,
    mesh: Mesh,
    known: IndexFacts,
    surface: Backdrop,
    seen: Seen,
    revolved: RevolvedObject,
    *,
    seed: int,
) -> tuple[Trial, ...]:
    """Fits vessels, or else all shapes that come near the mesh; the mesh itself comes first.

    If bubbles are found in the shape that is chosen, it comes once more with them, as the last.
    Pixels that see an opaque part do not count.

    Args:
      scene: folder of the scene.
      mesh: mesh from masks.
      known: index of refraction.
      surface: backdrop.
      seen: pixels to fit, and those that judge.
      revolved: the object as a body of revolution (`look_at_opaque_parts`).
      seed: random seed.
    """
    views = read_views(scene)
    outer, seen = _clear_part(revolved, seen)
    options = {} if known.source == "estimated" else {"deviation": 0.0}
    with ProgressBar("light", 100) as bar:
        trials = shape_from_refraction.fit_shapes(
            mesh,
            known.index,
            surface,
            seen.fitted,
            seen.judges,
            outlines=Outlines(views, common=WIDER, seed=seed),
            seed=seed,
            is_enough=lambda trials: _may_be_vessel(outer, trials),
            progress=lambda share, text: bar.show(round(100 * share), text),
            **options,
        )
    outlines = Outlines(views, seed=seed)
    if _may_be_vessel(outer, trials):
        trials = (*trials, *_vessels(outer, known, surface, seen, outlines, seed=seed))
    if _is_unexplained(trials) and not revolved.has_opaque_end:
        rival = min(trial.error for trial in trials)
        trials = (*trials, *_free_vessels(mesh, known, surface, seen, outlines, rival, seed=seed))
    masks, chosen, _ = choose(scene, mesh, trials)
    if chosen is masks or isinstance(chosen.model, Vessel):
        return trials
    outlines = Outlines(views, common=WIDER, seed=seed)
    return (*trials, *_with_bubbles(chosen, surface, seen, outlines, seed=seed))


def _clear_part(revolved: RevolvedObject, seen: Seen) -> tuple[Revolution | None, Seen]:
    """Returns the clear part of a body, and the pixels that do not see its opaque parts."""
    if revolved.outer is None or not revolved.opaque:
        return revolved.outer, seen
    fitted, judges = (
        each.chosen(np.flatnonzero(~opaque_parts.seen_by(revolved.outer, revolved.opaque, each)))
        for each in (seen.fitted, seen.judges)
    )
    clear = opaque_parts.clear_part(revolved.outer, revolved.opaque)
    return clear, Seen(fitted, judges, seen.split)


def _with_bubbles(
    chosen: Trial, surface: Backdrop, seen: Seen, outlines: Outlines, *, seed: int
) -> list[Trial]:
    """Returns a shape with the bubbles that are found in it; nothing if there are none.

    The search itself finds out whether it is worth while: it ends after one picture of some pixels
    if nowhere inside the errors of the paths stand out.
    """
    find = functools.partial(bubble_search.find_bubbles, chosen)
    found = _with_bar("bubbles", find, surface, seen, outlines=outlines, seed=seed)
    return [] if found is chosen else [found]


def _with_bar(
    name: str, find: Callable[..., Trial | None], surface: Backdrop, seen: Seen, **options: Any
) -> Trial | None:
    """Returns what a search finds, which shows a progress bar."""
    with ProgressBar(name, 100) as bar:
        found = find(
            surface,
            seen.fitted,
            seen.judges,
            progress=lambda share, text: bar.show(round(100 * share), text),
            **options,
        )
        bar.show(100, "done")
    return found


def _may_be_vessel(outer: Revolution | None, trials: Sequence[Trial]) -> bool:
    """Returns whether no solid shape explains the pixels of an object that may be a vessel."""
    return outer is not None and _is_unexplained(trials)


def _is_unexplained(trials: Sequence[Trial]) -> bool:
    return min(trial.error for trial in trials) > UNEXPLAINED


def _free_vessels(
    mesh: Mesh,
    known: IndexFacts,
    surface: Backdrop,
    seen: Seen,
    outlines: Outlines,
    rival: float,
    *,
    seed: int,
) -> list[Trial]:
    """Returns a vessel that is no body of revolution; none if no wall fits into the object."""
    find = functools.partial(free_vessels.fit_free_vessel, mesh, rival=rival, **_glass(known))
    found = _with_bar("free vessel", find, surface, seen, outlines=outlines, seed=seed)
    return [] if found is None else [found]


def _glass(known: IndexFacts) -> dict[str, Any]:
    """Returns options of a search inside: a given index of the glass is kept."""
    return {"glass": known.index, "glass_deviation": 0.0} if known.source == "given" else {}


def _vessels(
    outer: Revolution,
    known: IndexFacts,
    surface: Backdrop,
    seen: Seen,
    outlines: Outlines,
    *,
    seed: int,
) -> list[Trial]:
    """Returns vessels that were fitted; none if solid glass is the best look, or no wall fits."""
    settings = SearchSettings(seed=seed, **_glass(known))
    try:
        found = _search(outer, surface, seen, outlines, settings)
    except ReconstructionError:
        return []
    return [each.trial for each in found]


def _search(
    outer: Revolution,
    surface: Backdrop,
    seen: Seen,
    outlines: Outlines,
    settings: SearchSettings,
) -> list[Finding]:
    """Looks at what may be inside, and fits the best hypotheses.

    Raises:
      ReconstructionError: if no wall fits into the object.
    """
    with ProgressBar("inside", 100) as bar:
        bar.show(0, "looking at hypotheses")
        looks = interior_looks.looks_at_all(outer, surface, seen.fitted, settings)
        best = looks[0].interior
        if best.contents == "none" and not best.stained:
            bar.show(100, "solid glass")
            return []
        found = interior_search.search(
            outer,
            surface,
            seen.fitted,
            seen.judges,
            settings=settings,
            outlines=outlines,
            looks=looks,
            progress=lambda share, text: bar.show(round(100 * share), text),
        )
        bar.show(100, f"vessel: {found.best.name}")
    return [found.best, *(each for each in found.findings if each.name != found.best.name)]


def _facts(trial: Trial, best: Trial) -> TrialFacts:
    worse = model_selection.compare(trial, best)
    return TrialFacts(
        trial.name,
        len(trial.fit.x),
        trial.error,
        worse.mean,
        worse.error,
        trial.outer_index,
        trial.index_deviation,
        trial.fit.taken,
    )
