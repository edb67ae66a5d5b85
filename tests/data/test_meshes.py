import json

import numpy as np
import pytest
import trimesh

from refref_jax.data import meshes
from tests.factories.small_scenes import truncate
from tests.factories.solids import ball
from tests.laws.expectations import scene_error

# Meshes are stored in single precision.
_SINGLE = 1e-7

_ASCII_HEADER = """ply
format ascii 1.0
element vertex {vertices}
property float x
property float y
property float z
element face {faces}
property list uchar int vertex_indices
end_header
"""

_CORNERS = ["0 0 0", "1 0 0", "1 1 0", "0 1 0"]


def _ply(part, encoding="binary"):
    content = trimesh.Trimesh(part.vertices, part.faces, process=False).export(
        file_type="ply", encoding=encoding
    )
    return content if isinstance(content, bytes) else content.encode()


def _write_text(path, faces, vertices=_CORNERS):
    header = _ASCII_HEADER.format(vertices=len(vertices), faces=len(faces))
    path.write_text(header + "\n".join([*vertices, *faces]) + "\n", encoding="ascii")
    return path


@pytest.fixture
def ply(tmp_path):
    return tmp_path / "ball_glass.ply"


@pytest.fixture
def make_scene(tmp_path):
    """Makes a scene of balls with the given file names."""

    def make(*names, folder="cube_smcvx_toy"):
        scene = tmp_path / folder
        (scene / "meshes").mkdir(parents=True)
        for name in names:
            (scene / "meshes" / name).write_bytes(_ply(ball()))
        return scene

    return make


def _index(scene, indices=None):
    [part] = meshes.read_meshes(scene, indices=indices)
    return part.index


@pytest.mark.parametrize(
    ("name", "index"),
    [
        ("glass.ply", 1.5),
        ("ball_glass.ply", 1.5),
        ("cup_water.ply", 1.333),
        ("ring_diamond.ply", 2.418),
        ("bubble_air.ply", 1.0),
        ("drink_alcohol.ply", 1.36),
        ("cap_plastic.ply", 1.45),
        ("bottle_perfume.ply", 1.46),
        ("perfume_red_glass.ply", 1.5),
        ("glass_perfume.ply", 1.46),
        ("glass_body_01.ply", 1.5),
        ("my old cup_water.ply", 1.333),
        ("cup_water_with some ice.ply", 1.333),
    ],
)
def test_the_last_known_word_of_the_file_name_is_the_material(make_scene, name, index):
    assert _index(make_scene(name)) == index


@pytest.mark.parametrize("folder", ["water", "cube_water", "diamond water_air"])
def test_the_folder_s_name_is_no_material(make_scene, folder):
    assert _index(make_scene("ball_glass.ply", folder=folder)) == 1.5


def test_an_unknown_material_is_not_taken_from_the_folder(make_scene):
    scene = make_scene("ball.ply", folder="water_glass")
    with scene_error("ball.ply", "unknown"):
        meshes.read_meshes(scene)


def test_an_unknown_material_names_the_words_and_the_remedy(make_scene):
    scene = make_scene("ball_wood.ply")
    with scene_error(
        "ball_wood.ply", *meshes.INDEX_OF_REFRACTION, "in indices, as {'ball_wood': 1.5}", "Rename"
    ):
        meshes.read_meshes(scene)


@pytest.mark.parametrize(
    ("overrides", "index"),
    [
        ({"glass": 1.6}, 1.6),
        ({"red_glass": 1.7}, 1.7),
        ({"glass": 1.6, "red_glass": 1.7}, 1.7),
        ({}, 1.5),
        (None, 1.5),
    ],
)
def test_a_part_s_own_index_wins_over_its_material_s(make_scene, overrides, index):
    assert _index(make_scene("red_glass.ply"), overrides) == index


def test_an_index_for_one_part_leaves_the_others(make_scene):
    scene = make_scene("a_glass.ply", "b_glass.ply", "c_water.ply")
    parts = meshes.read_meshes(scene, indices={"b_glass": 1.7, "water": 1.3})
    assert [(part.name, part.index) for part in parts] == [
        ("a_glass", 1.5),
        ("b_glass", 1.7),
        ("c_water", 1.3),
    ]


