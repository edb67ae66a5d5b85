"""A generated capture, by Blender, and how exactly its cameras are refined.

Needs `make dataset-env`.
"""

import json

import imageio.v3 as iio
import numpy as np
import pytest
from absl import flags

from benchmarks import cameras as benchmark
from experiments.captures import nerfstudio
from experiments.dataset import captures, frame_files, handheld
from refref_jax.data import image_files, scene_folder
from refref_jax.geometry.cameras import box_filter, image_rays
from tests.processes.command import ROOT, run_command

# The options of a command that is imported must not meet those of another.
for _flag in list(flags.FLAGS.flags_by_module_dict()[benchmark.__name__]):
    delattr(flags.FLAGS, _flag.name)

_PYTHON = ROOT / ".venv-dataset" / "bin" / "python"


def test_without_blender_the_command_says_so(tmp_path):
    said = run_command(
        "dataset.make_capture", f"--out={tmp_path / 'a'}", "--blender=/nowhere", fails=True
    )
    assert "make dataset-env" in said.stderr and "Traceback" not in said.stderr
    assert not (tmp_path / "a").exists()


def test_a_folder_of_other_settings_is_refused(tmp_path):
    truth = tmp_path / "out" / captures.TRUTH
    truth.mkdir(parents=True)
    settings = captures.CaptureSettings(views=40)
    (truth / "truth.json").write_text(json.dumps(captures.describe_truth(settings)))
    captures.check(tmp_path / "out", settings)
    with pytest.raises(ValueError, match="views is 40, not 60"):
        captures.check(tmp_path / "out", captures.CaptureSettings())
    earlier = captures.describe_truth(captures.CaptureSettings())
    del earlier["settings"]["texture_scale"]
    (truth / "truth.json").write_text(json.dumps(earlier))
    captures.check(tmp_path / "out", captures.CaptureSettings())
    (truth / "truth.json").write_text("{}")
    with pytest.raises(ValueError, match="states no settings"):
        captures.check(tmp_path / "out", captures.CaptureSettings())
    (truth / "truth.json").unlink()
    with pytest.raises(ValueError, match="not a folder of this command"):
        captures.check(tmp_path / "out", settings)


def test_truth_and_capture_differ_by_the_stated_errors():
    settings = captures.CaptureSettings(views=60)
    true = np.array([f["transform_matrix"] for f in captures.describe_truth(settings)["frames"]])
    given = captures.given_poses(settings)
    turned, moved = benchmark.errors(given[:, :3], true[:, :3])
    assert 0.2 < turned.mean() < 0.35 and 0.3 < moved.mean() < 0.6
    assert benchmark.errors(true[:, :3], true[:, :3])[0].max() < 1e-5


def test_an_image_freed_of_its_lens_is_that_of_the_pinhole():
    lens, focal = handheld.usual_lens(96, 80.0), 80.0
    columns, rows = np.meshgrid(*[(np.arange(3 * 120) + 0.5) / 3 - 60.0] * 2)
    light = 0.4 + 0.25 * np.stack([np.sin(columns / 9), np.cos(rows / 8), np.sin(rows / 7)], -1)
    taken = handheld.photograph(light, lens, fine_focal=3 * focal, size=96, gain=np.ones(3), seed=0)
    flat = benchmark.flattened(taken, lens._asdict())
    pinhole = frame_files.to_srgb(box_filter(light[36:-36, 36:-36], 3))
    inner = (slice(8, -8), slice(8, -8))
    difference = flat[inner] - pinhole[inner]
    # Noise, and no shift: a tenth of a pixel would be about 0.7 grey levels of slope.
    assert abs(difference.mean()) < 0.1 and difference.std() < 3.0
    moved = np.gradient(pinhole.astype(float), axis=1)[inner]
    assert abs((difference * moved).sum() / (moved**2).sum()) < 0.02


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    out = tmp_path_factory.mktemp("capture") / "ball"
    run_command(
        "dataset.make_capture", f"--out={out}", f"--blender={_PYTHON}", "--spp=18", "--workers=2"
    )
    return out


@pytest.mark.slow
@pytest.mark.skipif(not _PYTHON.exists(), reason="Blender is missing: make dataset-env")
def test_the_perfect_scene_and_the_capture_are_whole(made):
    counts = {"train": 48, "val": 4, "test": 8}
    for split, count in counts.items():
        frames = scene_folder.read_frames(made / captures.PERFECT, split)
        assert len(frames.names) == count
        assert scene_folder.read_images(frames).shape == (count, 160, 160, 3)
        share = scene_folder.read_masks(frames).mean(axis=(1, 2))
        assert np.all((share > 0.1) & (share < 0.4))
    content = json.loads((made / captures.CAPTURE / nerfstudio.FILE).read_text())
    assert content["camera_model"] == "OPENCV" and content["k1"] == -0.11
    assert {split: len(content[f"{split}_filenames"]) for split in counts} == counts
    assert sum("mask_path" in frame for frame in content["frames"]) == 57
    for frame in content["frames"]:
        image = made / captures.CAPTURE / frame["file_path"]
        assert iio.immeta(image)["mode"] == "RGB" and image_files.read_size(image) == (160, 160)
    again = run_command("dataset.make_capture", f"--out={made}", f"--blender={_PYTHON}", "--spp=18")
    assert "render" not in again.stdout


