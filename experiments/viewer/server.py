"""The viewer's server, and the worker of each open page.

Every page has its own camera, panel and scene, and a thread that draws the images scheduled by
`session`. Pages take turns: one image is drawn at a time.

viser serves anyone who can reach it. `_guard` refuses pages of other sites that a browser shows
beside this one, names that lead to this machine from outside, large messages, and more pages than
can be drawn.

This is the only module that imports viser.
"""

import contextlib
import http
import io
import logging
import math
import threading
import time
import traceback
import urllib.parse
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import viser
import websockets.asyncio.server

from experiments.viewer import cameras, controls, layers, session
from experiments.viewer.cameras import Viewpoint
from experiments.viewer.controls import Panel
from experiments.viewer.layers import Image
from experiments.viewer.session import Choice, Job, State, Subject
from refref_jax.geometry.rays import Rays
from refref_jax.render import pixel_paths

_JPEG_QUALITY = 92

# Names of this machine in the address of a page, if the server listens to nobody else.
_LOOPBACK = ("127.0.0.1", "::1", "localhost")

# Pages at once, and bytes of a message of a page, which only tells cameras, clicks and options.
_MOST_PAGES, _LONGEST_MESSAGE = 32, 1 << 20

# Closer to a test view than this, a browser's camera is not moved.
_NEAR = 10 * cameras.ROUNDING


class Turns:
    """State shared by pages: the lock for drawing, and the compiled settings."""

    def __init__(self) -> None:
        """Starts with nothing compiled."""
        self.drawing = threading.Lock()
        self.tracing = threading.Lock()
        self.compiled: set[Any] = set()


def serve(subject: Subject, *, host: str, port: int) -> viser.ViserServer:
    """Starts a server, which runs in its own threads until it is stopped.

    Args:
      subject: run to display.
      host: address to listen on.
      port: first port to try; the server's method `get_port` returns the actual one.
    """
    with contextlib.redirect_stdout(io.StringIO()), _guard(host):  # viser prints a box
        server = viser.ViserServer(host=host, port=port, label=subject.name, verbose=False)
    # Sharing would expose the page to the internet, through a server of viser's authors.
    server.gui.configure_theme(show_share_button=False, show_logo=False)
    view = session.first_viewpoint(subject)
    position, back = view.pose[:, 3], view.pose[:, 2]
    server.initial_camera.position = position
    distance = np.linalg.norm(position - subject.model.config.centre)
    server.initial_camera.look_at = position - back * distance
    server.initial_camera.fov = view.fov
    turns, pages = Turns(), {}

    @server.on_client_connect
    def _(client: viser.ClientHandle) -> None:
        page = pages[client.client_id] = Page(client, subject, turns)
        if client.client_id not in server.get_clients():  # gone before its page was built
            page.close()

    @server.on_client_disconnect
    def _(client: viser.ClientHandle) -> None:
        if page := pages.pop(client.client_id, None):
            page.close()

    return server


@contextlib.contextmanager
def _guard(host: str) -> Iterator[None]:
    """Makes a server that starts in the context refuse requests, as the module says."""
    original, pages = websockets.asyncio.server.serve, 0
    # It prints a traceback when a message is malformed, and closes that connection.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)

    def serve(handler: Any, *address: Any, process_request: Any, **options: Any) -> Any:
        async def counted(connection: Any) -> None:
            nonlocal pages
            pages += 1
            try:
                await handler(connection)
            finally:
                pages -= 1

        def checked(connection: Any, request: Any) -> Any:
            if told := refusal(request.headers, host=host, pages=pages):
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"{told}\n")
            return process_request(connection, request)

        options |= {"process_request": checked, "max_size": _LONGEST_MESSAGE}
        return original(counted, *address, **options)

    websockets.asyncio.server.serve = serve
    try:
        yield
    finally:
        websockets.asyncio.server.serve = original


def refusal(headers: Mapping[str, str], *, host: str, pages: int) -> str | None:
    """Returns why a request is refused; `None` if it is not.

    Args:
      headers: headers of the request.
      host: address that the server listens on.
      pages: number of pages that are open.
    """
    asked, origin = headers.get("Host", ""), headers.get("Origin")
    try:
        named = urllib.parse.urlsplit(f"//{asked}").hostname
        page = asked if origin is None else urllib.parse.urlsplit(origin).netloc
    except ValueError:
        return "The request has no valid Host or Origin."
    if host in _LOOPBACK and named not in _LOOPBACK:
        return f"The viewer answers to localhost only, not to {asked}."
    if page != asked:
        return f"A page of {origin} may not use the viewer."
    if headers.get("Upgrade", "").lower() == "websocket" and pages >= _MOST_PAGES:
        return f"{pages} pages are open. Close one first."
    return None


