"""Reads the properties of a scene: `scene.json`, and an overlay of the same form (no JAX).

A scene consists of images and meshes; its properties are what these files cannot hold: the
background, the rule for overlapping media, the ambient medium, and the material of each part. All
of them are optional.

    {"version": 1, "rule": "nested", "ambient_index": 1.0, "ior": {"glass": 1.52},
     "background": {"type": "sphere", "radius": 7.3, "image": FILE},
     "parts": [{"mesh": "meshes/cup_glass.ply", "index": 1.5, "shading": "smooth", "priority": 3,
                "tint": [0.9, 1.0, 0.9], "absorption": [0.1, 0.0, 0.1]}]}

`docs/data_formats.md` documents every key. Unknown keys (other than `RECORDS`, which generators
write) and values out of range are errors. Images are in the folder of the file or of the scene.

An overlay holds the properties of a scene whose folder cannot be written to. It is merged key by
key with `scene.json`, and wins; parts are matched by the file name of their mesh.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

from refref_jax import configuration
from refref_jax.choices import CLEAR, NO_ABSORPTION, Colour, Material, PartKind, RuleName, Space
from refref_jax.configuration import (
    UnsuitableError,
    Vector,
    number_within,
    of_type,
    one_of,
    vector_within,
)
from refref_jax.data import FARTHEST, SceneError, file_inside, scene_names

FILE = "scene.json"
"""Name of the file in the scene's folder."""

VERSION = 1
"""Version of the format. Files without a version are of the time before, with the same keys."""

RECORDS: dict[str, tuple[str, ...]] = {
    "": (
        *("scene", "category", "seed", "renderer", "size", "spp", "views", "texture_size"),
        *("render", "camera_radius"),
    ),
    "background": ("texture",),
    "face": ("texture",),
    "part": ("inside", "outside", "ior_outside", "watertight", "faces", "albedo"),
}
"""Keys that generators write as a record, without effect, by the object that contains them."""

Shading = Literal["auto", "smooth", "flat"]
BackgroundKind = Literal["cube", "sphere", "env"]

_SPACES: dict[str, Space] = {"cube": "bounded", "sphere": "spherical", "env": "unbounded"}

# Keys of a background by its type, in addition to those of all types.
_OF_KIND = {"cube": ("half_extent", "faces"), "sphere": ("radius", "image"), "env": ("image",)}

# Keys of a part that its kind needs, and those that have no effect on it.
_NEEDED = {"conductor": ("eta", "k")}
_IDLE = {
    "dielectric": ("eta", "k", "radiance"),
    "opaque": ("eta", "k", "index", "ior_inside", "tint", "absorption", "roughness", "interior"),
    "conductor": ("index", "ior_inside", "absorption", "radiance", "interior"),
    "thin_sheet": ("eta", "k", "absorption", "radiance", "interior"),
}

# The mapping of an image: its name, or the beginning of the formula that generators write.
_PLANAR = ("planar", "point = half_extent*(")
_EQUIRECTANGULAR = ("equirectangular", "u = 0.5 - atan2(y, x)/(2 pi)")
_MAPPINGS = {"cube": _PLANAR, "sphere": _EQUIRECTANGULAR, "env": _EQUIRECTANGULAR}

# Two names of the same property of a part, of which the second is the earlier one.
_TWINS = (("index", "ior_inside"), ("tint", "colour_per_interface"), ("shading", "smooth_normals"))


class PartDescription(NamedTuple):
    """Description of one mesh in `scene.json`, with defaults.

    Attributes:
      index: index of refraction inside, relative to vacuum; `None` if the material decides.
      shading: `smooth`, `flat`, or `auto` for smooth up to the crease angle.
      tint: factor of linear RGB light at every reflection and every crossing, 0 to 1.
      absorption: absorption of the medium inside, linear RGB, per world unit.
      priority: priority under the rule `priority`; the highest wins where parts overlap.
      colour_known: whether tint or absorption is given; if only one is, the other is clear.
      material: kind of the part, and what else its surface and its inside are made of.
    """

    index: float | None = None  # type: ignore[assignment]  # hides tuple.index
    shading: Shading = "auto"
    tint: Colour = CLEAR
    absorption: Colour = NO_ABSORPTION
    priority: int = 0
    colour_known: bool = False
    material: Material = Material()


