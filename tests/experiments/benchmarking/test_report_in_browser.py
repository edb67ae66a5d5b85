"""The report in headless Chromium, without a network: pages, slider and filter do what they say."""

import json
import os
import re
import shutil
import subprocess
from html import unescape

import pytest

from experiments.benchmarking.report import page
from tests.factories.made_benchmark import write_benchmark

_CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(_CHROMIUM is None, reason="there is no Chromium"),
]

_ODD = "a'b\"c <i>&amp;%2F#"
_SCENES = ("cube_smcvx_ball", _ODD)

# Does what a user does, and writes what came of it into the page. The browser's errors are caught
# from the first line of the page's own script on.
_LISTEN = """<script>
window.wrong = [];
addEventListener("error", (event) => wrong.push(String(event.message)), true);
addEventListener("securitypolicyviolation", (event) => wrong.push(event.violatedDirective));
</script>"""
_ACT = """<script>
const found = {};
const shown = () => [...document.querySelectorAll("section.scene")].find((each) => !each.hidden);
const look = () => {
  const slider = shown().querySelector(".slider");
  const over = slider.querySelector(".over"), under = slider.querySelector(".under");
  return {
    scene: shown().dataset.scene,
    view: shown().querySelector("article:not([hidden])").dataset.view,
    clip: getComputedStyle(over).clipPath,
    left: over.alt, right: under.alt,
    visible: !slider.hidden && over.naturalWidth > 0 && under.naturalWidth > 0,
    differ: over.src !== under.src,
    overview: document.getElementById("overview").hidden,
  };
};
const wait = () => new Promise((done) => setTimeout(done, 100));
const change = (element, value, kind) => {
  element.value = value;
  element.dispatchEvent(new Event(kind, { bubbles: true }));
};
(async () => {
  await wait();
  found.first = shown() === undefined && !document.getElementById("overview").hidden;
  const failing = document.getElementById("failing");
  change(failing, "tree", "change");
  found.cases = [...document.querySelectorAll(".cases li")].filter((row) => !row.hidden)
    .map((row) => row.dataset.method);
  found.thumbnails = [...document.querySelectorAll("img[data-copy]")]
    .every((image) => image.naturalWidth > 0);
  for (const [name, address] of Object.entries(ADDRESSES)) {
    location.hash = address;
    await wait();
    found[name] = look();
  }
  const slider = shown().querySelector(".slider");
  change(slider.querySelector("input"), "20", "input");
  found.moved = look();
  change(slider.querySelector("select.left"), "straight", "change");
  found.changed = look();
  const box = slider.querySelector(".wipe").getBoundingClientRect();
  const wipe = slider.querySelector(".wipe");
  wipe.setPointerCapture = () => { wipe.hasPointerCapture = () => true; };
  const at = { pointerId: 1, clientX: box.left + 0.75 * box.width, clientY: box.top + 5 };
  wipe.dispatchEvent(new PointerEvent("pointerdown", at));
  found.dragged = look();
  location.hash = "#scenes";
  await wait();
  found.back = shown() === undefined;
  found.wide = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  found.wrong = wrong;
  const place = document.createElement("pre");
  place.id = "found";
  place.textContent = JSON.stringify(found);
  document.body.append(place);
})();
</script>"""


def _opened(tmp_path, html):
    """Opens a page with no network, and returns the page as it is then, and all complaints."""
    path = tmp_path / "page.html"
    path.write_text(html, encoding="utf-8")
    words = [
        _CHROMIUM,
        "--headless=new",
        "--disable-gpu",
        "--disable-background-networking",
        "--proxy-server=127.0.0.1:9",
        "--enable-logging=stderr",
        "--window-size=360,800",
        "--virtual-time-budget=20000",
        f"--user-data-dir={tmp_path / 'profile'}",
        "--dump-dom",
        path.as_uri(),
    ]
    if os.geteuid() == 0:
        words.insert(1, "--no-sandbox")  # Chromium's sandbox refuses root
    result = subprocess.run(words, capture_output=True, text=True, timeout=300, check=True)
    return result.stdout, [line for line in result.stderr.splitlines() if "CONSOLE" in line]


def test_the_slider_moves_and_the_pages_change(tmp_path):
    out = write_benchmark(tmp_path, _SCENES)
    html = page.write(out, views=3, edge=200).read_text("utf-8")
    addresses = {
        "ball": page.address(_SCENES[0]),
        "odd": page.address(_ODD, "r_1"),
    }
    act = _ACT.replace("ADDRESSES", json.dumps(addresses))
    html = html.replace("<title>", _LISTEN + "<title>", 1).replace("</body>", act + "</body>")
    dom, complaints = _opened(tmp_path, html)
    found = json.loads(unescape(re.search(r'<pre id="found">(.*?)</pre>', dom, re.DOTALL)[1]))
    assert complaints == [] and found["wrong"] == []
    assert found["first"] and found["thumbnails"] and set(found["cases"]) == {"tree"}
    ball, odd = found["ball"], found["odd"]
    assert (ball["scene"], ball["view"], ball["overview"]) == (_SCENES[0], "r_0", True)
    assert (odd["scene"], odd["view"]) == (_ODD, "r_1")
    assert odd["visible"] and odd["differ"] and "50%" in odd["clip"]
    assert "ground truth" in odd["left"] and "tree" in odd["right"] and "r_1" in odd["left"]
    assert "80%" in found["moved"]["clip"]  # a fifth of the left picture is left
    assert (
        "straight" in found["changed"]["left"]
        and found["changed"]["clip"] == (found["moved"]["clip"])
    )
    assert "25%" in found["dragged"]["clip"]
    assert found["back"] and found["wide"] == 0
