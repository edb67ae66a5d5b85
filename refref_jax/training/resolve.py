"""Resolves a configuration: takes all open decisions of a training run.

    facts = read_facts(config.scene)      # reads and checks the scene (NumPy)
    resolved = resolve(config, facts)     # takes every open decision, with a reason for each
    print(resolved.describe())

A run models only the features that its scene requires, unless the user overrides a decision:
objects that are known to be clear need no absorption, a single convex object needs no re-entry, and
a scene without meshes needs no tracer. This saves computation.

All decisions are taken in this module. The resolved configuration is complete, and resolving it
again changes nothing.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from refref_jax import choices, configuration
from refref_jax.data import (
    background_fit,
    mesh_checks,
    mesh_queries,
    meshes,
    scene_analysis,
    scene_folder,
    scene_names,
    scene_properties,
)
from refref_jax.data.batches import check_batch
from refref_jax.data.mesh_queries import Containment
from refref_jax.data.meshes import MeshPart
from refref_jax.data.scene_analysis import SceneAnalysis
from refref_jax.data.scene_assembly import assemble_scene
from refref_jax.data.scene_properties import SceneProperties
from refref_jax.geometry.cameras import Cameras
from refref_jax.optics.media import INDEX_OF_AIR, Scene
from refref_jax.optics.path_settings import PathSettings, make_path_settings
from refref_jax.render.checkpoint_io import SavedModel
from refref_jax.render.model import ModelConfig, has_foreground
from refref_jax.sampling import scene_bounds
from refref_jax.training import learned_surface, presets
from refref_jax.training.config import (
    BACKDROP_ONLY,
    BACKDROP_PIXELS,
    FIELD_ONLY,
    SceneConfig,
    TrainConfig,
    options_of,
    require,
)

# Reasons for the values of options.
_GIVEN, _USUAL, _KEPT = "given", "by default", "as the configuration has it"


class SceneFacts(NamedTuple):
    """Properties of a scene that decisions depend on.

    Attributes:
      analysis: required features, with the space of `SceneConfig` if that is given.
      cameras: cameras of the training images.
      parts: meshes of the scene.
      tree: containment of the meshes.
      half_extent: half edge of the background cube, or radius of the background sphere, if it is in
        scene.json or measured.
      notes: results of checks, and overridden properties of scene.json.
      rule: interface rule: that of `SceneConfig`, that of scene.json, or `nested`.
      ambient: index of refraction of the medium outside all parts.
      origins: names of the files that define properties, by their keys in scene.json.
      source: reason for `half_extent` and `centre`.
      centre: centre of the background, in scene.json, given or measured.
      stated: source of the kind of the background, such as `scene.json`; empty without one.
      misfits: function of space, size, centre, exposure and `masked` to `scene_analysis.misfits` of
        the scene's images.
    """

    analysis: SceneAnalysis
    cameras: Cameras
    parts: Sequence[MeshPart]
    tree: Containment
    half_extent: float | None
    notes: tuple[str, ...]
    rule: choices.RuleName = "nested"
    ambient: float = INDEX_OF_AIR
    origins: Mapping[str, str] = MappingProxyType({})
    source: str = "scene.json"
    centre: choices.Position = choices.ORIGIN
    stated: str = ""
    misfits: Callable[..., float] | None = None


class Resolved(NamedTuple):
    """A training run with every decision taken.

    Attributes:
      config: complete configuration.
      model: static part of the model: fields, sampling and path settings.
      reasons: reason for the value of each option, by its name.
      warnings: warnings about doubtful overrides.
    """

    config: TrainConfig
    model: SavedModel
    reasons: dict[str, str]
    warnings: tuple[str, ...]

    def describe(self) -> str:
        """Returns the options that the run reads, grouped by the reason for their values."""
        values = {o.name: self.config.get(o.name) for o in options_of()}
        model = self.model.config
        surface = model.backdrop is not None and not has_foreground(model)
        unread = {n for n in FIELD_ONLY if surface and self.reasons.get(n) != _GIVEN}
        unread.update(presets.unread_by_splats(self.config))
        used = {n: x for n, x in values.items() if n not in unread}
        shown = {n: x for n, x in used.items() if x not in (None, (), "", choices.ORIGIN)}
        lines = configuration.describe(shown, self.reasons)
        return "\n".join([*lines, *(f"warning: {each}" for each in self.warnings)])


def read_facts(scene: SceneConfig, *, parts: Sequence[MeshPart] | None = None) -> SceneFacts:
    """Reads and checks a scene (a folder).

    Args:
      scene: configuration of the scene, with the path of a folder.
      parts: objects that replace the scene's own meshes.

    Raises:
      ValueError: if the scene is broken, or a camera is inside a mesh under an unsuitable rule.
    """
    folder = Path(scene.path)
    scene_folder.check_scene(folder)
    cameras = scene_folder.read_frames(folder, "train").cameras
    told = scene_properties.read(folder, overlay=scene.properties)
    if parts is not None:  # they are not those that scene.json describes
        known = {key: path for key, path in told.origins.items() if key != "rule"}
        told = dataclasses.replace(told, rule=None, parts={}, origins=known)
    else:
        parts = meshes.read_meshes(folder, indices=dict(scene.indices), properties=told)
    rule, masked = scene.rule or told.rule or "nested", scene.pixels == "background"
    given: dict[str, Any] = {"space": scene.space, "radius": scene.radius, "centre": scene.centre}
    tree = mesh_queries.find_containment(parts)
    notes = mesh_checks.check_meshes(parts, tree, rule=rule)
    notes += scene_analysis.overridden(told, parts, rule=rule, **given)
    embedded = any(part.material.kind != "dielectric" for part in parts)
    if rule == "priority" or (rule == "facing" and tree.overlaps) or embedded:
        mesh_checks.refuse_cameras_inside(parts, cameras)
    measure = functools.partial(scene_analysis.size_in_images, folder, parts)
    bounds = background_fit.find_bounds(folder, told, **given, measure=measure, cameras=cameras)
    return SceneFacts(
        scene_analysis.analyse(parts, tree, cameras, rule=rule, space=bounds.space),
        cameras,
        parts,
        tree,
        bounds.size,
        (*notes, *bounds.notes),
        *(rule, told.ambient_index, {key: path.name for key, path in told.origins.items()}),
        bounds.source,
        bounds.centre,
        f"background={scene.space}" if scene.space else _statement(folder, told),
        functools.partial(scene_analysis.read_misfits, folder, parts, masked=masked),
    )


def _statement(folder: Path, told: SceneProperties) -> str:
    """Returns what states the kind of a scene's background; nothing if it is assumed."""
    if told.background.kind is not None:
        return told.origins["background"].name
    kind = scene_names.of_folder(folder).split("_")[0]
    return "its name" if kind in scene_names.BACKGROUNDS else ""


