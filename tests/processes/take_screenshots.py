"""Takes the pictures of docs/viewer.md, of a viewer that runs.

    python -m experiments.view --run=runs/demo --heights=36,180,540
    python -m tests.processes.take_screenshots http://127.0.0.1:8080 docs

`viewer_rgb.jpg` is the page as it opens; `viewer_paths.jpg` after a click on the body and a turn of
the camera, so that the paths are seen from beside.
"""

import sys
import tempfile
import time
from pathlib import Path

import imageio.v3 as iio

from tests.processes import browser

_SIZE = (1280, 720)

# On the bundled ball, left of its middle; and a turn, begun beside it.
_CLICK = (540, 300)
_TURN = ((200, 600), (480, 560))

# Tells that the browser draws without a GPU, which headless ones do.
_CLOSE_NOTICE = "document.querySelector('[class*=Notification-closeButton]')?.click()"


def main(address: str, out: str) -> None:
    """Opens the page, and keeps it twice."""
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile,
        browser.opened(address, Path(profile), size=_SIZE) as page,
    ):
        page.wait_for("size 3 of 3")
        page.evaluate(_CLOSE_NOTICE)
        time.sleep(1.0)  # it fades
        _keep(page, Path(out) / "viewer_rgb.jpg")
        page.click(*_CLICK)
        page.wait_for("left the objects")
        page.drag(*_TURN)
        browser.until(lambda: "size 3 of 3" not in page.text(), "a new picture is begun")
        page.wait_for("size 3 of 3")
        _keep(page, Path(out) / "viewer_paths.jpg")


def _keep(page: browser.Page, path: Path) -> None:
    iio.imwrite(path, page.screenshot(), quality=88)
    print(path)


if __name__ == "__main__":
    main(*sys.argv[1:])
