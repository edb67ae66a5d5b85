import json
import shutil

import numpy as np
import pytest
import trimesh

from refref_jax.data import mesh_queries, meshes, scene_analysis
from refref_jax.data.mesh_queries import is_convex
from refref_jax.data.scene_analysis import analyse, describe
from refref_jax.geometry.cameras import image_rays, orbit
from refref_jax.training.config import SceneConfig
from refref_jax.training.resolve import read_facts
from tests.factories import solids
from tests.factories.cut_ball import BALL

_CAMERAS = orbit(4, distance=4.0, elevation=0.3, size=8, angle_x=1.0)


def _analysis(*parts, rule="nested", space="bounded", cameras=_CAMERAS):
    tree = mesh_queries.find_containment(parts)
    return analyse(parts, tree, cameras, rule=rule, space=space)


def _clear(part):
    return part._replace(colour_known=True)


def _made(mesh):
    return solids.as_part(mesh, "solid_glass")


def _turned(mesh, dtype=np.float32):
    """The mesh in an arbitrary attitude, rounded as a file rounds it, equal corners merged."""
    axis = np.array([0.36, 0.48, 0.8])
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.7, axis))
    return _made(trimesh.Trimesh(mesh.vertices.astype(dtype), mesh.faces))


def _subdivided_box():
    mesh = trimesh.creation.box()
    for _ in range(4):
        mesh = mesh.subdivide()
    return mesh


def _dented(depth):
    """A ball one of whose vertices is pushed in: at 0.2 % a little beyond its neighbours."""
    part = _made(trimesh.creation.icosphere(subdivisions=5))
    vertices = part.vertices.copy()
    vertices[7] *= 1.0 - depth
    return part._replace(vertices=vertices)


def _prism(*corners):
    """A prism over a polygon in the plane z = 0, of unit height."""
    polygon = np.asarray(corners, np.float64)
    count = len(polygon)
    vertices = np.concatenate([np.c_[polygon, np.zeros(count)], np.c_[polygon, np.ones(count)]])
    # Fans from the first corner, which must see all others.
    fan = [(0, i, i + 1) for i in range(1, count - 1)]
    bottom = [(a, c, b) for a, b, c in fan]
    top = [(a + count, b + count, c + count) for a, b, c in fan]
    ring = [(i, (i + 1) % count) for i in range(count)]
    sides = [(i, j, j + count) for i, j in ring] + [(i, j + count, i + count) for i, j in ring]
    return solids.as_part(trimesh.Trimesh(vertices, bottom + top + sides), "prism_glass")


_L_SHAPE = ((1.0, 1.0), (0.0, 2.0), (0.0, 0.0), (2.0, 0.0), (2.0, 1.0))


@pytest.mark.parametrize(
    "part",
    [
        solids.ball(),
        solids.box(size=(1.0, 1e-3, 30.0)),
        _made(trimesh.creation.icosphere(subdivisions=0)),
        _made(trimesh.creation.uv_sphere(count=[24, 24])),
        _turned(_subdivided_box()),
        _turned(trimesh.creation.cylinder(radius=1.0, height=0.2, sections=64)),
        _turned(trimesh.creation.icosphere(subdivisions=4)),
        _prism((0.0, 0.0), (1.0, 0.0), (0.3, 0.8)),
        solids.ball(radius=1e-3, centre=(5.0, 5.0, 5.0)),
    ],
)
def test_convex_bodies(part):
    assert is_convex(part)


@pytest.mark.parametrize(
    "part",
    [
        _made(trimesh.creation.torus(1.0, 0.3)),
        _prism(*_L_SHAPE),
        _dented(0.002),
        _dented(1.0),
        solids.shell(),
        # All corners lie on the hull, and the faces between the boxes do not.
        solids.joined("two_glass", solids.box(), solids.box(centre=(2.0, 0.0, 0.0))),
        solids.inverted(solids.box()),
    ],
)
def test_bodies_that_are_not_convex(part):
    assert not is_convex(part)


