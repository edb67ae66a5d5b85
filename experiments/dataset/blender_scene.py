"""Builds a scene folder in Blender and sets Cycles up (bpy, NumPy and the standard library only).

`scene.json` describes the scene: parts, indices of refraction, background, bounces. Positions are
world units, z up; images are mapped as in `refref_jax.render.backgrounds`.

Blender runs this file by its path, in a separate environment, so it imports nothing from the
package.
"""

import math
from pathlib import Path
from typing import Any

import blender_materials
import bpy
import mathutils
import numpy as np

# Thickness of the wall that stands for a thin sheet, world units: far below the size of a pixel,
# and far above rounding in single precision.
_SHEET = 4e-4

WHOLE_PIXEL, MIDDLE = "BOX", "GAUSSIAN"
"""Filters: the mean over a pixel's square, and 1 % of its width around its centre."""

# Near and far clipping distance of the camera, world units.
_NEAR, _FAR = 1e-3, 1e6

# A sphere of 327,680 triangles, which deviates from the exact one by at most 5e-5 world units.
_SUBDIVISIONS = 8


def build(folder: Path, record: dict[str, Any]) -> None:
    """Replaces the current Blender scene, without a camera pose.

    Args:
      folder: folder of the scene; file names are relative to it.
      record: content of its `scene.json`.
    """
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    _set_up_cycles(scene, record["render"]["bounces"])
    _set_up_output(scene, record["size"])
    for number, part in enumerate(record["parts"], start=1):
        vertices, faces, colours = read_ply(folder / part["mesh"])
        if part.get("kind") == "thin_sheet":
            vertices, faces = slab(vertices, faces)
        material = blender_materials.of_part(part)
        body = _add_mesh(part["mesh"], vertices, faces, material, smooth=part["smooth_normals"])
        body.pass_index = number
        if colours is not None:
            layer = body.data.attributes.new(blender_materials.COLOURS, "FLOAT_COLOR", "POINT")
            layer.data.foreach_set("color", _to_linear(colours).ravel())
    _BACKGROUNDS[record["background"]["type"]](folder, record["background"])
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.sensor_fit = "HORIZONTAL"
    camera.data.clip_start, camera.data.clip_end = _NEAR, _FAR
    scene.collection.objects.link(camera)
    scene.camera = camera


def disperses(record: dict[str, Any]) -> bool:
    """Returns whether a part of a scene has an index of refraction per colour channel."""
    return any(isinstance(part.get("index"), list) for part in record["parts"])


def tune_to(record: dict[str, Any], channel: int) -> None:
    """Sets the indices of refraction of a colour channel in the current scene."""
    if not disperses(record):
        return
    for body in bpy.context.scene.objects:
        if body.pass_index:
            part = record["parts"][body.pass_index - 1]
            blender_materials.tune_to(body.data.materials[0], part, channel)


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Reads a mesh written by `scene_setup.write_meshes`.

    Returns:
      Positions `[v, 3]`, corners `[f, 3]`, and 8-bit colours `[v, 3]` if the file has any.
    """
    header, body = path.read_bytes().split(b"end_header\n", 1)
    counts = {}
    for line in header.decode("ascii").splitlines():
        if line.startswith("element "):
            _, name, count = line.split()
            counts[name] = int(count)
    coloured = b"property uchar red" in header
    fields = [("position", "<f4", 3), *[("colour", "u1", 4)] * coloured]
    vertices = np.frombuffer(body, np.dtype(fields), counts["vertex"])
    face = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
    faces = np.frombuffer(body, face, counts["face"], offset=vertices.nbytes)["corners"]
    return vertices["position"], faces, vertices["colour"][:, :3] if coloured else None


def slab(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns a thin wall around an open surface, half of its thickness on either side.

    The wall's rim has vertices of its own, so that it does not bend the normals of the sides.

    Args:
      vertices: positions of the surface.
      faces: its corners.
    """
    a, b, c = (vertices[faces[:, corner]].astype(np.float64) for corner in range(3))
    normals = np.zeros(vertices.shape)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], np.cross(b - a, c - a))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    front, back = (vertices + side * 0.5 * _SHEET * normals for side in (1.0, -1.0))
    count = len(vertices)
    edges = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64)
    rim = edges[~np.isin(edges @ [count, 1], edges @ [1, count])]
    first, second = 2 * count + rim.T
    strip = [
        np.stack([second, first, first + count], 1),
        np.stack([second, first + count, second + count], 1),
    ]
    return (
        np.concatenate([front, back, front, back]),
        np.concatenate([faces, faces[:, ::-1] + count, *strip]),
    )