class Face(NamedTuple):
    """One wall of a background cube; values that are not given are `None`.

    Attributes:
      name: name of the wall.
      image: path of its image.
      normal: outward unit normal.
      u_axis: unit direction to the right of the image.
      v_axis: unit direction to the top of the image.
    """

    name: str
    image: str | None
    normal: Vector | None
    u_axis: Vector | None
    v_axis: Vector | None


@dataclasses.dataclass(frozen=True)
class BackgroundProperties:
    """The background of a scene; values that are not given are `None`.

    Attributes:
      kind: type of the background: `cube`, `sphere` or `env`.
      extent: half the edge of the cube, or radius of the sphere, world units.
      centre: centre of the cube or sphere, world units.
      image: path of the image of a sphere or an environment.
      faces: walls of a cube.
    """

    kind: BackgroundKind | None = None
    extent: float | None = None
    centre: Vector | None = None
    image: str | None = None
    faces: tuple[Face, ...] = ()


@dataclasses.dataclass(frozen=True)
class SceneProperties:
    """The properties of a scene.

    Attributes:
      space: geometry of the background, from its type, or else from the scene's name.
      background: the background.
      rule: interface rule, or `None` if it is not given.
      ambient_index: index of refraction of the medium outside all parts.
      indices: indices of refraction of materials, in addition to those of the data set.
      parts: descriptions of meshes, by the names of their files.
      origins: files that define properties, by the key of the property; for parts, by the name of
        the mesh file.
    """

    space: Space
    background: BackgroundProperties = BackgroundProperties()
    rule: RuleName | None = None
    ambient_index: float = 1.0
    indices: Mapping[str, float] = dataclasses.field(default_factory=dict)
    parts: Mapping[str, PartDescription] = dataclasses.field(default_factory=dict)
    origins: Mapping[str, Path] = dataclasses.field(default_factory=dict)


def read(scene: Path, *, overlay: str | Path | None = None) -> SceneProperties:
    """Reads the properties of a scene.

    Args:
      scene: folder of the scene, with or without `scene.json`.
      overlay: JSON file of the same form whose values override those of `scene.json`, if any.
        Images that it names are relative to its own folder.

    Raises:
      SceneError: if a file is not valid; the message names the file, the key and the remedy.
    """
    files = [Path(overlay)] if overlay else []
    if (scene / FILE).is_file():
        files.insert(0, scene / FILE)
    sources = [_Source(path, _read_file(path, scene)) for path in files]
    content: dict[str, Any] = {}
    for source in sources:
        content = _merged(content, source.content)
    return _built(content, sources, scene)


def check_file(path: Path) -> None:
    """Checks an overlay by itself, before the scene is opened.

    Raises:
      SceneError: if it does not exist or is not valid.
    """
    source = _Source(path, _read_file(path, None))
    _checked(source.content, _TOP, (), [source])
    _checked(source.content.get("background", {}), _BACKGROUND, ("background",), [source])
    for name, part in source.content.get("parts", {}).items():
        _checked(part, _PART, ("parts", name), [source])  # the scene may have what it lacks


def read_part(name: str, description: Mapping[str, Any]) -> PartDescription:
    """Reads the description of a part that is not from a file.

    Raises:
      SceneError: if it is not valid.
    """
    record = dict(description)
    return _part(name, record, [_Source(Path("The material"), {"parts": {name: record}})])


class _Source(NamedTuple):
    """A file of properties, and its content with the parts by the names of their meshes."""

    path: Path
    content: dict[str, Any]