def resolve(config: TrainConfig, facts: SceneFacts) -> Resolved:
    """Takes every decision that a configuration leaves open.

    Raises:
      ValueError: if overrides contradict each other or the scene.
    """
    presets.check_splats(config)
    asked, found, reasons = config, facts.analysis, _first_reasons(config)
    config = _decide(config, reasons, facts.origins.get("rule", _USUAL), rule=facts.rule)
    settings, config = _resolve_paths(config, facts, reasons)
    config = _resolve_inside(config, found, settings, reasons)
    model, config = _resolve_model(config, facts, reasons)
    if settings.max_bends:
        settings = dataclasses.replace(settings, reentry=require(config.paths.reentry))
    config = _resolve_training(config, model, reasons)
    check_batch(facts.cameras, require(config.schedule.batch))
    return Resolved(config, SavedModel(model, settings), reasons, _warnings(asked, config, facts))


def build_scene(resolved: Resolved, facts: SceneFacts) -> Scene:
    """Builds the scene for tracing; its parts only have colours if `tints` is `given`.

    The field learns the colour of opaque parts, even if their radiance is known.
    """
    given = resolved.config.model.tints == "given"
    parts = facts.parts if given else meshes.without_colour(facts.parts)
    parts = [part._replace(radiance=None) for part in parts]
    parts = meshes.with_shading(parts, resolved.config.scene.shading)
    rule, (parents, overlaps) = resolved.config.scene.rule or facts.rule, facts.tree
    return assemble_scene(parts, parents, rule=rule, overlaps=overlaps, ambient=facts.ambient)


def _first_reasons(config: TrainConfig) -> dict[str, str]:
    usual, overrides, reasons = TrainConfig(), config.overrides(), {}
    for option in options_of():
        decided = option.field.default is None and option.name not in overrides
        same = config.get(option.name) == usual.get(option.name)
        reasons[option.name] = _USUAL if same else _KEPT if decided else _GIVEN
    return reasons


