"""Writes the report of a benchmark as one HTML file that needs nothing else.

No server, no network: the style, the script and all pictures are in it, and a browser is told to
load nothing from anywhere. Its pages are told apart by the address' end, as #scene/NAME/VIEW.
"""

from pathlib import Path

from experiments.benchmarking.report import data, overview, scene_pages
from experiments.benchmarking.report.data import Contents, Scene
from experiments.benchmarking.report.markup import Html, join, tag
from experiments.benchmarking.report.scene_pages import Page
from experiments.cli import commands
from experiments.figures.style import COLOURS
from refref_jax import drafts

FILE = "report.html"

# Beyond, a report shows fewer views of each scene than it is asked to, though never none: of about
# 5 KiB each at 200 pixels, so many are 20 MiB.
_MOST_PICTURES = 3000

_NOTHING_FROM_OUTSIDE = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
)

_ASSETS = Path(__file__).parent


def write(out: Path, *, views: int, edge: int) -> Path:
    """Writes the report of a benchmark, all or nothing.

    Args:
      out: folder of the benchmark, with its results.json.
      views: of each scene to show.
      edge: longest edge of a picture in pixels; smaller ones stay as they are.

    Returns:
      The file.

    Raises:
      ValueError: if there are no results, or they are broken.
    """
    everything = data.read(out)
    count = shown_views(everything.scenes, views)
    pages: dict[str, Page] = {}
    with commands.ProgressBar("report", len(everything.scenes)) as bar:
        for i, scene in enumerate(everything.scenes):
            chosen = data.choose_views(scene, count)
            pages[scene.name] = scene_pages.show(out, scene, chosen, edge=edge, prefix=f"s{i}")
            bar.show(i + 1, scene.name)
    body = [
        tag("h1", "Benchmark"),
        overview.show(
            everything,
            _introduction(everything, count, edge),
            {name: page.places for name, page in pages.items()},
        ),
        *(page.html for page in pages.values()),
    ]
    path = out / FILE
    with drafts.unfinished_file(path) as draft:
        draft.write_text(_document("Benchmark", join(body)), encoding="utf-8")
    return path


def shown_views(scenes: tuple[Scene, ...], asked: int) -> int:
    """Returns how many views of each scene a report shows, so that it does not grow too large."""
    of_one = sum(3 * (len(scene.results) + 1) for scene in scenes)
    return max(1, min(asked, _MOST_PICTURES // max(1, of_one)))


def _introduction(everything: Contents, count: int, edge: int) -> str:
    results = sum(len(scene.results) for scene in everything.scenes)
    views = max((len(data.view_names(scene)) for scene in everything.scenes), default=0)
    preset, steps = everything.settings.preset, everything.settings.steps
    return (
        f"Results: {results}, scenes: {len(everything.scenes)}; preset {preset}, {steps} steps. "
        f"Pictures: {min(count, views)} of at most {views} test views of a scene, three in five "
        "where methods fail most and the others spread evenly. They are compressed, and reduced "
        f"where they have more than {edge} pixels an edge; all numbers are of the originals."
    )


def _document(title: str, body: Html) -> str:
    colours = ";".join(f"--c{i}:{colour}" for i, colour in enumerate(COLOURS))
    style = f":root{{{colours}}}\n{(_ASSETS / 'report.css').read_text('utf-8')}"
    script = (_ASSETS / "report.js").read_text("utf-8")
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", http_equiv="Content-Security-Policy", content=_NOTHING_FROM_OUTSIDE),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="color-scheme", content="light dark"),
        tag("title", title),
        tag("style", Html(style)),
    )
    page = tag("body", tag("main", body), tag("script", Html(script)))
    return f"<!doctype html>\n{tag('html', head, page, lang='en')}\n"
