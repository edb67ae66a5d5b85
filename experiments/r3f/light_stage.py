"""Refines the object with the light refracted through it, the third stage of R3F.

    {out}/light/{object}_{material}.ply    the refined surface, if it was kept
    {out}/light/errors.png                 pixels before and after, and the uncertainty of normals

Families of shapes and a free surface are fitted to pixels of the training views, together with the
index (`reconstruct.shape_from_refraction`). If the object is a body of revolution, and no solid
glass explains its pixels, the stage looks at what may be inside instead of a free surface
(`reconstruct.interior_search`). In a solid that was chosen, it looks for bubbles of air
(`reconstruct.bubble_search`). Vessels and solids with bubbles become several parts. Pixels that
were not fitted judge: those of the validation views, or of every eighth training view where these
have no masks. Where the background is a field, and where light explains nothing better, the surface
stays as it is.
"""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.spatial import KDTree

from experiments.cli.progress import ProgressBar
from experiments.figures.style import pyplot
from experiments.r3f import index_stage
from experiments.r3f.records import IndexFacts, LightFacts, PartFacts, TrialFacts
from refref_jax import atomic_files
from refref_jax.choices import Split
from refref_jax.data import meshes, scene_folder
from refref_jax.data.scene_folder import Frames
from refref_jax.geometry.cameras import image_rays
from refref_jax.geometry.surfaces import pack_meshes
from refref_jax.geometry.triangle_meshes import Mesh, face_vectors, volume
from refref_jax.reconstruct import (
    ReconstructionError,
    bubble_search,
    families,
    gauss_newton,
    interior_looks,
    interior_search,
    model_selection,
    photometry,
    shape_from_refraction,
)
from refref_jax.reconstruct.bubbles import ObjectWithBubbles
from refref_jax.reconstruct.families import Revolution
from refref_jax.reconstruct.interior_looks import SearchSettings
from refref_jax.reconstruct.interior_search import Finding
from refref_jax.reconstruct.interiors import Solid, Vessel
from refref_jax.reconstruct.masks import Views
from refref_jax.reconstruct.model_selection import Trial
from refref_jax.reconstruct.outlines import Outlines
from refref_jax.reconstruct.photometry import Backdrop, Photographs
from refref_jax.reconstruct.refinement import objection
from refref_jax.render.images import find_first_surface

FOLDER = "light"

FIGURE = "errors.png"

# Number of pixels that judge, and one training view in this many, if there are no others.
_JUDGES, _ONE_IN = 16_384, 8

# Most pixels that steps draw from.
_FITTED = 2_000_000

# Error of pixels through solid glass above which something may be inside, sRGB, and largest rms
# distance of the surface from a body of revolution, as a share of its diameter.
_UNEXPLAINED, _FURTHEST = 0.05, 0.03

# Materials that name the files of parts, with their indices.
_MATERIALS = [
    (name, meshes.INDEX_OF_REFRACTION[name]) for name in ("glass", "water", "alcohol", "air")
]

# Share of the volume that the refinement may change if pixels are small: it corrects normals, and
# outlines by a pixel.
_VOLUME_CHANGE = 0.02

# Standard deviation of how much too wide all masks are, pixels.
_WIDER = 0.5

# Rows of the figure, and largest error and deviation that it distinguishes, in sRGB and degrees.
_ROWS, _MOST_ERROR, _MOST_DEVIATION = 3, 0.2, 0.5

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


def run(
    scene: Path, mesh: Mesh, known: IndexFacts, surface: Backdrop | None, target: Path, *, seed: int
) -> LightFacts:
    """Refines an object, and writes it if it is better.

    Args:
      scene: folder of the scene; training and validation images and masks are read.
      mesh: mesh of the object.
      known: index of refraction, which is fixed if the user set it.
      surface: backdrop; `None` if the background is a field.
      target: path of the mesh to write, in a folder of its own.
      seed: random seed.
    """
    if surface is None:
        reason = "the background is a field, not a surface at a known place"
        return LightFacts(kept=False, index=known.index, remark=reason)
    seen = read(scene, seed=seed)
    trials = fit(scene, mesh, known, surface, seen, seed=seed)
    masks, chosen, remark = choose(scene, mesh, trials)
    kept = chosen is not masks
    deviations = model_selection.normal_deviations(chosen) if kept else None
    parts: tuple[PartFacts, ...] = ()
    with atomic_files.written_folder(target.parent) as folder:
        if kept and isinstance(chosen.model, Vessel | ObjectWithBubbles):
            solids = chosen.model.solids(chosen.fit.x)
            parts = _write_parts(folder, target.stem, solids, known)
        elif kept:
            meshes.write_mesh(folder / target.name, *chosen.mesh)
        draw(folder / FIGURE, scene, seen.split, masks, chosen, surface, deviations)
    unknown = 1.0 if deviations is None else float(np.mean(deviations > _UNKNOWN))
    estimated = known.source == "estimated"
    return LightFacts(
        kept=kept,
        index=chosen.outer_index if estimated else known.index,
        shape=chosen.name,
        before=masks.error,
        after=chosen.error,
        deviation=chosen.index_deviation if kept and estimated else None,
        undetermined=unknown,
        split=seen.split,
        remark=remark,
        trials=tuple(_facts(trial, min(trials, key=lambda each: each.error)) for trial in trials),
        parts=parts,
    )


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
        file = f"{name}_{solid.name}_{material}.ply"
        meshes.write_mesh(folder / file, *solid.mesh)
        given = known.source == "given" and solid.name == "glass"
        index = known.index if given else solid.index
        facts.append(PartFacts(file, index, solid.tint, solid.absorption))
    return tuple(facts)


