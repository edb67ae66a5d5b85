"""Checks of a rendered scene: files, meshes, and images against our own tracer.

Two renderers share only the scene's files, so a disagreement means that one of them is wrong.
Colours are compared inside the mask, where light passed through the object. Depths are compared
away from *silhouettes*, the edges of the object or of one part in front of another: within a pixel
or two of such an edge, rounding decides which surface is hit.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from experiments.runs import known_scene
from experiments.runs.known_scene import KnownScene
from refref_jax import configuration
from refref_jax.choices import ORIGIN, SPLITS
from refref_jax.data import (
    background_fit,
    image_files,
    mesh_checks,
    mesh_queries,
    meshes,
    scene_folder,
    scene_properties,
)
from refref_jax.data.mesh_checks import Finding
from refref_jax.data.mesh_queries import Containment
from refref_jax.data.meshes import MeshPart
from refref_jax.geometry import cameras
from refref_jax.optics.path_settings import PathSettings
from refref_jax.render.images import FirstSurface, find_first_surface

PSNR = 33.0
"""Least masked PSNR, dB, of the rendering relative to the image."""

PSNR_CONVEX = 40.0
"""The same for convex objects, whose light paths are short."""

DEPTH = 1e-3
"""Largest difference of planar depth, world units, away from silhouettes."""

DEPTH_SHARE = 0.999
"""Least share of pixels within that difference."""

MASK_SHARE = 0.002
"""Largest share of an image's pixels where mask and traced silhouette differ."""

BACKGROUND = 0.005
"""Largest difference of the background's size from that of the depth maps, relative."""

# Pixels around a silhouette that are excluded from depths and normals.
_MARGIN = 2

# Neighbours whose planar depths differ by more lie on either side of an inner silhouette.
_STEP = 0.2


class Meshes(NamedTuple):
    """The meshes of a scene, and their nesting."""

    parts: list[MeshPart]
    tree: Containment


class View(NamedTuple):
    """One test view, rendered by Blender and by our tracer.

    Attributes:
      name: name of the frame.
      target: image rendered by Blender, sRGB in `[0, 1]`.
      rgb: our rendering.
      psnr: PSNR over the whole image, dB.
      psnr_masked: masked PSNR, dB.
      dropped: share of the throughput that was dropped because the path buffer was full.
      mask_share: share of pixels where mask and traced silhouette differ.
      depth_share: share of pixels away from silhouettes whose depths agree; NaN without a map.
      depth_error: the 99.9th percentile of the depths' difference there, world units.
      normal_degrees: mean angle between both normals of the first surface there, degrees; NaN
        without a map.
    """

    name: str
    target: Float[np.ndarray, "h w 3"]
    rgb: Float[np.ndarray, "h w 3"]
    psnr: float
    psnr_masked: float
    dropped: float
    mask_share: float
    depth_share: float
    depth_error: float
    normal_degrees: float


def check_files(scene: Path) -> list[Finding]:
    """Reads every file named in the transforms, and every EXR next to them.

    A scene made with `--preview` has one split only.
    """
    try:
        scene_folder.check_scene(scene, needed=())
        for path in sorted(scene.glob("**/*.exr")):
            image_files.read_exr(path)
    except ValueError as error:
        return [Finding("error", scene.name, str(error))]
    return []


def check_background(scene: Path) -> list[Finding]:
    """Compares the background in `scene.json` with the depth maps of a split."""
    try:
        properties = scene_properties.read(scene)
        space, size = properties.space, properties.background.extent
        splits = [each for each in SPLITS if (scene / f"transforms_{each}.json").is_file()]
        if size is None or space == "unbounded" or not splits:
            return []
        samples = background_fit.read_samples(scene, split=splits[0])
    except ValueError as error:
        return [Finding("error", scene.name, str(error))]
    kind: background_fit.Kind = "sphere" if space == "spherical" else "cube"
    centre = properties.background.centre or ORIGIN
    fit = samples and background_fit.fit_background(kind, samples, centre=centre)
    if fit is None:
        return []
    off = fit.centre != centre  # which it only is if the depths clearly show another one
    if not off and abs(fit.size - size) <= BACKGROUND * size + fit.error:
        return []
    stated = f"{size:g}" + (f" around ({', '.join(f'{x:g}' for x in centre)})" if off else "")
    message = (
        f"the depth maps show a background {kind} of size {fit.describe()}, but scene.json states "
        f"{stated}. Correct it, or render the depth maps again."
    )
    return [Finding("error", scene.name, message)]


def unknown_light(scene: Path) -> list[str]:
    """Returns the mesh names of opaque parts whose light `scene.json` does not state.

    Colours of such a scene cannot be compared: the tracer does not know how the parts look.
    """
    path = scene / scene_properties.FILE
    if not path.is_file():
        return []
    parts = configuration.parse_json(path.read_text(encoding="utf-8")).get("parts", [])
    return [
        Path(part["mesh"]).name
        for part in parts
        if part.get("kind") == "opaque" and "radiance" not in part
    ]


def check_meshes(scene: Path) -> tuple[Meshes | None, list[Finding]]:
    """Reads and lints the meshes of a scene; returns `None` for unreadable meshes."""
    try:
        parts = meshes.read_meshes(scene)
        rule = known_scene.rule_of(scene_properties.read(scene))
    except ValueError as error:
        return None, [Finding("error", scene.name, str(error))]
    if not parts:
        return None, [Finding("error", scene.name, "the scene has no meshes. Make it again.")]
    tree = mesh_queries.find_containment(parts)
    return Meshes(parts, tree), mesh_checks.lint(parts, tree, rule=rule)