def test_an_edge_that_is_bent_inwards_is_not_convex_with_all_corners_on_the_hull():
    # Of the square on the right, slightly twisted, one diagonal bulges and the other is a valley.
    vertices = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
    vertices[7, 0] += 0.1
    hull = trimesh.convex.convex_hull(vertices)
    assert is_convex(_made(hull))
    faces = [tuple(face) for face in hull.faces.tolist()]
    pair = [face for face in faces if set(face) <= {4, 5, 6, 7}]
    shared = set(pair[0]) & set(pair[1])
    assert len(pair) == 2 and len(shared) == 2
    flipped = {
        frozenset((4, 5, 7)): [(4, 6, 5), (5, 6, 7)],
        frozenset((4, 6, 7)): [(4, 6, 5), (5, 6, 7)],
        frozenset((4, 5, 6)): [(4, 6, 7), (4, 7, 5)],
        frozenset((5, 6, 7)): [(4, 6, 7), (4, 7, 5)],
    }[frozenset(pair[0])]
    valley = [face for face in faces if face not in pair] + flipped
    assert not is_convex(_made(trimesh.Trimesh(hull.vertices, valley, process=False)))


def test_an_open_surface_is_not_convex():
    ball = solids.ball()
    assert not is_convex(ball._replace(faces=ball.faces[1:]))


def test_a_flat_sheet_and_a_doubled_ball_are_not_convex():
    square = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    both_sides = np.array([[0, 1, 2], [0, 2, 3], [0, 2, 1], [0, 3, 2]])
    sheet = meshes.MeshPart("sheet_glass", square, both_sides, 1.5, "flat")
    assert not is_convex(sheet)
    assert not is_convex(solids.joined("twice_glass", solids.ball(), solids.ball()))


def test_light_leaves_one_convex_body_for_good():
    analysis = _analysis(_clear(solids.ball()))
    assert (analysis.parts, analysis.objects, analysis.convex) == (1, 1, True)
    assert analysis.reentry == "impossible"
    assert describe(analysis) == (
        "this scene needs: 1 clear convex object, no re-entry, bounded background, no tint"
    )


def test_parts_inside_a_convex_body_do_not_bring_light_back():
    parts = [solids.ball(), solids.ball("inner_water", radius=0.5)]
    assert _analysis(*parts).reentry == "impossible"
    # Priorities may turn the order around, and to a facing inner wall what is outside is air.
    assert _analysis(*parts, rule="facing").reentry == "possible"
    assert _analysis(*parts, rule="priority").reentry == "possible"
    assert _analysis(parts[0], rule="priority").reentry == "impossible"


@pytest.mark.parametrize(
    "parts",
    [
        [solids.ball(), solids.ball("far_glass", centre=(2.5, 0.0, 0.0))],
        [solids.ball(), solids.ball("cut_glass", centre=(1.0, 0.0, 0.0))],
        [solids.shell()],
        [_made(trimesh.creation.torus(1.0, 0.3))],
    ],
)
def test_light_may_come_back_to_several_bodies_and_hollow_ones(parts):
    assert _analysis(*parts).reentry == "possible"


def test_nothing_is_promised_to_a_camera_inside():
    inside = _CAMERAS._replace(poses=0.1 * _CAMERAS.poses)
    assert _analysis(solids.ball(), cameras=inside).reentry == "possible"


def test_what_is_known_of_colours_decides_on_the_interior():
    ball, inner = solids.ball(), solids.ball("inner_water", radius=0.5)
    assert _analysis(_clear(ball))[4:6] == ("clear", "none")
    assert _analysis(ball)[4:6] == ("absorbing", "learned")
    assert _analysis(_clear(ball), inner)[4:6] == ("absorbing", "learned")
    tinted = _clear(inner)._replace(tint=(0.5, 1.0, 1.0))
    assert _analysis(_clear(ball), tinted)[4:6] == ("absorbing", "given")
    dark = _clear(inner)._replace(absorption=(0.0, 0.0, 0.1))
    assert _analysis(_clear(ball), dark)[4:6] == ("absorbing", "given")