def read(scene: Path, *, seed: int) -> Seen:
    """Returns the pixels to fit, and those that judge.

    Raises:
      ValueError: if no pixel is well inside a mask.
    """
    fitted = index_stage.photographs(scene, "train", seed=seed, rays=_FITTED)
    path = scene / "transforms_val.json"
    if path.is_file() and scene_folder.read_frames(scene, "val").masks is not None:
        judges = index_stage.photographs(scene, "val", seed=seed + 1, rays=_JUDGES)
        return Seen(fitted, judges, "val")
    held = np.isin(fitted.views, np.unique(fitted.views)[::_ONE_IN])
    some = np.flatnonzero(held)
    some = np.random.default_rng(seed).permutation(some)[:_JUDGES]
    return Seen(fitted.chosen(np.flatnonzero(~held)), fitted.chosen(some), "train")


def fit(
    scene: Path, mesh: Mesh, known: IndexFacts, surface: Backdrop, seen: Seen, *, seed: int
) -> tuple[Trial, ...]:
    """Fits vessels, or else all shapes that come near the mesh; the mesh itself comes first.

    If bubbles are found in the shape that is chosen, it comes once more with them, as the last.

    Args:
      scene: folder of the scene.
      mesh: mesh from masks.
      known: index of refraction.
      surface: backdrop.
      seen: pixels to fit, and those that judge.
      seed: random seed.
    """
    frames = scene_folder.read_frames(scene, "train")
    views = Views(scene_folder.read_masks(frames), frames.cameras)
    outer = families.fit_revolution(mesh, furthest=_FURTHEST)
    options = {} if known.source == "estimated" else {"deviation": 0.0}
    with ProgressBar("light", 100) as bar:
        trials = shape_from_refraction.fit_shapes(
            mesh,
            known.index,
            surface,
            seen.fitted,
            seen.judges,
            outlines=Outlines(views, common=_WIDER, seed=seed),
            seed=seed,
            is_enough=lambda trials: _may_be_vessel(outer, trials),
            progress=lambda share, text: bar.show(round(100 * share), text),
            **options,
        )
    if _may_be_vessel(outer, trials):
        outlines = Outlines(views, seed=seed)
        trials = (*trials, *_vessels(outer, known, surface, seen, outlines, seed=seed))
    masks, chosen, _ = choose(scene, mesh, trials)
    if chosen is masks or isinstance(chosen.model, Vessel):
        return trials
    outlines = Outlines(views, common=_WIDER, seed=seed)
    return (*trials, *_with_bubbles(chosen, surface, seen, outlines, seed=seed))


def _with_bubbles(
    chosen: Trial, surface: Backdrop, seen: Seen, outlines: Outlines, *, seed: int
) -> list[Trial]:
    """Returns a shape with the bubbles that are found in it; nothing if there are none.

    The search itself finds out whether it is worth while: it ends after one picture of some pixels
    if nowhere inside the errors of the paths stand out.
    """
    with ProgressBar("bubbles", 100) as bar:
        found = bubble_search.find_bubbles(
            chosen,
            surface,
            seen.fitted,
            seen.judges,
            outlines=outlines,
            seed=seed,
            progress=lambda share, text: bar.show(round(100 * share), text),
        )
    return [] if found is chosen else [found]


