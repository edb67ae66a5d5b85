"""PLY files of splats, and images with distances."""

import jax
import numpy as np
import pytest
import trimesh

from refref_jax.geometry.cameras import image_rays, orbit
from refref_jax.splats import gaussians as splats
from refref_jax.splats import images
from tests.factories import made_splats


def test_a_file_is_read_as_it_was_written(tmp_path):
    made, path = made_splats.gaussians(7), tmp_path / "splats.ply"
    splats.write_ply(path, made)
    for ours, theirs in zip(made, splats.read_ply(path), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_a_file_has_the_usual_properties(tmp_path):
    """As an independent reader has them."""
    made, path = made_splats.gaussians(7), tmp_path / "splats.ply"
    splats.write_ply(path, made)
    read = trimesh.load(path, process=False)
    np.testing.assert_allclose(read.vertices, made.means)
    data = read.metadata["_ply_raw"]["vertex"]["data"]
    rest = [data[f"f_rest_{n}"].reshape(-1) for n in range(45)]
    harmonics = np.asarray(made.harmonics)
    # Red first; index 1 of the harmonics has the other sign, index 2 has not.
    np.testing.assert_array_equal(rest[0], -harmonics[:, 0, 0])
    np.testing.assert_array_equal(rest[1], harmonics[:, 1, 0])
    np.testing.assert_array_equal(rest[15], -harmonics[:, 0, 1])
    np.testing.assert_array_equal(data["opacity"].reshape(-1), made.logits)
    np.testing.assert_array_equal(data["rot_0"].reshape(-1), made.quaternions[:, 0])
    np.testing.assert_array_equal(data["scale_2"].reshape(-1), made.log_scales[:, 2])


def test_a_file_with_fewer_harmonics_is_read(tmp_path):
    made, path = made_splats.gaussians(3), tmp_path / "splats.ply"
    splats.write_ply(path, made)
    header, _, data = path.read_bytes().partition(b"end_header\n")
    rows = np.frombuffer(data, "<f4").reshape(3, -1)
    kept = [n for n in range(rows.shape[1]) if not 9 <= n < 54]
    lines = [line for line in header.splitlines() if b"f_rest" not in line]
    path.write_bytes(b"\n".join([*lines, b"end_header\n"]) + rows[:, kept].tobytes())
    read = splats.read_ply(path)
    np.testing.assert_array_equal(read.means, made.means)
    assert read.harmonics.shape == (3, 15, 3) and not np.any(read.harmonics)


@pytest.mark.parametrize(
    "change",
    [
        lambda content: b"",
        lambda content: content[:-4],
        lambda content: content.replace(b"binary_little_endian", b"ascii"),
        lambda content: content.replace(b"property float opacity", b"property float opacities"),
        lambda content: content.replace(b"property float x", b"property double x"),
        lambda content: content.replace(b"ply\n", b"plain\n", 1),
        lambda content: content.replace(b"vertex 3", b"vertex three"),
        lambda content: content.replace(b"vertex 3", b"vertex"),
        lambda content: content.replace(b"vertex 3", b"vertex -3"),
        lambda content: content.replace(b"vertex 3", b"vertex 3\nproperty float"),
        lambda content: content.replace(b"element", b"element chunk 0\nelement"),
        lambda content: content.replace(b"float f_rest_3\n", b"float f_rest_99\n"),
        lambda content: content.replace(b"float nx", b"float x"),
    ],
)
def test_other_files_are_refused(tmp_path, change):
    path = tmp_path / "splats.ply"
    splats.write_ply(path, made_splats.gaussians(3))
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(ValueError, match=r"splats\.ply is not a PLY file of Gaussian splats"):
        splats.read_ply(path)


def test_comments_are_ignored(tmp_path):
    made, path = made_splats.gaussians(3), tmp_path / "splats.ply"
    splats.write_ply(path, made)
    path.write_bytes(path.read_bytes().replace(b"element", b"comment of another program\nelement"))
    np.testing.assert_array_equal(splats.read_ply(path).means, made.means)


def test_nan_is_refused(tmp_path):
    made, path = made_splats.gaussians(3), tmp_path / "splats.ply"
    splats.write_ply(path, made._replace(logits=made.logits.at[1].set(np.nan)))
    with pytest.raises(ValueError, match=r"splats\.ply has Gaussians with NaN"):
        splats.read_ply(path)


@pytest.mark.slow
def test_distances_are_along_the_rays():
    """A wall of opaque, flat Gaussians at z = 0, seen from above."""
    cameras = orbit(2, distance=4.0, elevation=1.4, size=20, angle_x=1.1656)
    side = np.linspace(-3.0, 3.0, 25)
    places = [(x, y, 0.0) for x in side for y in side]
    wall = [made_splats.one(p, scale=(0.15, 0.15, 1e-4), opacity=0.99) for p in places]
    made = made_splats.joined(*wall)
    beyond = np.full((20, 20), 50.0)
    seen = images.render(made, cameras, 1, kernel="classic", beyond=beyond)
    rays = image_rays(cameras, 1)
    with np.errstate(divide="ignore"):
        true = -rays.origins[..., 2] / rays.directions[..., 2]
    hits = rays.origins + true[..., None] * rays.directions
    inside = (true > 0.0) & (np.abs(hits[..., :2]).max(axis=-1) < 2.0)
    assert inside.sum() > 40
    # A Gaussian has one depth, that of its mean, from which a pixel may be some deviations away.
    np.testing.assert_allclose(seen.distance[inside], true[inside], rtol=0.02)
    np.testing.assert_allclose(seen.mean_distance[inside], true[inside], rtol=0.02)
    assert np.all(seen.accumulation[inside] > 0.9)
    nothing = images.render(splats.blank(0), cameras, 1, kernel="classic", beyond=beyond)
    assert np.all(nothing.distance == 50.0) and np.all(nothing.mean_distance == 50.0)
    assert np.all(nothing.rgb == 0.5) and not np.any(nothing.accumulation)
    assert all(leaf.dtype == np.float32 for leaf in jax.tree.leaves(seen))