def test_objects_are_counted():
    wine = solids.ball("wine_water", radius=1.7)._replace(tint=(0.5, 1.0, 1.0))
    found = _analysis(_clear(solids.shell()), _clear(wine), space="unbounded")
    assert found[:3] == (2, 1, False)
    assert "2 parts in 1 object that is not convex" in describe(found)
    apart = [solids.box(), solids.box("other_glass", centre=(3.0, 0.0, 0.0))]
    assert _analysis(*apart).objects == 2
    assert _analysis(solids.ball(), solids.ball("inner_water", radius=0.5))[:3] == (2, 1, True)


def test_no_mesh_needs_no_tracer():
    analysis = _analysis(space="unbounded")
    assert (analysis.parts, analysis.objects, analysis.interior, analysis.tints) == (
        0,
        0,
        "none",
        "none",
    )
    assert "no meshes: no tracer" in describe(analysis)


def test_a_scene_tells_whether_its_colours_are_known(ball_scene):
    (part,) = meshes.read_meshes(ball_scene)
    assert part.colour_known
    assert describe(_analysis(part)) == (
        "this scene needs: 1 clear convex object, no re-entry, bounded background, no tint"
    )


def _wall(points):
    """Returns a smooth texture: the colour of each direction from the centre."""
    towards = points / np.linalg.norm(points, axis=-1, keepdims=True)
    return 0.5 + 0.4 * np.sin(25.0 * towards)


def _photographs(views, *, space="spherical", blob=0.0):
    """Returns images of a background of size 6, with a red ball in front of it."""
    images = []
    for view in range(len(views.poses)):
        rays = image_rays(views, view)
        origins, towards = np.float64(rays.origins), np.float64(rays.directions)
        if space == "spherical":
            along = np.sum(origins * towards, axis=-1)
            depth = np.sqrt(along**2 + 36.0 - np.sum(origins**2, axis=-1)) - along
        elif space == "bounded":
            depth = np.min((6.0 * np.sign(towards) - origins) / towards, axis=-1)
        seen = towards if space == "unbounded" else origins + depth[..., None] * towards
        image = _wall(seen)
        away = np.array([0.0, 2.5, 0.0]) - origins
        along = np.sum(away * towards, axis=-1)
        image[(np.sum(away**2, axis=-1) - along**2 < blob**2) & (along > 0.0)] = 1.0, 0.0, 0.0
        images.append(np.round(255.0 * image).astype(np.uint8))
    return np.stack(images)


def _room_views(size=96):
    rings = [orbit(8, distance=4.0, elevation=e, size=size, angle_x=1.6) for e in (0.9, 0.0, -0.8)]
    return rings[0]._replace(poses=np.concatenate([ring.poses for ring in rings]))


@pytest.mark.parametrize("space", ["spherical", "bounded", "unbounded"])
def test_an_object_in_front_of_the_background_is_seen_in_the_images(space):
    views, ball = _room_views(), [_made(trimesh.creation.icosphere(2, 1.0))]
    known = {"space": space, "size": 6.0}
    clean, painted = (_photographs(views, space=space, blob=size) for size in (0.0, 0.4))
    few = scene_analysis.misfits(views, clean, ball, **known)
    many = scene_analysis.misfits(views, painted, ball, **known)
    assert few < scene_analysis.MOST_MISFITS < 0.5 * many


def test_only_pixels_among_a_mask_are_compared_with_the_background():
    views, known = _room_views(), {"space": "bounded", "size": 6.0}
    clean, painted = (_photographs(views, space="bounded", blob=size) for size in (0.0, 0.4))
    beside = np.all(clean == painted, axis=-1)
    every, some = (
        scene_analysis.misfits(views, painted, (), **known, among=among) for among in (None, beside)
    )
    assert some < scene_analysis.MOST_MISFITS < 0.5 * every
    nothing = np.zeros_like(beside)
    assert scene_analysis.misfits(views, painted, (), **known, among=nothing) == 0.0


def test_masks_say_where_objects_of_a_scene_without_meshes_are():
    known = {"space": "bounded", "size": 7.3, "centre": (0.0, 0.0, 0.0)}
    every, beside = (
        scene_analysis.read_misfits(BALL, (), **known, masked=masked) for masked in (False, True)
    )
    assert beside < scene_analysis.MOST_MISFITS < 0.5 * every