@pytest.mark.parametrize("name", ["ball_honey.ply", "honey.ply"])
def test_an_index_may_add_a_material(make_scene, name):
    assert _index(make_scene(name), {"honey": 1.48}) == 1.48


def test_the_table_of_indices_stays_as_it_is(make_scene):
    before = dict(meshes.INDEX_OF_REFRACTION)
    meshes.read_meshes(make_scene("ball_glass.ply"), indices={"glass": 1.7})
    assert before == meshes.INDEX_OF_REFRACTION


@pytest.mark.parametrize("name", ["water", "ball_water", "Glass", "ball_glass.ply", ""])
def test_an_index_that_fits_no_mesh(make_scene, name):
    scene = make_scene("ball_glass.ply")
    with scene_error(repr(name), "fits no mesh", "ball_glass.ply"):
        meshes.read_meshes(scene, indices={name: 1.4})


@pytest.mark.parametrize("name", ["ball", "water"])
def test_an_index_for_a_word_that_is_not_the_material(make_scene, name):
    """The material is the last known word, so this index would change nothing, silently."""
    scene = make_scene("water_ball_glass.ply")
    with scene_error(repr(name), "water_ball_glass.ply"):
        meshes.read_meshes(scene, indices={name: 1.4})


def test_an_index_for_a_scene_without_meshes(make_scene):
    with scene_error("'glass'", "none"):
        meshes.read_meshes(make_scene(), indices={"glass": 1.5})


@pytest.mark.parametrize("index", [0.0, -1.5, np.nan, np.inf, -np.inf])
def test_an_index_that_is_not_positive_and_finite(make_scene, index):
    scene = make_scene("ball_glass.ply")
    with scene_error("'glass'", str(index), "Give a positive number"):
        meshes.read_meshes(scene, indices={"glass": index})


# Folders and scene.json.


def test_no_mesh_is_no_part(make_scene, tmp_path):
    assert meshes.read_meshes(make_scene()) == []
    assert meshes.read_meshes(tmp_path / "absent") == []


def test_parts_are_ordered_by_name_and_other_files_are_left_alone(make_scene):
    scene = make_scene("b_glass.ply", "a_glass.ply", "C_glass.ply")
    (scene / "meshes" / "notes.txt").write_text("no mesh", encoding="utf-8")
    assert [p.name for p in meshes.read_meshes(scene)] == ["C_glass", "a_glass", "b_glass"]


def test_a_described_mesh_that_is_missing_is_named(make_scene):
    content = {"parts": [{"mesh": "meshes/other_glass.ply"}, {"mesh": "meshes/ball_glass.ply"}]}
    scene = make_scene("ball_glass.ply")
    (scene / "scene.json").write_text(json.dumps(content), encoding="utf-8")
    with scene_error("other_glass.ply", "Restore the mesh"):
        meshes.read_meshes(scene)


@pytest.mark.parametrize(
    ("content", "shading"),
    [
        (None, "auto"),
        ({}, "auto"),
        ({"parts": []}, "auto"),
        ({"parts": [{"mesh": "meshes/ball_glass.ply"}]}, "auto"),
        ({"parts": [{"mesh": "meshes/ball_glass.ply", "smooth_normals": True}]}, "smooth"),
        ({"parts": [{"mesh": "ball_glass.ply", "smooth_normals": False}]}, "flat"),
    ],
)
def test_scene_json_gives_the_shading(make_scene, content, shading):
    scene = make_scene("ball_glass.ply")
    if content is not None:
        (scene / "scene.json").write_text(json.dumps(content), encoding="utf-8")
    [part] = meshes.read_meshes(scene)
    assert part.shading == shading


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b'{"parts": [',
        b"\xff\xfe",
        b"[]",
        b'{"parts": null}',
        b'{"parts": [7]}',
        b'{"parts": [{"smooth_normals": true}]}',
        b'{"parts": [{"mesh": 7, "smooth_normals": true}]}',
    ],
)
def test_broken_scene_json(make_scene, content):
    scene = make_scene("ball_glass.ply")
    (scene / "scene.json").write_bytes(content)
    with scene_error("scene.json", "Correct it, or remove it"):
        meshes.read_meshes(scene)


