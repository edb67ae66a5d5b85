"""What Blender renders, against what is known. Needs `make dataset-env`."""

import json
import math
import subprocess
import time

import imageio.v3 as iio
import jax
import numpy as np
import pytest
import trimesh

from experiments.dataset import cameras, frame_files, workers
from experiments.dataset.parts import ObjectPart
from refref_jax.data import meshes
from refref_jax.data.scene_assembly import assemble, read_background
from refref_jax.geometry.cameras import box_filter, image_rays, supersample
from refref_jax.optics.media import interior_length
from refref_jax.optics.path_settings import PathSettings
from refref_jax.render import render_known
from refref_jax.render.backgrounds import radiance_of
from tests.factories import small_dataset
from tests.factories.blender_rooms import Blender, cameras_at, pose, write_room
from tests.processes.command import ROOT

_THOROUGH = PathSettings(48, "all", min_throughput=0.004, truncated_paths="black")

_PYTHON = ROOT / ".venv-dataset" / "bin" / "python"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not _PYTHON.exists(), reason="Blender is missing: make dataset-env"),
]


@pytest.fixture(scope="module")
def blender(tmp_path_factory):
    process = Blender(_PYTHON, tmp_path_factory.mktemp("scratch"))
    yield process
    process.close()


def _ball(radius, name="body", material="glass", **options):
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return ObjectPart(name, material, np.array(mesh.vertices), np.array(mesh.faces), **options)


def _psnr(a, b):
    return -10.0 * math.log10(np.mean((a - b) ** 2))


@pytest.mark.parametrize("kind", ["cube", "sphere", "env"])
def test_every_background_lies_as_the_library_has_it(tmp_path, blender, kind):
    room = write_room(tmp_path / "room", kind)
    radiance = jax.jit(jax.vmap(radiance_of(jax.device_put(read_background(room)))))
    for number in (0, 3, 9):
        rendering = blender.render(room, pose(number), samples=64)
        rays = image_rays(supersample(cameras_at(pose(number)), 5), 0)
        seen = radiance(rays.origins.reshape(-1, 3), rays.directions.reshape(-1, 3))
        wanted = box_filter(np.asarray(seen).reshape(*rays.origins.shape), 5)
        assert _psnr(rendering.linear, wanted) > 45.0
        assert not rendering.mask.any() and not rendering.normal.any()


@pytest.mark.parametrize(("kind", "smooth"), [("cube", True), ("sphere", False), ("env", True)])
def test_depth_mask_and_normal_are_those_of_rays_through_middles(tmp_path, blender, kind, smooth):
    part = _ball(1.7, smooth=smooth)
    room = write_room(tmp_path / "room", kind, [part])
    rendering = blender.render(room, pose(7), seed=5)
    rays = image_rays(cameras_at(pose(7)), 0)
    # Blender holds vertices in single precision.
    vertices = part.vertices.astype(np.float32).astype(np.float64)
    mesh = trimesh.Trimesh(vertices, part.faces, process=False)
    origins, directions = (array.reshape(-1, 3).astype(np.float64) for array in rays[:2])
    points, ray, face = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
    mask = np.zeros(len(origins), bool)
    mask[ray] = True
    np.testing.assert_array_equal(rendering.mask.ravel(), mask)
    distances = _distances_to_walls(kind, origins, directions)
    distances[ray] = np.linalg.norm(points - origins[ray], axis=1)
    depth = distances * (directions @ -pose(7)[:3, 2])
    np.testing.assert_allclose(rendering.depth.ravel(), np.minimum(depth, 1e10), atol=1e-4)
    normals = mesh.face_normals[face]
    if smooth:
        weights = trimesh.triangles.points_to_barycentric(mesh.triangles[face], points)
        normals = np.einsum("fk,fkc->fc", weights, mesh.vertex_normals[part.faces[face]])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(rendering.normal.reshape(-1, 3)[ray], normals, atol=2e-3)
    assert not rendering.normal[~rendering.mask].any()