def read_views(scene: Path, made_of: Meshes, *, count: int) -> KnownScene:
    """Reads some evenly spaced test views of a scene, and everything required to render them.

    The rule is that of `scene.json`, or `nested`.
    """
    frames = scene_folder.read_frames(scene, "test")
    last = len(frames.names) - 1
    spread = np.linspace(0, last, min(count, last + 1)).round().astype(int)
    chosen = tuple(int(i) for i in np.unique(spread))
    properties = scene_properties.read(scene)
    rule = known_scene.rule_of(properties)
    return known_scene.build_scene(
        scene, *made_of, frames=frames, chosen=chosen, rule=rule, properties=properties
    )


def compare_view(scene: KnownScene, index: int, *, settings: PathSettings, side: int) -> View:
    """Renders one of a scene's views and compares all available maps."""
    rendered = known_scene.render_view(scene, index, settings=settings, side=side)
    measured = known_scene.measure(scene, index, rendered.rgb)
    first = find_first_surface(
        scene.objects.surfaces, cameras.image_rays(scene.frames.cameras, index)
    )
    depth = cameras.distance_to_planar_depth(scene.frames.cameras, first.distances)
    hit = np.isfinite(depth)
    mask = scene.masks[index] if scene.masks is not None else hit
    inner = away_from_silhouettes(mask, depth)
    errors = _depth_errors(scene, index, depth, inner)
    return View(
        name=scene.frames.names[index],
        target=scene.images[index] / 255.0,
        rgb=rendered.rgb,
        psnr=_number(measured, "psnr"),
        psnr_masked=_number(measured, "psnr_masked"),
        dropped=rendered.dropped,
        mask_share=float(np.mean(mask != hit)),
        depth_share=float(np.mean(errors <= DEPTH)) if errors.size else np.nan,
        depth_error=float(np.quantile(errors, DEPTH_SHARE)) if errors.size else np.nan,
        normal_degrees=_normal_degrees(scene, index, first, inner),
    )


def away_from_silhouettes(
    mask: Bool[np.ndarray, "h w"], depth: Float[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Returns the pixels of an object that are not close to a silhouette.

    Args:
      mask: mask of the object.
      depth: traced planar depth of the first surface; `inf` where there is none.
    """
    finite = np.isfinite(depth)
    filled = np.where(finite, depth, 0.0)
    steps = ndimage.maximum_filter(filled, 3) - ndimage.minimum_filter(filled, 3) > _STEP
    near = ndimage.binary_dilation(steps | ~finite | ~mask, iterations=_MARGIN)
    return finite & mask & ~near


def complaints(
    convex: bool, findings: Sequence[Finding], views: Sequence[View], *, colours: bool = True
) -> list[str]:
    """Returns the failed checks of a scene, in words; empty if the scene may be used.

    Args:
      convex: whether the object is convex; more checks apply then.
      findings: results for its files and meshes; notes do not count as failures.
      views: compared views.
      colours: whether colours count; they cannot where `unknown_light` finds a part.
    """
    least = PSNR_CONVEX if convex else PSNR
    found = [f"{each.part}: {each.message}" for each in findings if each.severity != "note"]
    for view in views:
        if colours and not view.psnr_masked >= least:
            found.append(
                f"{view.name}: {view.psnr_masked:.1f} dB masked PSNR, not at least {least:g}"
            )
        if not view.mask_share <= MASK_SHARE:
            found.append(f"{view.name}: the mask differs in {view.mask_share:.2%} of pixels")
        if view.depth_share < DEPTH_SHARE:
            found.append(
                f"{view.name}: depths agree to {DEPTH:g} in only {view.depth_share:.2%} of pixels"
            )
    return found


def _number(measured: Mapping[str, float | None], key: str) -> float:
    value = measured[key]
    return np.nan if value is None else value


def _depth_errors(
    scene: KnownScene,
    index: int,
    traced: Float[np.ndarray, "h w"],
    inner: Bool[np.ndarray, "h w"],
) -> Float[np.ndarray, " pixels"]:
    """Returns the differences from the float map; none if the map does not exist."""
    depths = scene.frames.depths
    if depths is None or depths[index].suffix != ".exr":
        return np.zeros(0)
    return np.abs(traced[inner] - image_files.read_depth(depths[index])[inner])


def _normal_degrees(
    scene: KnownScene, index: int, first: FirstSurface, inner: Bool[np.ndarray, "h w"]
) -> float:
    image = scene.frames.images[index]
    path = image.parents[1] / "normal" / image.parent.name / f"{image.stem}.exr"
    if not path.is_file() or not inner.any():
        return np.nan
    cosine = np.sum(image_files.read_exr(path) * first.normals, axis=-1)[inner]
    kinds = scene.objects.interfaces.kinds
    if kinds.size:  # an open surface has no outside: either of its two normals is right
        open_ones = np.isin(first.parts, np.flatnonzero(np.asarray(kinds)))[inner]
        cosine = np.where(open_ones, np.abs(cosine), cosine)
    return float(np.degrees(np.mean(np.arccos(np.clip(cosine, -1.0, 1.0)))))