def _decide(
    config: TrainConfig, reasons: dict[str, str], why: str, /, **values: Any
) -> TrainConfig:
    """Sets options that are open, and records the reason."""
    for name, value in values.items():
        if config.get(name) is None and value is not None:
            config = config.decided(**{name: value})
            reasons[name] = why
    return config


def _resolve_paths(
    config: TrainConfig, facts: SceneFacts, reasons: dict[str, str]
) -> tuple[PathSettings, TrainConfig]:
    found, bends = facts.analysis, config.model.field == learned_surface.KIND
    if found.parts == 0 and not bends and config.paths.name not in (None, "straight"):
        raise ValueError(
            f"There are no meshes that could bend light for paths={config.paths.name}."
            " Add .ply files of the objects to the scene's folder meshes, or use paths=straight."
        )
    if config.paths.name is None and not bends:
        meshes.refuse_missing(facts.parts, facts.origins)
    name, why = presets.usual_paths(config, found.parts)
    config = _decide(config, reasons, why, paths=name)
    if bends and config.paths.name != "straight":
        config = _decide(config, reasons, why, max_bends=learned_surface.BENDS)
    paths = config.paths
    limits: Any = {"min_throughput": paths.min_throughput, "max_bends": paths.max_bends}
    settings = make_path_settings(require(paths.name), **limits)
    if settings.max_bends:
        why = "light may meet the objects again"
        if found.reentry == "impossible" and not bends:
            why = "light that has left one convex object meets none again"
        config = _decide(config, reasons, why, reentry="possible" if bends else found.reentry)
    else:
        presets.check_straight(config)
    why = f"paths={paths.name}"
    return settings, _decide(
        config, reasons, why, min_throughput=settings.min_throughput, max_bends=settings.max_bends
    )


def _resolve_inside(
    config: TrainConfig, found: SceneAnalysis, settings: PathSettings, reasons: dict[str, str]
) -> TrainConfig:
    """Decides the model of the inside of the objects, and the source of their colours."""
    interior: choices.Interior | None
    if config.model.field == learned_surface.KIND:
        learned_surface.check(config, found.parts)
        interior, why = "clear", "field=tnsr, whose surface is that of a clear body"
    elif settings.max_bends == 0:
        interior, why = "field", "straight rays ignore the objects"
    elif found.interior == "clear" and config.model.tints != "learned":
        interior, why = "clear", "the objects are clear in scene.json"
    else:
        interior, why = "absorbing", "objects may absorb light"
    config = _decide(config, reasons, why, interior=interior)
    interior, tints = config.model.interior, config.model.tints
    if interior != "absorbing" or settings.max_bends == 0:
        given_as_clear = tints == "given" and found.tints == "none" and interior == "clear"
        if tints not in (None, "none") and not given_as_clear:
            raise ValueError(
                f"tints={tints} has no effect with interior {interior}"
                f"{'' if settings.max_bends else ' and straight rays'}. Leave it out, or use "
                "interior=absorbing and bent paths."
            )
        model = dataclasses.replace(config.model, tints=None)
        config = dataclasses.replace(config, model=model)
        return _decide(config, reasons, f"interior={interior}", tints="none")
    if tints == "none":
        raise ValueError(
            "tints=none, but an absorbing interior has colours. Use tints=given or learned, or "
            "interior=clear."
        )
    if tints == "given" and found.tints == "learned":
        raise ValueError(
            "tints=given, but scene.json lacks colour_per_interface or absorption of a part. "
            "Describe all parts there, or use tints=learned."
        )
    if found.tints == "learned":
        why = "scene.json does not describe the colours of every part"
        return _decide(config, reasons, why, tints="learned")
    return _decide(config, reasons, "scene.json describes the colours", tints="given")


def _resolve_model(
    config: TrainConfig, facts: SceneFacts, reasons: dict[str, str]
) -> tuple[ModelConfig, TrainConfig]:
    extent, config = _resolve_bounds(config, facts, reasons)
    preset = presets.PRESETS[config.model.preset]
    model = preset.model(extent, require(config.model.interior), field=config.model.field)
    model = learned_surface.place(model, facts.cameras)
    if config.model.field == learned_surface.KIND:
        for why, values in learned_surface.usual(config.model, facts.parts, facts.ambient):
            config = _decide(config, reasons, why, **values)
    learned = facts.analysis.parts if config.model.tints == "learned" else 0
    inside = model.interior == "field" or config.model.field == learned_surface.KIND
    fields = () if inside else facts.analysis.field_parts
    model = dataclasses.replace(model, learned_tints=learned, field_parts=fields)
    config = _resolve_far_field(config, facts, reasons)
    fewer = preset.background_samples(model) if config.model.far_field == "field" else None
    # Images are only compared with the background if it matters.
    if fewer and not config.model.samples_per_ray and _is_surface_alone(config, facts)[0]:
        why = f"preset={config.model.preset}, and only the background is behind the objects"
        config = _decide(config, reasons, why, samples_per_ray=fewer)
    in_front: choices.InFront = "field" if _in_front(config, facts) else "nothing"
    if config.model.exposure == "per_image" and config.model.far_field == "field":
        model = dataclasses.replace(model, learned_gains=len(facts.cameras.poses))
    model = presets.override_model(model, config.model, in_front=in_front)
    why = f"preset={config.model.preset}"
    return model, _decide(config, reasons, why, **presets.sampling_of(model))