def _read_file(path: Path, scene: Path | None) -> dict[str, Any]:
    if not path.is_file():
        raise SceneError(f"{path} does not exist. Give a JSON file of properties like {FILE}.")
    try:
        content = configuration.parse_json(path.read_text(encoding="utf-8-sig"))
    except ValueError as error:
        raise SceneError(
            f"{path} is not valid JSON ({error}). Correct it, or remove it: it is optional."
        ) from error
    if not isinstance(content, dict):
        raise SceneError(f"{path} is not a JSON object. Correct it, or remove it: it is optional.")
    if "parts" in content:
        content["parts"] = _by_mesh(content["parts"], path)
    if isinstance(background := content.get("background"), dict):
        faces = background.get("faces")
        walls = faces.values() if isinstance(faces, dict) else ()
        for record in (background, *(wall for wall in walls if isinstance(wall, dict))):
            if isinstance(image := record.get("image"), str) and image:
                folders = (path.parent, scene or Path("/"))  # without a scene, nothing is opened
                record["image"] = str(file_inside(folders, image, where="image", path=path))
    return content


def _by_mesh(parts: Any, path: Path) -> dict[str, Any]:
    """Returns the descriptions of parts by the file names of their meshes."""
    if not isinstance(parts, list):
        raise SceneError(
            f"{path}: parts is a {type(parts).__name__}, not a list. Correct it, or remove it."
        )
    found: dict[str, Any] = {}
    for number, part in enumerate(parts):
        mesh = part.get("mesh") if isinstance(part, dict) else None
        if not isinstance(mesh, str) or not Path(mesh).name:
            raise SceneError(
                f"{path}: parts[{number}] does not name a file as its 'mesh'. Correct it, or "
                "remove it."
            )
        name = Path(mesh).name
        if name in found:
            raise SceneError(f"{path}: parts describe {name} twice. Remove one description.")
        found[name] = part
        for one, other in _TWINS:
            if one in part and other in part:
                raise SceneError(
                    f"{path}: parts[{name!r}] has both {one!r} and {other!r}, two names of the "
                    "same property. Remove one."
                )
    return found


def _merged(below: Any, above: Any, key: str = "") -> Any:
    """Returns a value with another one on top; objects are merged key by key."""
    if not isinstance(below, dict) or not isinstance(above, dict):
        return above
    if key == "background" and _kind_of(above) not in (None, _kind_of(below)):
        return above  # the sizes and images of another type of background do not fit
    if "kind" in above and above["kind"] != below.get("kind", "dielectric"):
        return above  # the values of another kind of part do not fit
    twins = {name: pair for pair in _TWINS for name in pair}
    hidden = {other for name in above for other in twins.get(name, ())}
    kept = {name: value for name, value in below.items() if name not in hidden - set(above)}
    return kept | {name: _merged(kept.get(name), above[name], name) for name in above}


def _kind_of(background: Mapping[str, Any]) -> Any:
    """Returns the type of a background, which follows from its other keys if it is not given."""
    if "type" in background:
        return background["type"]
    return next((kind for kind in ("cube", "sphere") if _OF_KIND[kind][0] in background), None)


# ---- Values ----
def _index_or_three(value: Any) -> float | Vector:
    """Returns an index of refraction, or three for red, green and blue: dispersion."""
    return _indices(value) if isinstance(value, list) else _index(value)


def _metal(least: float, sign: str) -> Callable[[Any], Vector]:
    """Returns a check of one number, or three for red, green and blue, from a limit on."""
    three = vector_within(least, _MOST, f"a {sign} number, or three for red, green and blue")
    return lambda value: three(value if isinstance(value, list) else [value] * 3)


def _radiance(value: Any) -> Vector | str:
    return value if value == "vertex_colours" else _light(value)


def _record(value: Any) -> Any:
    return value


# Limits of indices of refraction and of light, whose powers single precision still holds.
_LEAST, _MOST, _BRIGHTEST = 1e-3, 1e3, 1e9

_size = number_within(1e-6, FARTHEST, "a positive number of world units")
_index = number_within(_LEAST, _MOST, "a positive number, such as 1.5 for glass")
_indices = vector_within(_LEAST, _MOST, "a positive number, or three for red, green and blue")
_vector = vector_within(-FARTHEST, FARTHEST, "three numbers")
_tint = vector_within(0.0, 1.0, "three numbers from 0 to 1, since no surface adds light")
_absorption = vector_within(0.0, math.inf, "three numbers that are 0 or positive, per world unit")
_light = vector_within(0.0, _BRIGHTEST, "vertex_colours, or three numbers that are 0 or positive")