class Page:
    """One open page."""

    def __init__(self, client: viser.ClientHandle, subject: Subject, turns: Turns) -> None:
        """Builds panel and scene, and starts to draw."""
        self._client, self._subject, self._turns = client, subject, turns
        self._event = threading.Condition()
        self._closed = False
        self._state = State(stages=len(subject.heights))
        self._view = self._viewpoint()
        surfaces = subject.model.scene.surfaces
        self._scenery = controls.Scenery(client.scene, surfaces, subject.views)
        self._panel = Panel(
            client.gui,
            subject,
            changed=self._change,
            show_objects=self._scenery.show_objects,
            show_cameras=self._scenery.show_cameras,
            remove_paths=self._scenery.remove_paths,
        )
        client.camera.on_update(lambda _: self._look())
        if subject.has_paths:
            client.scene.on_click()(self._click)
        threading.Thread(target=self._work, daemon=True).start()
        self._change()

    def close(self) -> None:
        """Stops the page's thread."""
        with self._event:
            self._closed = True
            self._event.notify()

    def _viewpoint(self) -> Viewpoint:
        camera = self._client.camera
        aspect = camera.image_width / max(camera.image_height, 1) or cameras.ASPECT
        return cameras.from_browser(camera.wxyz, camera.position, camera.fov, aspect)

    def _look(self) -> None:
        """Records the camera; repeated reports of the same camera are not a change."""
        view = self._viewpoint()
        with self._event:
            if cameras.is_same(view, self._view):
                return
            self._view = view
        self._change()

    def _change(self) -> None:
        with self._event:
            self._state = session.changed(self._state, time.monotonic())
            self._event.notify()

    def _work(self) -> None:
        while True:
            with self._event:
                if self._closed:
                    return
                now = time.monotonic()
                job, view = session.next_job(self._state, now), self._view
                if job is None:
                    self._event.wait(session.wait(self._state, now))
                    continue
            try:
                image = self._draw(job, view, self._panel.choice())
            except Exception as error:  # the page stays open and shows the error
                traceback.print_exc()
                self._say(f"**{type(error).__name__}**: {error}")
                image = np.zeros((2, 2, 3), np.uint8)
            if image is not None and not self._closed:
                self._client.scene.set_background_image(
                    image, format="jpeg", jpeg_quality=_JPEG_QUALITY
                )
                with self._event:
                    self._state = session.finished(self._state, job)

    def _draw(self, job: Job, view: Viewpoint, choice: Choice) -> Image | None:
        """Draws a job's image; `None` if it was cancelled."""
        model = session.chosen_model(self._subject, choice)
        height, chunk = self._subject.heights[job.stage], self._subject.chunk
        most = height * cameras.width_of(height)
        layer, what = choice.layer, ("image", model.settings)
        if layer == layers.ERROR and job.stage > 0:
            return self._draw_error(job, view, model, most)
        if layer == layers.ERROR:  # no error is available while moving to a view
            layer = layers.RGB
        if layer in layers.OF_SURFACES:
            what = ("surfaces", most)
        window = cameras.window(view, height)
        with self._turns.drawing, self._compiling(what):
            if model.config.splats is not None:
                image = layers.draw_splats(model, layer, window)
            else:
                image = layers.draw(
                    model,
                    layer,
                    window.rays,
                    chunk=chunk,
                    most=most,
                    cancelled=lambda: self._stale(job),
                )
        if image is not None:
            self._say(_sized(image, job.stage + 1, len(self._subject.heights)))
        return image

    def _draw_error(self, job: Job, view: Viewpoint, model: Any, most: int) -> Image | None:
        """Moves to the nearest test view and draws its error, with bars at the sides."""
        frames = self._subject.frames
        centre = self._subject.model.config.centre
        i = cameras.nearest(view.pose, frames.cameras, centre=centre)
        fov = cameras.containing_fov(frames.cameras, view.aspect)
        self._go_to(Viewpoint(frames.cameras.poses[i], fov, view.aspect))
        pixels = layers.view_pixels(frames, i, most)
        with self._turns.drawing, self._compiling(("image", model.settings)):
            drawn = layers.draw_error(
                model, pixels, chunk=self._subject.chunk, cancelled=lambda: self._stale(job)
            )
        if drawn is None:
            return None
        image, error = drawn
        decibels = -20.0 * math.log10(error) if error else math.inf
        name = frames.names[i]
        self._say(
            f"test view **{name}**: {decibels:.1f} dB, errors x {layers.GAIN:g}. "
            + _sized(image, job.stage + 1, len(self._subject.heights))
        )
        return cameras.letterbox(image, view.aspect)

    def _go_to(self, view: Viewpoint) -> None:
        """Moves the browser's camera, which does not count as a change.

        Browsers keep the horizon level, and report another pose if the view's is tilted. That pose
        is not corrected again, to avoid an endless loop.
        """
        with self._event:
            if cameras.is_same(view, self._view, within=_NEAR):
                return
            self._view = view
        wxyz, position = cameras.to_browser(view.pose)
        with self._client.atomic():
            self._client.camera.position = position
            self._client.camera.wxyz = wxyz
            self._client.camera.fov = view.fov

    def _click(self, event: viser.SceneClickEvent) -> None:
        """Draws the light paths of the clicked pixel."""
        model = session.chosen_model(self._subject, self._panel.choice())
        direction = np.asarray(event.ray_direction)
        ray = Rays(np.asarray(event.ray_origin), direction / np.linalg.norm(direction), 1e-3)
        with self._turns.tracing, self._compiling(("pixel", model.settings)):
            paths = pixel_paths.trace_pixel(model, ray)
        self._scenery.show_paths(pixel_paths.pieces(paths))
        self._panel.show_table(pixel_paths.describe(paths))

    def _say(self, text: str) -> None:
        if not self._closed:
            self._panel.say(text)

    def _stale(self, job: Job) -> bool:
        with self._event:
            return self._closed or session.is_stale(self._state, job)

    @contextlib.contextmanager
    def _compiling(self, what: Any) -> Iterator[None]:
        """Notifies the user while something is compiled for the first time."""
        if what in self._turns.compiled:
            yield
            return
        notice = self._client.add_notification(
            "Compiling", "Once for these settings.", loading=True, with_close_button=False
        )
        try:
            yield
            self._turns.compiled.add(what)
        finally:
            if not self._closed:
                notice.remove()


def _sized(image: Image, stage: int, stages: int) -> str:
    height, width, _ = image.shape
    return f"{width} x {height} pixels, size {stage} of {stages}"