@pytest.mark.slow
@pytest.mark.skipif(not _PYTHON.exists(), reason="Blender is missing: make dataset-env")
@pytest.mark.parametrize("meshes", [False, True])
def test_one_command_leads_from_the_capture_to_a_report(made, tmp_path, meshes):
    out = tmp_path / "run"
    options = [f"--source={made / captures.CAPTURE}", f"--out={out}", "--steps=400"]
    options += [f"--meshes={made / captures.PERFECT / 'meshes'}"] if meshes else []
    said = run_command("capture_to_model", *options, "--rays_per_pixel=1").stdout
    assert ("Report:" in said) != meshes and (out / "object" / "report.md").is_file() != meshes
    seen = out / "model" / "eval" / "test"
    results = json.loads((seen / "metrics.json").read_text())["results"]
    assert results["psnr"] > 17.0 and results["psnr_masked"] > (16.0 if meshes else 13.0)
    assert image_files.read_rgb(seen / "comparison.png").ndim == 3
    again = run_command("capture_to_model", *options, "--rays_per_pixel=1").stdout
    assert again.count("done before") == (4 if meshes else 5)


def _first_hits(surfaces, origins, directions):
    """Returns distance, number of the rectangle and place on it of the first hit of each ray."""
    nearest, which = np.full(len(directions), np.inf), np.zeros(len(directions), int)
    place = np.zeros((len(directions), 2))
    for number, surface in enumerate(surfaces):
        corner, along, up = (np.array(surface[key]) for key in ("corner", "along", "up"))
        normal = np.cross(along, up)
        with np.errstate(divide="ignore", invalid="ignore"):
            away = (corner - origins) @ normal / (directions @ normal)
            offset = origins + away[:, None] * directions - corner
            at = np.stack([offset @ along / (along @ along), offset @ up / (up @ up)], -1)
            better = np.all((at >= 0.0) & (at <= 1.0), -1) & (away > 0.0) & (away < nearest)
        nearest[better], which[better], place[better] = away[better], number, at[better]
    return nearest, which, place


@pytest.mark.slow
@pytest.mark.skipif(not _PYTHON.exists(), reason="Blender is missing: make dataset-env")
def test_beside_the_object_is_what_the_room_is_made_of(made):
    stage = made / captures.TRUTH / "room"
    surfaces = json.loads((stage / "scene.json").read_text())["background"]["surfaces"]
    frames = scene_folder.read_frames(made / captures.PERFECT, "test")
    beside = image_files.well_outside(scene_folder.read_masks(frames), margin=2)
    for view in (0, 5):
        rays = image_rays(frames.cameras, view)
        free = np.nonzero(beside[view].ravel())[0]
        origins, directions = (
            np.asarray(each, np.float64).reshape(-1, 3)[free] for each in rays[:2]
        )
        away, which, place = _first_hits(surfaces, origins, directions)
        measured = scene_folder.read_distances(frames)[view].ravel()[free]
        assert np.mean(np.abs(away - measured) < 2e-3 * measured) > 0.99
        image = frames.images[view].with_suffix(".exr")
        linear = image_files.read_exr(image).reshape(-1, 3)[free]
        expected = np.zeros_like(linear)
        for number in np.unique(which):
            texture = image_files.read_exr(stage / surfaces[number]["image"])
            here = which == number
            row = ((1.0 - place[here, 1]) * len(texture)).astype(int).clip(0, len(texture) - 1)
            column = (place[here, 0] * texture.shape[1]).astype(int).clip(0, texture.shape[1] - 1)
            expected[here] = texture[row, column]
        # A texel at the middle of a pixel against the mean of the pixel.
        assert np.median(np.abs(linear - expected)) < 0.05 * linear.mean() + 0.03
        assert np.corrcoef(linear.ravel(), expected.ravel())[0, 1] > 0.8


@pytest.mark.slow
@pytest.mark.skipif(not _PYTHON.exists(), reason="Blender is missing: make dataset-env")
def test_refining_its_cameras_leaves_a_tenth_of_their_errors(made):
    given, *refined = benchmark.measure(benchmark.read(made))
    assert given.rotation > 0.2 and given.position > 0.35
    for row in refined:
        assert row.rotation < benchmark.DEGREES and row.position < benchmark.PERCENT
        assert row.test_rotation < benchmark.DEGREES and row.test_position < benchmark.PERCENT