def _described(make_scene, **values):
    scene = make_scene("cup_glass.ply")
    content = {"parts": [{"mesh": "meshes/cup_glass.ply", **values}]}
    (scene / "scene.json").write_text(json.dumps(content), encoding="utf-8")
    return scene


def test_scene_json_gives_colour_and_priority(make_scene):
    colours = {"colour_per_interface": [0.5, 0, 1], "absorption": [0, 7, 0.1]}
    [part] = meshes.read_meshes(_described(make_scene, **colours, priority=-3))
    assert (part.tint, part.absorption, part.priority) == ((0.5, 0.0, 1.0), (0.0, 7.0, 0.1), -3)
    assert (part.index, part.shading) == (1.5, "auto")


def test_a_part_is_clear_unless_scene_json_says_otherwise(make_scene):
    [part] = meshes.read_meshes(_described(make_scene))
    assert (part.tint, part.absorption, part.priority) == ((1.0,) * 3, (0.0,) * 3, 0)


def test_colour_can_be_left_to_the_field(make_scene):
    scene = _described(make_scene, colour_per_interface=[0.5] * 3, absorption=[1] * 3, priority=2)
    [coloured] = meshes.read_meshes(scene)
    [clear] = meshes.without_colour([coloured])
    assert (clear.tint, clear.absorption, clear.priority) == ((1.0,) * 3, (0.0,) * 3, 2)
    np.testing.assert_array_equal(clear.vertices, coloured.vertices)


@pytest.mark.parametrize(
    ("overrides", "index"), [({}, 1.44), ({"glass": 1.6}, 1.6), ({"cup_glass": 1.7}, 1.7)]
)
def test_the_index_of_scene_json_stands_between_the_table_and_the_user(
    make_scene, overrides, index
):
    assert _index(_described(make_scene, ior_inside=1.44), overrides) == index


def test_scene_json_makes_a_material_known(make_scene):
    scene = make_scene("cup.ply")
    content = {"parts": [{"mesh": "cup.ply", "ior_inside": 2}]}
    (scene / "scene.json").write_text(json.dumps(content), encoding="utf-8")
    assert _index(scene) == 2.0


@pytest.mark.parametrize("key", ["colour_per_interface", "absorption"])
@pytest.mark.parametrize(
    "value",
    [
        [1, 1],
        [1] * 4,
        [1, 1, -0.1],
        [1, 1, np.nan],
        [1, 1, np.inf],
        [1, 1, 10**400],
        [1, 1, "1"],
        [1, 1, True],
        0.5,
        "red",
        None,
        {"r": 1},
    ],
    ids=lambda value: str(value)[:20],
)
def test_a_colour_that_is_none(make_scene, key, value):
    with scene_error("scene.json", "cup_glass.ply", key, "Give three numbers"):
        meshes.read_meshes(_described(make_scene, **{key: value}))


@pytest.mark.parametrize("value", [0, -1.5, np.nan, np.inf, "1.5", None, True, [1.5]], ids=str)
def test_an_index_of_scene_json_that_is_none(make_scene, value):
    with scene_error("scene.json", "cup_glass.ply", "ior_inside", "Give a positive number"):
        meshes.read_meshes(_described(make_scene, ior_inside=value))


@pytest.mark.parametrize("value", [1.5, 2.0, "2", None, True, [1], np.nan], ids=str)
def test_a_priority_that_is_none(make_scene, value):
    with scene_error("scene.json", "cup_glass.ply", "priority", "Give a whole number"):
        meshes.read_meshes(_described(make_scene, priority=value))


def test_shading_is_true_or_false(make_scene):
    with scene_error("smooth_normals", "'false'", "Give true or false"):
        meshes.read_meshes(_described(make_scene, smooth_normals="false"))


@pytest.mark.parametrize("encoding", ["binary", "ascii"])
def test_a_mesh_survives_the_round_trip(ply, encoding):
    part = ball(centre=(1.0, -2.0, 3.0))
    ply.write_bytes(_ply(part, encoding))
    vertices, faces = meshes.read_mesh(ply)
    assert vertices.dtype == np.float64
    assert faces.shape == part.faces.shape
    # Vertices may come in another order, but triangles and their turning sense do not.
    np.testing.assert_allclose(vertices[faces], part.vertices[part.faces], atol=10.0 * _SINGLE)