@pytest.mark.parametrize("space", ["spherical", "bounded"])
def test_a_wrong_size_of_the_background_is_seen_in_the_images(space):
    views = _room_views()
    images = _photographs(views, space=space)
    shares = [scene_analysis.misfits(views, images, (), space=space, size=s) for s in (6.0, 7.5)]
    assert shares[0] < scene_analysis.MOST_MISFITS < 0.5 * shares[1]


@pytest.mark.slow
@pytest.mark.parametrize("space", ["bounded", "unbounded"])
def test_gains_of_images_are_not_mistaken_for_something_in_front_of_the_background(space):
    views, known = _room_views(), {"space": space, "size": 6.0}
    gains = np.exp(np.random.default_rng(0).normal(0.0, 0.2, (len(views.poses), 1, 1, 3)))
    clean, painted = (
        np.round(np.clip(image * gains ** (1.0 / 2.2), 0.0, 255.0)).astype(np.uint8)
        for image in (_photographs(views, space=space, blob=size) for size in (0.0, 0.4))
    )
    fixed, few, many = (
        scene_analysis.misfits(views, images, (), **known, exposure=exposure)
        for images, exposure in ((clean, "fixed"), (clean, "per_image"), (painted, "per_image"))
    )
    assert fixed > 0.2 and few < scene_analysis.MOST_MISFITS < 0.5 * many
    some = clean.copy()  # a lens cap, and a flash that misfired
    some[3], some[7] = 0, some[7] // 30
    assert scene_analysis.misfits(views, some, (), **known, exposure="per_image") <= few + 1e-3
    dark = np.zeros_like(clean)
    assert scene_analysis.misfits(views, dark, (), **known, exposure="per_image") == 0.0


def test_pixels_that_only_see_objects_are_not_judged():
    views = _room_views()
    noise = np.random.default_rng(0).integers(256, size=(24, 96, 96, 3), dtype=np.uint8)
    around = [_made(trimesh.creation.icosphere(2, 5.0))]
    assert scene_analysis.misfits(views, noise, around, space="spherical", size=6.0) == 0.0
    for shape in ((3, 5), (1, 1)):  # images smaller than a patch
        tiny = views._replace(height=shape[0], width=shape[1])
        image = np.full((24, *shape, 3), 99, np.uint8)
        assert scene_analysis.misfits(tiny, image, (), space="unbounded", size=1.0) == 0.0


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "space"), [("sphere", "spherical"), ("cube", "bounded")])
def test_the_size_of_the_background_is_measured_by_its_parallax(kind, space):
    views = _room_views()
    images, other = (_photographs(views, space=s) for s in (space, "unbounded"))
    size, error = scene_analysis.fit_size_by_parallax(views, images, (), kind)
    assert abs(size - 6.0) < max(3.0 * error, 0.01) and 0.0 < error < 0.05
    assert scene_analysis.fit_size_by_parallax(views, other, (), kind) is None


@pytest.mark.slow
def test_walls_of_one_colour_have_no_measurable_size():
    views = _room_views(size=48)
    grey = np.full((24, 48, 48, 3), 99, np.uint8)
    assert scene_analysis.fit_size_by_parallax(views, grey, (), "cube") is None
    around = [_made(trimesh.creation.icosphere(2, 5.0))]  # no pixel sees the background directly
    assert scene_analysis.fit_size_by_parallax(views, grey, around, "cube") is None


@pytest.mark.slow
def test_a_scene_that_states_no_size_gets_that_of_its_images(tmp_path):
    scene = shutil.copytree(BALL, tmp_path / "cube_smcvx_ball")
    properties = json.loads((scene / "scene.json").read_text())
    del properties["background"]
    (scene / "scene.json").write_text(json.dumps(properties))
    for path in scene.glob("transforms_*.json"):
        content = json.loads(path.read_text())
        content["frames"] = content["frames"][:24]
        for frame in content["frames"]:
            del frame["depth_file_path"]
        path.write_text(json.dumps(content))
    facts = read_facts(SceneConfig(path=str(scene)))
    assert abs(facts.half_extent - 7.3) < 0.005 and facts.centre == (0.0, 0.0, 0.0)
    assert facts.source.startswith("measured from the parallax of the images: 7.30")