def _distances_to_walls(kind, origins, directions):
    if kind == "env":
        return np.full(len(origins), np.inf)
    if kind == "cube":
        with np.errstate(divide="ignore"):
            return np.min((7.3 * np.sign(directions) - origins) / directions, axis=1)
    along = np.sum(origins * directions, axis=1)
    return np.sqrt(along**2 - np.sum(origins**2, axis=1) + 7.3**2) - along


def test_absorption_follows_beer_and_lambert(tmp_path, blender):
    absorption = (0.8, 0.25, 0.0)
    # Of index 1 it neither bends nor reflects.
    part = small_dataset.box(2.0, "body", "air", absorption=absorption)
    room = write_room(tmp_path / "room", "cube", [part], white=True)
    rendering = blender.render(room, pose(2), samples=256)
    rays = image_rays(supersample(cameras_at(pose(2)), 8), 0)
    near, far = np.sort([(side - rays.origins) / rays.directions for side in (-1.0, 1.0)], axis=0)
    length = np.maximum(far.min(axis=-1) - near.max(axis=-1), 0.0)
    wanted = box_filter(np.exp(-length[..., None] * np.array(absorption)), 8)
    assert wanted.min() < 0.2
    assert _psnr(rendering.linear, wanted) > 45.0
    np.testing.assert_allclose(rendering.linear.mean((0, 1)), wanted.mean((0, 1)), rtol=1e-3)


@pytest.mark.parametrize(
    ("rule", "inner", "clear"), [("nested", "glass", True), ("facing", "glass", False)]
)
def test_an_interface_between_equal_media_is_seen_under_facing_alone(
    tmp_path, blender, rule, inner, clear
):
    shell, body = _ball(1.8, "shell"), _ball(1.2, "core", inner)
    alone = write_room(tmp_path / "alone", "cube", [shell])
    both = write_room(tmp_path / "both", "cube", [shell, body], rule=rule)
    images = [blender.render(room, pose(4), samples=256).linear for room in (alone, both)]
    assert (_psnr(*images) > 38.0) == clear
    assert _psnr(*images) > 30.0 or not clear


def test_a_tint_multiplies_at_both_crossings(tmp_path, blender):
    part = small_dataset.box(2.0, "body", "air", tint=(0.5, 0.9, 1.0))
    room = write_room(tmp_path / "room", "env", [part], white=True)
    rendering = blender.render(room, pose(2), samples=16)
    middle = rendering.linear[20:28, 20:28]
    np.testing.assert_allclose(middle, np.broadcast_to([0.25, 0.81, 1.0], middle.shape), atol=1e-3)


def _light(blender, folder, part, *, samples=64, number=2, **options):
    """The image of one part in a white environment, and its mask."""
    room = write_room(folder, "env", [part], white=True, **options)
    rendering = blender.render(room, pose(number), samples=samples)
    return rendering.linear, rendering.mask


def test_an_emitter_has_its_radiance_and_its_colours_are_decoded(tmp_path, blender):
    radiance = (0.8, 0.3, 2.5)
    part = _ball(1.5, material="opaque", kind="opaque", radiance=radiance)
    linear, mask = _light(blender, tmp_path / "constant", part)
    np.testing.assert_allclose(linear[20:28, 20:28].mean((0, 1)), radiance, rtol=1e-5)
    colours = np.broadcast_to(np.array([188, 0, 10], np.uint8), part.vertices.shape)
    part = part._replace(radiance=None, colours=colours)
    coloured, same = _light(blender, tmp_path / "colours", part)
    wanted = [((188 / 255 + 0.055) / 1.055) ** 2.4, 0.0, 10 / 255 / 12.92]
    np.testing.assert_allclose(coloured[20:28, 20:28].mean((0, 1)), wanted, rtol=1e-5, atol=1e-7)
    assert mask.any() and np.array_equal(mask, same)


def test_a_diffuse_part_reflects_its_albedo_of_uniform_light(tmp_path, blender):
    albedo = (0.7, 0.2, 0.05)
    part = _ball(1.5, material="opaque", kind="opaque", albedo=albedo, smooth=False)
    linear, mask = _light(blender, tmp_path / "diffuse", part, samples=16)
    # A convex body in light from all sides: no noise, no interreflection.
    np.testing.assert_allclose(linear[20:28, 20:28].mean((0, 1)), albedo, rtol=1e-4)
    assert mask[24, 24]