def _to_linear(colours: np.ndarray) -> np.ndarray:
    """Decodes 8-bit sRGB as linear RGBA (IEC 61966-2-1)."""
    share = colours / 255.0
    linear = np.where(share > 0.04045, ((share + 0.055) / 1.055) ** 2.4, share / 12.92)
    return np.column_stack([linear, np.ones(len(linear))]).astype(np.float32)


def use_gpu() -> None:
    """Renders on all GPUs of the first kind that Blender finds.

    Raises:
      RuntimeError: if it finds none.
    """
    preferences = bpy.context.preferences.addons["cycles"].preferences
    for kind in ("OPTIX", "CUDA", "HIP", "ONEAPI", "METAL"):
        try:
            preferences.compute_device_type = kind
        except TypeError:  # not a kind of this platform
            continue
        preferences.get_devices()
        if gpus := [device for device in preferences.devices if device.type == kind]:
            for device in preferences.devices:
                device.use = device in gpus
            bpy.context.scene.cycles.device = "GPU"
            return
    raise RuntimeError("Blender finds no GPU; use --device=CPU")


def _set_up_cycles(scene: Any, bounces: int) -> None:
    """Disables all settings that trade correctness for noise or speed; see the comments."""
    scene.render.engine = "CYCLES"
    scene.render.use_persistent_data = True
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.use_auto_tile = False
    # A constant number of samples, and no denoising.
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = False
    cycles.sampling_pattern = "TABULATED_SOBOL"
    cycles.use_light_tree = False
    # Energy is preserved: no clamping, no filtering of glossy paths, no early end of reflections.
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.blur_glossy = 0.0
    cycles.caustics_reflective = cycles.caustics_refractive = True
    for kind in ("max", "diffuse", "glossy", "transmission", "volume", "transparent_max"):
        setattr(cycles, f"{kind}_bounces", bounces)


def _set_up_output(scene: Any, size: int) -> None:
    """Writes square float EXRs with linear light, planar depth, normal and object index."""
    render = scene.render
    render.resolution_x = render.resolution_y = size
    render.resolution_percentage = 100
    render.use_compositing = render.use_sequencer = False
    render.dither_intensity = 0.0
    scene.view_settings.view_transform = "Standard"
    settings = render.image_settings
    settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format = "OPEN_EXR_MULTILAYER"
    settings.color_depth = "32"
    settings.exr_codec = "NONE"
    layer = scene.view_layers[0]
    layer.use_pass_z = layer.use_pass_normal = layer.use_pass_object_index = True


def _add_mesh(
    name: str, vertices: np.ndarray, faces: np.ndarray, material: Any, *, smooth: bool
) -> Any:
    """Adds polygons, all with the same number of corners, as an object with one material."""
    mesh = bpy.data.meshes.new(name)
    corners = faces.shape[1]
    mesh.vertices.add(len(vertices))
    mesh.vertices.foreach_set("co", np.ascontiguousarray(vertices, np.float32).ravel())
    mesh.loops.add(faces.size)
    mesh.loops.foreach_set("vertex_index", np.ascontiguousarray(faces, np.int32).ravel())
    mesh.polygons.add(len(faces))
    starts = np.arange(0, faces.size, corners, dtype=np.int32)
    mesh.polygons.foreach_set("loop_start", starts)
    mesh.polygons.foreach_set("use_smooth", np.full(len(faces), smooth))
    mesh.materials.append(material)
    mesh.update(calc_edges=True)
    if mesh.validate():
        raise ValueError(f"{name} has faces that Blender rejects. Generate the mesh again.")
    added = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(added)
    return added