_Checks = Mapping[str, Callable[[Any], Any]]

_TOP: _Checks = {
    "version": number_within(1.0, 1.0, f"{VERSION}, the version that this library reads"),
    "rule": one_of(*get_args(RuleName)),
    "ambient_index": _index,
    "ior": _record,
    "background": _record,
    "parts": _record,
    "notes": of_type(str, "text"),
} | dict.fromkeys(RECORDS[""], _record)

_BACKGROUND: _Checks = {
    "type": one_of(*get_args(BackgroundKind)),
    "half_extent": _size,
    "radius": _size,
    "centre": _vector,
    "image": of_type(str, "the name of a file"),
    "faces": _record,
    "mapping": of_type(str, "its name"),
} | dict.fromkeys(RECORDS["background"], _record)

_FACE: _Checks = {
    "image": of_type(str, "the name of a file"),
    "normal": _vector,
    "u_axis": _vector,
    "v_axis": _vector,
} | dict.fromkeys(RECORDS["face"], _record)

_PART: _Checks = {
    "mesh": of_type(str, "the name of a file"),
    "kind": one_of(*get_args(PartKind)),
    "index": _index_or_three,
    "ior_inside": _index_or_three,
    "eta": _metal(_LEAST, "positive"),
    "k": _metal(0.0, "non-negative"),
    "radiance": _radiance,
    "interior": one_of("clear", "absorbing", "field"),
    "shading": one_of(*get_args(Shading)),
    "smooth_normals": of_type(bool, "true or false"),
    "tint": _tint,
    "colour_per_interface": _tint,
    "absorption": _absorption,
    "priority": of_type(int, "a whole number; the highest wins"),
    "roughness": number_within(0.0, 1.0, "a number from 0 to 1"),
} | dict.fromkeys(RECORDS["part"], _record)


# ---- Records ----
def _built(content: dict[str, Any], sources: Sequence[_Source], scene: Path) -> SceneProperties:
    top = _checked(content, _TOP, (), sources)
    materials = _object(content.get("ior", {}), ("ior",), sources)
    background = _background(content.get("background", {}), sources)
    kind = background.kind or scene_names.of_folder(scene).split("_")[0]
    parts, layout = content.get("parts", {}), scene_names.published_rule(scene)
    return SceneProperties(
        space="bounded" if background.kind is None and kind != "env" else _SPACES[kind],
        background=background,
        rule=top.get("rule", layout),
        ambient_index=top.get("ambient_index", 1.0),
        indices=_checked(materials, dict.fromkeys(materials, _index), ("ior",), sources),
        parts={name: _part(name, part, sources) for name, part in parts.items()},
        origins={
            **({"rule": Path("the published layout")} if layout else {}),
            **{key: _origin((key,), sources) for key in content},
            **{name: _origin(("parts", name), sources) for name in parts},
        },
    )


def _background(record: Any, sources: Sequence[_Source]) -> BackgroundProperties:
    keys = ("background",)
    values = _checked(record, _BACKGROUND, keys, sources)
    kind = _kind_of(values)
    if kind is None and values:
        raise _error(keys, sources, f"lacks the key 'type'. Give one of {', '.join(_SPACES)}.")
    others = {key for each, own in _OF_KIND.items() for key in own if each != kind}
    others |= {"centre"} if kind == "env" else set()
    if wrong := sorted((others - set(_OF_KIND.get(kind, ()))) & set(values)):
        raise _error(
            (*keys, wrong[0]),
            sources,
            f"has no effect on a background of type {kind}, which has "
            f"{' and '.join(_OF_KIND[kind])}. Remove it, or correct the type.",
        )
    mapping = values.get("mapping")
    if mapping and mapping != (known := _MAPPINGS[kind])[0] and not mapping.startswith(known[1]):
        raise _refusal((*keys, "mapping"), mapping, sources, f"{known[0]}, the only one")
    walls = _object(values.get("faces", {}), (*keys, "faces"), sources)
    extent = values.get("radius" if kind == "sphere" else "half_extent")
    faces = (_face(name, wall, sources) for name, wall in walls.items())
    centre, image = values.get("centre"), values.get("image")
    return BackgroundProperties(kind, extent, centre, image, tuple(faces))