def test_a_conductor_reflects_as_fresnel_has_it(tmp_path, blender):
    eta, k = np.array([0.143, 0.375, 1.442]), np.array([3.983, 2.386, 1.603])
    part = small_dataset.box(2.0, "body", "conductor", kind="conductor")
    part = part._replace(eta=tuple(eta.tolist()), k=tuple(k.tolist()))
    linear, _ = _light(blender, tmp_path / "metal", part, number=0, samples=4)
    # The camera sees the face at its middle under 10 degrees, where reflectance is that of 0.
    wanted = ((eta - 1.0) ** 2 + k**2) / ((eta + 1.0) ** 2 + k**2)
    np.testing.assert_allclose(linear[24, 24], wanted, rtol=2e-3)


def test_a_thin_sheet_reflects_and_transmits_all_light_without_an_offset(tmp_path, blender):
    grid = np.array([[0.0, y, z] for z in (-1.5, 1.5) for y in (-1.5, 1.5)])
    sheet = ObjectPart("sheet", "glass", grid, np.array([[0, 1, 3], [0, 3, 2]]), smooth=False)
    sheet = sheet._replace(kind="thin_sheet")
    linear, mask = _light(blender, tmp_path / "white", sheet, number=0)
    np.testing.assert_allclose(linear[mask], 1.0, atol=1e-4)
    assert mask[24, 24] and not mask[0, 0]
    # Before black, reflected light is missing: 2 R / (1 + R) at normal incidence.
    room = write_room(tmp_path / "cube", "cube", [sheet], white=True)
    for path in room.glob("background/wall_*.png"):
        if path.stem != "wall_1":  # behind the sheet
            iio.imwrite(path, np.zeros_like(iio.imread(path)))
    rendering = blender.render(room, pose(0), samples=4096)
    single = 0.04
    wanted = 1.0 - 2.0 * single / (1.0 + single)
    np.testing.assert_allclose(rendering.linear[22:26, 22:26].mean(), wanted, atol=3e-3)
    distance = 4.0 / np.cos(np.radians(10.0)) * np.cos(np.radians(10.0))
    np.testing.assert_allclose(rendering.depth[24, 24], distance, atol=0.05)


def test_each_channel_of_a_dispersive_part_has_its_own_index(tmp_path, blender):
    indices = (1.4, 1.5, 1.7)
    images = []
    for name, index in (("all", indices), *((str(each), each) for each in indices)):
        room = write_room(tmp_path / name, "cube", [_ball(1.5)._replace(index=index)])
        images.append(blender.render(room, pose(4), samples=64, seed=3).linear)
    for channel in range(3):
        np.testing.assert_array_equal(images[0][..., channel], images[1 + channel][..., channel])
    assert _psnr(images[1], images[3]) < 35.0


def test_roughness_spreads_light_and_loses_what_microfacets_scatter_twice(tmp_path, blender):
    whole, means = [], []
    for name, roughness, seed in (("clear", 0.0, 0), ("rough", 0.3, 0), ("again", 0.3, 1)):
        part = _ball(1.5)._replace(roughness=roughness)
        white, mask = _light(blender, tmp_path / f"white_{name}", part)
        whole.append(white[mask].mean())
        room = write_room(tmp_path / name, "cube", [part])
        inner = blender.render(room, pose(4), samples=256, seed=seed).linear[16:32, 16:32]
        means.append(inner.reshape(4, 4, 4, 4, 3).mean((1, 3)))
    clear, rough, again = means
    np.testing.assert_allclose(whole[0], 1.0, atol=2e-3)
    assert 0.9 < whole[1] < whole[0] - 1e-3
    # The noise of means over 4 x 4 pixels is far below the difference of the materials.
    assert _psnr(rough, again) > 55.0 and _psnr(rough, clear) < 45.0