def _add_cube(folder: Path, record: dict[str, Any]) -> None:
    _set_world(None)
    half = record["half_extent"]
    for name, wall in record["faces"].items():
        normal, u_axis, v_axis = (np.array(wall[key]) for key in ("normal", "u_axis", "v_axis"))
        uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        places = 2.0 * uv - 1.0
        vertices = half * (normal + places[:, :1] * u_axis + places[:, 1:] * v_axis)
        material = blender_materials.wall(folder / wall["image"])
        plane = _add_mesh(name, vertices, np.array([[0, 1, 2, 3]]), material, smooth=False)
        layer = plane.data.uv_layers.new(name="uv")
        layer.data.foreach_set("uv", uv.astype(np.float32).ravel())


def _add_surfaces(folder: Path, record: dict[str, Any]) -> None:
    """Adds rectangles that emit the light of their images, as `room.Surface` describes them."""
    _set_world(None)
    for surface in record["surfaces"]:
        material = blender_materials.wall(folder / surface["image"], extension="EXTEND")
        add_rectangle(surface, material)


def add_rectangle(surface: dict[str, Any], material: Any) -> Any:
    """Adds a rectangle with the corner and the sides of a record, and returns it."""
    corner, along, up = (np.array(surface[key]) for key in ("corner", "along", "up"))
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    vertices = corner + uv[:, :1] * along + uv[:, 1:] * up
    faces = np.array([[0, 1, 2, 3]])
    plane = _add_mesh(surface["name"], vertices, faces, material, smooth=False)
    layer = plane.data.uv_layers.new(name="uv")
    layer.data.foreach_set("uv", uv.astype(np.float32).ravel())
    return plane


def _add_nothing(folder: Path, record: dict[str, Any]) -> None:
    del folder, record
    _set_world(None)


def _add_sphere(folder: Path, record: dict[str, Any]) -> None:
    _set_world(None)
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=_SUBDIVISIONS, radius=1.0)
    sphere = bpy.context.object
    directions = np.empty(3 * len(sphere.data.vertices), np.float32)
    sphere.data.vertices.foreach_get("co", directions)
    directions = directions.reshape(-1, 3)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # Vertices lie as far outside the exact sphere as the centres of the largest triangle inside.
    corners = np.empty(3 * len(sphere.data.polygons), np.int32)
    sphere.data.loops.foreach_get("vertex_index", corners)
    middles = directions[corners.reshape(-1, 3)].mean(axis=1)
    inset = 1.0 - np.linalg.norm(middles, axis=1).min()
    scale = record["radius"] * (1.0 + 0.5 * inset)
    sphere.data.vertices.foreach_set("co", (scale * directions).ravel())
    sphere.data.materials.append(blender_materials.sphere(folder / record["image"]))


def _add_environment(folder: Path, record: dict[str, Any]) -> None:
    _set_world(folder / record["image"])


def _set_world(image: Path | None) -> None:
    bpy.context.scene.world = blender_materials.world(image)


_BACKGROUNDS = {
    "cube": _add_cube,
    "sphere": _add_sphere,
    "env": _add_environment,
    "surfaces": _add_surfaces,
    "none": _add_nothing,
}


def place_camera(pose: list[list[float]], angle_x: float) -> None:
    """Moves the camera.

    Args:
      pose: camera-to-world matrix, 4 x 4; the camera looks along -z, y up.
      angle_x: horizontal field of view in radians.
    """
    camera = bpy.context.scene.camera
    camera.matrix_world = mathutils.Matrix(pose)
    camera.data.lens = 0.5 * camera.data.sensor_width / math.tan(0.5 * angle_x)


def filter_over(pixel_filter: str) -> None:
    """Sets the pixel filter to `WHOLE_PIXEL` or `MIDDLE`.

    Cycles sends the first sample through the centre of any filter, but looks up its position in a
    coarse table, with errors of 0.001 of the width.
    """
    cycles = bpy.context.scene.cycles
    cycles.pixel_filter_type = pixel_filter
    cycles.filter_width = 0.01  # of GAUSSIAN; BOX has always 1