@pytest.mark.parametrize("duplicates", [3, 6])
def test_a_soup_of_triangles_is_merged(ply, duplicates):
    part = ball()
    corners = np.repeat(part.vertices[part.faces].reshape(-1, 3), duplicates // 3, axis=0)
    faces = np.arange(0, len(corners), duplicates // 3).reshape(-1, 3)
    ply.write_bytes(_ply(part._replace(vertices=corners, faces=faces)))
    vertices, faces = meshes.read_mesh(ply)
    assert vertices.shape == part.vertices.shape
    assert faces.max() < len(vertices)
    np.testing.assert_allclose(vertices[faces], part.vertices[part.faces], atol=_SINGLE)


@pytest.mark.parametrize(
    ("names", "values"),
    [
        ("nx ny nz", ["0 0 1"] * 3 + ["1 0 0"] * 3),
        ("s t", ["0 0", "1 0", "0 1", "0.5 0.5", "0.2 0.3", "0.1 0.1"]),
    ],
    ids=["normals", "texture"],
)
def test_equal_positions_are_merged_whatever_else_they_carry(ply, names, values):
    corners = ["0 0 0", "1 0 0", "0 1 0", "1 0 0", "0 1 0", "0 0 1"]
    lines = [f"{corner} {value}" for corner, value in zip(corners, values, strict=True)]
    _write_text(ply, ["3 0 1 2", "3 3 5 4"], lines)
    extra = "".join(f"property float {name}\n" for name in names.split())
    ply.write_text(ply.read_text(encoding="ascii").replace("element face", extra + "element face"))
    vertices, faces = meshes.read_mesh(ply)
    assert vertices.shape == (4, 3)
    assert faces.shape == (2, 3)


def test_quadrangles_become_triangles(ply):
    vertices, faces = meshes.read_mesh(_write_text(ply, ["4 0 1 2 3"]))
    assert faces.shape == (2, 3)
    corners = vertices[faces]
    areas = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    np.testing.assert_allclose(areas, [[0.0, 0.0, 0.5]] * 2)


@pytest.mark.parametrize("faces", [[], ["2 0 1"]], ids=["none", "an-edge"])
def test_a_mesh_without_triangles(ply, faces):
    with scene_error(ply.name, "no triangles", "Export the mesh again"):
        meshes.read_mesh(_write_text(ply, faces))


def test_a_cloud_of_points(ply):
    header = _ASCII_HEADER.format(vertices=4, faces=0)
    lines = [line for line in header.splitlines() if "face" not in line and "list" not in line]
    ply.write_text("\n".join(lines + _CORNERS) + "\n", encoding="ascii")
    with scene_error(ply.name, "again"):
        meshes.read_mesh(ply)


@pytest.mark.parametrize("encoding", ["binary", "ascii"])
@pytest.mark.parametrize("kept", [0.0, 0.01, 0.3, 0.6, 0.8, 0.95])
def test_a_truncated_mesh(ply, encoding, kept):
    ply.write_bytes(_ply(ball(), encoding))
    truncate(ply, kept)
    with scene_error(ply.name, "again"):
        meshes.read_mesh(ply)


def test_a_text_mesh_cut_between_two_lines(ply):
    _write_text(ply, ["3 0 1 2", "3 0 2 3"])
    lines = ply.read_text(encoding="ascii").splitlines()[:-1]
    ply.write_text("\n".join(lines) + "\n", encoding="ascii")
    with scene_error(ply.name, "again"):
        meshes.read_mesh(ply)


def test_a_file_that_is_no_mesh(ply):
    ply.write_bytes(b"not a mesh")
    with scene_error(ply.name, "export it again"):
        meshes.read_mesh(ply)


@pytest.mark.parametrize("face", ["3 0 1 4", "3 0 1 -1"])
def test_a_face_that_refers_to_no_vertex(ply, face):
    with scene_error(ply.name, "again"):
        meshes.read_mesh(_write_text(ply, ["3 0 1 2", face]))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_vertex_that_is_not_finite(ply, value):
    part = ball()
    vertices = part.vertices.copy()
    vertices[part.faces[7, 1], 2] = value
    ply.write_bytes(_ply(part._replace(vertices=vertices)))
    with scene_error(ply.name, "not finite", "Clean the mesh"):
        meshes.read_mesh(ply)