def test_threads_and_order_do_not_show(tmp_path, blender):
    parts = [_ball(1.8, "shell"), _ball(1.3, "liquid", "water", absorption=(0.1, 0.4, 0.0))]
    rooms = [write_room(tmp_path / kind, kind, parts) for kind in ("cube", "env")]
    calls = [(room, number) for room in rooms for number in (0, 5)]
    first = [blender.render(room, pose(n), samples=9, seed=n) for room, n in calls]
    other = Blender(_PYTHON, tmp_path, threads=1)
    second = [other.render(room, pose(n), samples=9, seed=n) for room, n in calls[::-1]][::-1]
    other.close()
    for a, b in zip(first, second, strict=True):
        assert all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))
    assert not np.array_equal(first[0].linear, first[1].linear)


def test_our_encoding_is_blenders_standard_view(tmp_path):
    """Blender writes a ramp as PNG, and we encode it."""
    script = """
import sys, bpy, numpy as np
scene = bpy.context.scene
scene.view_settings.view_transform = "Standard"
scene.render.image_settings.file_format = "PNG"
scene.render.dither_intensity = 0.0
ramp = bpy.data.images.new("ramp", 4096, 1, float_buffer=True)
ramp.colorspace_settings.name = "Linear Rec.709"
pixels = np.ones((4096, 4), np.float32)
pixels[:, :3] = np.linspace(-0.1, 1.3, 4096)[:, None]
ramp.pixels.foreach_set(pixels.ravel())
ramp.save_render(sys.argv[1], scene=scene)
"""
    path = tmp_path / "ramp.png"
    subprocess.run([_PYTHON, "-c", script, path], check=True, capture_output=True)
    theirs = iio.imread(path)[0, :, 0].astype(int)
    ours = frame_files.to_srgb(np.linspace(-0.1, 1.3, 4096).astype(np.float32)).astype(int)
    assert np.max(np.abs(ours - theirs)) <= 1
    assert np.mean(ours != theirs) < 0.01


def test_a_process_ends_when_nobody_listens(tmp_path):
    room = write_room(tmp_path / "room", "env", [_ball(1.8)])
    command = [_PYTHON, workers.SCRIPT, "--threads=1"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(command, **pipes, encoding="utf-8") as process:
        assert json.loads(process.stdout.readline())["blender"] == "5.0.1"
        for samples in (1, 1 << 22):
            job = workers.Job(str(room), pose(0).tolist(), cameras.ANGLE_X, samples, 0)
            files = {"colours": [f"{tmp_path}/colour.exr"], "geometry": f"{tmp_path}/geometry.exr"}
            print(json.dumps(job._asdict() | files), file=process.stdin, flush=True)
            if samples == 1:
                assert json.loads(process.stdout.readline()) == {"written": 1}
        # It takes hours to render this one.
        time.sleep(1.0)
        process.stdin.close()
        assert process.wait(timeout=60) == 0
        assert process.stdout.read() == ""


def test_facing_bends_light_where_parts_overlap_as_cycles_does(tmp_path, blender):
    """A hollow ball of glass, and a ball of water that reaches into its wall."""
    wall = trimesh.util.concatenate(
        [
            trimesh.creation.icosphere(4, radius=1.8),
            trimesh.creation.icosphere(4, radius=1.3).copy(),
        ]
    )
    faces = wall.faces.copy()
    inner = np.arange(len(faces)) >= len(faces) // 2
    faces[inner] = faces[inner][:, ::-1]
    cup = ObjectPart("cup", "glass", np.array(wall.vertices), faces)
    water = trimesh.creation.icosphere(4, radius=1.5)
    drink = ObjectPart("drink", "water", np.array(water.vertices), np.array(water.faces))
    room = write_room(tmp_path / "room", "cube", [cup, drink], rule="facing")
    rendering = blender.render(room, pose(4), samples=1024)
    parts = meshes.read_meshes(room)
    scene = jax.device_put(assemble(parts, rule="facing"))
    assert interior_length(scene.interfaces)
    rays = image_rays(supersample(cameras_at(pose(4)), 8), 0)
    seen = render_known(
        scene, radiance_of(jax.device_put(read_background(room))), rays, settings=_THOROUGH
    )
    assert _psnr(rendering.linear, box_filter(np.asarray(seen.linear), 8)) > 38.0
