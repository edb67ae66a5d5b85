"""Blender materials: glass, emissive backgrounds, the world (bpy only)."""

from pathlib import Path
from typing import Any

import bpy

_LINEAR, _SRGB = "Linear Rec.709", "sRGB"


def glass(part: dict[str, Any]) -> Any:
    """Returns a clear, polished interface.

    Cycles keeps no interior list for a ray: at a front face it divides by the index given here, at
    a back face it multiplies. So the index must be the ratio of the inside's to the outside's.

    Args:
      part: record of the part in `scene.json`.
    """
    material, nodes, links = _new_material(part["mesh"])
    bsdf = nodes.new("ShaderNodeBsdfGlass")
    bsdf.distribution = "GGX"  # a roughness of 0 makes it sharp
    bsdf.inputs["Roughness"].default_value = 0.0
    bsdf.inputs["IOR"].default_value = part["ior_inside"] / part["ior_outside"]
    bsdf.inputs["Color"].default_value = (*part["colour_per_interface"], 1.0)
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


def wall(image: Path) -> Any:
    """Returns an emissive wall with an image mapped by the mesh's UVs."""
    material, nodes, _ = _new_material(image.name)
    texture = nodes.new("ShaderNodeTexImage")
    texture.image = _load(image)
    texture.interpolation = "Linear"
    texture.extension = "REPEAT"
    _glow(material, texture)
    return material


def sphere(image: Path) -> Any:
    """Returns an emissive sphere around the origin, with an image mapped by direction."""
    material, nodes, links = _new_material(image.name)
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


def _new_material(name: str) -> tuple[Any, Any, Any]:
    """Returns a material without nodes, its nodes and its links."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    material.node_tree.nodes.clear()
    return material, material.node_tree.nodes, material.node_tree.links


def _glow(material: Any, texture: Any) -> None:
    """Makes a surface emit a texture's colour, without light sampling."""
    nodes, links = material.node_tree.nodes, material.node_tree.links
    emission = nodes.new("ShaderNodeEmission")
    emission.inputs["Strength"].default_value = 1.0
    output = nodes.new("ShaderNodeOutputMaterial")
    links.new(texture.outputs["Color"], emission.inputs["Color"])
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