def _resolve_far_field(
    config: TrainConfig, facts: SceneFacts, reasons: dict[str, str]
) -> TrainConfig:
    """Decides whether the world behind the objects is a surface, and how to solve for it.

    Raises:
      ValueError: if far_field=backdrop where a field is needed, or an option needs the other.
    """
    needs, model = _needs_of_a_field(config, facts), config.model
    if model.far_field == "backdrop" and needs:
        raise ValueError(
            f"far_field=backdrop cannot model {' and '.join(needs)}. Use far_field=field."
        )
    if model.far_field is None:
        choice, why = _choose_far_field(config, facts, needs)
        config = _decide(config, reasons, why, far_field=choice)
    if config.model.far_field == "backdrop":
        if config.scene.pixels == "background" and _in_front(config, facts):
            raise ValueError("pixels=background cannot train the field in front. Use pixels=all.")
        return _decide(
            config,
            reasons,
            "far_field=backdrop",
            backdrop_resolution=presets.BACKDROP_RESOLUTION,
            iterations=presets.BACKDROP_ITERATIONS,
            most_pixels=BACKDROP_PIXELS,
            exposure="fixed",
            view_dependence="none",
        )
    if "field_ball" not in config.overrides():
        config = config.decided(field_ball=None)
    for name in BACKDROP_ONLY:
        if (value := config.get(name)) is not None:
            raise ValueError(f"{name}={value} needs far_field=backdrop. Add it, or leave this out.")
    return config


def _needs_of_a_field(config: TrainConfig, facts: SceneFacts) -> list[str]:
    """Returns what a backdrop cannot model, even with a field in front of it."""
    others = ("neus", "unisurf", "nunerf", "tnsr", "raydef", "raydef_polyline", "rosenerf")
    needs = {
        "Gaussian splats (field=splats)": config.model.field == presets.SPLATS,
        "straight rays (paths=straight)": facts.analysis.parts > 0 and not config.paths.max_bends,
        "contraction=always": config.model.contraction == "always",
        f"a surface or deformation (field={config.model.field})": config.model.field in others,
    }
    return [name for name, holds in needs.items() if holds]


def _in_front(config: TrainConfig, facts: SceneFacts) -> list[str]:
    """Returns what only a field models in front of a backdrop."""
    needs = {
        "a field inside the objects (interior=field)": config.model.interior == "field",
        "parts whose interior is a field": bool(facts.analysis.field_parts),
        "opaque parts, whose colour a field learns": "opaque" in facts.analysis.embedded,
    }
    return [name for name, holds in needs.items() if holds and config.paths.max_bends]


def _choose_far_field(
    config: TrainConfig, facts: SceneFacts, needs: Sequence[str]
) -> tuple[choices.FarField, str]:
    """Returns the model of the far field, and the reason for it."""
    inside = config.model.interior == "field" and config.paths.max_bends
    if needs or (inside and "interior" in config.overrides()):
        return "field", f"the scene needs a field: {[*needs, *_in_front(config, facts)][0]}"
    read = BACKDROP_ONLY if inside else (*BACKDROP_ONLY, *FIELD_ONLY)
    given = [name for name in read if name in config.overrides()]
    if given:
        choice: choices.FarField = "backdrop" if given[0] in BACKDROP_ONLY else "field"
        return choice, f"{given[0]} is an option of a {choice}"
    alone, why = _is_surface_alone(config, facts)
    return "backdrop" if alone else "field", why


def _is_surface_alone(config: TrainConfig, facts: SceneFacts) -> tuple[bool, str]:
    """Returns whether only the background's surface is behind the objects, and the reason."""
    if facts.misfits is None or not facts.stated:
        return False, "the scene does not state what is behind the objects"
    surface = f"{choices.SURFACES[require(config.scene.space)]} that {facts.stated} states"
    if share := _share_of_misfits(config, facts):
        return False, f"{100.0 * share:.2g} % of the images' patches differ from the {surface}"
    return True, f"behind the objects is the {surface}, as the images show"


