import jax.numpy as jnp
import numpy as np
import pytest

from experiments.dataset import frame_files
from refref_jax.data import image_files
from refref_jax.render import pixels


def test_colours_are_encoded_as_the_library_does():
    linear = np.concatenate([np.linspace(0.0, 1.2, 1201), np.geomspace(1e-5, 1.0, 500)])
    known = np.asarray(pixels.linear_to_srgb(jnp.asarray(linear, jnp.float32)))
    ours = frame_files.to_srgb(linear)
    assert np.max(np.abs(ours / 255.0 - np.clip(known, 0.0, 1.0))) <= 0.5 / 255.0 + 1e-5
    levels = frame_files.to_srgb(np.array([-1.0, 0.0, 0.5, 1.0, 7.0]))
    assert levels.tolist() == [0, 0, 188, 255, 255]


def test_depth_is_inverted_and_saturates():
    depth = np.array([0.5, 1.0, 6.25, 11.5, 1e10], np.float32)
    assert frame_files.to_published_depth(depth).tolist() == [255, 255, 128, 0, 0]


def test_half_precision_does_not_overflow(tmp_path):
    shape = (2, 2)
    rendering = frame_files.Rendering(
        np.full((*shape, 3), 1e6, np.float32),
        np.ones(shape, np.float32),
        np.zeros((*shape, 3), np.float32),
        np.ones(shape, bool),
    )
    frame_files.write(tmp_path, "test", 7, rendering, linear=True)
    assert frame_files.is_done(tmp_path, "test", 7, linear=True)
    assert not frame_files.is_done(tmp_path, "test", 8, linear=False)
    written = image_files.read_exr(tmp_path / "test" / "r_007.exr")
    assert np.all(written == 65504.0)


def test_a_broken_rendering_is_told(tmp_path):
    (tmp_path / "colour.exr").write_bytes(b"v/1\x01")
    with pytest.raises(ValueError, match=r"colour\.exr cannot be read .*resumes"):
        frame_files.read_rendering([tmp_path / "colour.exr"], tmp_path / "geometry.exr")
