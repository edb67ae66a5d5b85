"""Blender materials: parts, emissive backgrounds, the world (bpy only).

Cycles keeps no interior list for a ray: at a front face it divides by the index given here, at a
back face it multiplies. So the index must be the ratio of the inside's to the outside's.
Microfacets follow GGX with single scattering, whose alpha is the square of the roughness.
"""

from pathlib import Path
from typing import Any

import bpy

_LINEAR, _SRGB = "Linear Rec.709", "sRGB"
_GLASS = "ShaderNodeBsdfGlass"


COLOURS = "colours"
"""Name of the mesh attribute that holds the light emitted at vertices."""


def of_part(part: dict[str, Any]) -> Any:
    """Returns the material of a part.

    Args:
      part: record of the part in `scene.json`.
    """
    if part.get("kind") == "conductor":
        return _metal(part)
    if part.get("kind") == "opaque":
        return _emitter(part) if "radiance" in part else _diffuse(part)
    return _glass(part)  # also a thin sheet, which is a wall of glass here


def tune_to(material: Any, part: dict[str, Any], channel: int) -> None:
    """Sets the index of refraction of a colour channel in the material of a part."""
    for node in material.node_tree.nodes:
        if node.bl_idname == _GLASS:
            node.inputs["IOR"].default_value = _of_channel(
                part.get("index", part.get("ior_inside")), channel
            ) / _of_channel(part["ior_outside"], channel)


def _of_channel(value: float | list[float], channel: int) -> float:
    return value[channel] if isinstance(value, list) else value


def _glass(part: dict[str, Any]) -> Any:
    """Returns an interface of glass, for the first colour channel."""
    material, nodes, links = new_material(part["mesh"])
    bsdf = nodes.new(_GLASS)
    bsdf.distribution = "GGX"  # a roughness of 0 makes it sharp
    bsdf.inputs["Roughness"].default_value = part.get("roughness", 0.0)
    bsdf.inputs["Color"].default_value = (*part["colour_per_interface"], 1.0)
    tune_to(material, part, 0)
    output = nodes.new("ShaderNodeOutputMaterial")
    links.new(bsdf.outputs["BSDF"], output.inputs["Surface"])
    absorption = part.get("absorption", (0.0, 0.0, 0.0))
    density = max(absorption)
    if density > 0.0:
        # The node's coefficient is density (1 - colour).
        volume = nodes.new("ShaderNodeVolumeAbsorption")
        colour = [1.0 - channel / density for channel in absorption]
        volume.inputs["Color"].default_value = (*colour, 1.0)
        volume.inputs["Density"].default_value = density
        links.new(volume.outputs["Volume"], output.inputs["Volume"])
    return material


def _metal(part: dict[str, Any]) -> Any:
    """Returns the surface of a conductor, relative to the medium outside."""
    material, nodes, links = new_material(part["mesh"])
    bsdf = nodes.new("ShaderNodeBsdfMetallic")
    bsdf.distribution, bsdf.fresnel_type = "GGX", "PHYSICAL_CONDUCTOR"
    bsdf.inputs["Roughness"].default_value = part.get("roughness", 0.0)
    for name, key in (("IOR", "eta"), ("Extinction", "k")):
        bsdf.inputs[name].default_value = [
            _of_channel(part[key], channel) / _of_channel(part["ior_outside"], channel)
            for channel in range(3)
        ]
    output = nodes.new("ShaderNodeOutputMaterial")
    links.new(bsdf.outputs["BSDF"], output.inputs["Surface"])
    return material


def _diffuse(part: dict[str, Any]) -> Any:
    """Returns an opaque surface that is lit by the scene."""
    material, nodes, links = new_material(part["mesh"])
    bsdf = nodes.new("ShaderNodeBsdfDiffuse")
    bsdf.inputs["Color"].default_value = (*part["albedo"], 1.0)
    bsdf.inputs["Roughness"].default_value = 0.0  # Lambert
    output = nodes.new("ShaderNodeOutputMaterial")
    links.new(bsdf.outputs["BSDF"], output.inputs["Surface"])
    return material


def _emitter(part: dict[str, Any]) -> Any:
    """Returns an opaque surface that emits the same light to all directions, on both sides."""
    material, nodes, _ = new_material(part["mesh"])
    if part["radiance"] == "vertex_colours":
        colour = nodes.new("ShaderNodeAttribute")
        colour.attribute_name = COLOURS
        _glow(material, colour)
    else:
        colour = nodes.new("ShaderNodeRGB")
        colour.outputs["Color"].default_value = (*part["radiance"], 1.0)
        _glow(material, colour)
    return material


def wall(image: Path, *, extension: str = "REPEAT") -> Any:
    """Returns an emissive wall with an image mapped by the mesh's UVs."""
    material, nodes, _ = new_material(image.name)
    texture = nodes.new("ShaderNodeTexImage")
    texture.image = _load(image)
    texture.interpolation = "Linear"
    texture.extension = extension
    _glow(material, texture)
    return material


def sphere(image: Path) -> Any:
    """Returns an emissive sphere around the origin, with an image mapped by direction."""
    material, nodes, links = new_material(image.name)
    geometry = nodes.new("ShaderNodeNewGeometry")
    normalise = nodes.new("ShaderNodeVectorMath")
    normalise.operation = "NORMALIZE"
    texture = _equirectangular(nodes, image)
    links.new(geometry.outputs["Position"], normalise.inputs[0])
    links.new(normalise.outputs["Vector"], texture.inputs["Vector"])
    _glow(material, texture)
    return material


def world(image: Path | None) -> Any:
    """Returns an environment map, or a black world."""
    made = bpy.data.worlds.new("world")
    made.use_nodes = True
    made.cycles.sampling_method = "NONE"
    tree = made.node_tree
    tree.nodes.clear()
    background = tree.nodes.new("ShaderNodeBackground")
    background.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
    background.inputs["Strength"].default_value = 1.0
    output = tree.nodes.new("ShaderNodeOutputWorld")
    tree.links.new(background.outputs["Background"], output.inputs["Surface"])
    if image is not None:
        texture = _equirectangular(tree.nodes, image)
        tree.links.new(texture.outputs["Color"], background.inputs["Color"])
    return made


def new_material(name: str) -> tuple[Any, Any, Any]:
    """Returns a material without nodes, its nodes and its links."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    material.node_tree.nodes.clear()
    return material, material.node_tree.nodes, material.node_tree.links


def _glow(material: Any, colour: Any) -> None:
    """Makes a surface emit the colour of a node, without light sampling."""
    nodes, links = material.node_tree.nodes, material.node_tree.links
    emission = nodes.new("ShaderNodeEmission")
    emission.inputs["Strength"].default_value = 1.0
    output = nodes.new("ShaderNodeOutputMaterial")
    links.new(colour.outputs["Color"], emission.inputs["Color"])
    links.new(emission.outputs["Emission"], output.inputs["Surface"])
    material.cycles.emission_sampling = "NONE"


def _equirectangular(nodes: Any, image: Path) -> Any:
    texture = nodes.new("ShaderNodeTexEnvironment")
    texture.image = _load(image)
    texture.interpolation = "Linear"
    texture.projection = "EQUIRECTANGULAR"
    return texture


def _load(path: Path) -> Any:
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = _LINEAR if path.suffix == ".exr" else _SRGB
    return image