def _share_of_misfits(config: TrainConfig, facts: SceneFacts) -> float:
    """Returns the share of the images that differs from the background; 0 if it is small."""
    space, size, centre = (config.get(name) for name in ("background", "radius", "centre"))
    if facts.misfits is None:
        return 0.0
    exposure = config.model.exposure or "fixed"
    where = {"masked": True} if config.model.field_ball else {}  # a field explains what masks show
    share = facts.misfits(space=space, size=size, centre=centre, exposure=exposure, **where)
    return share if share > scene_analysis.MOST_MISFITS else 0.0


def _resolve_bounds(
    config: TrainConfig, facts: SceneFacts, reasons: dict[str, str]
) -> tuple[scene_bounds.Bounds, TrainConfig]:
    """Decides the size of the background, and the near and far planes.

    Raises:
      ValueError: if a far plane is given where paths end at the background.
    """
    space, size = facts.analysis.space, config.scene.radius
    config = _decide(config, reasons, "the scene", background=space)
    why = facts.source if facts.half_extent else "the data set's usual background"
    why = "the cameras" if space == "unbounded" else why
    half, centre = size or facts.half_extent, config.scene.centre or facts.centre
    extent = scene_bounds.bounds(facts.cameras, space=space, radius=half, centre=centre)
    sampled, reason = extent, f"background={space}"
    if config.model.contraction == "always":
        sampled, reason = scene_bounds.contracted(extent, radius=size), "contraction=always"
        if space == "unbounded":
            extent, why = sampled, reason
    far = config.model.far
    if sampled.space != "unbounded" and far not in (None, sampled.far):
        raise ValueError(
            f"far={far:g} has no effect in a {space} scene, whose paths end at the background. "
            "Leave it out, or use contraction=always."
        )
    config = _decide(config, reasons, why, radius=extent.radius)
    config = _decide(config, reasons, facts.source, centre=centre)
    config = _decide(config, reasons, reason, near=sampled.near, far=sampled.far)
    near, far = require(config.model.near), require(config.model.far)
    return dataclasses.replace(sampled, near=near, far=far), config


def _resolve_training(
    config: TrainConfig, model: ModelConfig, reasons: dict[str, str]
) -> TrainConfig:
    why = f"field={config.model.field}"
    config = _decide(config, reasons, why, **presets.losses_of(model, config.losses))
    blurs, rounds = len(require(config.losses.blurs)), len(model.proposals)
    if blurs != rounds:
        raise ValueError(f"{blurs} blurs for {rounds} proposal levels: give one for each, or none.")
    preset = presets.PRESETS[config.model.preset]
    steps = config.schedule.steps or preset.schedule.steps
    schedule = presets.stretched(preset.schedule, require(steps))
    why = f"preset={config.model.preset}"
    config = _decide(config, reasons, why, **presets.schedule_of(schedule))
    presets.check_lengths(config.schedule)
    return config


def _warnings(asked: TrainConfig, config: TrainConfig, facts: SceneFacts) -> tuple[str, ...]:
    warnings, found, given = [], facts.analysis, asked.overrides()
    ignored = [name for name in FIELD_ONLY if name in given]
    asks = config.model.far_field == "backdrop" and given & {"far_field", *BACKDROP_ONLY}
    if asks and ignored and not _in_front(config, facts):
        warnings.append(f"No effect on a backdrop: {', '.join(ignored)}. Use far_field=field.")
    if asks and (share := _share_of_misfits(config, facts)):
        causes = "something is in front of it"
        if config.scene.space != "unbounded":
            causes += f", or its size ({config.scene.radius:g}) or centre is wrong"
        warnings.append(
            f"{100.0 * share:.2g} % of the patches beside the objects differ from the backdrop: "
            f"{causes}. Correct this, or use far_field=field."
        )
    if asked.model.interior == "clear" and found.tints == "given":
        warnings.append(
            "interior=clear, but the objects have colours in scene.json, which will be missing. "
            "Use interior=absorbing."
        )
    if asked.paths.reentry == "impossible" and found.reentry == "possible":
        warnings.append(
            "reentry=impossible, but light that has left these objects may meet them again; "
            "such light will not be traced any further. Leave it out."
        )
    return tuple(warnings)
