"""The viewer in headless Chromium: it opens, draws, and a click draws light paths."""

import dataclasses
import socket

import jax
import numpy as np
import pytest

from experiments.viewer import session
from refref_jax.data import scene_folder
from refref_jax.optics.path_settings import TREE
from refref_jax.render import Model, images, init_params
from tests.factories import scenes
from tests.factories.small_model import MODEL

serving = pytest.importorskip("experiments.viewer.server", exc_type=ModuleNotFoundError)
browser = pytest.importorskip("tests.processes.browser", exc_type=ModuleNotFoundError)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(browser.CHROMIUM is None, reason="there is no Chromium"),
]

_SIZE = (1000, 640)

# A pixel of the ball beside its middle, where light bends; one beside the ball.
_OF_THE_BALL, _BESIDE = (440, 290), (60, 600)


@pytest.fixture
def subject(ball_scene, monkeypatch):
    monkeypatch.setattr(images, "TILE", 1024)
    params = init_params(jax.random.key(0), MODEL)
    settings = dataclasses.replace(TREE, max_bends=4, reentry="impossible")
    config = dataclasses.replace(MODEL, interior="clear")
    model = Model(config, settings, scenes.build(scenes.ball(1.4, subdivisions=3)), params)
    frames = scene_folder.read_frames(ball_scene, "test")
    return session.Subject("made", model, "nested", frames, ("ball_glass",), (18, 36), 1024)


@pytest.fixture
def server(subject):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    server = serving.serve(subject, host="127.0.0.1", port=port)
    yield server
    server.stop()


def _choose(page, old, new):
    """Opens the list that shows one word and takes another."""
    page.evaluate(f"[...document.querySelectorAll('input')].find(x => x.value === '{old}').click()")
    option = f"[...document.querySelectorAll('[role=option]')].find(x => x.innerText === '{new}')"
    browser.until(lambda: page.evaluate(f"{option} !== undefined"), new)
    page.evaluate(f"{option}.click()")


def _drawn_light(before, after):
    """Returns how many pixels have come to the pale yellow of strong light."""
    before, after = before.astype(int), after.astype(int)
    changed = np.abs(after - before).max(axis=-1) > 20
    strong = after[..., :2].min(axis=-1)
    return np.sum(changed & (strong > 190) & (after[..., 2] < strong - 40))


def _canvas(page):
    """Returns what is left of the panel."""
    return page.screenshot()[:, : _SIZE[0] // 2]


def test_it_opens_and_draws_and_a_click_draws_light_paths(subject, server, tmp_path):
    address = f"http://127.0.0.1:{server.get_port()}"
    with browser.opened(address, tmp_path / "profile", size=_SIZE) as page:
        page.wait_for("size 2 of 2")
        (client,) = server.get_clients().values()

        _choose(page, "rgb", "normals")
        page.wait_for("56 x 36 pixels, size 2 of 2")
        x, y = _BESIDE
        browser.until(lambda: (_canvas(page)[y, x] > 245).all(), "white where no surface is")
        drawn = _canvas(page)
        x, y = _OF_THE_BALL
        assert np.ptp(drawn[y, x].astype(int)) > 20
        assert _drawn_light(drawn, _canvas(page)) == 0

        page.click(*_OF_THE_BALL)
        page.wait_for("left the objects")
        lines = [client.scene.get_handle_by_name(f"/paths/{i}") for i in range(4)]
        segments = np.concatenate([line.points for line in lines if line is not None])
        assert len(segments) >= 4  # in, through, out, and mirrored
        eye = np.asarray(client.camera.position)
        assert np.linalg.norm(segments - eye, axis=-1).min() < 0.05
        assert np.abs(segments).max() < MODEL.radius + 0.01
        browser.until(lambda: _drawn_light(drawn, _canvas(page)) > 50, "lines of strong light")

        page.drag((300, 500), (420, 460))
        page.wait_for("size 2 of 2")
        moved = np.asarray(client.camera.position)
        assert np.linalg.norm(moved - eye) > 0.3

        _choose(page, "normals", "error")
        page.wait_for("test view")
        views = subject.frames.cameras.poses[:, :, 3]
        gaps = np.linalg.norm(views - client.camera.position, axis=-1)
        assert gaps.min() < 0.01
        assert f"test view {subject.frames.names[gaps.argmin()]}" in page.text()
        assert page.complaints == []
