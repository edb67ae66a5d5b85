import sys

import imageio.v3 as iio
import numpy as np
import pytest

from experiments.figures import video

pytestmark = pytest.mark.loose


def _frames(height=23, width=25, count=5):
    """Grey pictures that grow brighter, with a red half."""
    frames = np.full((count, height, width, 3), 40, np.uint8)
    frames += (30 * np.arange(count, dtype=np.uint8))[:, None, None, None]
    frames[:, :, : width // 2] = (200, 30, 30)
    return list(frames)


def test_an_mp4_has_all_frames_and_their_colours(tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    gif, mp4 = video.write(tmp_path / "turn.1", _frames(), fps=10.0)
    assert (gif.name, mp4.name) == ("turn.1.gif", "turn.1.mp4")
    read = iio.imread(mp4, plugin="FFMPEG")
    assert read.shape == (5, 24, 26, 3)  # odd sizes are filled up, not resized
    expected = np.stack(_frames()).astype(int)
    np.testing.assert_allclose(read[:, 4:20, 15:24].mean((1, 2)), expected[:, 0, -1], atol=6)
    np.testing.assert_allclose(read[:, 4:20, 2:9].mean((1, 2)), expected[:, 0, 0], atol=12)
    meta = iio.immeta(mp4, plugin="FFMPEG")
    assert meta["fps"] == pytest.approx(10.0)


def test_without_ffmpeg_there_is_the_gif(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert not video.has_ffmpeg()
    assert video.write(tmp_path / "turn", _frames(), fps=10.0) == (tmp_path / "turn.gif",)
    assert iio.imread(tmp_path / "turn.gif").shape == (5, 23, 25, 3)
    assert not (tmp_path / "turn.mp4").exists()
