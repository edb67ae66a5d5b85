"""Headless Chromium, steered through its DevTools protocol: opens a page, looks, clicks."""

import base64
import contextlib
import io
import itertools
import json
import os
import shutil
import subprocess
import time
import urllib.request

import imageio.v3 as iio
from websockets.sync.client import connect

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)

_PATIENCE = 300.0


class Page:
    """One page of a browser."""

    def __init__(self, socket):
        self._socket, self._numbers = socket, itertools.count(1)
        self.complaints = []

    def send(self, method, **parameters):
        """Sends a command and returns its result; the page's complaints are kept meanwhile."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=_PATIENCE))
            if answer.get("method") == "Runtime.exceptionThrown":
                self.complaints.append(answer["params"]["exceptionDetails"]["text"])
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]

    def evaluate(self, expression):
        """Returns the value of a JavaScript expression; `None` for none."""
        answer = self.send("Runtime.evaluate", expression=expression, returnByValue=True)
        return answer["result"].get("value")

    def text(self):
        """Returns what the page says."""
        return self.evaluate("document.body?.innerText") or ""

    def wait_for(self, words, *, patience=600.0):
        """Waits until the page says something; programs are compiled on the way."""
        until(lambda: words in self.text(), words, patience=patience)

    def screenshot(self):
        """Returns what the page looks like, `[h, w, 3]` of 8 bits."""
        data = self.send("Page.captureScreenshot", format="png")["data"]
        return iio.imread(io.BytesIO(base64.b64decode(data)), plugin="pillow", mode="RGB")

    def click(self, x, y):
        """Presses and releases the mouse."""
        at = {"x": x, "y": y, "button": "left", "clickCount": 1}
        self.send("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        self.send("Input.dispatchMouseEvent", type="mousePressed", **at)
        self.send("Input.dispatchMouseEvent", type="mouseReleased", **at)

    def drag(self, start, end, *, steps=10):
        """Moves the mouse with its button held."""
        x, y = start
        self.send("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        held = {"button": "left", "buttons": 1, "clickCount": 1}
        self.send("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, **held)
        for i in range(1, steps + 1):
            x, y = (a + (b - a) * i / steps for a, b in zip(start, end, strict=True))
            self.send("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y, **held)
        self.send("Input.dispatchMouseEvent", type="mouseReleased", x=x, y=y, button="left")


@contextlib.contextmanager
def opened(address, folder, *, size=(1200, 675)):
    """Opens a page, which may reach this machine alone."""
    words = [
        CHROMIUM,
        "--headless=new",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--disable-background-networking",
        "--no-first-run",
        f"--window-size={size[0]},{size[1]}",
        "--proxy-server=127.0.0.1:9",
        "--proxy-bypass-list=127.0.0.1",
        "--remote-debugging-port=0",
        f"--user-data-dir={folder}",
        "about:blank",
    ]
    if os.geteuid() == 0:
        words.insert(1, "--no-sandbox")  # Chromium's sandbox refuses root
    quiet = subprocess.DEVNULL
    process = subprocess.Popen(words, stdin=quiet, stdout=quiet, stderr=quiet)
    try:
        port = until(lambda: _port(folder), "Chromium has started")
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list") as answer:
            target = next(each for each in json.load(answer) if each["type"] == "page")
        with connect(target["webSocketDebuggerUrl"], max_size=2**26) as socket:
            page = Page(socket)
            page.send("Runtime.enable")
            page.send("Page.enable")
            width, height = size
            page.send(
                "Emulation.setDeviceMetricsOverride",
                width=width,
                height=height,
                deviceScaleFactor=1,
                mobile=False,
            )
            page.send("Page.navigate", url=address)
            yield page
    finally:
        process.terminate()
        process.wait(timeout=_PATIENCE)


def until(look, what, *, patience=_PATIENCE):
    """Looks again and again, and returns what was found."""
    end = time.monotonic() + patience
    while time.monotonic() < end:
        if found := look():
            return found
        time.sleep(0.2)
    raise AssertionError(f"{what}: not within {patience:g} s")


def _port(folder):
    path = folder / "DevToolsActivePort"
    return path.read_text().split("\n")[0] if path.exists() and path.read_text() else None