def _may_be_vessel(outer: Revolution | None, trials: Sequence[Trial]) -> bool:
    """Returns whether no solid shape explains the pixels of an object that may be a vessel."""
    if outer is None or outer.closed:
        return False
    return min(trial.error for trial in trials) > _UNEXPLAINED


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
    glass = {"glass": known.index} if known.source == "given" else {}
    settings = SearchSettings(seed=seed, **glass)
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
        if looks[0].interior.contents == "none":
            bar.show(100, "solid glass")
            return []
        count = itertools.count(10, 8)
        found = interior_search.search(
            outer,
            surface,
            seen.fitted,
            seen.judges,
            settings=settings,
            outlines=outlines,
            looks=looks,
            progress=lambda line: bar.show(min(next(count), 99), line),
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


def draw(
    path: Path,
    scene: Path,
    split: Split,
    before: Trial,
    after: Trial,
    surface: Backdrop,
    deviations: Float[np.ndarray, " normals"] | None,
) -> None:
    """Draws views: the photograph, what both surfaces predict, their errors, and the uncertainty.

    Args:
      path: file to write.
      scene: folder of the scene.
      split: split of the views.
      before: the surface from masks.
      after: the chosen one.
      surface: backdrop.
      deviations: standard deviation of each normal of the chosen surface, degrees; `None` if light
        has not determined them.
    """
    frames = scene_folder.read_frames(scene, split)
    count = len(frames.names)
    chosen = np.unique(np.linspace(0, count - 1, min(_ROWS, count)).astype(int))
    masks, images = scene_folder.read_masks(frames), scene_folder.read_images(frames)
    titles = ("photograph", "from masks", "by light", "error before", "error after", "normals ±")
    figure, axes = pyplot.subplots(
        len(chosen),
        len(titles),
        figsize=(12.5, 2.1 * len(chosen) + 0.3),
        squeeze=False,
        layout="constrained",
    )
    for axis in axes.flat:
        axis.axis("off")
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=9)
    shown = None
    for row, view in zip(axes, chosen, strict=True):
        panels = _panels(frames, int(view), images[view], masks[view], (before, after), surface)
        for axis, panel in zip(row[:3], panels[:3], strict=True):
            axis.imshow(panel)
        for axis, panel in zip(row[3:5], panels[3:], strict=True):
            errors = axis.imshow(panel, vmin=0.0, vmax=_MOST_ERROR, cmap="magma")
        seen = _seen_deviations(frames, int(view), after, deviations)
        shown = row[5].imshow(seen, vmin=0.0, vmax=_MOST_DEVIATION, cmap="viridis")
    figure.colorbar(errors, ax=axes[:, 3:5], label="sRGB", shrink=0.8, aspect=40, pad=0.01)
    figure.colorbar(shown, ax=axes[:, 5], label="degrees", shrink=0.8, aspect=40, pad=0.01)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _panels(
    frames: Frames,
    view: int,
    image: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    trials: Sequence[Trial],
    surface: Backdrop,
) -> list[np.ndarray]:
    """Returns the photograph, the predictions, and their errors within the mask."""
    rays = image_rays(frames.cameras, view)
    flat = rays._replace(**{k: getattr(rays, k).reshape(-1, *s) for k, s in _SHAPES.items()})
    photograph = image.astype(np.float64) / 255.0
    predicted = []
    for trial in trials:
        traced = gauss_newton.traced_object(trial.model.pose(trial.fit.x))
        linear = photometry.predict(traced, surface, flat).linear
        predicted.append(photometry.encode(linear).reshape(photograph.shape))
    errors = [
        np.where(mask, np.sqrt(np.mean((each - photograph) ** 2, axis=-1)), np.nan)
        for each in predicted
    ]
    return [photograph, *predicted, *errors]


_SHAPES = {"origins": (3,), "directions": (3,), "radii": ()}


def _seen_deviations(
    frames: Frames, view: int, trial: Trial, deviations: Float[np.ndarray, " normals"] | None
) -> Float[np.ndarray, "h w"]:
    """Returns the deviation of the normal that each pixel sees, NaN beside the object."""
    rays = image_rays(frames.cameras, view)
    first = find_first_surface(pack_meshes([trial.mesh]), rays)
    seen = np.full(first.distances.shape, np.nan)
    hit = np.isfinite(first.distances)
    if deviations is None or not hit.any():
        return seen
    part = trial.model.pose(trial.fit.x).parts[0]
    of_vertices = np.zeros(len(part.vertices))
    of_vertices[part.faces.ravel()] = deviations[part.normal_ids.ravel()]
    reach = np.where(hit, first.distances, 0.0)[..., None]
    points = (rays.origins + reach * rays.directions)[hit]
    seen[hit] = of_vertices[KDTree(part.vertices).query(points)[1]]
    return seen