def _face(name: str, record: Any, sources: Sequence[_Source]) -> Face:
    values = _checked(record, _FACE, ("background", "faces", name), sources)
    return Face(name, *(values.get(key) for key in Face._fields[1:]))


def _part(name: str, record: Any, sources: Sequence[_Source]) -> PartDescription:
    values = _checked(record, _PART, ("parts", name), sources)
    if "smooth_normals" in values:
        values["shading"] = "smooth" if values["smooth_normals"] else "flat"
    for later, earlier in _TWINS[:2]:
        values |= {later: values[earlier]} if earlier in values else {}
    kind = values.get("kind", "dielectric")
    if idle := sorted(set(_IDLE[kind]) & set(values)):
        raise _error(("parts", name, idle[0]), sources, f"has no effect on kind {kind}. Remove it.")
    if missing := sorted(set(_NEEDED.get(kind, ())) - set(values)):
        raise _error(("parts", name), sources, f"lacks the key {missing[0]!r} of a {kind}. Add it.")
    values["material"] = _material(kind, values)
    if isinstance(values.get("index"), tuple):
        values["index"] = values["index"][1]  # the index of green stands for the material
    fields = {key: values[key] for key in PartDescription._fields if key in values}
    known = "tint" in fields or "absorption" in fields
    if known and values.get("interior") == "clear":
        raise _error(("parts", name), sources, "is clear, but has a colour. Remove one of the two.")
    return PartDescription(**fields, colour_known=known or values.get("interior") == "clear")


def _material(kind: PartKind, values: Mapping[str, Any]) -> Material:
    index = values.get("index")
    return Material(
        kind,
        roughness=values.get("roughness", 0.0),
        complex_index=(values["eta"], values["k"]) if kind == "conductor" else None,
        dispersion=index if isinstance(index, tuple) and len(set(index)) > 1 else None,
        interior="field" if values.get("interior") == "field" else None,
        radiance=values.get("radiance"),
    )


def _checked(
    record: Any, checks: _Checks, keys: tuple[str, ...], sources: Sequence[_Source]
) -> dict[str, Any]:
    """Returns the values of an object, converted by the checks of their keys."""
    values = {}
    for key, value in _object(record, keys, sources).items():
        if key not in checks:
            near = configuration.nearest(key, checks)
            remedy = (
                f"Write {near!r}, or remove it." if near else f"The keys are {', '.join(checks)}."
            )
            raise _error((*keys, key), sources, f"is not a known key. {remedy}")
        try:
            values[key] = checks[key](value)
        except UnsuitableError as error:
            raise _refusal((*keys, key), value, sources, str(error)) from None
    return values


def _object(record: Any, keys: tuple[str, ...], sources: Sequence[_Source]) -> dict[str, Any]:
    if not isinstance(record, dict):
        raise _refusal(keys, record, sources, "an object, or remove it: it is optional")
    return record


def _refusal(
    keys: tuple[str, ...], value: Any, sources: Sequence[_Source], wanted: str
) -> SceneError:
    return _error(keys, sources, f"is {configuration.abridged(value)}. Give {wanted}.")


def _error(keys: tuple[str, ...], sources: Sequence[_Source], complaint: str) -> SceneError:
    named = [keys[0][:99]] + [
        f"[{key[:99]!r}]" if above in ("parts", "faces") else f".{key[:99]}"
        for above, key in itertools.pairwise(keys)
    ]
    return SceneError(f"{_origin(keys, sources)}: {''.join(named)} {complaint}")


def _origin(keys: tuple[str, ...], sources: Sequence[_Source]) -> Path:
    """Returns the last file that defines a property."""

    def defines(source: _Source) -> bool:
        value: Any = source.content
        for key in keys:
            if not isinstance(value, dict) or key not in value:
                return False
            value = value[key]
        return True

    return next(source.path for source in reversed(sources) if defines(source))
